"""Where two meshes of the same faces, numbered alike, are not refined alike."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from .connectivity import Topology

# Chaikin's method takes means of a few numbers below ten, whose order may differ.
ROUNDED = 1e-13
DECIMALS = 12


@dataclass(frozen=True, eq=False)
class Differences:
    """Half-edges at which two meshes differ, the expected one and the one that was found.

    Attributes
    ----------
    is_joined, is_torn : (n_h,) bool
        Whether a half-edge has a twin that is not expected, and whether it lacks the one that is.
    has_other_rule : (n_h,) bool
        Whether the vertex at its beginning has another `VertexRule`.
    is_sharper : (n_h,) bool
        Whether semi-sharpness of its edge, or at the vertex at its beginning, is another one.
    """

    is_joined: NDArray[np.bool_]
    is_torn: NDArray[np.bool_]
    has_other_rule: NDArray[np.bool_]
    is_sharper: NDArray[np.bool_]


def differences(expected: Topology, found: Topology) -> Differences:
    """Compare two meshes, half-edge by half-edge. Without differences refinement does the same to both."""
    is_other = expected.twin != found.twin
    of_expected, of_found = _sharpness(expected), _sharpness(found)
    return Differences(
        is_other & (found.twin >= 0),
        is_other & (expected.twin >= 0),
        expected.vertex_rules[expected.face_vertices] != found.vertex_rules[found.face_vertices],
        (np.abs(of_expected - of_found) > ROUNDED).any(axis=0) | _differs_beyond(expected, found),
    )


def _sharpness(t: Topology) -> NDArray[np.float64]:
    """``(3, n_h)`` of each half-edge's edge, what is left of it, and of the vertex at its beginning."""
    semi = t.semi_sharpness
    if semi is None:
        return np.zeros((3, t.half_edge_count))
    return np.stack([semi.edges, semi.edges_left, semi.vertices[t.face_vertices]])


def _differs_beyond(expected: Topology, found: Topology) -> NDArray[np.bool_]:
    """``(n_h,)`` whether the vertex at the beginning of each half-edge has other semi-sharp edges beyond cuts."""
    one, other = _rows_beyond(expected), _rows_beyond(found)
    rows, which = np.unique(np.concatenate([one, other]), axis=0, return_inverse=True)
    surplus = np.bincount(which.ravel(), np.repeat([1, -1], [len(one), len(other)]), minlength=len(rows))
    at = rows[surplus != 0, 0].astype(np.int64)
    return np.isin(expected.face_vertices, expected.face_vertices[at])


def _rows_beyond(t: Topology) -> NDArray[np.float64]:
    """``(n, 4)``: the lowest half-edge of the vertex, sharpness, what is left of it, whether it sharpens the vertex.

    Edges that do not sharpen a vertex take part in means only. They are left out where nothing has a mean.
    """
    semi = t.semi_sharpness
    if semi is None:
        return np.empty((0, 4))
    beyond = semi.beyond
    has_means = np.zeros(t.vertex_count, dtype=bool)
    has_means[t.face_vertices[semi.edges > 0]] = True
    has_means[beyond.vertex[beyond.sharpens]] = True
    lowest, sharpens = t.vertex_half_edge[beyond.vertex].astype(np.float64), beyond.sharpens.astype(np.float64)
    rows = np.stack([lowest, beyond.sharpness, semi.beyond_left, sharpens], axis=1)[has_means[beyond.vertex]]
    return np.asarray(np.round(rows, DECIMALS), dtype=np.float64)
