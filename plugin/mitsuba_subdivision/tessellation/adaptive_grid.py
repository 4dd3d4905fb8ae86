"""Numbering, locations and triangles of an adaptive tessellation."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from ..mesh import ragged
from ..mesh.chunks import chunks_of
from ..mesh.connectivity import IndexArray, IntArray, Topology
from ..schemes.domain import FloatArray
from .patch_frames import EdgeNames, PatchFrames
from .stitching import Loops, Stitched, inner_counts, inner_steps, stitched
from .tile_lines import UNIT, LinePoints, Spans, SpanVertices, at_vertices, cut_into_spans, first_of_each
from .tiles import Tiles


@dataclass(frozen=True, eq=False)
class AdaptiveGrid:
    """An adaptive tessellation: vertices where spans begin come first, then those inside spans, then those in tiles.

    Parameters
    ----------
    tiles : Tiles
    frames : PatchFrames
    keeps_corner : (t, m) bool or None
        At which corners of tiles no triangle lies across: at vertices of valence 2, where two tiles meet along both
        sides, and the same triangle would be there twice. None if there are none.
    """

    tiles: Tiles
    frames: PatchFrames
    keeps_corner: NDArray[np.bool_] | None = None

    @classmethod
    def of(cls, tiles: Tiles, frames: PatchFrames) -> AdaptiveGrid:
        """The grid of some tiles, which get more segments where elements meet more than once."""
        t, m = frames.topology, frames.domain.corner_count
        is_pair = (t.vertex_face_count <= 2) & ~t.is_border_vertex
        keeps = at_vertices(is_pair[t.face_vertices], tiles, frames) if is_pair.any() else None
        has_more = (tiles.depth == 0) & frames.meets_twice[t.face_of(tiles.corner)]
        if keeps is not None:
            has_more |= keeps.any(axis=1)
        if not has_more.any():
            return cls(tiles, frames)
        # So many that no line inside joins two points of the sides.
        least = np.where(has_more, 3 if m == 3 else 2, 1)
        return cls(replace(tiles, rates=np.maximum(tiles.rates, least[:, None])), frames, keeps)

    @property
    def _corner_count(self) -> int:
        return self.frames.domain.corner_count

    @cached_property
    def _spans(self) -> Spans:
        return cut_into_spans(self.tiles, self.frames)

    @cached_property
    def _points(self) -> LinePoints:
        return LinePoints(self.tiles, self.frames, self._spans)

    def numbered(self, topology: Topology | None = None) -> SpanVertices:
        """Vertices where spans begin and inside spans; of elements that are cut further, if a topology is given."""
        return self._numbers if topology is None else self._points.numbered(EdgeNames.of(topology))

    @cached_property
    def _numbers(self) -> SpanVertices:
        return self._points.numbered(EdgeNames.of(self.frames.topology))

    @cached_property
    def _inner_counts(self) -> IntArray:
        return inner_counts(self.tiles.rates, self._corner_count)

    @cached_property
    def vertex_count(self) -> int:
        """Vertices of the tessellation."""
        return self._numbers.vertex_count + int(self._inner_counts.sum())

    @cached_property
    def place(self) -> IntArray:
        """``(vertex_count,)`` the vertex whose position each one has: itself, or one on the other side of a crease."""
        place = np.arange(self.vertex_count)
        own, shared = self._numbers, self._points.numbered(self.frames.places)
        if shared.vertex_count == own.vertex_count:
            return place
        # Of vertices in the same place, the first.
        at = shared.point[own.of_point]
        place[: len(at)] = first_of_each(at)[at]
        at = self._spans.at[own.of_span]
        lengths, first = self._spans.rate[own.of_span] - 1, own.first_inside
        place[ragged.ranges(first, lengths)] = ragged.ranges(first[first_of_each(at)[at]], lengths)
        return place

    def _loop_spans(self, block: slice = slice(None)) -> tuple[IndexArray, FloatArray]:
        """Of the samples in the loops of tiles the span, and how far along it they are; of a block of spans."""
        rate = self._spans.rate[block]
        first = block.start or 0
        span = np.repeat(np.arange(first, first + len(rate), dtype=np.int32), rate)
        return span, ragged.places(rate) / np.repeat(rate, rate)

    def _loop_vertices(self, numbers: SpanVertices) -> IntArray:
        """Vertices of the samples in the loops of all tiles."""
        rate = self._spans.rate
        found = np.repeat(numbers.point, rate)
        long = np.flatnonzero(rate > 1)
        inside = rate[long] - 1
        first = numbers.first_inside[numbers.span[long]] + np.where(self._spans.is_backward[long], inside - 1, 0)
        step = np.where(self._spans.is_backward[long], -1, 1)
        found[ragged.ranges(ragged.starts(rate)[long] + 1, inside)] = np.repeat(first, inside) + (
            np.repeat(step, inside) * ragged.places(inside)
        )
        return found

    @cached_property
    def _stitched(self) -> Stitched:
        spans, m = self._spans, self._corner_count
        # Samples of all loops come first, then those inside tiles.
        loop_count, inner_begin = int(spans.rate.sum(dtype=np.int64)), ragged.offsets(self._inner_counts)
        loop_begin, found = 0, []
        for tiles in chunks_of(len(self.tiles)):
            own = slice(*np.searchsorted(spans.side, np.array([m * tiles.start, m * tiles.stop], dtype=np.int32)))
            span, along = self._loop_spans(own)
            counts = np.bincount(spans.side[span] - m * tiles.start, minlength=m * (tiles.stop - tiles.start))
            loops = Loops(ragged.offsets(counts), spans.first[span] + along * spans.part[span], m)
            keeps = None if self.keeps_corner is None else self.keeps_corner[tiles]
            stitches = stitched(self.tiles.rates[tiles], loops, keeps)
            triangles, in_loops = stitches.triangles, len(span)
            is_inner = triangles >= in_loops
            triangles += np.where(is_inner, loop_count - in_loops + inner_begin[tiles.start], loop_begin).astype(
                np.int32
            )
            found.append((triangles, stitches.tile + tiles.start))
            loop_begin += in_loops
        return Stitched(*map(np.concatenate, zip(*found, strict=True)))

    def sample_vertices(self, topology: Topology | None = None) -> tuple[IntArray, int]:
        """Vertices of all samples, those of loops and then those inside tiles; and how many vertices there are.

        Parameters
        ----------
        topology : Topology, optional
            Of the elements, cut further: along seams of attributes. There are more vertices then.
        """
        numbers = self.numbered(topology)
        count = int(self._inner_counts.sum())
        inside = np.arange(numbers.vertex_count, numbers.vertex_count + count, dtype=np.int32)
        return np.concatenate([self._loop_vertices(numbers), inside]), numbers.vertex_count + count

    def triangles(self, topology: Topology | None = None) -> NDArray[np.uint32]:
        """``(m, 3)`` vertices, counter-clockwise from outside, in the order of the elements."""
        return self.sample_vertices(topology)[0].astype(np.uint32)[self._stitched.triangles]

    def element(self) -> NDArray[np.uint32]:
        """``(m,)`` element of each triangle."""
        return self.frames.topology.face_of(self.tiles.corner)[self._stitched.tile].astype(np.uint32)

    def _inner_places(self) -> tuple[IndexArray, FloatArray]:
        """Of the samples inside tiles the tile, and ``(2, n)`` where they lie in its patch, in parts of `UNIT`."""
        tile = np.repeat(np.arange(len(self.tiles), dtype=np.int32), self._inner_counts)
        steps = inner_steps(self.tiles.rates, self._corner_count) / self.tiles.rates[tile]
        return tile, self._in_patch(tile, steps.T)

    def _in_patch(self, tile: IntArray, uv: FloatArray) -> FloatArray:
        """``(2, n)`` places in patches, in parts of `UNIT`, of parameters in tiles."""
        size: FloatArray = (UNIT >> self.tiles.depth[tile]).astype(np.float64)
        return size * (self.tiles.place[tile].T + np.where(self.tiles.is_flipped[tile], 1 - uv, uv))

    def vertex_places(self, topology: Topology | None = None) -> tuple[IndexArray, FloatArray]:
        """Where vertices lie, each as one of its tiles has it; arguments as for `sample_vertices`.

        Returns
        -------
        tile : (n,) int32
        places : (2, n) float64
            In the tile's patch, in parts of `UNIT`.
        """
        numbers, spans = self.numbered(topology), self._spans
        inside = spans.rate[numbers.of_span] - 1
        span = np.repeat(numbers.of_span, inside)
        step = ragged.places(inside) + 1
        along = np.where(spans.is_backward[span], spans.rate[span] - step, step) / spans.rate[span]
        along = np.concatenate([np.zeros(len(numbers.of_point)), along])
        of_lines = np.concatenate([numbers.of_point, span])
        tile, places = self._inner_places()
        return (
            np.concatenate([spans.side[of_lines] // self._corner_count, tile]),
            np.concatenate([self._points.along(of_lines, along), places], axis=1),
        )

    def _seen(self, tile: IntArray, turn: IntArray, places: FloatArray) -> FloatArray:
        """``(n, 2)`` parameters in elements, seen from the corner after so many turns; of patches that are whole."""
        uv: FloatArray = np.ascontiguousarray(places.T) / UNIT
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
        far = [np.maximum(*np.abs(places - corner[:, None])) for corner in corners]
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
        middle = self._in_patch(tile, np.full((2, len(tile)), 1 / self._corner_count))
        turn, corner = self._nearest_corner(tile, middle)
        span, along = self._loop_spans()
        samples = np.concatenate([self._points.along(span, along), self._inner_places()[1]], axis=1)
        uv = [self._seen(tile, turn, samples[:, self._stitched.triangles[:, i]]) for i in range(3)]
        return corner.astype(np.int32), np.stack(uv, axis=1)

    def locations(self, topology: Topology | None = None) -> tuple[IntArray, FloatArray]:
        """Where each vertex lies: see `SamplingTable.locations`.

        Parameters
        ----------
        topology : Topology, optional
            As for `sample_vertices`. Vertices on seams lie on their side of these.
        """
        tile, places = self.vertex_places(topology)
        turn, corner = self._nearest_corner(tile, places)
        return corner.astype(np.int64), self._seen(tile, turn, places)
