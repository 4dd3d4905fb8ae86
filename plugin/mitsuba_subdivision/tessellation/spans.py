"""Cuts the lines on which tiles meet, at T-junctions, into spans that all adjacent tiles share, to avoid cracks.

Tiles of different sizes and rates meet along edges of elements, along the spokes of polygons, and inside patches. Two
sides of tiles on one line are apart, or one contains the other, as all are halves of halves of the line's whole. Those
that contain no others are the line's *spans*: the tiles beside it that are finest. A span has as many segments as the
most demanding of its tiles asks for, and each of its samples is one vertex of the tessellation.

The sides of a crease are two lines with vertices of their own at the same positions: they share spans and rates.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from ..mesh import ragged
from ..mesh.connectivity import IndexArray, IntArray
from ..mesh.ragged import chunks_of
from ..schemes.domain import FloatArray
from .patch_frames import PatchFrames
from .tile_sides import EDGE, HALVINGS, SidePoints, points_on_sides, side_lines, tile_corners
from .tiles import DEEPEST, UNIT, Tiles

# Bits that numbers may have.
MOST_BITS = 63


def ranked(keys: IntArray) -> tuple[IndexArray, IndexArray]:
    """Number integers from 0 on, in their order and equal ones alike.

    Returns
    -------
    number : (n,) int32
    first : (k,) int32
        First index of each number.
    """
    order, begins = ragged.sorted_order(keys)
    number = np.empty(len(keys), dtype=np.int32)
    number[order] = np.cumsum(begins, dtype=np.int32) - 1
    return number, order[begins]


def joined(high: IntArray, low: IntArray, bits: int) -> NDArray[np.int64]:
    """``(n,)`` integers ordered and equal as pairs are; `low` has `bits` bits.

    They are the lowest bits of the result if there are at most 32.
    """
    if int(high.max(initial=0)).bit_length() + bits > MOST_BITS:
        # There are fewer of them than numbers of 31 bits.
        high = ranked(high.astype(np.int64))[0]
        if bits > 32:
            low, bits = ranked(low.astype(np.int64))[0], 31
    keys = high.astype(np.int64)
    keys <<= bits
    keys |= low
    return keys


@dataclass(frozen=True, eq=False)
class Spans:
    """Spans of all sides of all tiles: in the order of the sides, along each side counter-clockwise around the tile."""

    tiles: Tiles  # Without `Tiles.sides`, as rates say what these did
    frames: PatchFrames  # Of the tiles' patches
    side: IndexArray  # (s,) int32: ``m`` times the tile, plus the corner at which its side begins
    rate: NDArray[np.int16]  # (s,) int16: segments
    # (s,) unsigned integer: which part of its side each span is, in the tree of halves: 1 is the whole side, ``2 n``
    # and ``2 n + 1`` are the halves of part ``n``
    node: NDArray[np.unsignedinteger]
    is_backward: NDArray[np.bool_]  # (s,) bool: whether the numbers of the vertices inside fall along the side
    at: IndexArray  # (s,) int32: 0-based number shared by all spans at the same location

    def samples(self, block: slice = slice(None)) -> tuple[IndexArray, FloatArray]:
        """The span of each sample along all sides, and its position along the span; for a block of spans."""
        rate, first = self.rate[block], block.start or 0
        span = np.repeat(np.arange(first, first + len(rate), dtype=np.int32), rate)
        return span, ragged.index_in_row(rate) / np.repeat(rate, rate)

    def along(self, span: IntArray, part: FloatArray) -> FloatArray:
        """``(2, n)`` parameters, in their patches, of points at given fractions of spans."""
        m = self.frames.domain.corner_count
        found = np.empty((2, len(span)))
        for block in chunks_of(len(span)):
            own = span[block]
            side = self.side[own]
            begin = self._corners(side)
            way = self._corners(side + np.where(side % m == m - 1, 1 - m, 1)) - begin
            found[:, block] = self.along_sides(own, part[block]) * way + begin
        return found

    def along_sides(self, span: IntArray | slice, part: FloatArray) -> FloatArray:
        """``(n,)`` fractions of sides, of points at given fractions of spans."""
        # The tree's levels begin at powers of two.
        mantissa, exponent = np.frexp(self.node[span].astype(np.float64))
        return np.ldexp(part, 1 - exponent) + (2 * mantissa - 1)

    def _corners(self, side: IntArray) -> IndexArray:
        """``(2, n)`` parameters at which sides begin."""
        tiles, m = self.tiles, self.frames.domain.corner_count
        tile = side // m
        number = side - m * tile + m * tiles.is_flipped[tile]
        corners = self.frames.domain.corners.T.astype(np.int32)
        steps, size = np.concatenate([corners, 1 - corners], axis=1), tiles.size[tile]
        found = [size * (at[tile] + step[number]) for at, step in zip(tiles.origin.T, steps, strict=True)]
        return np.stack(found).astype(np.int32)

    def _blocks(self) -> Iterator[tuple[slice, IndexArray, list[SidePoints]]]:
        """Blocks of spans, with the points where they begin, ``(2, n)``, and those of these that lie on borders."""
        side, m = self.side, self.frames.domain.corner_count
        for block in chunks_of(len(side)):
            first = side[block.start] // m
            own = self.tiles[first : side[block.stop - 1] // m + 1]
            points = tile_corners(own, self.frames.domain).reshape(2, -1).take(side[block] - m * first, axis=1)
            inside = np.flatnonzero(self.node[block] & (self.node[block] - 1))
            points[:, inside] = self.along(block.start + inside, np.zeros(len(inside)))
            yield block, points, points_on_sides(self.frames, self._corner(block), points)

    def _corner(self, block: slice) -> IntArray:
        """``(n,)`` the corner that the patch of each span begins at."""
        return self.tiles.corner[self.side[block] // self.frames.domain.corner_count]

    @cached_property
    def _points(self) -> tuple[IndexArray, IndexArray]:
        """``(s,)`` number of the point at which each span begins, and the first span of each."""
        frames, t = self.frames, self.frames.topology
        vertex_count, count = int(frames.vertex.max(initial=0)) + 1, t.half_edge_count
        on_edge, on_spoke, at_centre = vertex_count + count * np.arange(3)
        depth = int(self.tiles.depth.max(initial=0))
        bits = 2 * depth + 3
        most = at_centre + t.face_count + count
        names: IntArray = np.empty(len(self.side), dtype=np.int32 if most < 1 << 31 else np.int64)
        positions: IntArray = np.empty(len(self.side), dtype=np.int32 if bits < 32 else np.int64)
        for block, (x, y), borders in self._blocks():
            name = at_centre + t.face_count + self._corner(block).astype(np.int64)
            for border in borders:
                if border.is_spoke:
                    is_centre = border.at == UNIT
                    faces = t.face[border.edge]
                    name[border.on] = np.where(is_centre, at_centre + faces, on_spoke + border.edge)
                    x[border.on], y[border.on] = np.where(is_centre, 0, border.at), 0
            # The first point of a spoke is on an edge, as the first and the last one of an edge are vertices.
            for border in borders:
                if not border.is_spoke:
                    name[border.on] = on_edge + frames.edge[border.edge]
                    x[border.on] = np.where(frames.is_backward[border.edge], EDGE - border.at, border.at)
                    y[border.on] = 0
            on, edge = self._vertices(borders)
            name[on], x[on], y[on] = frames.vertex[edge], 0, 0
            names[block] = name
            positions[block] = (x >> (DEEPEST - depth)).astype(np.int64) << (depth + 1) | y >> (DEEPEST - depth)
        keys = joined(names, positions, bits)
        del names, positions
        return ranked(keys)

    def _vertices(self, borders: list[SidePoints]) -> tuple[IntArray, IntArray]:
        """Points at vertices, and half-edges that begin there."""
        # The end of each side is the beginning of the next one.
        chosen = [(border, np.flatnonzero(border.at == 0)) for border in borders if not border.is_spoke]
        on, edge = (np.concatenate(each) for each in zip(*((own.on[i], own.edge[i]) for own, i in chosen), strict=True))
        return on, edge

    def numbered(
        self,
        # (n_h,) int32: numbers of edges and vertices, as those of `PatchFrames`. Spans and their beginnings
        # are the same if they lie in the same place, and on edges and vertices of the same numbers.
        edge: IndexArray,
        vertex: IndexArray,
    ) -> SpanVertices:
        """Number the vertices where spans begin and inside spans, by which edges and vertices are the same."""
        frames = self.frames
        point, of_point = self._points
        span, of_span = self.at, first_of_each(self.at)
        if _is_finer(edge, frames.edge) or _is_finer(vertex, frames.vertex):
            of_points = np.zeros(len(point), dtype=np.int32)
            for block, _, borders in self._blocks():
                name = of_points[block]
                for border in borders:
                    if not border.is_spoke:
                        name[border.on] = edge[border.edge]
                on, half_edge = self._vertices(borders)
                name[on] = vertex[half_edge]
            half_edges = [side_lines(self.tiles[block], self.frames).half_edge for block in chunks_of(len(self.tiles))]
            half_edge = np.concatenate(half_edges)[self.side]
            of_spans = np.where(half_edge >= 0, edge[half_edge], 0)
            point, of_point = ranked(joined(point, of_points, 32))
            span, of_span = ranked(joined(span, of_spans, 32))
        first_inside = ragged.offsets(self.rate[of_span] - 1, np.int32)
        first_inside += len(of_point)
        return SpanVertices(point, span, first_inside[:-1], of_point, of_span, int(first_inside[-1]))


@dataclass(frozen=True, eq=False)
class SpanVertices:
    """Vertices of the tessellation where spans begin, which are numbered first, and those inside spans."""

    point: IndexArray  # (s,) int32: the vertex where each span begins
    span: IndexArray  # (s,) int32: 0-based number shared by all equal spans
    first_inside: IndexArray  # (k,) int32: the vertex with the least number inside each of these
    of_point: IndexArray  # (p,) int32: the first span that begins at each vertex
    of_span: IndexArray  # (k,) int32: the first of the spans with each number
    vertex_count: int


def cut_into_spans(tiles: Tiles, frames: PatchFrames) -> Spans:
    """Cut the sides of tiles where others on the same lines end."""
    m = frames.domain.corner_count
    shift = DEEPEST - int(tiles.depth.max(initial=0))
    keys, is_backward = _side_keys(tiles, frames, shift)
    group, first = ranked(keys)
    keys = keys[first]
    wanted = np.maximum(tiles.rates[:, [0, 1, 0, 1] if m == 4 else [0, 0, 0]], tiles.sides).astype(np.int16).ravel()
    rate = np.ones(len(keys), dtype=np.int16)
    np.maximum.at(rate, group, wanted)
    del wanted
    # Positions along all lines, one line after the other.
    begin, size = keys >> HALVINGS, (EDGE >> shift) >> (keys & ((1 << HALVINGS) - 1)).astype(np.int32)
    del keys
    is_span = np.ones(len(begin), dtype=bool)
    np.less_equal(begin[:-1] + size[:-1], begin[1:], out=is_span[:-1])
    # The spans of each group: itself, or all of those that follow up to its end.
    offsets: IntArray = ragged.offsets(is_span, np.int32)
    before = offsets[:-1]
    count = np.ones(len(begin), dtype=np.int32)
    cut = np.flatnonzero(~is_span)
    ends = np.searchsorted(begin, begin[cut] + size[cut])
    count[cut] = offsets[ends] - before[cut]
    spans, of_span = ragged.ranges(before[cut], count[cut]), np.repeat(cut, count[cut])
    span_rate, of_row = rate[is_span], np.flatnonzero(is_span).astype(np.int32)
    # Lengths are powers of two: a side that is cut has its rate in parts of it, too.
    np.maximum.at(span_rate, spans, -(-rate[of_span].astype(np.int64) * size[of_row[spans]] // size[of_span]))
    counts = count[group]
    del rate, is_span, count

    side = np.repeat(np.arange(len(group), dtype=np.int32), counts)
    at = before[group][side]
    is_held = counts > 1
    rows = np.flatnonzero(is_held[side])
    of_side, place = side[rows], ragged.index_in_row(counts[is_held])
    backward = is_backward[of_side]
    at[rows] += np.where(backward, counts[of_side] - 1 - place, place).astype(np.int32)
    own, row = group[of_side], of_row[at[rows]]
    length = size[row]
    # Sizes are powers of two.
    parts, passed = size[own] // length, (begin[row] - begin[own]) // length
    nodes = parts + np.where(backward, parts - 1 - passed, passed)
    # Few sides are cut into parts so small that these numbers need more than a byte.
    node = np.ones(len(side), dtype=np.min_scalar_type(int(nodes.max(initial=1))))
    node[rows] = nodes
    del group, begin, size, before, counts, of_row
    tiles = replace(tiles, sides=np.empty((len(tiles), 0), dtype=np.int16))
    return Spans(tiles, frames, side, span_rate[at], node, is_backward[side], at.astype(np.int32, copy=False))


def _side_keys(tiles: Tiles, frames: PatchFrames, shift: int) -> tuple[NDArray[np.int64], NDArray[np.bool_]]:
    """Integers in the order of all sides along all lines, and whether these lead backwards.

    Of sides that begin at the same place, the longest come first.
    """
    count = frames.domain.corner_count * len(tiles)
    line, low = np.empty(count, dtype=np.int64), np.empty(count, dtype=np.int32)
    is_backward = np.empty(count, dtype=bool)
    for block in chunks_of(len(tiles)):
        sides = side_lines(tiles[block], frames)
        own = slice(frames.domain.corner_count * block.start, frames.domain.corner_count * block.stop)
        # Levels of lines are multiples of the least tile's size.
        line[own], low[own] = sides.line >> shift, sides.low >> shift << HALVINGS | sides.halvings
        is_backward[own] = sides.is_backward
    return joined(line, low, DEEPEST + 1 - shift + HALVINGS), is_backward


def _is_finer(names: IntArray, others: IntArray) -> bool:
    """Whether some names distinguish items with equal other names."""
    if names is others:
        return False
    one = np.zeros(int(others.max(initial=0)) + 1, dtype=names.dtype)
    one[others] = names
    return bool((one[others] != names).any())


def first_of_each(number: IntArray) -> IndexArray:
    """First index of each number from 0 on."""
    found = np.empty(int(number.max(initial=-1)) + 1, dtype=np.int32)
    found[number[::-1]] = np.arange(len(number) - 1, -1, -1, dtype=np.int32)
    return found
