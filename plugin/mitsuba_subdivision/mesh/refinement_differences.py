"""Where two meshes of the same faces, numbered alike, are not refined alike."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from .connectivity import Topology

# Chaikin's method takes means of a few numbers below ten, whose order may differ.
MEAN_TOLERANCE = 1e-13
DECIMALS = 12

BoolArray = NDArray[np.bool_]


def differences(expected: Topology, found: Topology) -> tuple[BoolArray, BoolArray, BoolArray, BoolArray]:
    """Compare two meshes, half-edge by half-edge. Without differences refinement does the same to both.

    Returns
    -------
    is_joined, is_torn : (n_h,) bool
        Whether a half-edge of the found mesh has a twin that is not expected, and whether it lacks the expected one.
    has_other_rule : (n_h,) bool
        Whether the vertex at its beginning has another `VertexRule`.
    is_sharper : (n_h,) bool
        Whether semi-sharpness of its edge, or at the vertex at its beginning, is another one.
    """
    is_other = expected.twin != found.twin
    has_other_rule = expected.vertex_rules[expected.face_vertices] != found.vertex_rules[found.face_vertices]
    is_sharper = (np.abs(_sharpness(expected) - _sharpness(found)) > MEAN_TOLERANCE).any(axis=0)
    is_sharper |= _differs_across(expected, found)
    return is_other & (found.twin >= 0), is_other & (expected.twin >= 0), has_other_rule, is_sharper


def _sharpness(t: Topology) -> NDArray[np.float64]:
    """``(3, n_h)`` of each half-edge's edge, of its half after a refinement, and of the vertex at its beginning."""
    semi = t.semi_sharpness
    if semi is None:
        return np.zeros((3, t.half_edge_count))
    return np.stack([semi.edges, semi.edges_refined, semi.vertices[t.face_vertices]])


def _differs_across(expected: Topology, found: Topology) -> NDArray[np.bool_]:
    """``(n_h,)`` whether the vertex at the beginning of each half-edge has other semi-sharp edges across cuts."""
    one, other = _rows_across(expected), _rows_across(found)
    rows, which = np.unique(np.concatenate([one, other]), axis=0, return_inverse=True)
    surplus = np.bincount(which.ravel(), np.repeat([1, -1], [len(one), len(other)]), minlength=len(rows))
    at = rows[surplus != 0, 0].astype(np.int64)
    return np.isin(expected.face_vertices, expected.face_vertices[at])


def _rows_across(t: Topology) -> NDArray[np.float64]:
    """``(n, 4)`` edges across cuts: lowest half-edge of the vertex, sharpness, refined sharpness, whether it sharpens.

    Edges that do not sharpen a vertex take part in means only. They are left out where nothing has a mean.
    """
    semi = t.semi_sharpness
    if semi is None:
        return np.empty((0, 4))
    has_means = np.zeros(t.vertex_count, dtype=bool)
    has_means[t.face_vertices[semi.edges > 0]] = True
    has_means[semi.across_vertex[semi.across_sharpens]] = True
    lowest = t.vertex_half_edge[semi.across_vertex]
    rows = np.stack([lowest, semi.across_sharpness, semi.across_refined, semi.across_sharpens], axis=1)
    return np.asarray(np.round(rows[has_means[semi.across_vertex]], DECIMALS), dtype=np.float64)
