"""Numbering, locations and triangles of an adaptive tessellation."""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from ..mesh import ragged
from ..mesh.connectivity import IntArray, Topology
from ..schemes.domain import FloatArray
from .stitching import Loops, Stitched, inner_counts, inner_steps, stitched
from .tile_lines import UNIT, EdgeNames, PatchFrames, Spans, SpanVertices, cut_into_spans, numbered, tile_corners
from .tiles import Tiles


@dataclass(frozen=True, eq=False)
class Lattices:
    """Vertices of a tessellation as lattices of samples, each on one polynomial piece.

    Attributes
    ----------
    corner : (l,) int32
        Corner of an element that parameters are seen from, a half-edge of `PatchTable.elements`: the nearest one.
    origin : (l, 2) float64
        Parameters of the first sample.
    step_u, step_v : (l, 2) float64
        From one sample to the next in a row, and from one row to the next.
    counts : (l, 2) int64
        Samples in a row, and rows; over triangles each row has one sample less than the row before, if ``falls``.
    falls : (l,) bool
    middle : (l, 2) float64
        A place inside the piece.
    first_vertex : (l,) int64
        Vertex of the first sample; the others follow, row by row.
    """

    corner: IntArray
    origin: FloatArray
    step_u: FloatArray
    step_v: FloatArray
    counts: IntArray
    falls: NDArray[np.bool_]
    middle: FloatArray
    first_vertex: IntArray


