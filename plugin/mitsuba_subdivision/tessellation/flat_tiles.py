"""Finds the tiles that one pair of triangles, or one triangle, approximates within the limit."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..evaluation.bernstein import times
from ..mesh.connectivity import IntArray
from ..mesh.one_ring import one_ring
from ..mesh.signature import Signature
from ..schemes.domain import FloatArray
from .cones import NormalCone, cross, dot
from .criterion import Measure
from .tile_extents import TileParts, fit_within
from .tile_rates import TileRates, axis_across
from .tiles import Tiles

# Relative area of triangles that rounding may flip.
FOLDED = 1e-6


class PatchGroup(NamedTuple):
    """One-rings of one class."""

    signature: Signature
    at: IntArray  # (n,) int64: the tile that each is of
    points: FloatArray  # (K, 3, n) float64: control points
    slots: IntArray | None = None  # (K,) int64 or None: the vertices of a one-ring that these are; None if they are all

    def chosen(self, which: NDArray[np.bool_]) -> PatchGroup:
        """Some of them."""
        if which.all():
            return self
        chosen = np.flatnonzero(which)
        return self._replace(at=self.at[chosen], points=self.points.take(chosen, axis=2))


def have_flat_rings(rates: TileRates, tiles: Tiles, groups: list[PatchGroup]) -> NDArray[np.bool_]:
    """``(t,)`` whether the one-rings of patches are so flat that one pair of triangles suffices for each.

    Most patches of a dense cage are, and need no further test.
    """
    count = len(tiles)
    corners, extent = np.empty((4, 3, count)), np.empty(count)
    for each in groups:
        # The diagonals of a face: the element, or a face beside a vertex element.
        topology = one_ring(each.signature.smoothed).topology
        size = int(topology.face_sizes[0])
        corners[..., each.at] = each.points[topology.face_vertices[[0, size // 4, size // 2, 3 * size // 4]]]
    lower, upper = _boxes(groups, count)
    limit = rates.limit(tiles, lower, upper, NormalCone.of_any(count))
    fits = np.linalg.norm(upper - lower, axis=0) <= limit
    if rates.criterion.measure is Measure.EDGE:
        return fits
    axis = axis_across(corners)
    for each in groups:
        extent[each.at] = np.ptp(dot(each.points, axis[:, each.at]), axis=0)
    may_be_flat = axis.any(axis=0) & ~fits & ~tiles.sides.any(axis=1) & (extent <= limit)
    return fits | (may_be_flat & ~_are_folded(groups, axis, may_be_flat))


def are_flat(rates: TileRates, tiles: Tiles, groups: list[TileParts]) -> NDArray[np.bool_]:
    """``(t,)`` whether one pair of triangles is near enough to the surface over each tile, and along feature edges."""
    count, corners = len(tiles), np.empty((rates.domain.corner_count, 3, len(tiles)))
    rings = []
    for own, points, at, _ in groups:
        rings.append(PatchGroup(own.signature, at, own.one_ring_points(points), own.slots))
        corners[..., at] = times(own.corners, points)
    lower, upper = _boxes(rings, count)
    axis = axis_across(corners)
    limit = rates.limit(tiles, lower, upper, NormalCone.of_any(count))
    if rates.criterion.measure is Measure.EDGE:
        return fit_within(rates.scheme, limit, groups)
    parts = [TileParts(each.tile, dot(each.values, axis[:, each.owner])[:, None], each.owner) for each in groups]
    # A tile without a normal, or that may be folded, is tested by its size only.
    fits = (np.linalg.norm(upper - lower, axis=0) <= limit) & rates.scheme.has_convex_rules
    has_normal = axis.any(axis=0)
    found = fit_within(rates.scheme, np.where(has_normal, limit, np.where(fits, np.inf, -1.0)), parts)
    folded = _are_folded(rings, axis, found & ~fits)
    if folded.any():
        found &= ~folded | (_normal_sines(rates, groups, axis, folded) < 1)
    if rates.criterion.outline is not None:
        # A border may be a silhouette for any normals.
        cone = NormalCone(axis, _normal_sines(rates, groups, axis, ~(found | tiles.sides.any(axis=1))))
        higher = np.where(cone.sine < 1, rates.limit(tiles, lower, upper, cone), -1.0)
        found |= fit_within(rates.scheme, higher, parts)
    may_curve = found & ~fits & tiles.sides.any(axis=1)
    if may_curve.any():
        found &= ~_have_curved_sides(rates, tiles, groups, may_curve, corners, limit)
    return found


def _boxes(groups: list[PatchGroup], count: int) -> tuple[FloatArray, FloatArray]:
    """Least and largest coordinates ``(3, t)`` of the control points of each one-ring."""
    lower, upper = np.empty((3, count)), np.empty((3, count))
    for each in groups:
        lower[:, each.at], upper[:, each.at] = each.points.min(axis=0), each.points.max(axis=0)
    return lower, upper


def _are_folded(groups: list[PatchGroup], axis: FloatArray, are_asked: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """``(t,)`` whether control faces of some one-rings face opposite ways, seen along axes ``(3, t)``.

    Such a surface has silhouettes along its folds, and not only along edges of the cage. At a dart, where one vertex of
    the ring is left out as it equals another, so are its faces.
    """
    found = np.zeros(len(are_asked), dtype=bool)
    asked = np.flatnonzero(are_asked)
    across = np.empty((2, 3, len(are_asked)))
    across[..., asked] = _normals_to(axis[:, asked])
    for each in groups:
        own = each.chosen(are_asked[each.at])
        if not len(own.at):
            continue
        t = one_ring(own.signature.smoothed).topology
        # The diagonals of each face; of triangles, two sides.
        quarters = t.face_offsets[:-1] + np.arange(4)[:, None] * t.face_sizes // 4
        vertices = t.face_vertices[quarters]
        if own.slots is not None:
            number = np.full(t.vertex_count, -1)
            number[own.slots] = np.arange(len(own.slots))
            vertices = number[vertices]
        a, b, c, d = vertices[:, (vertices >= 0).all(axis=0)]
        x, y = (dot(own.points, along) for along in across[..., own.at])
        areas = (x[c] - x[a]) * (y[d] - y[b]) - (y[c] - y[a]) * (x[d] - x[b])
        found[own.at] = areas.min(axis=0) < -FOLDED * areas.max(axis=0)
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
    rates: TileRates,
    tiles: Tiles,
    groups: list[TileParts],
    are_asked: NDArray[np.bool_],
    corners: FloatArray,
    limit: FloatArray,
) -> NDArray[np.bool_]:
    """``(t,)`` whether tiles with these corners have a feature edge that is no straight line within the limit."""
    m, asked = rates.domain.corner_count, []
    for side in range(m):
        for each in groups:
            on = are_asked[each.owner] & (tiles.sides[each.owner, side] > 0)
            if on.any():
                asked.append((side, each.chosen(on)))
    at = np.concatenate([each.owner for _, each in asked])
    sides = np.repeat([number for number, _ in asked], [len(each.owner) for _, each in asked])
    across = np.stack(_normals_to(corners[(sides + 1) % m, :, at].T - corners[sides, :, at].T))
    parts, begin = [], 0
    for number, each in asked:
        own = slice(begin, begin + len(each.owner))
        values = np.einsum("kit,dit->kdt", each.values, across[..., own])
        parts.append(TileParts(each.tile, values, np.arange(own.start, own.stop), number))
        begin = own.stop
    found = np.zeros(len(tiles), dtype=bool)
    found[at[~fit_within(rates.scheme, limit[at], parts)]] = True
    return found


def _normals_to(way: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Two unit vectors ``(3, t)`` orthogonal to each of some vectors and to each other; any two for zero vectors."""
    length = np.linalg.norm(way, axis=0)
    way = np.where(length > 0, way / np.where(length > 0, length, 1), np.array([[0.0], [0], [1]]))
    # Across the way and the axis that it is least along.
    first = cross(way, np.eye(3)[np.argmin(np.abs(way), axis=0)].T)
    first /= np.linalg.norm(first, axis=0)
    return first, cross(way, first)
