"""The lines on which tiles meet, cut into spans that all tiles beside them share: nothing can crack.

Tiles of different sizes and rates meet along edges of elements, along the spokes of polygons, and inside patches. Two
sides of tiles on one line are apart, or one contains the other, as all are halves of halves of the line's whole. Those
that contain no others are the line's *spans*: the tiles beside it that are finest. A span has as many segments as the
most demanding of its tiles asks for, and each of its samples is one vertex of the tessellation.

The sides of a crease are two lines with vertices of their own, but in the same places: they share spans and rates.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..mesh import ragged
from ..mesh.chunks import chunks_of
from ..mesh.connectivity import IndexArray, IntArray, Topology
from ..schemes.domain import FloatArray, ParameterDomain
from .patch_frames import EdgeNames, PatchFrames
from .tiles import DEEPEST, Tiles

# Parameters of patches in integers: corners of tiles lie at multiples of this part of a patch.
UNIT = 1 << DEEPEST
# An edge of an element, along which a patch of a polygon reaches half way, in the same parts.
EDGE = 2 * UNIT
# Bits that numbers may have.
MOST_BITS = 63
# Bits of how often an edge is halved.
HALVINGS = 5


def tile_corners(tiles: Tiles, domain: ParameterDomain) -> IndexArray:
    """``(2, t, m)`` corners of tiles in their patches, in parts of `UNIT`, counter-clockwise from the tile's (0, 0)."""
    size = (UNIT >> tiles.depth).astype(np.int32)[:, None]
    found = []
    for place, steps in zip(tiles.place.T, domain.corners.astype(np.int32).T, strict=True):
        found.append(place.astype(np.int32)[:, None] + np.where(tiles.is_flipped[:, None], 1 - steps, steps))
        found[-1] *= size
    return np.stack(found)


def at_vertices(marked: NDArray[np.bool_], tiles: Tiles, frames: PatchFrames) -> NDArray[np.bool_]:
    """``(t, m)`` whether corners of tiles lie at half-edges' beginnings that are marked, ``(n_h,)``: at vertices."""
    t, domain = frames.topology, frames.domain
    found = np.zeros((len(tiles), domain.corner_count), dtype=bool)
    is_whole, half_edge = frames.is_whole[t.face_of(tiles.corner)], tiles.corner
    for number, corner in enumerate(domain.corners.astype(np.int32) * UNIT):
        near = np.flatnonzero(marked[half_edge] & (is_whole | (number == 0)))
        u, v = tile_corners(tiles[near], domain)
        found[near] |= (u == corner[0]) & (v == corner[1])
        half_edge = t.following(half_edge)
    return found


def ranked(keys: IntArray) -> tuple[IndexArray, IndexArray]:
    """Number integers from 0 on, in their order and equal ones alike.

    Returns
    -------
    number : (n,) int32
    first : (k,) int32
        The first place of each number.
    """
    order, in_order = _sorted(keys)
    begins = _begins(in_order)
    number = np.empty(len(order), dtype=np.int32)
    number[order] = np.cumsum(begins, dtype=np.int32) - 1
    return number, order[begins]


def joined(high: IntArray, low: IntArray, bits: int) -> IntArray:
    """``(n,)`` integers in the order of pairs, equal where these are; the second ones have so many bits.

    Which are the lowest bits of the result, if there are no more than 32.
    """
    if int(high.max(initial=0)).bit_length() + bits > MOST_BITS:
        # There are fewer of them than numbers of 31 bits.
        high = ranked(high)[0]
        if bits > 32:
            low, bits = ranked(low)[0], 31
    keys = high.astype(np.int64)
    keys <<= bits
    keys |= low
    return keys


def _sorted(keys: IntArray) -> tuple[IndexArray, IntArray]:
    """Places of integers in ascending order, where equal ones keep theirs; and the integers in this order."""
    order = np.argsort(keys, kind="stable").astype(np.int32)
    return order, keys[order]


def _begins(in_order: IntArray) -> NDArray[np.bool_]:
    """Which of some sorted integers differ from the one before."""
    begins = np.ones(len(in_order), dtype=bool)
    np.not_equal(in_order[1:], in_order[:-1], out=begins[1:])
    return begins


