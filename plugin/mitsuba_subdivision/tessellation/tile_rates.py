"""Whether tiles are flat, and how many segments they need, by bounds of what a criterion limits."""

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
from .tiles import UNIT, PatchFrames, Tiles, sizes

# Samples of a displacement along each side of a tile.
HEIGHT_SAMPLES = 9
# Relative area of triangles that rounding may flip.
FOLDED = 1e-6


@dataclass(frozen=True, eq=False)
class TileRates:
    """Rates of tiles for a criterion.

    Tiles are asked about kind by kind, with their control points: ``(K, 3, t)`` float64, Bernstein coefficients of
    pieces.
    """

    scheme: Scheme
    frames: PatchFrames  # Of the patches that the tiles are parts of
    criterion: Criterion
    max_rate: int  # Most segments along an edge of the cage

    @property
    def basis(self) -> BernsteinBasis:
        return regular_bernstein(self.scheme).basis

    @property
    def domain(self) -> ParameterDomain:
        return self.scheme.domain

    def most(self, tiles: Tiles) -> IntArray:
        """``(t,)`` the highest rates that tiles may have: powers of two, as sides have."""
        found: IntArray = np.maximum(1, (1 << self.max_rate.bit_length() - 1) >> tiles["halvings"])
        return found

    def clipped(self, tiles: Tiles) -> Tiles:
        """The tiles, with no higher rates than these."""
        found, most = tiles.copy(), self.most(tiles)[:, None]
        found["rates"], found["sides"] = np.minimum(tiles["rates"], most), np.minimum(tiles["sides"], most)
        return found

    def triangle_counts(self, tiles: Tiles) -> IntArray:
        """``(t,)`` triangles of tiles with their rates, clipped; but for those that other rates next door add."""
        cells: IntArray = np.minimum(tiles["rates"], self.most(tiles)[:, None]).prod(axis=1, dtype=np.int64)
        return cells * (self.domain.corner_count - 2)

    def are_flat(
        self, kind: DividedTile, tiles: Tiles, values: FloatArray, heights: FloatArray | None = None
    ) -> NDArray[np.bool_]:
        """``(t,)`` whether one pair of triangles is near enough to the surface over each tile, and along features."""
        corners, ring = times(kind.corners, values), kind.one_ring_points(values)
        lower, upper = ring.min(axis=0), ring.max(axis=0)
        limit = self.criterion.limit(lower, upper, NormalCone.of_any(len(tiles)))
        if self.criterion.measure is Measure.EDGE:
            return _extent(kind, values, np.eye(3)[..., None] * np.ones(len(tiles))) <= limit
        moved = np.zeros(len(tiles)) if heights is None else np.ptp(heights, axis=(0, 1))
        # What a displacement takes of it.
        limit = limit - moved
        # A tile that is folded, or has no normal, is tested by its size only.
        fits = (np.linalg.norm(upper - lower, axis=0) <= limit) & self.scheme.has_convex_rules
        axis, extent = axis_across(corners), np.full(len(tiles), np.inf)
        at = np.flatnonzero(~fits & axis.any(axis=0))
        extent[at] = _extent(kind, values.take(at, axis=2), axis[None].take(at, axis=2))
        found = fits | (extent <= limit)
        at = np.flatnonzero(found & ~fits)
        at = at[_are_folded(kind, ring.take(at, axis=2), axis.take(at, axis=1))]
        found[at] = self._normal_sines(kind, values.take(at, axis=2), axis.take(at, axis=1)) < 1
        if self.criterion.outline is not None:
            # A border may be a silhouette for any normals.
            at = np.flatnonzero(~found & ~tiles["sides"].any(axis=1) & np.isfinite(extent))
            cone = NormalCone(axis[:, at], self._normal_sines(kind, values.take(at, axis=2), axis[:, at]))
            coarse = self.criterion.limit(lower[:, at], upper[:, at], cone)
            found[at] = (cone.sine < 1) & (extent[at] <= coarse - moved[at])
        for side, (begin, end) in enumerate(zip(corners, np.roll(corners, -1, axis=0), strict=True)):
            at = np.flatnonzero(found & ~fits & (tiles["sides"][:, side] > 0))
            if not len(at):
                continue
            hull = kind.side_hulls[side]
            if hull is None:
                found[at] = False
            else:
                curve, across = times(hull, values[..., at]), _normals_to(end[:, at] - begin[:, at])
                found[at] = np.hypot(*(np.ptp(dot(curve, way), axis=0) for way in across)) <= limit[at]
        return found

    def rated(self, tiles: Tiles, coefficients: FloatArray, heights: FloatArray | None) -> Tiles:
        """Pieces with the rates that the limit needs, which may exceed the highest; see `clipped`."""
        forms = self._forms(coefficients)
        if heights is not None:
            forms += self._form_of_displacement(heights, coefficients)
        if self.domain.corner_count == 3:
            rates = np.repeat(rounded_up(np.sqrt(forms[:, 0].max(axis=0)))[:, None], 2, axis=1)
        else:
            rates = least_product(forms)
        found = tiles.copy()
        found["rates"], found["sides"] = rates, self._along_sides(tiles, coefficients)
        return found

    def _normal_sines(self, kind: DividedTile, values: FloatArray, axis: FloatArray) -> FloatArray:
        """Sines of half the angles of cones about axes ``(3, t)`` that contain all normals of tiles.

        One where normals are not known to lead to one side of the planes across the axes. Nearer to an extraordinary
        point than the pieces, normals turn less than on these.
        """
        if kind.tangents is None or not len(axis.T):
            return np.ones(axis.shape[1])
        shape = kind.tangents.shape
        derivatives = times(kind.tangents.reshape(-1, shape[3]), values).reshape(*shape[:3], *values.shape[1:])
        found: FloatArray = NormalCone.of(*map(TangentCone.of, derivatives)).around(axis).sine.max(axis=0)
        return found

    def heights(self, tiles: Tiles) -> FloatArray | None:
        """``(n, n, t)`` heights of the displacement over tiles, by v and by u; None without one."""
        displacement = self.criterion.displacement
        if displacement is None:
            return None
        v, u = np.indices((HEIGHT_SAMPLES,) * 2).reshape(2, -1, 1) / (HEIGHT_SAMPLES - 1)
        if self.domain.corner_count == 3:
            # What is outside lies in the next element; the samples are mirrored at the diagonal.
            u, v = np.where(u + v > 1, 1 - v, u), np.where(u + v > 1, 1 - u, v)
        flipped, size = tiles["is_flipped"], sizes(tiles) / UNIT
        u, v = (
            size * (origin + np.where(flipped, 1 - t, t)) for origin, t in zip(tiles["origin"].T, (u, v), strict=True)
        )
        corner = np.broadcast_to(tiles["corner"], u.shape).ravel().astype(np.int64)
        scale = self.frames.scale[self.frames.topology.face[tiles["corner"]]]
        found = displacement.heights(corner, np.stack([(u * scale).ravel(), (v * scale).ravel()], axis=1))
        return found.reshape(HEIGHT_SAMPLES, HEIGHT_SAMPLES, -1)

    def _form_of_displacement(self, heights: FloatArray, coefficients: FloatArray) -> FloatArray:
        """``(1, 3, t)`` what the displacement adds to the forms of tiles."""
        any_normal = NormalCone.of_any(heights.shape[2])
        limit = self.criterion.limit(coefficients.min(axis=0), coefficients.max(axis=0), any_normal)
        a, b, c = self.criterion.form_of_displacement(heights) / np.maximum(self.criterion.bound(limit), TINY)
        if self.domain.corner_count == 3:
            return np.stack([a + 2 * b + c, 0 * b, 0 * c])[None]
        return np.stack([a, b, c])[None]

    def _along_sides(self, tiles: Tiles, coefficients: FloatArray) -> IndexArray:
        """Least segments on sides: as many segments as keep curves along feature edges to the limit."""
        sides = np.zeros_like(tiles["sides"])
        _, _, uu, uv, vv = self.basis.two_derivatives
        along = [uu, uu - 2 * uv + vv, vv] if self.domain.corner_count == 3 else [uu, vv, uu, vv]
        for side, (second, own) in enumerate(zip(along, self.basis.sides, strict=True)):
            on = np.flatnonzero(tiles["sides"][:, side])
            if not len(on):
                continue
            of_tile = coefficients[..., on]
            limit = self.criterion.limit(of_tile.min(axis=0), of_tile.max(axis=0), NormalCone.of_any(len(on)))
            sides[on, side] = self.criterion.segments(times(second[own], of_tile), limit)
        return sides

    def _forms(self, coefficients: FloatArray) -> FloatArray:
        """``(4, 3, t)`` `Criterion.form` over its bound, of pieces, by each of their copies' bounds."""
        criterion, (b, _, count) = self.criterion, coefficients.shape
        found = times(_of_copies(self.basis).reshape(-1, b), coefficients).reshape(6, b, 4, 3, count)
        points, derivatives = found[0], list(found[1:])
        tangents = TangentCone.of(derivatives[0]), TangentCone.of(derivatives[1])
        cone = NormalCone.of(*tangents)
        limit = criterion.limit(points.min(axis=0), points.max(axis=0), cone)
        form = criterion.form(derivatives, tangents, cone, self.domain.corner_count)
        # For the same limit a copy, which is half as large, needs half as many segments: its form is a quarter.
        with np.errstate(over="ignore"):
            return 4 * (form / np.maximum(criterion.bound(limit), TINY)).swapaxes(0, 1)


