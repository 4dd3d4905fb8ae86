"""The lines on which tiles meet, cut into spans that all tiles beside them share: nothing can crack.

Tiles of different sizes and rates meet along edges of elements, along the spokes of polygons, and inside patches. Two
sides of tiles on one line are apart, or one contains the other, as all are halves of halves of the line's whole. Those
that contain no others are the line's *spans*: the tiles beside it that are finest. A span has as many segments as the
most demanding of its tiles asks for, and each of its samples is one vertex of the tessellation.

The sides of a crease are two lines with vertices of their own, but in the same places: they share spans and rates.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from ..mesh import ragged
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


def ranked(*columns: IntArray) -> tuple[IndexArray, IndexArray]:
    """Number the rows of some columns of integers from 0 on, in their order and equal ones alike.

    Parameters
    ----------
    *columns : (n,) int
        Not negative; all but the first below 2^31.

    Returns
    -------
    number : (n,) int32
    first : (k,) int32
        The first row that has each number.
    """
    order, begins = _in_order(columns)
    number = np.empty(len(order), dtype=np.int32)
    number[order] = np.cumsum(begins, dtype=np.int32) - 1
    return number, order[begins]


def _in_order(columns: tuple[IntArray, ...]) -> tuple[IndexArray, NDArray[np.bool_]]:
    """Rows in ascending order, where equal ones keep theirs; and which of these differ from the one before."""
    keys, bits = columns[0].astype(np.int64), int(columns[0].max(initial=0)).bit_length()
    for column in columns[1:]:
        more = int(column.max(initial=0)).bit_length()
        if bits + more > MOST_BITS:
            # There are fewer rows than keys.
            keys = ranked(keys)[0].astype(np.int64)
            bits = int(keys.max(initial=0)).bit_length()
        keys <<= more
        keys |= column
        bits += more
    order = np.argsort(keys, kind="stable").astype(np.int32)
    keys = keys[order]
    begins = np.ones(len(order), dtype=bool)
    np.not_equal(keys[1:], keys[:-1], out=begins[1:])
    return order, begins


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
    line, level, low, length, is_backward, _ = _sides(tiles, frames)
    wanted = np.maximum(tiles.rates[:, [0, 1, 0, 1] if m == 4 else [0, 0, 0]], tiles.sides).astype(np.int32).ravel()
    shift = DEEPEST - int(tiles.depth.max(initial=0))
    # Of those that begin at the same place, the longest first.
    order, begins = _in_order((line, level >> shift, low >> shift, EDGE - length >> shift))
    first = np.flatnonzero(begins)
    own, group = order[begins], np.empty(len(order), dtype=np.int32)
    group[order] = np.cumsum(begins, dtype=np.int32) - 1
    rate = np.maximum.reduceat(wanted[order], first) if len(first) else wanted
    # Numbers of lines in the order of the groups.
    of_line = (np.diff(line[own], prepend=-1) != 0) | (np.diff(level[own], prepend=-1) != 0)
    of_line = np.cumsum(of_line) * (2 * EDGE)
    begin, size = of_line + low[own], length[own]
    is_span = np.ones(len(own), dtype=bool)
    np.less_equal(begin[:-1] + size[:-1], begin[1:], out=is_span[:-1])
    # The spans of each group: itself, or all of those that follow up to its end.
    before = np.cumsum(is_span) - is_span
    count = np.ones(len(own), dtype=np.int64)
    cut = np.flatnonzero(~is_span)
    ends = np.searchsorted(begin, begin[cut] + size[cut])
    count[cut] = np.append(before, np.count_nonzero(is_span))[ends] - before[cut]
    spans, of_span = ragged.ranges(before[cut], count[cut]), np.repeat(cut, count[cut])
    span_rate, span_size = rate[is_span], size[is_span]
    # Lengths are powers of two: a side that is cut has its rate in parts of it, too.
    np.maximum.at(span_rate, spans, -(-rate[of_span].astype(np.int64) * span_size[spans] // size[of_span]))

    counts = count[group]
    side = np.repeat(np.arange(len(group), dtype=np.int32), counts)
    at = before[group][side].astype(np.int32)
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

    @cached_property
    def _corners(self) -> IndexArray:
        """``(2, m t)`` where sides begin."""
        return tile_corners(self._tiles, self._frames.domain).reshape(2, -1)

    def along(self, span: IntArray, part: FloatArray) -> FloatArray:
        """``(2, n)`` where places in spans lie, such and such a part along them, in their patches."""
        side, m = self._spans.side[span], self._frames.domain.corner_count
        begin = self._corners.take(side, axis=1)
        following = side + np.where(side % m == m - 1, 1 - m, 1)
        way = (self._corners.take(following, axis=1) - begin).astype(np.float64)
        return (self._spans.first[span] + part * self._spans.part[span]) * way + begin

    @cached_property
    def _corner(self) -> IntArray:
        """``(s,)`` the corner that the patch of each span begins at."""
        return self._tiles.corner[self._spans.side // self._frames.domain.corner_count]

    def _begin(self) -> IndexArray:
        """``(2, s)`` the points."""
        found = self._corners.take(self._spans.side, axis=1)
        inside = np.flatnonzero(self._spans.first)
        found[:, inside] = self.along(inside, np.zeros(len(inside)))
        return found

    @cached_property
    def _places(self) -> tuple[IndexArray, IndexArray]:
        """``(s,)`` number of the place of each point, and the first point of each."""
        frames, t = self._frames, self._frames.topology
        vertex_count, count = int(frames.places.vertex.max(initial=0)) + 1, t.half_edge_count
        on_edge, on_spoke, at_centre = vertex_count + count * np.arange(3)
        inside = at_centre + t.face_count
        x, y = begin = self._begin()
        borders = self._borders(begin)
        name = inside + self._corner.astype(np.int64)
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
                x[border.on], y[border.on] = np.where(frames.is_backward[border.edge], EDGE - border.at, border.at), 0
        on, edge = self._vertices(borders)
        name[on], x[on], y[on] = frames.places.vertex[edge], 0, 0
        begin >>= DEEPEST - int(self._tiles.depth.max(initial=0))
        return ranked(name, x, y)

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

    def _borders(self, points: IndexArray) -> list[_Border]:
        """Of points of patches those that lie on the patches' sides, side by side."""
        t, corner = self._frames.topology, self._corner
        u, v = points
        is_whole = self._frames.is_whole[t.face_of(corner)]
        # How far from each side, and how far along it.
        sides: list[Callable[[], tuple[IndexArray, IndexArray]]]
        if self._frames.domain.corner_count == 3:
            sides = [lambda: (v, u), lambda: (UNIT - u - v, v), lambda: (u, UNIT - v)]
        else:
            sides = [lambda: (v, u), lambda: (UNIT - u, v), lambda: (UNIT - v, UNIT - u), lambda: (u, UNIT - v)]
        found, edge = [], corner
        for number, side in enumerate(sides):
            distance, along = side()
            on = np.flatnonzero(distance == 0).astype(np.int32)
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
            name = np.zeros(len(point), dtype=np.int64)
            borders = self._borders(self._begin())
            for border in borders:
                if not border.is_spoke:
                    name[border.on] = names.edge[border.edge]
            on, edge = self._vertices(borders)
            name[on] = names.vertex[edge]
            point, of_point = ranked(point, name)
            half_edge = _sides(self._tiles, self._frames)[-1][spans.side]
            span, of_span = ranked(span, np.where(half_edge >= 0, names.edge[half_edge], 0))
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