@dataclass(frozen=True, eq=False)
class Spans:
    """Spans of all sides of all tiles: in the order of the sides, along each side counter-clockwise around the tile.

    Attributes
    ----------
    side : (s,) int32
        ``m`` times the tile, plus the corner at which its side begins.
    rate : (s,) int32
        Segments.
    first, part : (s,) float32
        Where on the side each span begins, and how long it is, in parts of the side: exact, as these are dyadic.
    is_backward : (s,) bool
        Whether the numbers of the vertices inside fall along the side.
    at : (s,) int32
        A number that the span has in common with all others in the same place, from 0 on.
    """

    side: IndexArray
    rate: IndexArray
    first: NDArray[np.float32]
    part: NDArray[np.float32]
    is_backward: NDArray[np.bool_]
    at: IndexArray


@dataclass(frozen=True, eq=False)
class SpanVertices:
    """Vertices of the tessellation where spans begin, which are numbered first, and those inside spans.

    Attributes
    ----------
    point : (s,) int32
        The vertex where each span begins.
    span : (s,) int32
        A number that each span has in common with all that are the same, from 0 on.
    first_inside : (k,) int64
        The vertex with the least number inside each of these.
    of_point : (p,) int32
        The first span that begins at each vertex.
    of_span : (k,) int32
        The first of the spans with each number.
    vertex_count : int
    """

    point: IndexArray
    span: IndexArray
    first_inside: IntArray
    of_point: IndexArray
    of_span: IndexArray
    vertex_count: int