@dataclass(frozen=True, eq=False)
class AdaptiveGrid:
    """An adaptive tessellation: vertices at breaks of lines come first, then those inside spans, then those in tiles.

    Parameters
    ----------
    tiles : Tiles
    frames : PatchFrames
    """

    tiles: Tiles
    frames: PatchFrames

    @property
    def _corner_count(self) -> int:
        return self.frames.domain.corner_count

    @cached_property
    def _spans(self) -> Spans:
        return cut_into_spans(self.tiles, self.frames)

    def numbered(self, topology: Topology | None = None) -> SpanVertices:
        """Vertices at breaks and inside spans; of elements that are cut further, if a topology is given."""
        return numbered(self._spans, self.tiles, self.frames, EdgeNames.of(topology or self.frames.topology))

    @cached_property
    def _numbers(self) -> SpanVertices:
        return self.numbered()

    @cached_property
    def _inner_counts(self) -> IntArray:
        return inner_counts(self.tiles.rates, self._corner_count)

    @cached_property
    def vertex_count(self) -> int:
        """Vertices of the tessellation."""
        return self._numbers.vertex_count + int(self._inner_counts.sum())

    @cached_property
    def place(self) -> IntArray:
        """``(vertex_count,)`` the vertex whose position each vertex has: itself, or one on the other side of a crease."""
        place = np.arange(self.vertex_count)
        own, shared = self._numbers, numbered(self._spans, self.tiles, self.frames, self.frames.places)
        if len(shared.point_owner) == len(own.point_owner) and len(shared.span_owner) == len(own.span_owner):
            return place
        place[own.first_point] = own.first_point[shared.point_owner][shared.first_point]
        lengths = self._spans.rate - 1
        span_of = np.searchsorted(shared.first_inside[shared.span_owner], shared.first_inside, side="right") - 1
        first = own.first_inside[shared.span_owner][span_of]
        place[ragged.ranges(own.first_inside, lengths)] = ragged.ranges(first, lengths)
        return place

    @cached_property
    def _loop_spans(self) -> tuple[IntArray, IntArray, FloatArray]:
        """Of the samples in the loops of all tiles the span, the place in it, and how far along the span it is."""
        rate = self._spans.rate
        span, place = np.repeat(np.arange(len(rate)), rate), ragged.places(rate)
        return span, place, place / rate[span]

    def _loop_vertices(self, numbers: SpanVertices) -> IntArray:
        """Vertices of the samples in the loops of all tiles."""
        span, place, _ = self._loop_spans
        inside = np.where(self._spans.is_backward[span], self._spans.rate[span] - 1 - place, place - 1)
        return np.where(place == 0, numbers.first_point[span], numbers.first_inside[span] + inside)

    @cached_property
    def _stitched(self) -> Stitched:
        spans = self._spans
        span, _, along = self._loop_spans
        m = self._corner_count
        side = spans.side[span]
        size = (UNIT >> self.tiles.depth)[side // m]
        corners = tile_corners(self.tiles, self.frames.domain).reshape(-1, 2)
        # The longer coordinate of the way along a side is the tile's size.
        begin = np.abs(spans.begin - corners[spans.side]).max(axis=1)[span]
        length = np.abs(spans.end - spans.begin).max(axis=1)[span]
        counts = np.bincount(side, minlength=m * len(self.tiles))
        return stitched(self.tiles.rates, Loops(ragged.offsets(counts), (begin + along * length) / size, m))

    def sample_vertices(self, topology: Topology | None = None) -> tuple[IntArray, int]:
        """Vertices of all samples, those of loops and then those inside tiles; and how many vertices there are.

        Parameters
        ----------
        topology : Topology, optional
            Of the elements, cut further: along seams of attributes. There are more vertices then.
        """
        numbers = self._numbers if topology is None else self.numbered(topology)
        count = int(self._inner_counts.sum())
        inside = np.arange(numbers.vertex_count, numbers.vertex_count + count)
        return np.concatenate([self._loop_vertices(numbers), inside]), numbers.vertex_count + count

    def triangles(self, topology: Topology | None = None) -> NDArray[np.uint32]:
        """``(m, 3)`` vertices, counter-clockwise from outside, in the order of the elements."""
        return self.sample_vertices(topology)[0].astype(np.uint32)[self._stitched.triangles]

    def element(self) -> NDArray[np.uint32]:
        """``(m,)`` element of each triangle."""
        return self.frames.topology.face_of(self.tiles.corner)[self._stitched.tile].astype(np.uint32)

    @cached_property
    def _sample_places(self) -> FloatArray:
        """``(n, 2)`` where samples lie in their patches, in parts of `UNIT`."""
        spans = self._spans
        span, _, along = self._loop_spans
        of_loops = spans.begin[span] + along[:, None] * (spans.end - spans.begin)[span]
        tile = np.repeat(np.arange(len(self.tiles)), self._inner_counts)
        steps = inner_steps(self.tiles.rates, self._corner_count) / self.tiles.rates[tile]
        return np.concatenate([of_loops, self._in_patch(tile, steps)])

    def _in_patch(self, tile: IntArray, uv: FloatArray) -> FloatArray:
        """Places in patches, in parts of `UNIT`, of parameters in tiles."""
        flipped = self.tiles.is_flipped[tile, None]
        size = (UNIT >> self.tiles.depth[tile])[:, None]
        return size * (self.tiles.place[tile] + np.where(flipped, 1 - uv, uv))

    def _seen(self, tile: IntArray, turn: IntArray, places: FloatArray) -> FloatArray:
        """Parameters in elements, seen from the corner of the patch after so many turns; patches that are not whole have none."""
        uv = places / UNIT
        domain = self.frames.domain
        for corner in range(1, domain.corner_count):
            at = np.flatnonzero(turn == corner)
            if len(at):
                uv[at] = domain.rotation(corner).inverse()(uv[at])
        return uv * self.frames.scale[self.frames.topology.face_of(self.tiles.corner[tile])][:, None]

    def _nearest_corner(self, tile: IntArray, places: FloatArray) -> tuple[IntArray, IntArray]:
        """The turn to the nearest corner of each patch, and the half-edge that begins there."""
        t, domain = self.frames.topology, self.frames.domain
        is_whole = self.frames.is_whole[t.face_of(self.tiles.corner[tile])]
        corners = domain.corners * UNIT
        far = [np.abs(places - corner).max(axis=1) for corner in corners]
        turn = np.where(is_whole, np.argmin(far, axis=0), 0)
        corner = self.tiles.corner[tile]
        for step in range(1, domain.corner_count):
            corner = np.where(turn >= step, t.following(corner), corner)
        return turn, corner

    @cached_property
    def triangle_locations(self) -> tuple[IntArray, FloatArray]:
        """Where the corners of triangles lie.

        Returns
        -------
        corner : (m,) int32
            Corner of an element, a half-edge of `PatchTable.elements`.
        uv : (m, 3, 2) float64
            Parameters in the element, seen from there.
        """
        tile = self._stitched.tile
        middle = self._in_patch(tile, np.full((len(tile), 2), 1 / self._corner_count))
        turn, corner = self._nearest_corner(tile, middle)
        places = self._sample_places[self._stitched.triangles]
        uv = [self._seen(tile, turn, places[:, i]) for i in range(3)]
        return corner.astype(np.int32), np.stack(uv, axis=1)

    @cached_property
    def lattices(self) -> Lattices:
        """All vertices, each once, as lattices."""
        spans, numbers, m = self._spans, self._numbers, self._corner_count
        owner = numbers.point_owner
        found = [self._single(spans.side[owner] // m, spans.begin[owner], np.arange(len(owner)))]
        owner = numbers.span_owner[spans.rate[numbers.span_owner] > 1]
        tile, inside, first = spans.side[owner] // m, spans.rate[owner] - 1, numbers.first_inside[owner]
        is_backward = spans.is_backward[owner, None]
        begin = np.where(is_backward, spans.end[owner], spans.begin[owner])
        step = (np.where(is_backward, spans.begin[owner], spans.end[owner]) - begin) / (inside + 1)[:, None]
        # A tile that holds several pieces has them sample by sample.
        pieces, rest = np.flatnonzero(self.tiles.is_piece[tile]), np.flatnonzero(~self.tiles.is_piece[tile])
        counts = np.stack([inside, np.ones_like(inside)], axis=1)
        found.append(self._lattices(*(each[pieces] for each in (tile, begin + step, step, step, counts, first))))
        which, place = np.repeat(rest, inside[rest]), ragged.places(inside[rest])
        at = begin[which] + (place + 1)[:, None] * step[which]
        found.append(self._single(tile[which], at, first[which] + place))
        tile = np.flatnonzero(self._inner_counts)
        rates = self.tiles.rates[tile]
        corners = [self._in_patch(tile, np.array(steps) / rates) for steps in ((1, 1), (2, 1), (1, 2))]
        first = numbers.vertex_count + ragged.starts(self._inner_counts)[tile]
        counts = rates - (2 if m == 3 else 1)
        steps = (corner - corners[0] for corner in corners[1:])
        found.append(self._lattices(tile, corners[0], *steps, counts, first, falls=m == 3))
        return Lattices(*(np.concatenate([getattr(each, field.name) for each in found]) for field in fields(Lattices)))

    def _single(self, tile: IntArray, places: FloatArray, vertices: IntArray) -> Lattices:
        """Lattices of one sample each."""
        found = self._lattices(tile, places, 0 * places, 0 * places, np.ones((len(tile), 2), dtype=np.int64), vertices)
        return replace(found, middle=found.origin)

    def _lattices(
        self,
        tile: IntArray,
        origin: FloatArray,
        step_u: FloatArray,
        step_v: FloatArray,
        counts: IntArray,
        first_vertex: IntArray,
        *,
        falls: bool = False,
    ) -> Lattices:
        """Lattices in tiles, of places and steps in the patch, in parts of `UNIT`."""
        middle = self._in_patch(tile, np.full((len(tile), 2), 1 / self._corner_count))
        turn, corner = self._nearest_corner(tile, origin)
        seen, *ends = (self._seen(tile, turn, at) for at in (origin, origin + step_u, origin + step_v, middle))
        return Lattices(
            corner.astype(np.int32),
            seen,
            ends[0] - seen,
            ends[1] - seen,
            counts,
            np.full(len(tile), falls),
            ends[2],
            first_vertex,
        )

    @cached_property
    def locations(self) -> tuple[IntArray, FloatArray]:
        """Where each vertex lies: see `SamplingTable.locations`."""
        lattices = self.lattices
        (row_length, rows), falls = lattices.counts.T, lattices.falls
        totals = np.where(falls, row_length * (row_length + 1) // 2, row_length * rows)
        lattice = np.repeat(np.arange(len(totals)), totals)
        if falls.any():
            steps = np.empty((len(lattice), 2), dtype=np.int64)
            in_falling = falls[lattice]
            steps[in_falling] = inner_steps(np.repeat(row_length[falls, None] + 2, 2, axis=1), 3) - 1
            steps[~in_falling] = np.stack(np.divmod(ragged.places(totals[~falls]), row_length[lattice[~in_falling]])[::-1], axis=1)  # fmt: skip
        else:
            steps = np.stack(np.divmod(ragged.places(totals), row_length[lattice])[::-1], axis=1)
        uv = lattices.origin[lattice] + steps[:, :1] * lattices.step_u[lattice] + steps[:, 1:] * lattices.step_v[lattice]
        vertex = ragged.ranges(lattices.first_vertex, totals)
        corner, found = np.empty(self.vertex_count, dtype=np.int64), np.empty((self.vertex_count, 2))
        corner[vertex], found[vertex] = lattices.corner[lattice], uv
        return corner, found
