"""Rates of tiles in one piece, by bounds of what a criterion limits."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import lru_cache
from math import isqrt

import numpy as np
from numpy.typing import NDArray

from ..evaluation.bernstein import BernsteinBasis, regular_bernstein, times
from ..mesh.connectivity import IndexArray, IntArray
from ..schemes.domain import FloatArray, ParameterDomain
from ..schemes.scheme import Scheme
from .cones import NormalCone, TangentCone, cross, dot
from .criterion import TINY, Criterion, Measure, least_product, rounded_up
from .memory import require_memory_for_triangles
from .patch_frames import PatchFrames
from .tiles import UNIT, Tiles

# Parts of tiles are looked at so many at once, whose derivatives stay in a core's cache.
PARTS_AT_ONCE = 1 << 11
# Tiles of fewer cells are not divided: four parts have at least so many.
FEWEST_DIVIDED = 5
# Samples of a displacement along each side of a tile.
HEIGHT_SAMPLES = 9


@dataclass(frozen=True, eq=False)
class TileRates:
    """Rates of tiles for a criterion."""

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

    def limit(self, tiles: Tiles, lower: FloatArray, upper: FloatArray, cone: NormalCone) -> FloatArray:
        """``(t,)`` `Criterion.limit`, less what a displacement takes of it."""
        limit = self.criterion.limit(lower, upper, cone)
        if self.criterion.displacement is not None and self.criterion.measure is Measure.CHORD:
            limit = limit - np.ptp(self._heights(tiles), axis=(0, 1))
        return limit

    def are_within(
        self,
        tiles: Tiles,
        # (3, t) float64: boxes of the hulls
        lower: FloatArray,
        upper: FloatArray,
        axis: FloatArray,  # (3, t) float64: across which surfaces are hoped to be flat; unit vectors, or zero
        extent: FloatArray,  # (t,) float64: of the hulls, along these axes
    ) -> NDArray[np.bool_]:
        """``(t,)`` whether two triangles approximate tiles with these hulls within the tolerance."""
        limit = self.limit(tiles, lower, upper, NormalCone.of_any(len(tiles)))
        size = np.linalg.norm(upper - lower, axis=0)
        if self.criterion.measure is Measure.EDGE:
            return size <= limit
        return np.where(axis.any(axis=0), extent, size) <= limit

    def rated(
        self,
        tiles: Tiles,
        coefficients: FloatArray,  # (b, 3, t) float64: Bernstein coefficients over the tiles
        triangle_count: int,  # Of all tiles before
    ) -> list[Tiles]:
        """Choose the rates of tiles in pieces, and divide those in four where that saves triangles.

        Rates are those that the limit needs, and may exceed the highest; see `clipped`.

        Raises MemoryError if there would be too many triangles.
        """
        axis = axis_across(coefficients[self.basis.corners])
        extent = np.ptp(dot(coefficients, axis), axis=0)
        is_flat = self.are_within(tiles, coefficients.min(axis=0), coefficients.max(axis=0), axis, extent)
        if self.criterion.measure is Measure.CHORD:
            # A tile that is folded in its plane reaches beyond its corners, and no triangle covers that.
            is_flat[is_flat] = self.normal_sines(coefficients[..., is_flat], axis[:, is_flat]) < 1
        found = [replace(tiles[is_flat], sides=self._along_sides(tiles[is_flat], coefficients[..., is_flat]))]
        tiles, coefficients = tiles[~is_flat], coefficients[..., ~is_flat]
        forms = self._forms(coefficients, _parts(self.basis, 0)) + self._form_of_displacement(tiles, coefficients)
        rates = self._rates(forms)
        # Divided tiles have fewer triangles.
        require_memory_for_triangles(triangle_count + int(self._costs(tiles, rates).sum()))
        # Bounds of parts are tighter than those of the whole. For the same limit a part that is half as large needs
        # half as many segments: its form is a quarter.
        is_small = (rates.max(axis=1) > 1) & (self._cells(tiles, rates) < FEWEST_DIVIDED)
        small = tiles[is_small], coefficients[..., is_small]
        rates[is_small] = self._rates(
            4 * self._forms(small[1], _parts(self.basis, 1)) + self._form_of_displacement(*small)
        )
        while len(tiles):
            tried = np.flatnonzero(self._cells(tiles, rates) >= FEWEST_DIVIDED)
            of_parts = self._forms(coefficients[..., tried], _parts(self.basis, 2))
            of_parts += self._form_of_displacement(tiles[tried], coefficients[..., tried]) / 16
            rates[tried] = self._rates(16 * of_parts)
            of_children = 4 * of_parts.reshape(4, 4, *of_parts.shape[1:])
            # All first children, all second ones and so on.
            children = Tiles.joined([tiles[tried].child(number, self.domain) for number in range(4)])
            child_rates = self._rates(of_children.swapaxes(0, 1).swapaxes(1, 2).reshape(4, 3, -1))
            cost = self._costs(children, child_rates).reshape(4, -1).sum(axis=0)
            is_better = cost < self._costs(tiles[tried], rates[tried])
            keeps = np.full(len(tiles), True)
            keeps[tried[is_better]] = False
            kept = replace(tiles[keeps], rates=rates[keeps])
            kept = replace(kept, sides=self._along_sides(kept, coefficients[..., keeps]))
            found.append(self._without_pairs(kept))
            divided = coefficients[..., tried[is_better]]
            tiles, rates = children[np.tile(is_better, 4)], child_rates[np.tile(is_better, 4)]
            coefficients = np.concatenate([times(half, divided) for half in self.basis.halves], axis=2)
            if self.criterion.displacement is not None:
                # Parts show more of a displacement than the whole did.
                rates = self._rates(
                    self._forms(coefficients, _parts(self.basis, 0)) + self._form_of_displacement(tiles, coefficients)
                )
        return found

    def normal_sines(self, coefficients: FloatArray, axis: FloatArray) -> FloatArray:
        """Sines of half the angles of cones about axes ``(3, t)`` that contain all normals of tiles or their pieces.

        One where normals are not known to lead to one side of the planes across the axes.
        """
        found = np.empty(axis.shape[1])
        for begin in range(0, len(found), PARTS_AT_ONCE):
            tiles = slice(begin, begin + PARTS_AT_ONCE)
            own = np.ascontiguousarray(coefficients[..., tiles])
            tangents = [TangentCone.of(times(derivative, own)) for derivative in self.basis.derivatives]
            found[tiles] = NormalCone.of(*tangents).around(axis[:, tiles]).sine
        return found

    def most(self, tiles: Tiles) -> IntArray:
        """``(t,)`` the highest rates that tiles may have."""
        return np.maximum(1, self.max_rate >> tiles.halvings.astype(np.int64))

    def clipped(self, tiles: Tiles) -> Tiles:
        """The tiles, with no higher rates than these."""
        most = self.most(tiles)[:, None]
        return replace(
            tiles,
            rates=np.minimum(tiles.rates, most).astype(np.int32),
            sides=np.minimum(tiles.sides, most).astype(np.int16),
        )

    def _heights(self, tiles: Tiles) -> FloatArray:
        """``(n, n, t)`` heights of the displacement over tiles, by v and by u."""
        displacement = self.criterion.displacement
        if displacement is None:
            raise ValueError("heights were asked for without a displacement")
        v, u = np.indices((HEIGHT_SAMPLES,) * 2).reshape(2, -1, 1) / (HEIGHT_SAMPLES - 1)
        if self.domain.corner_count == 3:
            # What is outside lies in the next element; the samples are mirrored at the diagonal.
            u, v = np.where(u + v > 1, 1 - v, u), np.where(u + v > 1, 1 - u, v)
        flipped, size = tiles.is_flipped, tiles.size / UNIT
        uv = [size * (origin + np.where(flipped, 1 - t, t)) for origin, t in zip(tiles.origin.T, (u, v), strict=True)]
        corner = np.broadcast_to(tiles.corner, uv[0].shape).ravel().astype(np.int64)
        scale = self.frames.scale[self.frames.topology.face[tiles.corner]]
        found = displacement.heights(corner, np.stack([(each * scale).ravel() for each in uv], axis=1))
        return found.reshape(HEIGHT_SAMPLES, HEIGHT_SAMPLES, -1)

    def _form_of_displacement(self, tiles: Tiles, coefficients: FloatArray) -> FloatArray:
        """``(1, 3, t)`` what the displacement adds to the forms of tiles; zero without one."""
        if self.criterion.displacement is None or not len(tiles):
            return np.zeros((1, 3, len(tiles)))
        any_normal = NormalCone.of_any(len(tiles))
        limit = self.criterion.limit(coefficients.min(axis=0), coefficients.max(axis=0), any_normal)
        a, b, c = self.criterion.form_of_displacement(self._heights(tiles)) / np.maximum(
            self.criterion.bound(limit), TINY
        )
        if self.domain.corner_count == 3:
            return np.stack([a + 2 * b + c, 0 * b, 0 * c])[None]
        return np.stack([a, b, c])[None]

    def _along_sides(self, tiles: Tiles, coefficients: FloatArray) -> NDArray[np.int16]:
        """`Tiles.sides`: as many segments as keep curves along feature edges to the limit."""
        sides = np.zeros_like(tiles.sides)
        _, _, _, uu, uv, vv = _parts(self.basis, 0)[:, :, 0]
        along = [uu, uu - 2 * uv + vv, vv] if self.domain.corner_count == 3 else [uu, vv, uu, vv]
        for side, (second, own) in enumerate(zip(along, self.basis.sides, strict=True)):
            on = np.flatnonzero(tiles.sides[:, side])
            of_tile = coefficients[..., on]
            limit = self.criterion.limit(of_tile.min(axis=0), of_tile.max(axis=0), NormalCone.of_any(len(on)))
            needed = self.criterion.segments(times(second[own], of_tile), limit)
            sides[on, side] = np.minimum(needed, np.iinfo(sides.dtype).max)
        return sides

    def _forms(
        self,
        coefficients: FloatArray,  # (b, 3, t) float64
        maps: FloatArray,  # (6, b, p, b) float64: as `_parts`
    ) -> FloatArray:
        """``(p, 3, t)`` `Criterion.form` over its bound, of parts of tiles."""
        found = np.empty((maps.shape[2], 3, coefficients.shape[2]))
        size, length = maps.shape[-1], max(1, PARTS_AT_ONCE // maps.shape[2])
        criterion, corner_count, parts_across = self.criterion, self.domain.corner_count, isqrt(maps.shape[2])
        for begin in range(0, coefficients.shape[2], length):
            tiles = slice(begin, begin + length)
            own = coefficients[..., tiles]
            derivatives = list(times(maps[1:].reshape(-1, size), own).reshape(5, size, -1, 3, own.shape[2]))
            tangents = TangentCone.of(derivatives[0]), TangentCone.of(derivatives[1])
            cone = NormalCone.of(*tangents)
            if criterion.is_everywhere_alike:
                limit = np.full(cone.sine.shape, criterion.error)
            else:
                points = times(maps[0].reshape(-1, size), own).reshape(derivatives[0].shape)
                limit = criterion.limit(points.min(axis=0), points.max(axis=0), cone, derivatives[2:], parts_across)
            form = criterion.form(derivatives, tangents, cone, corner_count)
            found[..., tiles] = (form / np.maximum(criterion.bound(limit), TINY)).swapaxes(0, 1)
        return found

    def _rates(self, forms: FloatArray) -> IndexArray:
        """``(t, 2)`` segments along u and v for forms ``(f, 3, t)`` that are to be one at most."""
        if self.domain.corner_count == 3:
            found = np.repeat(rounded_up(np.sqrt(forms[:, 0].max(axis=0)))[:, None], 2, axis=1)
        else:
            found = least_product(forms)
        return found.astype(np.int32)

    def _without_pairs(self, tiles: Tiles) -> Tiles:
        """The tiles, with triangles of two segments divided: their only inner lines join the middles of the sides."""
        is_pair = (np.minimum(tiles.rates[:, 0], self.most(tiles)) == 2) & (self.domain.corner_count == 3)
        children = [tiles[is_pair].child(number, self.domain) for number in range(4)]
        return Tiles.joined([tiles[~is_pair], *(replace(each, rates=-(-each.rates // 2)) for each in children)])

    def cost(self, tiles: Tiles) -> int:
        """Triangles of some tiles, but for those of other rates next door."""
        return int(self._costs(tiles, tiles.rates).sum())

    def _costs(self, tiles: Tiles, rates: IntArray) -> IntArray:
        """Likewise of each tile with these rates."""
        return self._cells(tiles, rates) * (1 if self.domain.corner_count == 3 else 2)

    def _cells(self, tiles: Tiles, rates: IntArray) -> IntArray:
        """``(t,)`` cells of tiles with these rates, clipped."""
        cells: IntArray = np.minimum(rates, self.most(tiles)[:, None]).astype(np.int64).prod(axis=1)
        return cells


def axis_across(corners: FloatArray) -> FloatArray:
    """``(3, t)`` unit vectors across two diagonals, of three or four corners ``(m, 3, t)``; zero if these are parallel.

    Of a triangle, two of its sides.
    """
    axis = cross(corners[2] - corners[0], corners[-1] - corners[1])
    length = np.linalg.norm(axis, axis=0)
    return axis / np.where(length > 0, length, 1)


@lru_cache(maxsize=16)
def _parts(basis: BernsteinBasis, level: int) -> FloatArray:
    """``(6, b, 4^level, b)`` maps from coefficients to those over parts, and of derivatives u, v, uu, uv, vv.

    The parts are the copies of the domain, or the copies of these, and so on.
    """
    parts = np.eye(len(basis.indices))[None]
    maps = np.concatenate([parts, basis.two_derivatives])
    for _ in range(level):
        parts = (basis.halves @ parts[:, None]).reshape(-1, *parts.shape[1:])
    return np.ascontiguousarray(np.einsum("dab,pbc->dapc", maps, parts))