def cut_into_spans(tiles: Tiles, frames: PatchFrames) -> Spans:
    """Cut the sides of tiles where others on the same lines end."""
    m = frames.domain.corner_count
    shift = DEEPEST - int(tiles.depth.max(initial=0))
    bits = DEEPEST + 1 - shift + HALVINGS
    found = []
    for block in chunks_of(len(tiles)):
        sides = _sides(tiles[block], frames)
        # Of those that begin at the same place, the longest first.
        found.append((sides.line, sides.low >> shift << HALVINGS | sides.halvings, sides.is_backward))
    line, low = (np.concatenate([each[column] for each in found]) for column in (0, 1))
    is_backward: NDArray[np.bool_] = np.concatenate([each[2] for each in found])
    del found
    keys = joined(line, low, bits)
    del line, low
    order, keys = _sorted(keys)
    begins = _begins(keys)
    first, keys = np.flatnonzero(begins), keys[begins]
    group = np.empty(len(order), dtype=np.int32)
    group[order] = np.cumsum(begins, dtype=np.int32) - 1
    wanted = np.maximum(tiles.rates[:, [0, 1, 0, 1] if m == 4 else [0, 0, 0]], tiles.sides).astype(np.int32).ravel()
    rate = np.maximum.reduceat(wanted[order], first)
    del order, begins, wanted
    # Positions along all lines, one line after the other.
    begin, size = keys >> HALVINGS, (EDGE >> shift) >> (keys & ((1 << HALVINGS) - 1))
    is_span = np.ones(len(first), dtype=bool)
    np.less_equal(begin[:-1] + size[:-1], begin[1:], out=is_span[:-1])
    # The spans of each group: itself, or all of those that follow up to its end.
    before = np.cumsum(is_span) - is_span
    count = np.ones(len(first), dtype=np.int64)
    cut = np.flatnonzero(~is_span)
    ends = np.searchsorted(begin, begin[cut] + size[cut])
    count[cut] = np.append(before, np.count_nonzero(is_span))[ends] - before[cut]
    spans, of_span = ragged.ranges(before[cut], count[cut]), np.repeat(cut, count[cut])
    span_rate, span_size = rate[is_span], size[is_span]
    # Lengths are powers of two: a side that is cut has its rate in parts of it, too.
    np.maximum.at(span_rate, spans, -(-rate[of_span].astype(np.int64) * span_size[spans] // size[of_span]))

    counts = count[group]
    side = np.repeat(np.arange(len(group), dtype=np.int32), counts)
    at = before.astype(np.int32)[group][side]
    from_side, part = np.zeros(len(side), dtype=np.float32), np.ones(len(side), dtype=np.float32)
    held = np.flatnonzero(counts > 1)
    rows, of_side = ragged.ranges(ragged.starts(counts)[held], counts[held]), np.repeat(held, counts[held])
    place = ragged.places(counts[held])
    backward = is_backward[of_side]
    at[rows] += np.where(backward, counts[of_side] - 1 - place, place).astype(np.int32)
    own = group[of_side]
    part[rows] = span_size[at[rows]] / size[own]
    passed = (begin[is_span][at[rows]] - begin[own]) / size[own]
    from_side[rows] = np.where(backward, 1 - part[rows] - passed, passed)
    return Spans(side, span_rate[at], from_side, part, is_backward[side], at)


class LinePoints:
    """The points where the spans of some tiles begin.

    Parameters
    ----------
    tiles : Tiles
    frames : PatchFrames
    spans : Spans
    """

    def __init__(self, tiles: Tiles, frames: PatchFrames, spans: Spans) -> None:
        self._tiles, self._frames, self._spans = tiles, frames, spans

    def along(self, span: IntArray, part: FloatArray) -> FloatArray:
        """``(2, n)`` where places in spans lie, such and such a part along them, in their patches."""
        side, m = self._spans.side[span], self._frames.domain.corner_count
        begin = self._corners(side)
        way = (self._corners(side + np.where(side % m == m - 1, 1 - m, 1)) - begin).astype(np.float64)
        return (self._spans.first[span] + part * self._spans.part[span]) * way + begin

    def _corners(self, side: IntArray) -> IndexArray:
        """``(2, n)`` where sides begin."""
        tiles, m = self._tiles, self._frames.domain.corner_count
        tile = side // m
        number = side - m * tile + m * tiles.is_flipped[tile]
        corners = self._frames.domain.corners.T.astype(np.int32)
        steps, size = np.concatenate([corners, 1 - corners], axis=1), UNIT >> tiles.depth[tile]
        found = [size * (at[tile] + step[number]) for at, step in zip(tiles.place.T, steps, strict=True)]
        return np.stack(found).astype(np.int32)

    def _blocks(self) -> Iterator[tuple[slice, IndexArray, list[_Border]]]:
        """Blocks of spans, with the points where they begin, ``(2, n)``, and those of these that lie on borders."""
        side, m = self._spans.side, self._frames.domain.corner_count
        for block in chunks_of(len(side)):
            first = side[block.start] // m
            own = self._tiles[first : side[block.stop - 1] // m + 1]
            points = tile_corners(own, self._frames.domain).reshape(2, -1).take(side[block] - m * first, axis=1)
            inside = np.flatnonzero(self._spans.first[block])
            points[:, inside] = self.along(block.start + inside, np.zeros(len(inside)))
            yield block, points, self._borders(self._corner(block), points)

    def _corner(self, block: slice) -> IntArray:
        """``(n,)`` the corner that the patch of each span begins at."""
        return self._tiles.corner[self._spans.side[block] // self._frames.domain.corner_count]

    @cached_property
    def _places(self) -> tuple[IndexArray, IndexArray]:
        """``(s,)`` number of the place of each point, and the first point of each."""
        frames, t = self._frames, self._frames.topology
        vertex_count, count = int(frames.places.vertex.max(initial=0)) + 1, t.half_edge_count
        on_edge, on_spoke, at_centre = vertex_count + count * np.arange(3)
        depth = int(self._tiles.depth.max(initial=0))
        names, positions = (np.empty(len(self._spans.side), dtype=np.int64) for _ in range(2))
        for block, (x, y), borders in self._blocks():
            name = at_centre + t.face_count + self._corner(block).astype(np.int64)
            for border in borders:
                if border.is_spoke:
                    is_centre = border.at == UNIT
                    faces = t.face_of(border.edge)
                    name[border.on] = np.where(is_centre, at_centre + faces, on_spoke + border.edge)
                    x[border.on], y[border.on] = np.where(is_centre, 0, border.at), 0
            # The first point of a spoke is on an edge, as the first and the last one of an edge are vertices.
            for border in borders:
                if not border.is_spoke:
                    name[border.on] = on_edge + frames.places.edge[border.edge]
                    x[border.on] = np.where(frames.is_backward[border.edge], EDGE - border.at, border.at)
                    y[border.on] = 0
            on, edge = self._vertices(borders)
            name[on], x[on], y[on] = frames.places.vertex[edge], 0, 0
            names[block] = name
            positions[block] = (x >> (DEEPEST - depth)).astype(np.int64) << (depth + 1) | y >> (DEEPEST - depth)
        keys = joined(names, positions, 2 * depth + 3)
        del names, positions
        return ranked(keys)

    def _vertices(self, borders: list[_Border]) -> tuple[IntArray, IntArray]:
        """Points at vertices, and half-edges that begin there."""
        t = self._frames.topology
        found = [
            (border.on[border.at == position], edge[border.at == position])
            for border in borders
            if not border.is_spoke
            for position, edge in ((0, border.edge), (EDGE, t.following(border.edge)))
        ]
        on, edge = (np.concatenate(each) for each in zip(*found, strict=True))
        return on, edge

    def _borders(self, corner: IntArray, points: IndexArray) -> list[_Border]:
        """Of points of patches those that lie on the patches' sides, side by side."""
        t = self._frames.topology
        u, v = points
        is_whole = self._frames.is_whole[t.face_of(corner)]
        # How far from each side, and how far along it.
        if self._frames.domain.corner_count == 3:
            sides = [(v, u), (UNIT - u - v, v), (u, UNIT - v)]
        else:
            sides = [(v, u), (UNIT - u, v), (UNIT - v, UNIT - u), (u, UNIT - v)]
        found, edge = [], corner
        for number, (distance, along) in enumerate(sides):
            on = np.flatnonzero(distance == 0)
            whole, other = on[is_whole[on]], on[~is_whole[on]]
            found.append(_Border(whole, edge[whole], 2 * along[whole], is_spoke=False))
            edge = t.following(edge)
            if len(other):
                half_edge, at, is_spoke = _of_patch_at_corner(t, number, corner[other], along[other])
                found.append(_Border(other, half_edge, at, is_spoke))
        return found

    def numbered(self, names: EdgeNames) -> SpanVertices:
        """Number the vertices where spans begin and inside spans, by names of edges and vertices.

        Spans and their beginnings are the same if they lie in the same place, and on edges and vertices of the same
        names.
        """
        places, spans = self._frames.places, self._spans
        point, of_point = self._places
        span, of_span = spans.at, first_of_each(spans.at)
        if _is_finer(names.edge, places.edge) or _is_finer(names.vertex, places.vertex):
            of_points = np.zeros(len(point), dtype=np.int32)
            for block, _, borders in self._blocks():
                name = of_points[block]
                for border in borders:
                    if not border.is_spoke:
                        name[border.on] = names.edge[border.edge]
                on, edge = self._vertices(borders)
                name[on] = names.vertex[edge]
            half_edges = [_sides(self._tiles[block], self._frames).half_edge for block in chunks_of(len(self._tiles))]
            half_edge = np.concatenate(half_edges)[spans.side]
            of_spans = np.where(half_edge >= 0, names.edge[half_edge], 0)
            point, of_point = ranked(joined(point, of_points, 32))
            span, of_span = ranked(joined(span, of_spans, 32))
        first_inside = ragged.offsets(spans.rate[of_span] - 1) + len(of_point)
        return SpanVertices(point, span, first_inside[:-1], of_point, of_span, int(first_inside[-1]))


@dataclass(frozen=True, eq=False)
class _Border:
    """Points on one side of their patches.

    Attributes
    ----------
    on : (n,) int64
        Which of them lie there.
    edge : (n,) int32
        Half-edge of the element along that side; for a spoke, in whose middle it begins.
    at : (n,) int32
        Position along the half-edge, or along the spoke.
    is_spoke : bool
    """

    on: IntArray
    edge: IntArray
    at: IntArray
    is_spoke: bool


def _of_patch_at_corner(t: Topology, side: int, corner: IntArray, along: IntArray) -> tuple[IntArray, IntArray, bool]:
    """Where places on a side of patches at corners lie: half-edges, positions along these or their spokes, and which.

    The sides are half an edge, two spokes that join the middles of edges to the centre, and half an edge.
    """
    half_edge = corner if side < 2 else t.preceding(corner)
    return half_edge, (along, along, UNIT - along, UNIT + along)[side], side in (1, 2)


class _Sides(NamedTuple):
    """On which lines the sides of tiles lie, and where; side by side of each tile.

    Attributes
    ----------
    line : (n,) int64
    low : (n,) int32
        From where on along the line.
    halvings : (n,) int32
        How often `EDGE` is halved to their length.
    is_backward : (n,) bool
        Whether they lead towards lower positions.
    half_edge : (n,) int32
        Of an element, along which they lie; -1 elsewhere.
    """

    line: IntArray
    low: IndexArray
    halvings: IndexArray
    is_backward: NDArray[np.bool_]
    half_edge: IndexArray


def _sides(tiles: Tiles, frames: PatchFrames) -> _Sides:
    """Find the lines of some tiles' sides."""
    t, m, flipped = frames.topology, frames.domain.corner_count, tiles.is_flipped
    size = (UNIT >> tiles.depth).astype(np.int32)
    u, v = (place.astype(np.int32) * size for place in tiles.place.T)
    far_u, far_v, diagonal = u + size, v + size, u + v + size
    # Lines inside patches are numbered by their direction and patch, after edges and spokes.
    shape = len(tiles), m
    line, half_edge = np.empty(shape, dtype=np.int64), np.full(shape, -1, dtype=np.int32)
    low, halvings = (np.empty(shape, dtype=np.int32) for _ in range(2))
    is_backward = np.empty(shape, dtype=bool)
    halvings[:] = tiles.depth[:, None] + 1
    is_whole, edge = frames.is_whole[t.face_of(tiles.corner)], tiles.corner
    borders: list[tuple[IntArray, IntArray, IntArray, IntArray, bool]]
    if m == 3:
        # At which level, from where on, how far from the patch's side, and how far along it.
        sides = [
            (np.where(flipped, far_v, v), u, v, u),
            (diagonal, v, UNIT - diagonal, v),
            (np.where(flipped, far_u, u), v, u, UNIT - far_v),
        ]
    else:
        sides = [
            (v, u, v, u),
            (far_u, v, UNIT - far_u, v),
            (far_v, u, UNIT - far_v, UNIT - far_u),
            (u, v, u, UNIT - far_v),
        ]
    for side, (own_level, own_low, distance, along) in enumerate(sides):
        axis = side if m == 3 else side % 2
        line[:, side] = (tiles.corner.astype(np.int64) + (2 + axis) * t.half_edge_count) << (DEEPEST + 1) | own_level
        low[:, side] = own_low
        is_backward[:, side] = flipped ^ (side == 2 or (m == 4 and side == 3))
        on = np.flatnonzero((distance == 0) & ~flipped)
        whole, other = on[is_whole[on]], on[~is_whole[on]]
        borders = [(whole, edge[whole], 2 * along[whole], 2 * size[whole], False)]
        if len(other):
            own, at, is_spoke = _of_patch_at_corner(t, side, tiles.corner[other], along[other])
            # That position of the side's two ends which is less.
            borders.append((other, own, at - size[other] if side == 2 else at, size[other], is_spoke))
        for at, own, begin, own_length, is_spoke in borders:
            if is_spoke:
                line[at, side] = (own.astype(np.int64) + t.half_edge_count) << (DEEPEST + 1)
                low[at, side] = begin
                is_backward[at, side] = side == 2
            else:
                backward = frames.is_backward[own]
                line[at, side] = frames.places.edge[own].astype(np.int64) << (DEEPEST + 1)
                half_edge[at, side] = own
                low[at, side] = np.where(backward, EDGE - begin - own_length, begin)
                is_backward[at, side] = backward
        halvings[whole, side] -= 1
        edge = t.following(edge)
    return _Sides(line.ravel(), low.ravel(), halvings.ravel(), is_backward.ravel(), half_edge.ravel())


def _is_finer(names: IntArray, others: IntArray) -> bool:
    """Whether names tell apart what others do not."""
    one = np.zeros(int(others.max(initial=0)) + 1, dtype=names.dtype)
    one[others] = names
    return bool((one[others] != names).any())


def first_of_each(number: IntArray) -> IndexArray:
    """The first place of each number from 0 on."""
    found = np.empty(int(number.max(initial=-1)) + 1, dtype=np.int32)
    found[number[::-1]] = np.arange(len(number) - 1, -1, -1, dtype=np.int32)
    return found
