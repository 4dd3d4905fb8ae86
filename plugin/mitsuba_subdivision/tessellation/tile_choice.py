"""The choice of tiles: how patches are divided, and how many segments each part has, for a criterion."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from functools import lru_cache
from math import isqrt

import numpy as np
from numpy.typing import NDArray

from ..evaluation.bernstein import BernsteinBasis, regular_bernstein, times
from ..evaluation.tile_tree import Tail, TileTree, tile_tree
from ..mesh.connectivity import IntArray
from ..patches import PatchTable
from ..progress import counted
from ..schemes.domain import FloatArray, ParameterDomain
from .criterion import Criterion, Measure, NormalCone, TangentCone
from .least_rates import TINY, least_product, rounded_up
from .memory import require_memory_for_triangles
from .patch_frames import PatchFrames
from .tiles import DEEPEST, Tiles

# Parts of tiles are looked at in runs of this many, whose derivatives stay in a core's cache.
RUN = 1 << 11
# Tiles of fewer cells are not divided: four parts have at least so many.
FEWEST_DIVIDED = 5
# Forms in single precision are as much too small at most, and by so much of a tile's size: second derivatives are sums
# of nine coefficients with weights of 4 times 6 at most, and their eighth counts.
LOST = 1.001
EPSILON = 4 * 2.0**-23
# Samples of a relief along each side of a tile.
RELIEF_SAMPLES = 9


@dataclass(frozen=True, eq=False)
class _Pieces:
    """Tiles that lie in one piece.

    Attributes
    ----------
    tiles : Tiles
    coefficients : (b, 3, t) float64
        Bernstein coefficients.
    """

    tiles: Tiles
    coefficients: FloatArray


@dataclass(frozen=True, eq=False)
class _Undivided:
    """Tiles that may have to be divided: the same ones of some patches of a class.

    Attributes
    ----------
    tree : TileTree
    tile : int
        Which of the tree's.
    tiles : Tiles
    points : (K, 3, t) float64
        Control points.
    """

    tree: TileTree
    tile: int
    tiles: Tiles
    points: FloatArray

    @property
    def tail(self) -> Tail | None:
        return self.tree.tails[self.tile]

    @property
    def pieces(self) -> FloatArray:
        """``(p, b, K)`` pieces of the hull."""
        return self.tree.pieces[self.tree.hulls[self.tile]]

    def hull(self) -> FloatArray:
        """``(p b, 3, t)`` points whose hull, with the tail, contains the surface."""
        return times(self.pieces.reshape(-1, self.pieces.shape[2]), self.points)

    def children(
        self, hull: FloatArray, children: list[Tiles], which: NDArray[np.bool_]
    ) -> Iterator[_Undivided | _Pieces]:
        """The four copies of some of the tiles.

        Parameters
        ----------
        hull : (p b, 3, t) float64
            As `hull` gives it.
        children : four Tiles
            The copies of those.
        which : (t,) bool
        """
        first, size = self.tree.hulls[self.tile].start, self.pieces.shape[1]
        points = None
        for child, own in zip(self.tree.children[self.tile].tolist(), children, strict=True):
            if child < 0:
                begin = (~child - first) * size
                yield _Pieces(own, hull[begin : begin + size, :, which])
                continue
            if points is None:
                points = np.ascontiguousarray(self.points[..., which])
            # Each ring may have as many segments as the one around it.
            tiles = own if self.tail is None else replace(own, most=self.tiles.most[which])
            yield _Undivided(self.tree, child, tiles, points)


def choose_tiles(
    patches: PatchTable,
    frames: PatchFrames,
    control_points: FloatArray,
    row: IntArray,
    criterion: Criterion,
    max_rate: int,
) -> Tiles:
    """Divide the patches of a cage into tiles, and choose their rates.

    Parameters
    ----------
    patches : PatchTable
    frames : PatchFrames
        Of these.
    control_points : (n, 3) float64
    row : (n_v,) int64
        0-based control point at each mesh vertex.
    criterion : Criterion
    max_rate : int
        Most segments along an edge of the cage; around extraordinary points, along each ring.

    Returns
    -------
    Tiles
        In the order of the elements, and in each along a curve of Morton's.

    Raises
    ------
    MemoryError
        If their triangles would not fit into memory.
    """
    chooser = _Chooser(frames, regular_bernstein(patches.scheme).basis, criterion)
    found, pieces = chooser.divided(_classes(patches, frames, control_points, row, max_rate))
    if pieces:
        found += chooser.rated(pieces)
    tiles = Tiles.joined(found)
    return tiles[_order(tiles, frames)]


def _classes(
    patches: PatchTable, frames: PatchFrames, control_points: FloatArray, row: IntArray, max_rate: int
) -> Iterator[_Undivided]:
    """All patches, class by class, each as one tile."""
    refined = patches.refined
    table = patches if refined is None else refined.table
    points = control_points[row] if refined is None else refined.matrix @ control_points[row]
    for patch_class in counted(table.classes, "Tiles of patch classes"):
        corners = patch_class.corners if refined is None else refined.corners(patch_class)
        whole = Tiles.whole(corners, max_rate, _is_border(frames, corners))
        controls = np.ascontiguousarray(points.T[:, patch_class.controls.T].swapaxes(0, 1))
        yield _Undivided(tile_tree(table.scheme, patch_class.signature), 0, whole, controls)


def _is_border(frames: PatchFrames, corners: IntArray) -> NDArray[np.bool_]:
    """``(p, m)`` which sides of the patches that begin at these corners lie on borders of the mesh."""
    t, m = frames.topology, frames.domain.corner_count
    is_border, is_whole = t.twin < 0, frames.is_whole[t.face_of(corners)]
    found = np.zeros((len(corners), m), dtype=bool)
    half_edge = corners
    for side in range(m):
        found[:, side] = is_whole & is_border[half_edge]
        half_edge = t.following(half_edge)
    # Patches at corners have half an edge on their first and their last side.
    found[:, 0] |= is_border[corners]
    found[:, -1] |= ~is_whole & is_border[t.preceding(corners)]
    return found


def _order(tiles: Tiles, frames: PatchFrames) -> IntArray:
    """Tiles in the order of their elements, then of their patches, along a curve of Morton's."""
    code = _interleaved(tiles.place[:, 0] << (DEEPEST - tiles.depth)) | (
        _interleaved(tiles.place[:, 1] << (DEEPEST - tiles.depth)) << 1
    )
    return np.lexsort([tiles.is_flipped, code, tiles.corner, frames.topology.face_of(tiles.corner)])


