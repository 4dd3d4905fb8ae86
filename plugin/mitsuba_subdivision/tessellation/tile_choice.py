"""The choice of tiles: how patches are divided, and how many segments each part has, for a criterion."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..evaluation.bernstein import regular_bernstein, times
from ..evaluation.divided_element import divided_elements
from ..evaluation.divided_tile import DividedTile, part_of_tile
from ..mesh.connectivity import IntArray
from ..mesh.one_ring import one_ring
from ..mesh.signature import Signature
from ..patches import PatchTable
from ..progress import counted
from ..schemes.domain import FloatArray
from ..schemes.members import optional_member
from ..schemes.scheme import Scheme
from .criterion import Criterion, Measure, NormalCone, TangentCone
from .patch_frames import PatchFrames
from .tile_extents import TileValues, fit_within
from .tile_rates import TileRates, axis_across
from .tiles import DEEPEST, Tiles
from .watched_sides import sides_on, watched_edges

# So many patches, or pieces of these, are looked at together, which bounds temporary memory.
BLOCK = 1 << 15


class _Pieces(NamedTuple):
    """Tiles that lie in one piece.

    Attributes
    ----------
    tiles : Tiles
    coefficients : (b, 3, t) float64
        Bernstein coefficients.
    """

    tiles: Tiles
    coefficients: FloatArray


class _Undivided(NamedTuple):
    """Tiles that may have to be divided, and would be divided alike.

    Attributes
    ----------
    tile : DividedTile
    tiles : Tiles
    points : (K, 3, t) float64
        Control points.
    """

    tile: DividedTile
    tiles: Tiles
    points: FloatArray

    @classmethod
    def joined(cls, parts: list[_Undivided]) -> _Undivided:
        """Tiles of some lists, which are divided alike."""
        if len(parts) == 1:
            return parts[0]
        points = np.concatenate([each.points for each in parts], axis=2)
        return cls(parts[0].tile, Tiles.joined([each.tiles for each in parts]), points)

    def chosen(self, which: IntArray) -> _Undivided:
        """Some of the tiles."""
        return _Undivided(self.tile, self.tiles[which], np.ascontiguousarray(self.points[..., which]))

    @property
    def box(self) -> tuple[FloatArray, FloatArray]:
        """``(3, t)`` opposite corners of boxes around the control points."""
        points = self.tile.one_ring_points(self.points)
        return points.min(axis=0), points.max(axis=0)

    @property
    def axis(self) -> FloatArray:
        """``(3, t)`` unit vectors across the diagonals of the tiles, or zero."""
        return axis_across(times(self.tile.corners, self.points))

    def children(self, children: list[Tiles]) -> Iterator[_Undivided | _Pieces]:
        """The four copies of all tiles, given as such."""
        for (tile, rows), tiles in zip(self.tile.children, children, strict=True):
            points = times(rows, self.points)
            if tile is None:
                yield _Pieces(tiles, points)
            else:
                # Each ring around an extraordinary point may have as many segments as the one around it.
                yield _Undivided(tile, replace(tiles, most=self.tiles.most) if tile is self.tile else tiles, points)


class _Patches(NamedTuple):
    """Patches of a class, each as one tile.

    Attributes
    ----------
    signature : Signature
    tiles : Tiles
    points : (K, 3, t) float64
        Control points.
    """

    signature: Signature
    tiles: Tiles
    points: FloatArray


def choose_tiles(
    patches: PatchTable,
    frames: PatchFrames,
    control_points: FloatArray,
    control_of_vertex: IntArray,
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
    control_of_vertex : (n_v,) int64
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
    rates = TileRates(frames, regular_bernstein(patches.scheme).basis, criterion)
    chooser = _Chooser(patches.scheme, criterion, rates)
    found: list[Tiles] = []
    triangle_count = 0
    watched = watched_edges(patches, frames, control_points[control_of_vertex], criterion)
    for block in _blocks(patches, frames, control_points, control_of_vertex, watched, max_rate):
        chosen = chooser.chosen(block, triangle_count)
        triangle_count += chooser.rates.cost(chosen)
        found += chosen
    tiles = Tiles.joined(found)
    return tiles[_order(tiles, frames)]


def _blocks(
    patches: PatchTable,
    frames: PatchFrames,
    control_points: FloatArray,
    control_of_vertex: IntArray,
    watched: NDArray[np.bool_],
    max_rate: int,
) -> Iterator[list[_Patches]]:
    """All patches, class by class, in blocks that bound what is needed at once."""
    refined = patches.refined
    table = patches if refined is None else refined.table
    points = (
        control_points[control_of_vertex] if refined is None else refined.matrix @ control_points[control_of_vertex]
    )
    block, count = [], 0
    for patch_class in counted(table.classes, "Tiles of patch classes"):
        for begin in range(0, len(patch_class.corners), BLOCK):
            own = slice(begin, begin + BLOCK)
            corners = patch_class.corners[own]
            if refined is not None:
                corners = refined.corners(patch_class)[own]
            whole = Tiles.whole(corners, max_rate, sides_on(watched, frames, corners))
            controls = np.ascontiguousarray(points[patch_class.controls[own].T].swapaxes(1, 2))
            block.append(_Patches(patch_class.signature, whole, controls))
            count += len(corners)
            if count >= BLOCK:
                yield block
                block, count = [], 0
    if block:
        yield block


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

    scheme: Scheme
    criterion: Criterion
    rates: TileRates

    def chosen(self, patches: list[_Patches], triangle_count: int) -> list[Tiles]:
        """Tiles of some patches, with their rates.

        Parameters
        ----------
        patches : list of _Patches
        triangle_count : int
            Of all patches before.

        Raises
        ------
        MemoryError
            If there would be too many triangles.
        """
        done: list[Tiles] = []
        rest = patches
        if optional_member(self.scheme, "has_convex_rules"):
            done, rest = self._flat_patches(patches)
        flat, pieces = self._divided(rest)
        done += flat
        if pieces:
            tiles = Tiles.joined([each.tiles for each in pieces])
            coefficients = np.concatenate([each.coefficients for each in pieces], axis=2)
            for begin in range(0, len(tiles), BLOCK):
                run = slice(begin, begin + BLOCK)
                found = self.rates.rated(tiles[run], coefficients[..., run], triangle_count)
                triangle_count += self.rates.cost(found)
                done += found
        return done

    def _flat_patches(self, patches: list[_Patches]) -> tuple[list[Tiles], list[_Patches]]:
        """Patches whose one-rings are so flat that one pair of triangles does for each, and all others.

        Most patches of a dense cage are, and nothing else has to be known of them.
        """
        done: list[Tiles] = []
        rest: list[_Patches] = []
        for each in patches:
            # Across the diagonals of a face: of the element, or beside a vertex that is one.
            topology = one_ring(each.signature.smoothed).topology
            size = int(topology.face_sizes[0])
            corners = each.points[topology.face_vertices[[0, size // 4, size // 2, 3 * size // 4]]]
            is_flat = self.rates.have_flat_hulls(each.tiles, each.points, axis_across(corners))
            is_flat &= ~each.tiles.sides.any(axis=1)
            done.append(each.tiles[is_flat])
            if not is_flat.all():
                rest.append(_Patches(each.signature, each.tiles[~is_flat], each.points[..., ~is_flat]))
        return done, rest

    def _divided(self, patches: list[_Patches]) -> tuple[list[Tiles], list[_Pieces]]:
        """Divide patches until each tile lies in a piece, or is so flat that one pair of triangles does."""
        done: list[Tiles] = []
        pieces: list[_Pieces] = []
        waiting: list[_Undivided] = []
        elements = divided_elements(self.scheme, [each.signature for each in patches])
        for each, element in zip(patches, elements, strict=True):
            tile, rows = part_of_tile(element, np.eye(element.control_count))
            points = times(rows, each.points)
            if tile is None:
                pieces.append(_Pieces(each.tiles, points))
            else:
                waiting.append(_Undivided(tile, each.tiles, points))
        while waiting:
            alike: dict[DividedTile, list[_Undivided]] = {}
            for undivided in waiting:
                alike.setdefault(undivided.tile, []).append(undivided)
            groups = [_Undivided.joined(group) for group in alike.values()]
            waiting = []
            for group, is_flat in zip(groups, self._need_no_division(groups), strict=True):
                done.append(group.tiles[is_flat])
                if is_flat.all():
                    continue
                rest = group.chosen(np.flatnonzero(~is_flat))
                for child in rest.children([rest.tiles.child(number, self.scheme.domain) for number in range(4)]):
                    if isinstance(child, _Pieces):
                        pieces.append(child)
                    else:
                        waiting.append(child)
        return done, pieces

    def _need_no_division(self, groups: list[_Undivided]) -> list[NDArray[np.bool_]]:
        """Whether one pair of triangles does for each of some tiles."""
        found = self._end_along_lines(groups, self._are_flat(groups))
        # Single precision tells nothing nearer to an extraordinary point apart. Elsewhere rates get less.
        return [
            is_flat | (each.tiles.depth >= DEEPEST - 1) | ((each.tiles.most == 1) & (not each.tile.is_self_similar))
            for each, is_flat in zip(groups, found, strict=True)
        ]

    def _end_along_lines(self, groups: list[_Undivided], are_flat: list[NDArray[np.bool_]]) -> list[NDArray[np.bool_]]:
        """Which of the flat tiles have straight curves along their watched sides."""
        found = [is_flat.copy() for is_flat in are_flat]
        parts, which = [], []
        for number, each in enumerate(groups):
            for side in range(self.scheme.domain.corner_count):
                on = np.flatnonzero(are_flat[number] & (each.tiles.sides[:, side] > 0))
                if len(on):
                    own = each.chosen(on)
                    ends = times(each.tile.corners, own.points)[[side, (side + 1) % self.scheme.domain.corner_count]]
                    across = np.stack(_normals_to(ends[1] - ends[0]))
                    values = np.einsum("kit,dit->kdt", own.points, across)
                    limit = self.rates.limit(own.tiles, *own.box, NormalCone.of_any(len(on)))
                    parts.append(TileValues(each.tile, values, limit, side))
                    which.append((number, on))
        if parts:
            for (number, on), are_straight in zip(which, fit_within(self.scheme, parts), strict=True):
                found[number][on] &= are_straight
        return found

    def _are_flat(self, groups: list[_Undivided]) -> list[NDArray[np.bool_]]:
        """Whether one pair of triangles is near enough to the surface over each of some tiles."""
        values = [self._values(each) for each in groups]
        found = fit_within(self.scheme, values)
        if self.criterion.outline is not None:
            again = []
            for each, own, is_flat in zip(groups, values, found, strict=True):
                limit = np.where(is_flat, -1.0, self._limit_by_normals(each))
                again.append(own._replace(limit=limit))
            found = [a | b for a, b in zip(found, fit_within(self.scheme, again), strict=True)]
        return found

    def _values(self, group: _Undivided) -> TileValues:
        """Coordinates of control points along the axis across which tiles are hoped to be flat, and the limit there."""
        lower, upper = group.box
        limit = self.rates.limit(group.tiles, lower, upper, NormalCone.of_any(len(group.tiles)))
        if self.criterion.measure is Measure.EDGE:
            return TileValues(group.tile, group.points, limit)
        axis = group.axis
        along = np.einsum("kit,it->kt", group.points, axis)
        # Of a tile without a normal there is the size only.
        fits = np.linalg.norm(upper - lower, axis=0) <= limit
        limit = np.where(axis.any(axis=0), limit, np.where(fits, np.inf, -1.0))
        return TileValues(group.tile, along[:, None], limit)

    def _limit_by_normals(self, group: _Undivided) -> FloatArray:
        """``(t,)`` higher limits of tiles that no outline crosses, else negative ones.

        Along a border an outline may run, whatever the normals are.
        """
        found = np.full(len(group.tiles), -1.0)
        inside = np.flatnonzero(~group.tiles.sides.any(axis=1))
        if group.tile.pieces is None or not len(inside):
            return found
        pieces = group.tile.pieces
        coefficients = times(pieces.reshape(-1, pieces.shape[2]), group.points[..., inside])
        lower, upper = (each[:, inside] for each in group.box)
        cone = self._cone(coefficients, group.axis[:, inside])
        found[inside] = self.rates.limit(group.tiles[inside], lower, upper, cone)
        return found

    def _cone(self, pieces: FloatArray, axis: FloatArray) -> NormalCone:
        """Cones of the normals of pieces ``(p b, 3, t)`` about axes ``(3, t)``.

        Nearer to an extraordinary point than the pieces, normals turn less than on these.
        """
        size = len(self.rates.basis.indices)
        by_coefficient = np.ascontiguousarray(pieces.reshape(-1, size, *pieces.shape[1:]).swapaxes(0, 1))
        derivatives = [times(each, by_coefficient) for each in self.rates.basis.derivatives]
        tangents = [TangentCone.of(each) for each in derivatives]
        return NormalCone(axis, NormalCone.of(*tangents).around(axis).sine.max(axis=0))


def _normals_to(way: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Two unit vectors ``(3, t)`` across each of some vectors, and across each other; any two where these are zero."""
    length = np.linalg.norm(way, axis=0)
    way = np.where(length > 0, way / np.where(length > 0, length, 1), np.array([[0.0], [0], [1]]))
    # Across the way and the axis that it is least along.
    first = np.cross(way, np.eye(3)[np.argmin(np.abs(way), axis=0)].T, axis=0)
    first /= np.linalg.norm(first, axis=0)
    return first, np.cross(way, first, axis=0)
