"""Bounds of a criterion's limited quantity over tiles: tests for flatness, and numbers of segments."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from ..evaluation.divided_tile import DividedTile
from ..evaluation.polynomials import BernsteinBasis, regular_bernstein, times
from ..mesh.connectivity import IndexArray, IntArray
from ..schemes.domain import FloatArray, ParameterDomain
from ..schemes.scheme import Scheme
from .criterion import TINY, Criterion, Measure, NormalCone, TangentCone, cross, dot, least_product, rounded_up
from .tiles import PatchFrames, Tiles

# Samples of a displacement along each side of a tile.
HEIGHT_SAMPLES = 9
# Signed area of a control face, relative to the largest, whose sign may be due to rounding.
FOLDED = 1e-6


@dataclass(frozen=True, eq=False)
class TileRates:
    """Rates of tiles for a criterion.

    Methods take tiles of one kind, with their control points ``(K, 3, t)`` float64, or the Bernstein coefficients of
    pieces.
    """

    scheme: Scheme
    frames: PatchFrames  # Of the tiles' patches
    criterion: Criterion
    max_rate: int  # Most segments along an edge of the cage

    @property
    def basis(self) -> BernsteinBasis:
        return regular_bernstein(self.scheme).basis

    @property
    def domain(self) -> ParameterDomain:
        return self.scheme.domain

    def most(self, tiles: Tiles) -> IntArray:
        """``(t,)`` highest rates that tiles may have, which are powers of two, as on sides."""
        rates: IntArray = np.maximum(1, (1 << self.max_rate.bit_length() - 1) >> tiles["halvings"])
        return rates

    def clipped(self, tiles: Tiles) -> Tiles:
        """The tiles with rates clipped to `most`."""
        clipped, most = tiles.copy(), self.most(tiles)[:, None]
        clipped["rates"], clipped["sides"] = np.minimum(tiles["rates"], most), np.minimum(tiles["sides"], most)
        return clipped

    def triangle_counts(self, tiles: Tiles) -> IntArray:
        """``(t,)`` triangles of tiles with clipped rates, without those that higher rates of neighbours add."""
        cells: IntArray = np.minimum(tiles["rates"], self.most(tiles)[:, None]).prod(axis=1, dtype=np.int64)
        return cells * (self.domain.corner_count - 2)

    def are_flat(
        self, kind: DividedTile, tiles: Tiles, values: FloatArray, heights: FloatArray | None = None
    ) -> NDArray[np.bool_]:
        """``(t,)`` whether two triangles (or one) approximate each tile within the limit, also along feature edges."""
        corners, ring = times(kind.corners, values), kind.one_ring_points(values)
        lower, upper = ring.min(axis=0), ring.max(axis=0)
        limit = self.criterion.limit(lower, upper, NormalCone.of_any(len(tiles)))
        height_range = np.zeros(len(tiles)) if heights is None else np.ptp(heights, axis=(0, 1))
        if self.criterion.measure is Measure.EDGE:
            extent = _extent(kind, values, np.eye(3)[..., None] * np.ones(len(tiles)))
            return np.hypot(extent, height_range) <= limit
        # The displacement uses up a part of the limit.
        limit = limit - height_range
        # Tiles that fit into the limit as a whole: the only test for tiles that are folded or have no normal.
        fits = (np.linalg.norm(upper - lower, axis=0) <= limit) & self.scheme.has_convex_rules
        axis, extent = axis_across(corners), np.full(len(tiles), np.inf)
        tested = np.flatnonzero(~fits & axis.any(axis=0))
        extent[tested] = _extent(kind, values.take(tested, axis=2), axis[None].take(tested, axis=2))
        is_flat = fits | (extent <= limit)
        # Tiles whose control faces are folded along the axis need a bound of their normals.
        folded = np.flatnonzero(is_flat & ~fits)
        folded = folded[_are_folded(kind, ring.take(folded, axis=2), axis.take(folded, axis=1))]
        is_flat[folded] = self._normal_sines(kind, values.take(folded, axis=2), axis.take(folded, axis=1)) < 1
        if self.criterion.outline is not None:
            # Tiles on a border are left out, as it may be a silhouette for any normals.
            inner = np.flatnonzero(~is_flat & ~tiles["sides"].any(axis=1) & np.isfinite(extent))
            cone = NormalCone(axis[:, inner], self._normal_sines(kind, values.take(inner, axis=2), axis[:, inner]))
            coarse_limit = self.criterion.limit(lower[:, inner], upper[:, inner], cone)
            is_flat[inner] = (cone.sine < 1) & (extent[inner] <= coarse_limit - height_range[inner])
        for side, (begin, end) in enumerate(zip(corners, np.roll(corners, -1, axis=0), strict=True)):
            featured = np.flatnonzero(is_flat & ~fits & (tiles["sides"][:, side] > 0))
            if not len(featured):
                continue
            hull = kind.side_hulls[side]
            if hull is None:
                is_flat[featured] = False
            else:
                curve, across = times(hull, values[..., featured]), _normals_to(end[:, featured] - begin[:, featured])
                width = np.hypot(*(np.ptp(dot(curve, direction), axis=0) for direction in across))
                is_flat[featured] = width <= limit[featured]
        return is_flat

    def rated(self, tiles: Tiles, coefficients: FloatArray, heights: FloatArray | None) -> Tiles:
        """The tiles of pieces, with the rates that the limit needs, which may exceed `most`."""
        forms = self._forms(coefficients)
        if heights is not None:
            forms += self._form_of_displacement(heights, coefficients)
        if self.domain.corner_count == 3:
            rates = np.repeat(rounded_up(np.sqrt(forms[:, 0].max(axis=0)))[:, None], 2, axis=1)
        else:
            rates = least_product(forms)
        rated = tiles.copy()
        rated["rates"], rated["sides"] = rates, self._along_sides(tiles, coefficients)
        return rated

    def _normal_sines(self, kind: DividedTile, values: FloatArray, axis: FloatArray) -> FloatArray:
        """Sines of half the angles of cones about axes ``(3, t)`` that contain all normals of tiles.

        1 where the half angle is not known to be below 90 degrees. The pieces of the kind bound normals nearer to an
        extraordinary point as well, which vary less.
        """
        if kind.tangents is None or not len(axis.T):
            return np.ones(axis.shape[1])
        shape = kind.tangents.shape
        derivatives = times(kind.tangents.reshape(-1, shape[3]), values).reshape(*shape[:3], *values.shape[1:])
        sines: FloatArray = NormalCone.of(*map(TangentCone.of, derivatives)).around(axis).sine.max(axis=0)
        return sines

    def heights(self, tiles: Tiles) -> FloatArray | None:
        """``(n, n, t)`` heights of the displacement over tiles, by v and by u; None without a displacement."""
        displacement = self.criterion.displacement
        if displacement is None:
            return None
        v, u = np.indices((HEIGHT_SAMPLES,) * 2).reshape(2, -1, 1) / (HEIGHT_SAMPLES - 1)
        if self.domain.corner_count == 3:
            # Samples outside the triangle are mirrored at the diagonal, as they lie in another element.
            u, v = np.where(u + v > 1, 1 - v, u), np.where(u + v > 1, 1 - u, v)
        parameters = np.where(tiles["is_flipped"], 1 - np.stack([u, v]), np.stack([u, v]))
        u, v = (parameters + tiles["origin"].T[:, None]) * np.ldexp(1.0, -tiles["depth"])
        corner = np.broadcast_to(tiles["corner"], u.shape).ravel().astype(np.int64)
        scale = self.frames.scale[self.frames.topology.face[tiles["corner"]]]
        heights = displacement.heights(corner, np.stack([(u * scale).ravel(), (v * scale).ravel()], axis=1))
        return heights.reshape(HEIGHT_SAMPLES, HEIGHT_SAMPLES, -1)

    def _form_of_displacement(self, heights: FloatArray, coefficients: FloatArray) -> FloatArray:
        """``(1, 3, t)`` contribution of the displacement to `_forms`."""
        any_normal = NormalCone.of_any(heights.shape[2])
        limit = self.criterion.limit(coefficients.min(axis=0), coefficients.max(axis=0), any_normal)
        a, b, c = self.criterion.form_of_displacement(heights) / np.maximum(self.criterion.bound(limit), TINY)
        if self.domain.corner_count == 3:
            return np.stack([a + 2 * b + c, 0 * b, 0 * c])[None]
        return np.stack([a, b, c])[None]

    def _along_sides(self, tiles: Tiles, coefficients: FloatArray) -> IndexArray:
        """``(t, m)`` segments on sides that keep curves along feature edges within the limit; 0 on other sides."""
        sides = np.zeros_like(tiles["sides"])
        _, _, uu, uv, vv = self.basis.two_derivatives
        along = [uu, uu - 2 * uv + vv, vv] if self.domain.corner_count == 3 else [uu, vv, uu, vv]
        for side, (second, side_indices) in enumerate(zip(along, self.basis.sides, strict=True)):
            featured = np.flatnonzero(tiles["sides"][:, side])
            if not len(featured):
                continue
            points = coefficients[..., featured]
            limit = self.criterion.limit(points.min(axis=0), points.max(axis=0), NormalCone.of_any(len(featured)))
            sides[featured, side] = self.criterion.segments(times(second[side_indices], points), limit)
        return sides

    def _forms(self, coefficients: FloatArray) -> FloatArray:
        """``(4, 3, t)`` `Criterion.form` of pieces, relative to its bound, from the coefficients of their quarters."""
        criterion, (b, _, count) = self.criterion, coefficients.shape
        jets = times(_of_copies(self.basis).reshape(-1, b), coefficients).reshape(6, b, 4, 3, count)
        points, derivatives = jets[0], list(jets[1:])
        tangents = TangentCone.of(derivatives[0]), TangentCone.of(derivatives[1])
        cone = NormalCone.of(*tangents)
        limit = criterion.limit(points.min(axis=0), points.max(axis=0), cone)
        form = criterion.form(derivatives, tangents, cone, self.domain.corner_count)
        # For the same limit, a quarter of half the size needs half as many segments: its form is a fourth.
        with np.errstate(over="ignore"):
            return 4 * (form / np.maximum(criterion.bound(limit), TINY)).swapaxes(0, 1)


def _extent(kind: DividedTile, values: FloatArray, axes: FloatArray) -> FloatArray:
    """``(t,)`` upper bounds of the size of the surface over tiles along axes ``(d, 3, t)``; infinite if unknown."""
    if kind.hull is None:
        return np.full(values.shape[2], np.inf)
    extent: FloatArray = np.linalg.norm([np.ptp(times(kind.hull, dot(values, axis)), axis=0) for axis in axes], axis=0)
    return extent


def _are_folded(kind: DividedTile, ring: FloatArray, axis: FloatArray) -> NDArray[np.bool_]:
    """``(t,)`` whether control faces of one-rings ``(n, 3, t)`` face opposite ways along the axes; true for pieces.

    A folded surface has silhouettes along its folds, and not only along edges of the cage.
    """
    if kind.is_piece:
        return np.ones(axis.shape[1], dtype=bool)
    (a, c, b, d), (x, y) = kind.control_faces, (dot(ring, along) for along in _normals_to(axis))
    areas = (x[c] - x[a]) * (y[d] - y[b]) - (y[c] - y[a]) * (x[d] - x[b])
    are_folded: NDArray[np.bool_] = areas.min(axis=0) < -FOLDED * areas.max(axis=0)
    return are_folded


def axis_across(corners: FloatArray) -> FloatArray:
    """``(3, t)`` unit normals of tiles with corners ``(m, 3, t)``; zero if undefined.

    They are orthogonal to both diagonals of a quadrilateral, or to two sides of a triangle.
    """
    axis = cross(corners[2] - corners[0], corners[-1] - corners[1])
    length = np.linalg.norm(axis, axis=0)
    return axis / np.where(length > 0, length, 1)


def _normals_to(vectors: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Two unit vectors ``(3, t)`` orthogonal to each vector and to each other; any two for a zero vector."""
    length = np.linalg.norm(vectors, axis=0)
    direction = np.where(length > 0, vectors / np.where(length > 0, length, 1), np.array([[0.0], [0], [1]]))
    # The first is orthogonal to the axis along which the direction is smallest.
    first = cross(direction, np.eye(3)[np.argmin(np.abs(direction), axis=0)].T)
    first /= np.linalg.norm(first, axis=0)
    return first, cross(direction, first)


@lru_cache(maxsize=16)
def _of_copies(basis: BernsteinBasis) -> FloatArray:
    """``(6, b, 4, b)`` maps from coefficients to those of the four quarters and of their five derivatives."""
    maps = np.concatenate([np.eye(len(basis.indices))[None], basis.two_derivatives])
    return np.ascontiguousarray(np.einsum("dab,pbc->dapc", maps, basis.halves))
