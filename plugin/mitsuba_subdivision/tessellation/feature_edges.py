"""Feature edges: along which the surface ends, or folds, so that curves hold to the limit by themselves."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ..mesh.connectivity import IntArray
from ..patches import PatchTable
from ..schemes.domain import FloatArray
from .cones import dot
from .criterion import Criterion, Measure
from .patch_frames import PatchFrames

# Cosine of the angle by which elements beside a fold differ in their normals, at most.
FOLDED = -0.1


def feature_edges(
    patches: PatchTable, frames: PatchFrames, points: FloatArray, criterion: Criterion
) -> NDArray[np.bool_]:
    """``(n_h,)`` the half-edges along which curves hold to the limit by themselves.

    On open borders and folds, surfaces may be flat and end along curves all the same. Elsewhere the surface on one side
    of an edge holds the other, unless it may be coarse there.

    Parameters
    ----------
    points : (n_v, 3) float64
        At the vertices of the mesh.
    """
    t, names = frames.topology, frames.edge
    if criterion.measure is Measure.EDGE:
        return np.zeros(t.half_edge_count, dtype=bool)
    # Of the elements beside each edge.
    squares = sum(np.square(np.bincount(names, x.take(t.face))) for x in _normals(patches, points))
    is_fold = (np.bincount(names) != 2) | (squares < 2 + 2 * FOLDED)
    return is_fold[names] | ((t.twin < 0) & (criterion.outline is not None))


def _normals(patches: PatchTable, points: FloatArray) -> FloatArray:
    """``(3, n_e)`` about which way elements face: unit vectors, or zero."""
    t = patches.topology
    found: FloatArray = np.empty((3, t.face_count))
    for axis in range(3):
        # Of each half-edge's ends, along the two other axes.
        y, z = (points[:, (axis + step) % 3].take(t.face_vertices) for step in (1, 2))
        found[axis] = np.bincount(t.face, y * z.take(t.next) - z * y.take(t.next), t.face_count)
    if patches.scheme.element == "vertex":
        of_corner, t = found[:, t.face_of(patches.half_edge_of_corner)], patches.elements
        found = np.stack([np.bincount(t.face, x, t.face_count) for x in of_corner])
    length: FloatArray = np.sqrt(dot(found, found))
    return found / np.where(length > 0, length, 1)


def sides_on(edges: NDArray[np.bool_], frames: PatchFrames, corners: IntArray) -> NDArray[np.bool_]:
    """``(p, m)`` which sides of the patches that begin at these corners lie on some edges, ``(n_h,)``."""
    t, m = frames.topology, frames.domain.corner_count
    is_whole = frames.is_whole[t.face_of(corners)]
    found = np.zeros((len(corners), m), dtype=bool)
    half_edge = corners
    for side in range(m):
        found[:, side] = is_whole & edges[half_edge]
        half_edge = t.following(half_edge)
    # Patches at corners have half an edge on their first and their last side.
    found[:, 0] |= edges[corners]
    found[:, -1] |= ~is_whole & edges[t.preceding(corners)]
    return found
