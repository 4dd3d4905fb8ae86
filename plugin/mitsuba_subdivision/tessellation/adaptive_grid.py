"""Numbering, locations and triangles of an adaptive tessellation."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from ..mesh import ragged
from ..mesh.connectivity import IntArray, Topology
from ..schemes.domain import FloatArray
from .patch_frames import EdgeNames, PatchFrames
from .stitching import Loops, Stitched, inner_counts, inner_steps, stitched
from .tile_lines import (
    UNIT,
    Spans,
    SpanVertices,
    at_vertices,
    cut_into_spans,
    numbered,
    tile_corners,
)
from .tiles import Tiles


@dataclass(frozen=True, eq=False)
class AdaptiveGrid:
    """An adaptive tessellation: vertices at breaks of lines come first, then those inside spans, then those in tiles.

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
        """The grid of some tiles, which get more segments at vertices of valence 2."""
        t, m = frames.topology, frames.domain.corner_count
        is_pair = (np.bincount(t.face_vertices, minlength=t.vertex_count) == 2) & ~t.is_border_vertex
        if not is_pair.any():
            return cls(tiles, frames)
        keeps = at_vertices(is_pair[t.face_vertices], tiles, frames)
        least = np.where(keeps.any(axis=1), 3 if m == 3 else 2, 1)
        return cls(replace(tiles, rates=np.maximum(tiles.rates, least[:, None])), frames, keeps)

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
        """``(vertex_count,)`` the vertex whose position each one has: itself, or one on the other side of a crease."""
        place = np.arange(self.vertex_count)
        own, shared = self._numbers, numbered(self._spans, self.tiles, self.frames, self.frames.places)
        if shared.vertex_count == own.vertex_count:
            return place
        place[own.point] = _first_of_same(shared.point, own.point)
        lengths = self._spans.rate - 1
        first = _first_of_same(shared.span, own.first_inside)
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
        return np.where(place == 0, numbers.point[span], numbers.first_inside[span] + inside)

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
        return stitched(
            self.tiles.rates, Loops(ragged.offsets(counts), (begin + along * length) / size, m), self.keeps_corner
        )

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
        size: FloatArray = (UNIT >> self.tiles.depth[tile])[:, None].astype(np.float64)
        return size * (self.tiles.place[tile] + np.where(flipped, 1 - uv, uv))

    def _seen(self, tile: IntArray, turn: IntArray, places: FloatArray) -> FloatArray:
        """Parameters in elements, seen from the corner of the patch after so many turns; of patches that are whole."""
        uv: FloatArray = places / UNIT
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

    def locations(self, topology: Topology | None = None) -> tuple[IntArray, FloatArray]:
        """Where each vertex lies: see `SamplingTable.locations`.

        Parameters
        ----------
        topology : Topology, optional
            As for `sample_vertices`. Vertices on seams lie on their side of these.
        """
        vertices, count = self.sample_vertices(topology)
        # Of the samples of a vertex, the first.
        sample = np.empty(count, dtype=np.int64)
        sample[vertices[::-1]] = np.arange(len(vertices) - 1, -1, -1)
        tile, places = self._sample_tiles[sample], self._sample_places[sample]
        turn, corner = self._nearest_corner(tile, places)
        return corner.astype(np.int64), self._seen(tile, turn, places)

    @cached_property
    def _sample_tiles(self) -> IntArray:
        """``(n,)`` tile of each sample."""
        of_loops = self._spans.side[self._loop_spans[0]] // self._corner_count
        return np.concatenate([of_loops, np.repeat(np.arange(len(self.tiles)), self._inner_counts)])


def _first_of_same(number: IntArray, values: IntArray) -> IntArray:
    """The value of the first entry that has the same number as each."""
    first = np.empty(int(number.max(initial=-1)) + 1, dtype=np.int64)
    first[number[::-1]] = values[::-1]
    return first[number]