def _extent(kind: DividedTile, values: FloatArray, axes: FloatArray) -> FloatArray:
    """``(t,)`` size of the surface over tiles along axes ``(d, 3, t)``, no less than it is; infinite if unknown."""
    if kind.hull is None:
        return np.full(values.shape[2], np.inf)
    found: FloatArray = np.linalg.norm([np.ptp(times(kind.hull, dot(values, axis)), axis=0) for axis in axes], axis=0)
    return found


def _are_folded(kind: DividedTile, ring: FloatArray, axis: FloatArray) -> NDArray[np.bool_]:
    """``(t,)`` whether control faces of one-rings ``(n, 3, t)`` face opposite ways, along axes; true of pieces.

    Such a surface has silhouettes along its folds, and not only along edges of the cage.
    """
    if kind.is_piece:
        return np.ones(axis.shape[1], dtype=bool)
    (a, c, b, d), (x, y) = kind.control_faces, (dot(ring, along) for along in _normals_to(axis))
    areas = (x[c] - x[a]) * (y[d] - y[b]) - (y[c] - y[a]) * (x[d] - x[b])
    found: NDArray[np.bool_] = areas.min(axis=0) < -FOLDED * areas.max(axis=0)
    return found


def axis_across(corners: FloatArray) -> FloatArray:
    """``(3, t)`` unit vectors across two diagonals, of three or four corners ``(m, 3, t)``; zero if these are parallel.

    Of a triangle, two of its sides.
    """
    axis = cross(corners[2] - corners[0], corners[-1] - corners[1])
    length = np.linalg.norm(axis, axis=0)
    return axis / np.where(length > 0, length, 1)


def _normals_to(way: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Two unit vectors ``(3, t)`` orthogonal to each of some vectors and to each other; any two for zero vectors."""
    length = np.linalg.norm(way, axis=0)
    way = np.where(length > 0, way / np.where(length > 0, length, 1), np.array([[0.0], [0], [1]]))
    # Across the way and the axis that it is least along.
    first = cross(way, np.eye(3)[np.argmin(np.abs(way), axis=0)].T)
    first /= np.linalg.norm(first, axis=0)
    return first, cross(way, first)


@lru_cache(maxsize=16)
def _of_copies(basis: BernsteinBasis) -> FloatArray:
    """``(6, b, 4, b)`` maps from coefficients to those over the copies of the domain, and of their derivatives."""
    maps = np.concatenate([np.eye(len(basis.indices))[None], basis.two_derivatives])
    return np.ascontiguousarray(np.einsum("dab,pbc->dapc", maps, basis.halves))
