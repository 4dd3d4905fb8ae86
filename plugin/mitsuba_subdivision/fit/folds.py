"""Faces of a fitted cage that fold over onto their neighbours, as a term to be kept small."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from ..cage import ControlCage
from ..device_arrays import upload
from ..mesh.connectivity import IntArray, Topology

# Faces count from this cosine between their normals on, 107 degrees. Where a part is about to grow, those on both sides
# of its end turn by a right angle and more.
LEAST_COSINE = -0.3


def folds(cage: ControlCage) -> Callable[[dr.ArrayBase], mi.Float]:
    """Penalty of folds between neighbouring faces: a function of control points, flat x, y, z, differentiable by them.

    The mean over edges between two faces of ``max(0, -0.3 - cos a)^2``, where a is the angle between normals: between
    those of the two quadrilaterals, or triangles, that the edge makes with the next vertices around each face.
    """
    t = cage.topology
    half_edges = np.flatnonzero(t.twin > np.arange(t.half_edge_count))
    sides = [_quadrilaterals(t, each) for each in (half_edges, t.twin[half_edges])]

    def energy(points: dr.ArrayBase) -> mi.Float:
        if not len(half_edges):
            return mi.Float(0)
        cosine: Any = dr.dot(*(_normals(points, side) for side in sides))
        return dr.sum(dr.square(dr.maximum(LEAST_COSINE - cosine, 0))) / len(half_edges)

    return energy


def _quadrilaterals(t: Topology, half_edges: IntArray) -> list[mi.UInt32]:
    """Vertices of a face around its edge: one before it, the ends, and one after it, which may be the first one."""
    corners = t.prev[half_edges], half_edges, t.next[half_edges], t.next[t.next[half_edges]]
    return [upload(mi.UInt32, t.face_vertices[each]) for each in corners]


def _normals(points: dr.ArrayBase, corners: list[mi.UInt32]) -> mi.Normal3f:
    before, start, end, after = (dr.gather(mi.Point3f, points, each) for each in corners)
    normal = dr.cross(end - before, after - start)
    return normal * dr.rsqrt(dr.maximum(dr.squared_norm(normal), dr.smallest(mi.Float)))
