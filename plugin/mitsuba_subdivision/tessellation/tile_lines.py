"""The lines on which tiles meet, cut into spans that all tiles beside them share: nothing can crack.

Tiles of different sizes and rates meet along edges of elements, along the spokes of polygons, and inside patches. The
corners of all tiles beside a line are its *breaks*, and between two successive breaks lies a *span*. A span has as many
segments as the finest of its tiles asks for, and each of its samples is one vertex of the tessellation.

The sides of a crease are two lines with vertices of their own, but in the same places: they share breaks and rates.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..mesh import ragged
from ..mesh.connectivity import IntArray
from ..schemes.domain import ParameterDomain
from .patch_frames import EdgeNames, PatchFrames
from .tiles import DEEPEST, Tiles

# Parameters of patches in integers: corners of tiles lie at multiples of this part of a patch.
UNIT = 1 << DEEPEST
# An edge of an element, along which a patch of a polygon reaches half way, in the same parts.
EDGE = 2 * UNIT
# Bits of a position along a line.
POSITION = DEEPEST + 2
# Kinds of places, in the highest bits of the numbers that name them.
_AT_VERTEX, _ON_EDGE, _ON_SPOKE, _AT_CENTRE, _INSIDE = (np.int64(kind) << 60 for kind in range(5))


def tile_corners(tiles: Tiles, domain: ParameterDomain) -> IntArray:
    """``(t, m, 2)`` corners of tiles in their patches, in parts of `UNIT`, counter-clockwise from the tile's (0, 0)."""
    size = (UNIT >> tiles.depth)[:, None, None]
    steps = domain.corners.astype(np.int64)
    steps = np.where(tiles.is_flipped[:, None, None], 1 - steps, steps)
    return size * (tiles.place[:, None] + steps)


def at_vertices(marked: NDArray[np.bool_], tiles: Tiles, frames: PatchFrames) -> NDArray[np.bool_]:
    """``(t, m)`` whether corners of tiles lie at half-edges' beginnings that are marked, ``(n_h,)``: at vertices."""
    t, domain = frames.topology, frames.domain
    corners = tile_corners(tiles, domain)
    found = np.zeros(corners.shape[:2], dtype=bool)
    is_whole, half_edge = frames.is_whole[t.face_of(tiles.corner)], tiles.corner
    for number, corner in enumerate(domain.corners.astype(np.int64) * UNIT):
        may_be = marked[half_edge] & (is_whole | (number == 0))
        found |= may_be[:, None] & (corners == corner).all(axis=2)
        half_edge = t.following(half_edge)
    return found


@dataclass(frozen=True, eq=False)
class Spans:
    """Spans of all sides of all tiles: in the order of the sides, along each side counter-clockwise around the tile.

    Attributes
    ----------
    side : (s,) int64
        ``m`` times the tile, plus the corner at which its side begins.
    rate : (s,) int64
        Segments.
    begin, end : (s, 2) int64
        In the tile's patch, in parts of `UNIT`.
    is_backward : (s,) bool
        Whether the numbers of the vertices inside fall along the side.
    at : (s,) int64
        A number that the span has in common with all others in the same place.
    """

    side: IntArray
    rate: IntArray
    begin: IntArray
    end: IntArray
    is_backward: NDArray[np.bool_]
    at: IntArray


@dataclass(frozen=True, eq=False)
class SpanVertices:
    """Vertices of the tessellation at breaks, which are numbered first, and those inside spans.

    Attributes
    ----------
    point : (s,) int64
        The vertex where each span begins.
    span : (s,) int64
        A number of each span, which those that are one have in common.
    first_inside : (s,) int64
        The vertex with the least number inside each span.
    vertex_count : int
    """

    point: IntArray
    span: IntArray
    first_inside: IntArray
    vertex_count: int


