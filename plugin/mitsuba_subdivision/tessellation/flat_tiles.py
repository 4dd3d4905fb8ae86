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
from ..schemes.scheme_members import optional_member
from .cones import NormalCone, cross, dot
from .criterion import Measure
from .tile_extents import TileParts, fit_within
from .tile_rates import TileRates, axis_across
from .tiles import Tiles

# Relative area of triangles that rounding may flip.
FOLDED = 1e-6


class PatchGroup(NamedTuple):
    """Patches of a class, each as one tile.

    Attributes
    ----------
    signature : Signature
    at : (n,) int64
        Which of some tiles they are.
    points : (K, 3, n) float64
        Control points.
    """

    signature: Signature
    at: IntArray
    points: FloatArray

    def chosen(self, which: NDArray[np.bool_]) -> PatchGroup:
        """Some of the patches."""
        return self if which.all() else self._replace(at=self.at[which], points=self.points[..., which])


def have_flat_rings(rates: TileRates, tiles: Tiles, groups: list[PatchGroup]) -> NDArray[np.bool_]:
    """``(t,)`` whether the one-rings of patches are so flat that one pair of triangles suffices for each.

    Most patches of a dense cage are, and need no further test.
    """
    count = len(tiles)
    lower, upper, corners = np.empty((3, count)), np.empty((3, count)), np.empty((4, 3, count))
    for each in groups:
        lower[:, each.at], upper[:, each.at] = each.points.min(axis=0), each.points.max(axis=0)
        # The diagonals of a face: the element, or a face beside a vertex element.
        topology = one_ring(each.signature.smoothed).topology
        size = int(topology.face_sizes[0])
        corners[..., each.at] = each.points[topology.face_vertices[[0, size // 4, size // 2, 3 * size // 4]]]
    limit = rates.limit(tiles, lower, upper, NormalCone.of_any(count))
    fits = np.linalg.norm(upper - lower, axis=0) <= limit
    if rates.criterion.measure is Measure.EDGE:
        return fits
    axis = axis_across(corners)
    may_be_flat = axis.any(axis=0) & ~fits & ~tiles.sides.any(axis=1)
    for each in groups:
        extent = np.ptp(dot(each.points, axis[:, each.at]), axis=0)
        flat = each.chosen(may_be_flat[each.at] & (extent <= limit[each.at]))
        fits[flat.at] = ~_are_folded(flat.signature, flat.points, axis[:, flat.at])
    return fits


def are_flat(rates: TileRates, tiles: Tiles, groups: list[TileParts]) -> NDArray[np.bool_]:
    """``(t,)`` whether one pair of triangles is near enough to the surface over each tile, and along feature edges."""
    count, m = len(tiles), rates.domain.corner_count
    lower, upper, corners = np.empty((3, count)), np.empty((3, count)), np.empty((m, 3, count))
    axis, folded = np.empty((3, count)), np.empty(count, dtype=bool)
    for each in groups:
        ring, own = each.tile.one_ring_points(each.values), times(each.tile.corners, each.values)
        lower[:, each.owner], upper[:, each.owner] = ring.min(axis=0), ring.max(axis=0)
        corners[..., each.owner], axis[:, each.owner] = own, axis_across(own)
        folded[each.owner] = _are_folded(each.tile.signature, ring, axis[:, each.owner], each.tile.slots)
    limit = rates.limit(tiles, lower, upper, NormalCone.of_any(count))
    if rates.criterion.measure is Measure.EDGE:
        return fit_within(rates.scheme, limit, groups)
    parts = [TileParts(each.tile, dot(each.values, axis[:, each.owner])[:, None], each.owner) for each in groups]
    # A tile without a normal, or that may be folded, is tested by its size only.
    fits = (np.linalg.norm(upper - lower, axis=0) <= limit) & bool(optional_member(rates.scheme, "has_convex_rules"))
    has_normal = axis.any(axis=0)
    found = fit_within(rates.scheme, np.where(has_normal, limit, np.where(fits, np.inf, -1.0)), parts)
    folded &= found & ~fits
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


def _are_folded(
    signature: Signature, points: FloatArray, axis: FloatArray, slots: IntArray | None = None
) -> NDArray[np.bool_]:
    """``(t,)`` whether control faces of one-rings ``(K, 3, t)`` face opposite ways, seen along axes ``(3, t)``.

    Such a surface has silhouettes along its folds, and not only along edges of the cage. At a dart, where one vertex of
    the ring is left out as it equals another, so are its faces.
    """
    t, (first, second) = one_ring(signature.smoothed).topology, _normals_to(axis)
    # The diagonals of each face; of triangles, two sides.
    quarters = t.face_offsets[:-1] + np.arange(4)[:, None] * t.face_sizes // 4
    vertices = t.face_vertices[quarters]
    if slots is not None:
        number = np.full(t.vertex_count, -1)
        number[slots] = np.arange(len(slots))
        vertices = number[vertices]
    a, b, c, d = vertices[:, (vertices >= 0).all(axis=0)]
    x, y = dot(points, first), dot(points, second)
    areas = (x[c] - x[a]) * (y[d] - y[b]) - (y[c] - y[a]) * (x[d] - x[b])
    folded: NDArray[np.bool_] = areas.min(axis=0) < -FOLDED * areas.max(axis=0)
    return folded


def _normal_sines(
    rates: TileRates, groups: list[TileParts], axis: FloatArray, are_asked: NDArray[np.bool_]
) -> FloatArray:
    """``(t,)`` sines of half the angles of cones about axes ``(3, t)`` that contain all normals of some tiles.

    One where normals are unknown, and for other tiles. Nearer to an extraordinary point than the pieces, normals turn
    less than on these.
    """
    found = np.ones(axis.shape[1])
    for each in groups:
        on = are_asked[each.owner]
        if not on.any() or each.tile.pieces is None:
            continue
        own, pieces = each.chosen(on), each.tile.pieces
        coefficients = times(pieces.reshape(-1, pieces.shape[2]), own.values)
        by_coefficient = coefficients.reshape(-1, len(rates.basis.indices), *coefficients.shape[1:]).swapaxes(0, 1)
        by_coefficient = np.ascontiguousarray(by_coefficient)
        found[own.owner] = rates.normal_sines(by_coefficient, axis[:, own.owner]).max(axis=0)
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