def _sides(
    tiles: Tiles, frames: PatchFrames
) -> tuple[IntArray, IndexArray, IndexArray, IndexArray, NDArray[np.bool_], IndexArray]:
    """On which lines the sides of tiles lie, and where; side by side of each tile.

    Returns
    -------
    line, level : (n,)
        Two numbers of the line.
    low, length : (n,) int32
        From where on along the line, and how far.
    is_backward : (n,) bool
        Whether they lead towards lower positions.
    half_edge : (n,) int32
        Of an element, along which they lie; -1 elsewhere.
    """
    t, m, flipped = frames.topology, frames.domain.corner_count, tiles.is_flipped
    size = (UNIT >> tiles.depth).astype(np.int32)
    u, v = (place.astype(np.int32) * size for place in tiles.place.T)
    far_u, far_v, diagonal = u + size, v + size, u + v + size
    # Lines inside patches are numbered by their direction and patch, after edges and spokes.
    shape = len(tiles), m
    line, half_edge = np.empty(shape, dtype=np.int64), np.full(shape, -1, dtype=np.int32)
    level, low, length = (np.empty(shape, dtype=np.int32) for _ in range(3))
    is_backward = np.empty(shape, dtype=bool)
    length[:] = size[:, None]
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
        line[:, side] = tiles.corner.astype(np.int64) + (2 + axis) * t.half_edge_count
        level[:, side], low[:, side] = own_level, own_low
        is_backward[:, side] = flipped ^ (side == 2 or (m == 4 and side == 3))
        on = np.flatnonzero((distance == 0) & ~flipped)
        whole, other = on[is_whole[on]], on[~is_whole[on]]
        borders = [(whole, edge[whole], 2 * along[whole], 2 * size[whole], False)]
        if len(other):
            own, at, is_spoke = _of_patch_at_corner(t, side, tiles.corner[other], along[other])
            # That position of the side's two ends which is less.
            borders.append((other, own, at - size[other] if side == 2 else at, size[other], is_spoke))
        for at, own, begin, own_length, is_spoke in borders:
            level[at, side], length[at, side] = 0, own_length
            if is_spoke:
                line[at, side], low[at, side] = own.astype(np.int64) + t.half_edge_count, begin
                is_backward[at, side] = side == 2
            else:
                backward = frames.is_backward[own]
                line[at, side], half_edge[at, side] = frames.places.edge[own], own
                low[at, side] = np.where(backward, EDGE - begin - own_length, begin)
                is_backward[at, side] = backward
        edge = t.following(edge)
    return line.ravel(), level.ravel(), low.ravel(), length.ravel(), is_backward.ravel(), half_edge.ravel()


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
