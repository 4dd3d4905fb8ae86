"""The choice of tiles: how patches are divided, and how many segments each part has, for a criterion."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import lru_cache
from math import isqrt
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..evaluation.bernstein import BernsteinBasis, regular_bernstein, times
from ..evaluation.divided_element import divided_elements
from ..evaluation.divided_tile import DividedTile, part_of_tile
from ..mesh.connectivity import IntArray
from ..mesh.one_ring import one_ring
from ..mesh.signature import Signature
from ..patches import PatchTable
from ..progress import counted
from ..schemes.domain import FloatArray, ParameterDomain
from ..schemes.members import optional_member
from ..schemes.scheme import Scheme
from .criterion import Criterion, Measure, NormalCone, TangentCone
from .least_rates import TINY, least_product, rounded_up
from .memory import require_memory_for_triangles
from .patch_frames import PatchFrames
from .tile_extents import TileValues, fit_within
from .tiles import DEEPEST, Tiles

# Parts of tiles are looked at in runs of this many, whose derivatives stay in a core's cache.
RUN = 1 << 12
# So many patches, or pieces of these, are looked at together, which bounds temporary memory.
BLOCK = 1 << 15
# Cosine of the angle by which elements beside a fold differ in their normals, at most.
FOLDED = -0.1
# Tiles of fewer cells are not divided: four parts have at least so many.
FEWEST_DIVIDED = 5
# Forms in single precision are as much too small at most, and by so much of a tile's size: second derivatives are sums
# of nine coefficients with weights of 4 times 6 at most, and their eighth counts.
LOST = 1.001
EPSILON = 4 * 2.0**-23
# Samples of a relief along each side of a tile.
RELIEF_SAMPLES = 9


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
        points = times(self.tile.control_points, self.points)
        return points.min(axis=0), points.max(axis=0)

    @property
    def axis(self) -> FloatArray:
        """``(3, t)`` unit vectors across the diagonals of the tiles, or zero."""
        return _axis(times(self.tile.corners, self.points))

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
    chooser = _Chooser(patches.scheme, frames, criterion)
    found: list[Tiles] = []
    triangle_count = 0
    watched = _watched_edges(patches, frames, control_points[row], criterion)
    for block in _blocks(patches, frames, control_points, row, watched, max_rate):
        chosen = chooser.chosen(block, triangle_count)
        triangle_count += chooser.cost(chosen)
        found += chosen
    tiles = Tiles.joined(found)
    return tiles[_order(tiles, frames)]


def _blocks(
    patches: PatchTable,
    frames: PatchFrames,
    control_points: FloatArray,
    row: IntArray,
    watched: NDArray[np.bool_],
    max_rate: int,
) -> Iterator[list[_Patches]]:
    """All patches, class by class, in blocks that bound what is needed at once."""
    refined = patches.refined
    table = patches if refined is None else refined.table
    points = control_points[row] if refined is None else refined.matrix @ control_points[row]
    block, count = [], 0
    for patch_class in counted(table.classes, "Tiles of patch classes"):
        for begin in range(0, len(patch_class.corners), BLOCK):
            own = slice(begin, begin + BLOCK)
            corners = patch_class.corners[own]
            if refined is not None:
                corners = refined.corners(patch_class)[own]
            whole = Tiles.whole(corners, max_rate, _sides_on(watched, frames, corners))
            controls = np.ascontiguousarray(points[patch_class.controls[own].T].swapaxes(1, 2))
            block.append(_Patches(patch_class.signature, whole, controls))
            count += len(corners)
            if count >= BLOCK:
                yield block
                block, count = [], 0
    if block:
        yield block


def _watched_edges(
    patches: PatchTable, frames: PatchFrames, points: FloatArray, criterion: Criterion
) -> NDArray[np.bool_]:
    """``(n_h,)`` the half-edges along which curves hold to the limit by themselves.

    On open borders and folds, surfaces may be flat and end along curves all the same. Elsewhere the surface on one side
    of an edge holds the other, unless it may be coarse there.

    Parameters
    ----------
    points : (n_v, 3) float64
        At the vertices of the mesh.
    """
    t, names = frames.topology, frames.places.edge
    if criterion.measure is Measure.EDGE:
        return np.zeros(t.half_edge_count, dtype=bool)
    # Of the elements beside each edge.
    sums = np.stack([np.bincount(names, x) for x in _normals(patches, points)[t.face_of(np.arange(len(names)))].T])
    is_fold = (np.bincount(names) != 2) | (np.square(sums).sum(axis=0) < 2 + 2 * FOLDED)
    return is_fold[names] | ((t.twin < 0) & (criterion.outline is not None))


def _normals(patches: PatchTable, points: FloatArray) -> FloatArray:
    """``(n_e, 3)`` about which way elements face: unit vectors, or zero."""
    t = patches.topology
    along = np.cross(points[t.face_vertices], points[t.face_vertices[t.next]])
    found = np.stack([np.bincount(t.face_of(np.arange(len(along))), x, len(t.face_sizes)) for x in along.T], axis=1)
    if patches.scheme.element == "vertex":
        of_corner = found[t.face_of(patches.half_edge_of_corner)]
        elements = patches.elements
        faces = elements.face_of(np.arange(elements.half_edge_count))
        found = np.stack([np.bincount(faces, x, len(elements.face_sizes)) for x in of_corner.T], axis=1)
    length = np.linalg.norm(found, axis=1, keepdims=True)
    return found / np.where(length > 0, length, 1)


def _sides_on(edges: NDArray[np.bool_], frames: PatchFrames, corners: IntArray) -> NDArray[np.bool_]:
    """``(p, m)`` which sides of the patches that begin at these corners lie on some edges, ``(n_h,)``."""
    t, m = frames.topology, frames.domain.corner_count
    is_whole = frames.is_whole[t.face_of(corners)]
    found = np.zeros((len(corners), m), dtype=bool)
    half_edge = corners
    for side in range(m):
        found[:, side] = is_whole & edges[half_edge]
        half_edge = t.following(half_edge)
    # Patches at corners have half an edge on their first and their last side.
    found[:, 0] |= edges[corners]
    found[:, -1] |= ~is_whole & edges[t.preceding(corners)]
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

    scheme: Scheme
    frames: PatchFrames
    criterion: Criterion

    @property
    def basis(self) -> BernsteinBasis:
        return regular_bernstein(self.scheme).basis

    @property
    def domain(self) -> ParameterDomain:
        return self.scheme.domain

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
                found = self._rated(_Pieces(tiles[run], coefficients[..., run]), triangle_count)
                triangle_count += self.cost(found)
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
            is_flat = self._have_flat_hulls(each.tiles, each.points, _axis(corners)) & ~each.tiles.sides.any(axis=1)
            done.append(each.tiles[is_flat])
            if not is_flat.all():
                rest.append(_Patches(each.signature, each.tiles[~is_flat], each.points[..., ~is_flat]))
        return done, rest

    def _have_flat_hulls(self, tiles: Tiles, hull: FloatArray, axis: FloatArray) -> NDArray[np.bool_]:
        """Whether one pair of triangles does for each tile, by points ``(n, 3, t)`` whose hull contains the surface.

        Parameters
        ----------
        axis : (3, t) float64
            Across which the surface is hoped to be flat; a unit vector, or zero.
        """
        lower, upper = hull.min(axis=0), hull.max(axis=0)
        limit = self._limit(tiles, lower, upper, NormalCone.of_any(len(tiles)))
        size = np.linalg.norm(upper - lower, axis=0)
        if self.criterion.measure is Measure.EDGE:
            return size <= limit
        along = hull[:, 0] * axis[0] + hull[:, 1] * axis[1] + hull[:, 2] * axis[2]
        return np.where(axis.any(axis=0), along.max(axis=0) - along.min(axis=0), size) <= limit

    def _limit(self, tiles: Tiles, lower: FloatArray, upper: FloatArray, cone: NormalCone) -> FloatArray:
        """``(t,)`` `Criterion.limit`, less what a relief takes of it."""
        limit = self.criterion.limit(lower, upper, cone)
        if self.criterion.relief is not None and self.criterion.measure is Measure.CHORD:
            limit = limit - np.ptp(self._relief(tiles), axis=(0, 1))
        return limit

    def _divided(self, patches: list[_Patches]) -> tuple[list[Tiles], list[_Pieces]]:
        """Divide patches until each tile lies in a piece, or is so flat that one pair of triangles does."""
        done: list[Tiles] = []
        pieces: list[_Pieces] = []
        waiting: list[_Undivided] = []
        elements = divided_elements(self.scheme, [each.signature for each in patches])
        for each, element in zip(patches, elements, strict=True):
            tile, rows = part_of_tile(self.scheme, element, 0, np.eye(element.control_count))
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
                for child in rest.children([rest.tiles.child(number, self.domain) for number in range(4)]):
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
            for side in range(self.domain.corner_count):
                on = np.flatnonzero(are_flat[number] & (each.tiles.sides[:, side] > 0))
                if len(on):
                    own = each.chosen(on)
                    ends = times(each.tile.corners, own.points)[[side, (side + 1) % self.domain.corner_count]]
                    across = np.stack(_normals_to(ends[1] - ends[0]))
                    values = np.einsum("kit,dit->kdt", own.points, across)
                    limit = self._limit(own.tiles, *own.box, NormalCone.of_any(len(on)))
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
        limit = self._limit(group.tiles, lower, upper, NormalCone.of_any(len(group.tiles)))
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
        found[inside] = self._limit(group.tiles[inside], lower, upper, cone)
        return found

    def _cone(self, pieces: FloatArray, axis: FloatArray) -> NormalCone:
        """Cones of the normals of pieces ``(p b, 3, t)`` about axes ``(3, t)``.

        Nearer to an extraordinary point than the pieces, normals turn less than on these.
        """
        size = len(self.basis.indices)
        by_coefficient = np.ascontiguousarray(pieces.reshape(-1, size, *pieces.shape[1:]).swapaxes(0, 1))
        derivatives = [times(each, by_coefficient) for each in self.basis.derivatives]
        tangents = [TangentCone.of(each) for each in derivatives]
        return NormalCone(axis, NormalCone.of(*tangents).around(axis).sine.max(axis=0))

    def _rated(self, pieces: _Pieces, triangle_count: int) -> list[Tiles]:
        """Choose the rates of tiles in pieces, and divide those in four where that saves triangles.

        Arguments and errors as for `chosen`.
        """
        tiles, coefficients = pieces
        is_flat = self._have_flat_hulls(tiles, coefficients, _axis(coefficients[self.basis.corners]))
        found = [replace(tiles[is_flat], sides=self._along_sides(tiles[is_flat], coefficients[..., is_flat]))]
        tiles, coefficients = tiles[~is_flat], coefficients[..., ~is_flat]
        forms = self._forms(coefficients, _parts(self.basis, 0)) + self._form_of_relief(tiles, coefficients)
        rates = self._rates(forms, tiles)
        # Divided tiles have fewer triangles.
        require_memory_for_triangles(triangle_count + int(self._costs(rates).sum()))
        # Bounds of parts are tighter than those of the whole. For the same limit a part that is half as large needs
        # half as many segments: its form is a quarter.
        is_small = (rates.prod(axis=1) > 1) & (rates.prod(axis=1) < FEWEST_DIVIDED)
        small = tiles[is_small], coefficients[..., is_small]
        rates[is_small] = self._rates(
            4 * self._forms(small[1], _parts(self.basis, 1)) + self._form_of_relief(*small), tiles[is_small]
        )
        while len(tiles):
            tried = np.flatnonzero(rates.prod(axis=1) >= FEWEST_DIVIDED)
            of_parts = self._forms(coefficients[..., tried], _parts(self.basis, 2))
            of_parts += self._form_of_relief(tiles[tried], coefficients[..., tried]) / 16
            rates[tried] = self._rates(16 * of_parts, tiles[tried])
            of_children = 4 * of_parts.reshape(4, 4, *of_parts.shape[1:])
            # All first children, all second ones and so on.
            children = Tiles.joined([tiles[tried].child(number, self.domain) for number in range(4)])
            child_rates = self._rates(of_children.swapaxes(0, 1).swapaxes(1, 2).reshape(4, 3, -1), children)
            cost = self._costs(child_rates).reshape(4, -1).sum(axis=0)
            is_better = (cost < self._costs(rates[tried])) & (tiles.most[tried] > 1)
            keeps = np.full(len(tiles), True)
            keeps[tried[is_better]] = False
            kept = replace(tiles[keeps], rates=rates[keeps])
            kept = replace(kept, sides=self._along_sides(kept, coefficients[..., keeps]))
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

    def _along_sides(self, tiles: Tiles, coefficients: FloatArray) -> IntArray:
        """`Tiles.sides`: as many segments as keep curves along watched sides to the limit."""
        sides = np.zeros_like(tiles.sides)
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

    def cost(self, tiles: list[Tiles]) -> int:
        """Triangles of some tiles, but for those of other rates next door."""
        return sum(int(self._costs(each.rates).sum()) for each in tiles)

    def _costs(self, rates: IntArray) -> IntArray:
        """Likewise of each tile with these rates."""
        return rates[:, 0] * rates[:, 1] * (1 if self.domain.corner_count == 3 else 2)


def _axis(corners: FloatArray) -> FloatArray:
    """``(3, t)`` unit vectors across two diagonals, of three or four corners ``(m, 3, t)``; zero if these are parallel.

    Of a triangle, two of its sides.
    """
    axis = np.cross(corners[2] - corners[0], corners[-1] - corners[1], axis=0)
    length = np.linalg.norm(axis, axis=0)
    return axis / np.where(length > 0, length, 1)


def _normals_to(way: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Two unit vectors ``(3, t)`` across each of some vectors, and across each other; any two where these are zero."""
    length = np.linalg.norm(way, axis=0)
    way = np.where(length > 0, way / np.where(length > 0, length, 1), np.array([[0.0], [0], [1]]))
    # Across the way and the axis that it is least along.
    first = np.cross(way, np.eye(3)[np.argmin(np.abs(way), axis=0)].T, axis=0)
    first /= np.linalg.norm(first, axis=0)
    return first, np.cross(way, first, axis=0)


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