def cut_into_spans(tiles: Tiles, frames: PatchFrames) -> Spans:
    """Cut the sides of tiles at the breaks of the lines that they lie on."""
    count = frames.domain.corner_count
    corners = tile_corners(tiles, frames.domain)
    begin, end = corners.reshape(-1, 2), np.roll(corners, -1, axis=1).reshape(-1, 2)
    line, start, stop = _lines(frames, np.repeat(tiles.corner, count), begin, end)
    wanted = np.maximum(tiles.rates[:, [0, 1, 0, 1] if count == 4 else [0, 0, 0]], tiles.sides).ravel()
    low, high = np.minimum(start, stop), np.maximum(start, stop)
    _, number = np.unique(line, return_inverse=True)
    keys = number.astype(np.int64) << POSITION
    breaks = np.unique(np.concatenate([keys | low, keys | high]))
    first, last = np.searchsorted(breaks, keys | low), np.searchsorted(breaks, keys | high)

    side = np.repeat(np.arange(len(first)), last - first)
    # Along the line, or against it.
    is_backward = (stop < start)[side]
    place = ragged.places(last - first)
    at = np.where(is_backward, last[side] - 1 - place, first[side] + place)
    length, whole = breaks[at + 1] - breaks[at], (high - low)[side]
    rates = np.zeros(len(breaks), dtype=np.int64)
    # Lengths are powers of two: each side has its rate in parts of it, too.
    np.maximum.at(rates, at, -(-wanted[side] * length // whole))
    position = breaks & ((1 << POSITION) - 1)
    way = (end - begin)[side]

    def reached(which: IntArray) -> IntArray:
        """Where on the side a break lies."""
        passed = np.abs(position[which] - start[side])
        return begin[side] + way * passed[:, None] // whole[:, None]

    return Spans(side, rates[at], reached(at + is_backward), reached(at + ~is_backward), is_backward, at)


def numbered(spans: Spans, tiles: Tiles, frames: PatchFrames, names: EdgeNames) -> SpanVertices:
    """Number the vertices at breaks and inside spans, by names of edges and vertices.

    Spans and their beginnings are the same if they lie in the same place, and on edges and vertices of the same names.
    """
    corner = tiles.corner[spans.side // frames.domain.corner_count]
    point, point_count = _same(_place(frames, corner, spans.begin, names))
    line, _, _ = _lines(frames, corner, spans.begin, spans.end, names)
    span, span_count = _same(np.stack([line, spans.at]))
    inside = np.zeros(span_count, dtype=np.int64)
    inside[span] = spans.rate - 1
    first_inside = point_count + ragged.starts(inside)
    return SpanVertices(point, span, first_inside[span], point_count + int(inside.sum()))


def _same(keys: IntArray) -> tuple[IntArray, int]:
    """Number the columns of ``(2, n)`` integers, equal ones alike; and how many there are."""
    order = np.lexsort(keys[::-1])
    is_new = np.concatenate([[True], (np.diff(keys[:, order], axis=1) != 0).any(axis=0)])
    number = np.empty(keys.shape[1], dtype=np.int64)
    number[order] = np.cumsum(is_new) - 1
    return number, int(np.count_nonzero(is_new))


def _lines(
    frames: PatchFrames, corner: IntArray, begin: IntArray, end: IntArray, names: EdgeNames | None = None
) -> tuple[IntArray, IntArray, IntArray]:
    """On which lines the ways from one place of a patch to another lie, and from where to where along them.

    Parameters
    ----------
    corner : (n,) int32
        Where their patches begin.
    begin, end : (n, 2) int64
    names : EdgeNames, optional
        Of the lines; by default those of places.
    """
    is_level, is_upright = begin[:, 1] == end[:, 1], begin[:, 0] == end[:, 0]
    axis = np.where(is_level, 0, np.where(is_upright, 1, 2))
    level = np.where(is_level, begin[:, 1], np.where(is_upright, begin[:, 0], begin.sum(axis=1)))
    line = _INSIDE + ((((corner.astype(np.int64) << 2) | axis) << (DEEPEST + 1)) | level)
    start, stop = (np.where(is_level, place[:, 0], place[:, 1]) for place in (begin, end))
    for border in _borders(frames, corner, begin, end):
        on = border.on
        start[on], stop[on] = border.begin, border.end
        edges = (names or frames.places).edge
        line[on] = _ON_SPOKE + border.edge if border.is_spoke else _ON_EDGE + edges[border.edge]
    return line, start, stop


def _place(frames: PatchFrames, corner: IntArray, at: IntArray, names: EdgeNames) -> IntArray:
    """``(2, n)`` numbers that tell places of patches apart, by names of edges and vertices.

    Parameters
    ----------
    corner : (n,) int32
        Where the patches begin.
    at : (n, 2) int64
    """
    t = frames.topology
    found = np.stack([_INSIDE + corner.astype(np.int64), (at[:, 0] << POSITION) | at[:, 1]])
    borders = list(_borders(frames, corner, at, at))
    for border in borders:
        if border.is_spoke:
            is_centre = border.begin == UNIT
            found[0, border.on] = np.where(is_centre, _AT_CENTRE + t.face_of(border.edge), _ON_SPOKE + border.edge)
            found[1, border.on] = np.where(is_centre, 0, border.begin)
    # The first point of a spoke is on an edge, as the first and the last one of an edge are vertices.
    for border in borders:
        if not border.is_spoke:
            found[0, border.on], found[1, border.on] = _ON_EDGE + names.edge[border.edge], border.begin
    for border in borders:
        if not border.is_spoke:
            from_start = np.where(frames.is_backward[border.edge], EDGE - border.begin, border.begin)
            for position, edge in ((0, border.edge), (EDGE, t.following(border.edge))):
                is_here = from_start == position
                found[0, border.on[is_here]] = _AT_VERTEX + names.vertex[edge[is_here]]
                found[1, border.on[is_here]] = 0
    return found


@dataclass(frozen=True, eq=False)
class _Border:
    """Ways on one side of their patches.

    Attributes
    ----------
    on : (n,) int64
        Which of them lie there.
    edge : (n,) int64
        Half-edge of the element along that side; for a spoke, in whose middle it begins.
    begin, end : (n,) int64
        Positions along the edge, or along the spoke.
    is_spoke : bool
    """

    on: IntArray
    edge: IntArray
    begin: IntArray
    end: IntArray
    is_spoke: bool


def _borders(frames: PatchFrames, corner: IntArray, begin: IntArray, end: IntArray) -> Iterator[_Border]:
    """Of ways from one place of a patch to another those that lie on its sides, side by side."""
    t = frames.topology
    is_whole = frames.is_whole[t.face_of(corner)]
    ways = np.stack([begin, end])
    u, v = ways[..., 0], ways[..., 1]
    is_triangle = frames.domain.corner_count == 3
    # How far from each side, and how far along it.
    sides = (
        [(v, u), (UNIT - u - v, v), (u, UNIT - v)]
        if is_triangle
        else [(v, u), (UNIT - u, v), (UNIT - v, UNIT - u), (u, UNIT - v)]
    )
    if is_whole.any():
        edge = corner
        for distance, along in sides:
            on = np.flatnonzero(is_whole & (distance == 0).all(axis=0))
            yield _on_edge(frames, on, edge[on], 2 * along[:, on])
            edge = t.following(edge)
    if is_whole.all():
        return
    preceding = t.preceding(corner)
    for distance, edge, along, is_spoke in (
        (v, corner, u, False),
        (UNIT - u, corner, v, True),
        (UNIT - v, preceding, u, True),
        (u, preceding, EDGE - v, False),
    ):
        on = np.flatnonzero(~is_whole & (distance == 0).all(axis=0))
        if is_spoke:
            yield _Border(on, edge[on].astype(np.int64), along[0, on], along[1, on], True)
        else:
            yield _on_edge(frames, on, edge[on], along[:, on])


def _on_edge(frames: PatchFrames, on: IntArray, edge: IntArray, along: IntArray) -> _Border:
    begin, end = np.where(frames.is_backward[edge], EDGE - along, along)
    return _Border(on, edge.astype(np.int64), begin, end, False)
