"""Numbering, locations and triangles of an adaptive tessellation."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from ..mesh import ragged
from ..mesh.connectivity import IndexArray, IntArray, Topology
from ..mesh.ragged import chunks_of
from ..schemes.domain import FloatArray
from .patch_frames import PatchFrames
from .spans import Spans, SpanVertices, cut_into_spans, first_of_each
from .stitching import SideSamples, inner_counts, inner_steps, stitched
from .tile_sides import at_vertices
from .tiles import UNIT, Tiles


@dataclass(frozen=True, eq=False)
class AdaptiveGrid:
    """An adaptive tessellation: vertices where spans begin come first, then those inside spans, then those in tiles."""

    frames: PatchFrames
    spans: Spans  # All sides of the tiles
    topology: Topology  # Of the elements; its edges and vertices identify the tessellation's vertices
    keeps_corner: NDArray[np.bool_] | None  # (t, m) bool or None: as for `stitched`

    @classmethod
    def of(cls, tiles: Tiles, frames: PatchFrames) -> AdaptiveGrid:
        """The grid of some tiles; tiles of elements that meet more than once get more segments."""
        t, m = frames.topology, frames.domain.corner_count
        is_pair = (t.vertex_face_count <= 2) & ~t.is_border_vertex
        # At vertices of valence 2, no triangle cuts off the corner of a tile: two tiles meet along both sides, and both
        # would have the same triangle.
        keeps = at_vertices(is_pair[t.face_vertices], tiles, frames) if is_pair.any() else None
        has_more = (tiles.depth == 0) & frames.meets_twice[t.face[tiles.corner]]
        if keeps is not None:
            has_more |= keeps.any(axis=1)
        if has_more.any():
            # Enough segments that no inner edge joins two points of the sides.
            least = np.where(has_more, 3 if m == 3 else 2, 1).astype(np.int32)
            tiles = replace(tiles, rates=np.maximum(tiles.rates, least[:, None]))
        else:
            keeps = None
        return cls(frames, cut_into_spans(tiles, frames), t, keeps)

    @property
    def tiles(self) -> Tiles:
        """The tiles, in the order of the elements."""
        return self.spans.tiles

    def cut(self, topology: Topology) -> AdaptiveGrid:
        """See `Grid.cut`."""
        return replace(self, topology=topology)

    def vertices_of(self, other: AdaptiveGrid) -> IntArray:
        """See `Grid.vertices_of`."""
        found = np.empty(self.vertex_count, dtype=np.int64)
        found[self._sample_vertices()] = other._sample_vertices()
        return found

    @property
    def _corner_count(self) -> int:
        return self.frames.domain.corner_count

    @cached_property
    def _numbers(self) -> SpanVertices:
        return self.spans.numbered(self.topology.edge, self.topology.face_vertices)

    @property
    def _inner_counts(self) -> IntArray:
        return inner_counts(self.tiles.rates, self._corner_count)

    @cached_property
    def vertex_count(self) -> int:
        """Vertices of the tessellation."""
        return self._numbers.vertex_count + int(self._inner_counts.sum())

    def copies(self) -> IntArray:
        """`VertexTable.copies`: vertices on the second side of each crease, and those on the first."""
        own, shared = self._numbers, self.spans.numbered(self.frames.edge, self.frames.vertex)
        if shared.vertex_count == own.vertex_count:
            return np.empty((2, 0), dtype=np.int64)
        # The first of each set of copies.
        at = shared.point[own.of_point]
        first_point = first_of_each(at)[at]
        at = self.spans.at[own.of_span]
        lengths, first = self.spans.rate[own.of_span] - 1, own.first_inside
        inside = [ragged.ranges(begins, lengths) for begins in (first, first[first_of_each(at)[at]])]
        pairs = np.stack([np.append(np.arange(len(first_point)), inside[0]), np.append(first_point, inside[1])])
        return pairs[:, pairs[0] != pairs[1]]

    def _sample_vertices(self) -> IndexArray:
        """Vertices of all samples, those along sides and then those inside tiles."""
        spans, numbers = self.spans, self._numbers
        inside = np.arange(numbers.vertex_count, self.vertex_count, dtype=np.int32)
        found, begin = np.empty(int(spans.rate.sum(dtype=np.int64)) + len(inside), dtype=np.int32), 0
        for block in chunks_of(len(spans.rate)):
            rate = spans.rate[block]
            step, span = ragged.index_in_row(rate), block.start + np.repeat(np.arange(len(rate)), rate)
            own = slice(begin, begin + len(step))
            along = numbers.first_inside[numbers.span[span]] + np.where(
                spans.is_backward[span], spans.rate[span] - 1 - step, step - 1
            )
            found[own] = np.where(step == 0, numbers.point[span], along)
            begin += len(step)
        found[begin:] = inside
        return found

    def triangles(self) -> NDArray[np.uint32]:
        """``(m, 3)`` vertices, counter-clockwise from outside, in the order of the elements."""
        found, vertices = self._sample_triangles(), self._sample_vertices()
        for block in chunks_of(len(found)):
            found[block] = vertices[found[block]]
        return found.view(np.uint32)

    def element(self) -> NDArray[np.uint32]:
        """``(m,)`` element of each triangle."""
        return self.frames.topology.face[self.tiles.corner][self._tile()].astype(np.uint32)

    def _triangle_counts(self) -> IntArray:
        """``(t,)`` triangles of each tile, by Euler's formula."""
        begins = np.arange(0, len(self.tiles) * self._corner_count, self._corner_count, dtype=np.int32)
        along_sides = np.add.reduceat(self.spans.rate, np.searchsorted(self.spans.side, begins), dtype=np.int32)
        found: IntArray = along_sides + 2 * self._inner_counts - 2
        return found

    def _tile(self) -> IndexArray:
        """``(n,)`` tile of each triangle, in ascending order."""
        return np.repeat(np.arange(len(self.tiles), dtype=np.int32), self._triangle_counts())

    def _sample_triangles(self) -> IndexArray:
        """``(n, 3)`` samples of each triangle: those along the sides of all tiles come first, then those inside tiles.

        Made at each call: few ask for them more than once, and they would take memory as long as the grid lives.
        """
        spans, m = self.spans, self._corner_count
        inner_begin, begin = (
            ragged.offsets(counts, np.int32) for counts in (self._inner_counts, self._triangle_counts())
        )
        found = np.empty((int(begin[-1]), 3), dtype=np.int32)
        side_count, side_begin = int(spans.rate.sum(dtype=np.int64)), 0
        for own in chunks_of(len(self.tiles), m):
            of_tiles = slice(*np.searchsorted(spans.side, np.array([m * own.start, m * own.stop], dtype=np.int32)))
            span, along = spans.samples(of_tiles)
            counts = np.bincount(spans.side[span] - m * own.start, minlength=m * (own.stop - own.start))
            sides = SideSamples(ragged.offsets(counts), spans.along_sides(span, along), m)
            keeps = None if self.keeps_corner is None else self.keeps_corner[own]
            triangles = stitched(self.tiles.rates[own], sides, keeps)
            is_inner = triangles >= len(span)
            triangles += np.where(is_inner, side_count - len(span) + inner_begin[own.start], side_begin).astype(
                np.int32
            )
            found[begin[own.start] : begin[own.stop]] = triangles
            side_begin += len(span)
        return found

    def _inner_parameters(self) -> tuple[IndexArray, FloatArray]:
        """The tile of each inner sample, and its parameters ``(2, n)`` in the tile's patch, in units of 1 / `UNIT`."""
        tile = np.repeat(np.arange(len(self.tiles), dtype=np.int32), self._inner_counts)
        steps = inner_steps(self.tiles.rates, self._corner_count) / self.tiles.rates[tile]
        return tile, self._in_patch(tile, steps.T)

    def _in_patch(self, tile: IntArray, uv: FloatArray) -> FloatArray:
        """``(2, n)`` parameters in patches, in units of 1 / `UNIT`, from parameters in tiles."""
        found = np.where(self.tiles.is_flipped[tile], 1 - uv, uv)
        found += self.tiles.origin[tile].T
        found *= self.tiles.size[tile]
        return found

    def vertex_parameters(self) -> tuple[IndexArray, FloatArray]:
        """Parameters of vertices, each in one of its tiles.

        Returns
        -------
        tile : (n,) int32
        parameters : (2, n) float64
            In the tile's patch, in parts of `UNIT`.
        """
        numbers, spans = self._numbers, self.spans
        inside = spans.rate[numbers.of_span] - 1
        span = np.repeat(numbers.of_span, inside)
        step = ragged.index_in_row(inside) + 1
        along = np.where(spans.is_backward[span], spans.rate[span] - step, step) / spans.rate[span]
        del inside, step
        along = np.concatenate([np.zeros(len(numbers.of_point)), along])
        of_lines = np.concatenate([numbers.of_point, span])
        tile, parameters = self._inner_parameters()
        return (
            np.concatenate([spans.side[of_lines] // self._corner_count, tile]),
            np.concatenate([self.spans.along(of_lines, along), parameters], axis=1),
        )

    def _seen(self, tile: IntArray, turn: IntArray, parameters: FloatArray) -> FloatArray:
        """``(n, 2)`` parameters in elements, seen from the corner after so many turns; of patches that are whole."""
        uv: FloatArray = np.ascontiguousarray(parameters.T) / UNIT
        domain = self.frames.domain
        for corner in range(1, domain.corner_count):
            at = np.flatnonzero(turn == corner)
            if len(at):
                uv[at] = domain.rotation(corner).inverse()(uv[at])
        return uv * self.frames.scale[self.frames.topology.face[self.tiles.corner[tile]]][:, None]

    def _nearest_corner(self, tile: IntArray, parameters: FloatArray) -> tuple[IntArray, IntArray]:
        """The turn to the nearest corner of each patch, and the half-edge that begins there."""
        t, domain = self.frames.topology, self.frames.domain
        is_whole = self.frames.is_whole[t.face[self.tiles.corner[tile]]]
        corners = domain.corners * UNIT
        far = [np.maximum(*np.abs(parameters - corner[:, None])) for corner in corners]
        turn = np.where(is_whole, np.argmin(far, axis=0), 0)
        corner = self.tiles.corner[tile]
        for step in range(1, domain.corner_count):
            corner = np.where(turn >= step, t.next[corner], corner)
        return turn, corner

    @property
    def triangle_locations(self) -> tuple[IntArray, FloatArray]:
        """Locations of the corners of triangles; computed at each call, as kernels keep them.

        Returns
        -------
        corner : (m,) int32
            Corner of an element, a half-edge of `PatchTable.elements`.
        uv : (m, 3, 2) float64
            Parameters in the element, seen from there.
        """
        tile, triangles = self._tile(), self._sample_triangles()
        middle = self._in_patch(tile, np.full((2, len(tile)), 1 / self._corner_count))
        turn, corner = self._nearest_corner(tile, middle)
        span, along = self.spans.samples()
        samples = np.concatenate([self.spans.along(span, along), self._inner_parameters()[1]], axis=1)
        uv = [self._seen(tile, turn, samples[:, triangles[:, i]]) for i in range(3)]
        return corner.astype(np.int32), np.stack(uv, axis=1)

    def locations(self) -> tuple[IntArray, FloatArray]:
        """See `Grid.locations`."""
        tile, parameters = self.vertex_parameters()
        turn, corner = self._nearest_corner(tile, parameters)
        return corner.astype(np.int64), self._seen(tile, turn, parameters)
