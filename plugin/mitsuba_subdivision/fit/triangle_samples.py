"""Random points on meshes of triangles."""

from __future__ import annotations

import numpy as np

from ..mesh.connectivity import IntArray
from ..schemes.domain import FloatArray


def triangle_samples(positions: FloatArray, triangles: IntArray, count: int, seed: int) -> tuple[IntArray, FloatArray]:
    """Locations uniform by area.

    Parameters
    ----------
    positions : (n, 3) array
    triangles : (m, 3) int array
        0-based; some of them have an area.
    count : int
    seed : int

    Returns
    -------
    triangle : (count,) int64
        0-based.
    weights : (count, 3) float64
        Of its three vertices; not negative, and their sum is one.
    """
    rng = np.random.default_rng(seed)
    a, b, c = positions[triangles].swapaxes(0, 1)
    areas = np.linalg.norm(np.cross(b - a, c - a), axis=1)
    return rng.choice(len(areas), count, p=areas / areas.sum()), rng.dirichlet(np.ones(3), count)
