"""A cage whose surface is that of a dense mesh."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from ..cage import ControlCage
from ..mesh.connectivity import IntArray
from ..schemes.domain import FloatArray
from .point_fit import PointFit

# Points on the mesh for each control point that the fit ends with, by default.
POINTS_PER_CONTROL_POINT = 8


def to_mesh(
    cage: ControlCage,
    positions: ArrayLike,
    triangles: ArrayLike,
    *,
    steps: int = 40,
    count: int | None = None,
    seed: int = 0,
    **options: Any,
) -> ControlCage:
    """Fit a cage to a mesh of triangles: from a scan or a sculpt to a few control points.

    Parameters
    ----------
    cage : ControlCage
        Where to begin, near the mesh.
    positions : (n, 3) array
    triangles : (m, 3) int array
        0-based, counter-clockwise from outside.
    steps : int
        Of `PointFit`.
    count : int, optional
        Points on the mesh, uniform by area; by default eight for each control point in the end.
    seed : int
    **options
        Of `PointFit`, such as ``refine``.

    Raises
    ------
    ValueError
        If the mesh is malformed or has no area, or as `PointFit`.
    CageError, SchemeError
        As `PointFit`.
    """
    refine = options.get("refine", ())
    if count is None:
        refinements = refine if isinstance(refine, int) else len(refine)
        count = POINTS_PER_CONTROL_POINT * cage.vertex_count * 4**refinements
    points, normals = _samples(np.asarray(positions, dtype=np.float64), np.asarray(triangles), count, seed)
    return PointFit(cage, points, normals, seed=seed, **options).run(steps).cage


def _samples(positions: np.ndarray, triangles: np.ndarray, count: int, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Points on triangles, uniform by area, and their normals."""
    if positions.ndim != 2 or positions.shape[1] != 3:
        raise ValueError(f"positions of the shape {positions.shape}; expected (n, 3)")
    if triangles.ndim != 2 or triangles.shape[1] != 3 or not np.issubdtype(triangles.dtype, np.integer):
        found = f"triangles of the shape {triangles.shape} and type {triangles.dtype}"
        raise ValueError(f"{found}; expected (m, 3) integers")
    if len(triangles) and (triangles.min() < 0 or triangles.max() >= len(positions)):
        row = int(np.flatnonzero(((triangles < 0) | (triangles >= len(positions))).any(axis=1))[0])
        expected = f"expected vertices from 0 to {len(positions) - 1}"
        raise ValueError(f"triangle {row} is {triangles[row].tolist()}; {expected}")
    a, b, c = positions[triangles].swapaxes(0, 1)
    normals = np.cross(b - a, c - a)
    doubled = np.linalg.norm(normals, axis=1)
    if not doubled.sum() > 0:
        raise ValueError("the mesh has no area; expected triangles")
    chosen, weights = triangle_samples(positions, triangles, count, seed)
    points = (positions[triangles[chosen]] * weights[:, :, None]).sum(axis=1)
    return points, normals[chosen] / doubled[chosen, None]


def triangle_samples(
    positions: FloatArray,  # (n, 3)
    triangles: IntArray,  # (m, 3): 0-based; some of them have an area
    count: int,
    seed: int,
) -> tuple[IntArray, FloatArray]:
    """Locations uniform by area.

    Returns 0-based triangles ``(count,)`` int64, and weights ``(count, 3)`` float64 of their three vertices; these are
    not negative, and their sum is one.
    """
    rng = np.random.default_rng(seed)
    a, b, c = positions[triangles].swapaxes(0, 1)
    areas = np.linalg.norm(np.cross(b - a, c - a), axis=1)
    return rng.choice(len(areas), count, p=areas / areas.sum()), rng.dirichlet(np.ones(3), count)
