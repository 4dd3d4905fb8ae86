"""Finds the tiles that one pair of triangles, or one triangle, approximates within the limit."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..evaluation.bernstein import times
from ..evaluation.divided_tile import DividedTile
from ..mesh.connectivity import IntArray
from ..mesh.one_ring import one_ring
from ..schemes.domain import FloatArray
from .cones import NormalCone, cross, dot
from .criterion import Measure
from .tile_rates import TileRates, axis_across
from .tiles import Tiles

# Relative area of triangles that rounding may flip.
FOLDED = 1e-6
# Tiles whose hulls are made together, which bounds temporary memory to some megabytes.
TILES_TOGETHER = 1 << 10


class TileParts(NamedTuple):
    """Tiles that are divided alike."""

    tile: DividedTile
    values: FloatArray  # (K, 3, p) float64: control points
    owner: IntArray  # (p,) int64: the tile that each is

    def chosen(self, which: NDArray[np.bool_]) -> TileParts:
        """Some of them."""
        if which.all():
            return self
        chosen = np.flatnonzero(which)
        return self._replace(values=self.values.take(chosen, axis=2), owner=self.owner[chosen])


def are_flat(rates: TileRates, tiles: Tiles, groups: list[TileParts]) -> NDArray[np.bool_]:
    """``(t,)`` whether one pair of triangles is near enough to the surface over each tile, and along feature edges."""
    corners = np.empty((rates.domain.corner_count, 3, len(tiles)))
    lower, upper = np.empty((2, 3, len(tiles)))
    for own, points, at in groups:
        corners[..., at] = times(own.corners, points)
        ring = own.one_ring_points(points)
        lower[:, at], upper[:, at] = ring.min(axis=0), ring.max(axis=0)
    limit = rates.limit(tiles, lower, upper, NormalCone.of_any(len(tiles)))
    # A tile that is folded, or has no normal, is tested by its size only.
    fits = (np.linalg.norm(upper - lower, axis=0) <= limit) & rates.scheme.has_convex_rules
    others = [each.chosen(~fits[each.owner]) for each in groups]
    if rates.criterion.measure is Measure.EDGE:
        return fits | (_extents(others, np.eye(3)[..., None] * np.ones(len(tiles))) <= limit)
    axis = axis_across(corners)
    extent = _extents(others, axis[None])
    found = fits | (axis.any(axis=0) & (extent <= limit))
    folded = _are_folded(groups, axis, found & ~fits)
    if folded.any():
        found &= ~folded | (_normal_sines(rates, groups, axis, folded) < 1)
    if rates.criterion.outline is not None:
        # A border may be a silhouette for any normals.
        cone = NormalCone(axis, _normal_sines(rates, groups, axis, ~(found | tiles.sides.any(axis=1))))
        found |= (cone.sine < 1) & (extent <= rates.limit(tiles, lower, upper, cone))
    return found & ~_have_curved_sides(tiles, groups, found & ~fits, corners, limit)


def _extents(groups: list[TileParts], axes: FloatArray) -> FloatArray:
    """``(t,)`` size of the surface over tiles along axes ``(d, 3, t)``, no less than it is; infinite if unknown."""
    found = np.full(axes.shape[2], np.inf)
    for tile, points, at in groups:
        if tile.hull is None:
            continue
        for begin in range(0, len(at), TILES_TOGETHER):
            run = slice(begin, begin + TILES_TOGETHER)
            along = [np.ptp(times(tile.hull, dot(points[..., run], axis[:, at[run]])), axis=0) for axis in axes]
            found[at[run]] = np.linalg.norm(along, axis=0)
    return found


def _are_folded(groups: list[TileParts], axis: FloatArray, are_asked: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """``(t,)`` whether control faces of some one-rings face opposite ways, seen along axes ``(3, t)``.

    Such a surface has silhouettes along its folds, and not only along edges of the cage. At a dart, where one vertex of
    the ring is left out as it equals another, so are its faces.
    """
    found = np.zeros(len(are_asked), dtype=bool)
    asked = np.flatnonzero(are_asked)
    across = np.empty((2, 3, len(are_asked)))
    across[..., asked] = _normals_to(axis[:, asked])
    for each in groups:
        tile, values, at = each.chosen(are_asked[each.owner])
        if not len(at):
            continue
        t, points = one_ring(tile.signature.smoothed).topology, tile.one_ring_points(values)
        # The diagonals of each face; of triangles, two sides.
        quarters = t.face_offsets[:-1] + np.arange(4)[:, None] * t.face_sizes // 4
        vertices = t.face_vertices[quarters]
        if tile.slots is not None:
            number = np.full(t.vertex_count, -1)
            number[tile.slots] = np.arange(len(tile.slots))
            vertices = number[vertices]
        a, b, c, d = vertices[:, (vertices >= 0).all(axis=0)]
        x, y = (dot(points, along) for along in across[..., at])
        areas = (x[c] - x[a]) * (y[d] - y[b]) - (y[c] - y[a]) * (x[d] - x[b])
        found[at] = areas.min(axis=0) < -FOLDED * areas.max(axis=0)
    return found


def _normal_sines(
    rates: TileRates, groups: list[TileParts], axis: FloatArray, are_asked: NDArray[np.bool_]
) -> FloatArray:
    """``(t,)`` sines of half the angles of cones about axes ``(3, t)`` that contain all normals of some tiles.

    One where normals are unknown, and for other tiles. Nearer to an extraordinary point than the pieces, normals turn
    less than on these.
    """
    found = np.ones(axis.shape[1])
    # Those of all tiles together, as tiles of many kinds are few of each.
    owners, coefficients = [], []
    for each in groups:
        pieces, on = each.tile.pieces, are_asked[each.owner]
        if pieces is not None and on.any():
            own = each.chosen(on)
            of_pieces = times(pieces.reshape(-1, pieces.shape[2]), own.values).reshape(*pieces.shape[:2], 3, -1)
            coefficients.append(of_pieces.transpose(1, 2, 0, 3).reshape(pieces.shape[1], 3, -1))
            owners.append(np.tile(own.owner, len(pieces)))
    if owners:
        owner = np.concatenate(owners)
        found[owner] = 0
        np.maximum.at(found, owner, rates.normal_sines(np.concatenate(coefficients, axis=2), axis[:, owner]))
    return found


def _have_curved_sides(
    tiles: Tiles,
    groups: list[TileParts],
    are_asked: NDArray[np.bool_],
    corners: FloatArray,
    limit: FloatArray,
) -> NDArray[np.bool_]:
    """``(t,)`` whether tiles with these corners have a feature edge that is no straight line within the limit."""
    found = np.zeros(len(tiles), dtype=bool)
    for side, (begin, end) in enumerate(zip(corners, np.roll(corners, -1, axis=0), strict=True)):
        on_side = are_asked & (tiles.sides[:, side] > 0)
        for each in groups if on_side.any() else ():
            own = each.chosen(on_side[each.owner])
            if not len(own.owner):
                continue
            hull, at = own.tile.side_hulls[side], own.owner
            if hull is None:
                found[at] = True
                continue
            curve = times(hull, own.values)
            extents = [np.ptp(dot(curve, across), axis=0) for across in _normals_to(end[:, at] - begin[:, at])]
            found[at] |= np.hypot(*extents) > limit[at]
    return found


def _normals_to(way: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Two unit vectors ``(3, t)`` orthogonal to each of some vectors and to each other; any two for zero vectors."""
    length = np.linalg.norm(way, axis=0)
    way = np.where(length > 0, way / np.where(length > 0, length, 1), np.array([[0.0], [0], [1]]))
    # Across the way and the axis that it is least along.
    first = cross(way, np.eye(3)[np.argmin(np.abs(way), axis=0)].T)
    first /= np.linalg.norm(first, axis=0)
    return first, cross(way, first)