def _interleaved(values: IntArray) -> IntArray:
    """Integers of up to 26 bits with a zero after each bit."""
    found = values.astype(np.uint64)
    for shift, mask in _SPREADING:
        found = (found | (found << np.uint64(shift))) & np.uint64(mask)
    return found.astype(np.int64)


# By so many bits the upper half of each group of bits moves, and which bits there are then.
_SPREADING = (
    (16, 0x0000FFFF0000FFFF),
    (8, 0x00FF00FF00FF00FF),
    (4, 0x0F0F0F0F0F0F0F0F),
    (2, 0x3333333333333333),
    (1, 0x5555555555555555),
)


@dataclass(frozen=True, eq=False)
class _Chooser:
    """What choosing needs everywhere."""

    frames: PatchFrames
    basis: BernsteinBasis
    criterion: Criterion

    @property
    def domain(self) -> ParameterDomain:
        return self.basis.domain

    def divided(self, patches: Iterable[_Undivided]) -> tuple[list[Tiles], list[_Pieces]]:
        """Divide patches until each tile lies in a piece, or is so flat that one pair of triangles does."""
        done: list[Tiles] = []
        pieces: list[_Pieces] = []
        waiting = []
        for each in patches:
            if len(each.tree.children):
                waiting.append(each)
            else:
                pieces.append(_Pieces(each.tiles, times(each.tree.pieces[0], each.points)))
        while waiting:
            # Hulls of the same number of pieces are looked at together.
            alike: dict[int, list[_Undivided]] = {}
            for each in waiting:
                alike.setdefault(len(each.pieces), []).append(each)
            waiting = []
            for group in alike.values():
                tiles = Tiles.joined([each.tiles for each in group])
                hull = np.concatenate([each.hull() for each in group], axis=2)
                is_flat = self._are_flat(group, tiles, hull)
                done.append(tiles[is_flat])
                divided = tiles[~is_flat]
                children = [divided.child(number, self.domain) for number in range(4)]
                begin, first = 0, 0
                for each in group:
                    own = slice(begin, begin + len(each.tiles))
                    which = ~is_flat[own]
                    of_these = slice(first, first + int(np.count_nonzero(which)))
                    if which.any():
                        for child in each.children(hull[..., own], [every[of_these] for every in children], which):
                            if isinstance(child, _Pieces):
                                pieces.append(child)
                            else:
                                waiting.append(child)
                    begin, first = own.stop, of_these.stop
        return done, pieces

    def _are_flat(self, group: list[_Undivided], tiles: Tiles, hull: FloatArray) -> NDArray[np.bool_]:
        """Whether one pair of triangles does for each tile, of some with hulls of the same number of pieces."""
        ends = np.cumsum([len(each.tiles) for each in group])
        corners = np.concatenate([times(each.tree.corners[each.tile], each.points) for each in group], axis=2)
        # Across the two diagonals; of a triangle, two of its sides.
        axis = np.cross(corners[2] - corners[0], corners[-1] - corners[1], axis=0)
        length = np.linalg.norm(axis, axis=0)
        axis /= np.where(length > 0, length, 1)
        along = np.einsum("bit,it->bt", hull, axis)
        lower, upper, low, high = hull.min(axis=0), hull.max(axis=0), along.min(axis=0), along.max(axis=0)
        for each, begin, end in zip(group, ends - [len(each.tiles) for each in group], ends, strict=True):
            if each.tail is not None:
                own, tail = slice(begin, end), each.tail
                moved = times(tail.coordinates, each.points)
                centre = moved[0]
                extent = (tail.reach @ np.abs(moved).reshape(len(moved), -1)).reshape(3, -1)
                np.minimum(lower[:, own], centre - extent, out=lower[:, own])
                np.maximum(upper[:, own], centre + extent, out=upper[:, own])
                height = (centre * axis[:, own]).sum(axis=0)
                rise = tail.reach @ np.abs((moved * axis[:, own]).sum(axis=1))
                np.minimum(low[own], height - rise, out=low[own])
                np.maximum(high[own], height + rise, out=high[own])
        # Of a tile without a normal there is the size only.
        heights = np.where(length > 0, high - low, np.linalg.norm(upper - lower, axis=0))
        if self.criterion.relief is not None:
            heights += np.ptp(self._relief(tiles), axis=(0, 1))
        cone = self._cone(hull, axis)
        # Along a border an outline may run, whatever the normals are.
        cone = replace(cone, sine=np.where(tiles.sides.any(axis=1), 1, cone.sine))
        is_flat = self.criterion.is_flat(lower, upper, heights, self.criterion.limit(lower, upper, cone))
        # Single precision tells nothing nearer to an extraordinary point apart from it.
        has_tail = np.repeat([each.tail is not None for each in group], [len(each.tiles) for each in group])
        is_flat |= (tiles.depth >= DEEPEST - 1) | (~has_tail & (tiles.most == 1))
        return is_flat

    def _cone(self, hull: FloatArray, axis: FloatArray) -> NormalCone:
        """Cones of the normals of hulls ``(p b, 3, t)`` about axes ``(3, t)``, if the criterion asks for normals.

        Nearer to an extraordinary point than the pieces, normals turn less than on these.
        """
        if self.criterion.outline is None:
            return NormalCone(axis, np.ones(axis.shape[1]))
        size = len(self.basis.indices)
        by_coefficient = np.ascontiguousarray(hull.reshape(-1, size, *hull.shape[1:]).swapaxes(0, 1))
        derivatives = [times(each, by_coefficient) for each in self.basis.derivatives]
        tangents = [TangentCone.of(each) for each in derivatives]
        return NormalCone(axis, NormalCone.of(*tangents).around(axis).sine.max(axis=0))

    def rated(self, pieces: list[_Pieces]) -> list[Tiles]:
        """Choose the rates of tiles in pieces, and divide those in four where that saves triangles."""
        tiles = Tiles.joined([each.tiles for each in pieces])
        coefficients = np.concatenate([each.coefficients for each in pieces], axis=2)
        forms = self._forms(coefficients, _parts(self.basis, 0)) + self._form_of_relief(tiles, coefficients)
        rates = self._rates(forms, tiles)
        # Divided tiles have fewer triangles.
        require_memory_for_triangles(int(self._cost(rates).sum()))
        # Bounds of parts are tighter than those of the whole. For the same limit a part that is half as large needs
        # half as many segments: its form is a quarter.
        is_small = (rates.prod(axis=1) > 1) & (rates.prod(axis=1) < FEWEST_DIVIDED)
        small = tiles[is_small], coefficients[..., is_small]
        rates[is_small] = self._rates(
            4 * self._forms(small[1], _parts(self.basis, 1)) + self._form_of_relief(*small), tiles[is_small]
        )
        found = []
        while len(tiles):
            tried = np.flatnonzero(rates.prod(axis=1) >= FEWEST_DIVIDED)
            of_parts = self._forms(coefficients[..., tried], _parts(self.basis, 2))
            of_parts += self._form_of_relief(tiles[tried], coefficients[..., tried]) / 16
            rates[tried] = self._rates(16 * of_parts, tiles[tried])
            of_children = 4 * of_parts.reshape(4, 4, *of_parts.shape[1:])
            # All first children, all second ones and so on.
            children = Tiles.joined([tiles[tried].child(number, self.domain) for number in range(4)])
            child_rates = self._rates(of_children.swapaxes(0, 1).swapaxes(1, 2).reshape(4, 3, -1), children)
            cost = self._cost(child_rates).reshape(4, -1).sum(axis=0)
            is_better = (cost < self._cost(rates[tried])) & (tiles.most[tried] > 1)
            keeps = np.full(len(tiles), True)
            keeps[tried[is_better]] = False
            kept = replace(tiles[keeps], rates=rates[keeps])
            kept = replace(kept, sides=self._along_borders(kept, coefficients[..., keeps]))
            found.append(self._without_pairs(kept))
            divided = coefficients[..., tried[is_better]]
            tiles, rates = children[np.tile(is_better, 4)], child_rates[np.tile(is_better, 4)]
            coefficients = np.concatenate([times(half, divided) for half in self.basis.halves], axis=2)
            if self.criterion.relief is not None:
                # Parts show more of a relief than the whole did.
                rates = self._rates(
                    self._forms(coefficients, _parts(self.basis, 0)) + self._form_of_relief(tiles, coefficients), tiles
                )
        return found

    def _relief(self, tiles: Tiles) -> FloatArray:
        """``(n, n, t)`` heights of the relief over tiles, by v and by u."""
        relief = self.criterion.relief
        if relief is None:
            raise ValueError("heights were asked for without a relief")
        v, u = np.indices((RELIEF_SAMPLES,) * 2).reshape(2, -1, 1) / (RELIEF_SAMPLES - 1)
        if self.domain.corner_count == 3:
            # What is outside lies in the next element; the samples are mirrored at the diagonal.
            u, v = np.where(u + v > 1, 1 - v, u), np.where(u + v > 1, 1 - u, v)
        flipped, size = tiles.is_flipped, 0.5**tiles.depth
        uv = [size * (place + np.where(flipped, 1 - t, t)) for place, t in zip(tiles.place.T, (u, v), strict=True)]
        corner = np.broadcast_to(tiles.corner, uv[0].shape).ravel().astype(np.int64)
        scale = self.frames.scale[self.frames.topology.face_of(tiles.corner)]
        found = relief.heights(corner, np.stack([(each * scale).ravel() for each in uv], axis=1))
        return found.reshape(RELIEF_SAMPLES, RELIEF_SAMPLES, -1)

    def _form_of_relief(self, tiles: Tiles, coefficients: FloatArray) -> FloatArray:
        """``(1, 3, t)`` what the relief adds to the forms of tiles; zero without one."""
        if self.criterion.relief is None or not len(tiles):
            return np.zeros((1, 3, len(tiles)))
        any_normal = NormalCone.of_any(len(tiles))
        limit = self.criterion.limit(coefficients.min(axis=0), coefficients.max(axis=0), any_normal)
        a, b, c = self.criterion.form_of_relief(self._relief(tiles)) / np.maximum(self.criterion.bound(limit), TINY)
        if self.domain.corner_count == 3:
            return np.stack([a + 2 * b + c, 0 * b, 0 * c])[None]
        return np.stack([a, b, c])[None]

    def _along_borders(self, tiles: Tiles, coefficients: FloatArray) -> IntArray:
        """`Tiles.sides`: as many segments as keep outlines along borders to the limit, if others need not."""
        sides = np.zeros_like(tiles.sides)
        if self.criterion.outline is None:
            return sides
        _, _, _, uu, uv, vv = _parts(self.basis, 0)[:, :, 0].astype(np.float64)
        along = [uu, uu - 2 * uv + vv, vv] if self.domain.corner_count == 3 else [uu, vv, uu, vv]
        for side, (second, own) in enumerate(zip(along, self.basis.sides, strict=True)):
            on = np.flatnonzero(tiles.sides[:, side])
            of_tile = coefficients[..., on]
            limit = self.criterion.limit(of_tile.min(axis=0), of_tile.max(axis=0), NormalCone.of_any(len(on)))
            needed = self.criterion.segments(times(second[own], of_tile), limit)
            sides[on, side] = np.minimum(needed, tiles.most[on])
        return sides

    def _forms(self, coefficients: FloatArray, maps: FloatArray) -> FloatArray:
        """``(p, 3, t)`` `Criterion.form` over its bound, of parts of tiles.

        In single precision, about a point of each tile: what that loses is added.

        Parameters
        ----------
        coefficients : (b, 3, t) float64
        maps : (6, b, p, b) float32
            As `_parts`.
        """
        found = np.empty((maps.shape[2], 3, coefficients.shape[2]))
        size, length = maps.shape[-1], max(1, RUN // maps.shape[2])
        criterion, corner_count, parts_across = self.criterion, self.domain.corner_count, isqrt(maps.shape[2])
        for begin in range(0, coefficients.shape[2], length):
            tiles = slice(begin, begin + length)
            origin = coefficients[0, :, tiles]
            own = (coefficients[..., tiles] - origin).astype(np.float32)
            derivatives = list(times(maps[1:].reshape(-1, size), own).reshape(5, size, -1, 3, own.shape[2]))
            tangents = TangentCone.of(derivatives[0]), TangentCone.of(derivatives[1])
            cone = NormalCone.of(*tangents)
            if criterion.is_everywhere_alike:
                limit = np.full(cone.sine.shape, criterion.error)
            else:
                points = times(maps[0].reshape(-1, size), own).reshape(derivatives[0].shape)
                boxes = points.min(axis=0) + origin, points.max(axis=0) + origin
                limit = criterion.limit(*boxes, cone, derivatives[2:], parts_across)
            form = LOST * criterion.form(derivatives, tangents, cone, corner_count)
            if criterion.measure is Measure.CHORD:
                form[[0, 2]] += EPSILON * np.abs(own).max(axis=(0, 1))
            found[..., tiles] = (form / np.maximum(criterion.bound(limit), TINY)).swapaxes(0, 1)
        return found

    def _rates(self, forms: FloatArray, tiles: Tiles) -> IntArray:
        """``(t, 2)`` segments along u and v for forms ``(f, 3, t)`` that are to be one at most."""
        if self.domain.corner_count == 3:
            found: IntArray = np.repeat(rounded_up(np.sqrt(forms[:, 0].max(axis=0)))[:, None], 2, axis=1)
        else:
            found = least_product(forms)
        return np.minimum(found, tiles.most[:, None])

    def _without_pairs(self, tiles: Tiles) -> Tiles:
        """The tiles, with triangles of two segments divided: their only inner lines join the middles of the sides."""
        is_pair = (tiles.rates[:, 0] == 2) & (self.domain.corner_count == 3)
        children = [tiles[is_pair].child(number, self.domain) for number in range(4)]
        ones = np.ones((int(is_pair.sum()), 2), dtype=np.int64)
        return Tiles.joined([tiles[~is_pair], *(replace(each, rates=ones) for each in children)])

    def _cost(self, rates: IntArray) -> IntArray:
        """Triangles, but for those of other rates next door."""
        return rates[:, 0] * rates[:, 1] * (1 if self.domain.corner_count == 3 else 2)


@lru_cache(maxsize=16)
def _parts(basis: BernsteinBasis, level: int) -> FloatArray:
    """``(6, b, 4^level, b)`` float32 maps from coefficients to those over parts, and of derivatives u, v, uu, uv, vv.

    The parts are the copies of the domain, or the copies of these, and so on.
    """
    parts = np.eye(len(basis.indices))[None]
    maps = np.concatenate([parts, basis.two_derivatives])
    for _ in range(level):
        parts = (basis.halves @ parts[:, None]).reshape(-1, *parts.shape[1:])
    return np.ascontiguousarray(np.einsum("dab,pbc->dapc", maps, parts), dtype=np.float32)
