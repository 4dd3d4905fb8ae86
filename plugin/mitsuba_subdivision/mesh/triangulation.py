"""Triangles of the polygons of a mesh."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from . import ragged
from .ragged import IntArray

# Part of its polygon's area, by which rounding turns back the triangle of collinear corners.
COLLINEAR = 1e-9


def triangle_corners(
    positions: NDArray[np.floating],  # (n_v, 3)
    face_sizes: IntArray,  # (n_f,)
    face_vertices: IntArray,  # (n_h,)
) -> tuple[IntArray, IntArray]:
    """Return corners ``(n, 3)`` of triangles of polygons, 0-based in ``face_vertices``, and the face of each, in order.

    Most polygons become a fan at their first corner. Where that would leave the polygon, as at a notch or at a cut to
    a hole, quadrilaterals are split at the other diagonal, and larger polygons are clipped ear by ear in their mean
    plane. Triangles have the orientation of their polygon. Polygons without a mean plane become fans.
    """
    counts = np.maximum(face_sizes - 2, 0)
    first, face = ragged.starts(face_sizes), np.repeat(np.arange(len(face_sizes)), counts)
    second = ragged.ranges(first + 1, counts)
    corners = np.stack([first[face], second, second + 1], axis=1)
    points = np.asarray(positions, dtype=np.float64)[face_vertices]
    fails = np.flatnonzero(~_are_fans(points[corners], face, len(face_sizes)) & (face_sizes > 3))
    if not len(fails):
        return corners, face
    kept = ~np.isin(face, fails)
    quads, larger = fails[face_sizes[fails] == 4], fails[face_sizes[fails] > 4]
    clipped = [_clipped(points[first[f] : first[f] + face_sizes[f]]) + first[f] for f in larger]
    turned = (first[quads, None] + np.array([1, 2, 3, 1, 3, 0])).reshape(-1, 3)
    corners = np.concatenate([corners[kept], turned, *clipped])
    face = np.concatenate([face[kept], np.repeat(quads, 2), np.repeat(larger, [len(part) for part in clipped])])
    order = np.argsort(face, kind="stable")
    return corners[order], face[order]


def _are_fans(triangles: NDArray[np.float64], face: IntArray, face_count: int) -> NDArray[np.bool_]:
    """``(n_f,)`` whether fans ``(n, 3, 3)`` cover their polygons: none turns back, and all is less than a full turn."""
    a, b = (triangles[:, corner] - triangles[:, 0] for corner in (1, 2))
    normal = np.cross(a, b)
    of_face = np.stack([np.bincount(face, column, face_count) for column in normal.T], axis=1)[face]
    along, size = (normal * of_face).sum(axis=1), (of_face * of_face).sum(axis=1)
    angle = np.arctan2(np.linalg.norm(normal, axis=1), (a * b).sum(axis=1))
    turns_back = np.bincount(face, along < -COLLINEAR * size, face_count) > 0
    return ~turns_back & (np.bincount(face, angle, face_count) < 2 * np.pi)


def _clipped(polygon: NDArray[np.float64]) -> IntArray:
    """Corners of the triangles of a polygon ``(n, 3)`` in its mean plane."""
    from mapbox_earcut import triangulate_float64

    offsets = polygon - polygon.mean(axis=0)
    normal = np.cross(offsets, np.roll(offsets, -1, axis=0)).sum(axis=0)
    # The two coordinates of the plane that the normal is farthest from, in an order that keeps the orientation.
    axis = int(np.abs(normal).argmax())
    plane = offsets[:, [(axis + 1) % 3, (axis + 2) % 3]]
    triangles: IntArray = triangulate_float64(plane, np.array([len(plane)], np.uint32)).reshape(-1, 3).astype(np.int64)
    (ax, ay), (bx, by) = (np.moveaxis(plane[triangles[:, i]] - plane[triangles[:, 0]], 1, 0) for i in (1, 2))
    is_turned = (ax * by - ay * bx) * normal[axis] < 0
    return np.where(is_turned[:, None], triangles[:, ::-1], triangles)
