"""Adaptive tessellations, refined until an error criterion holds: their numbering, locations and triangles.

Tiles of different sizes and rates meet along lines: edges of elements, spokes of polygons, and lines inside patches.
The segments that a tile needs along a side are rounded up to a power of two, so that one of two rows of samples on a
line contains the other. A tile's triangles use all samples on its sides, of its neighbours too: there are no cracks.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..mesh import ragged
from ..mesh.connectivity import IndexArray, IntArray, Topology
from ..mesh.ragged import chunks_of
from ..patches import PatchTable
from ..schemes.domain import FloatArray
from . import HIGHEST_RATE
from .criterion import Criterion
from .stitching import SideSamples, inner_counts, inner_steps, stitched
from .tile_choice import choose_tiles
from .tiles import PatchFrames, Sides, Tiles, half_edges_around, in_patch, ranked, sides_of, vertices_at_corners
from .uniform import checked_rate
from .vertex_polynomials import VertexPolynomials, VertexRuns, vertex_polynomials
from .vertex_table import VertexTable


def adaptive_table(
    patches: PatchTable,
    control_of_vertex: IntArray,  # (n_v,) int64: 0-based control point at each mesh vertex
    # (n, 3) float64: control points at which the criterion holds. The table can be applied to others.
    control_points: FloatArray,
    criterion: Criterion,
    max_rate: int,  # Most segments along an edge of the cage, 1 to `HIGHEST_RATE`; see `choose_tiles`
    cage_name: str,  # For warnings
) -> VertexTable:
    """Prepare the adaptive tessellation of a cage's patches.

    Raises ValueError if ``max_rate`` is out of range. Raises MemoryError, and warns, as `choose_tiles` does.
    """
    max_rate = checked_rate(max_rate, "max_rate")
    if max_rate > HIGHEST_RATE:
        raise ValueError(f"max_rate {max_rate}; expected at most {HIGHEST_RATE} segments per edge")
    frames = PatchFrames.of(patches, control_of_vertex)
    tiles = choose_tiles(patches, frames, control_points, control_of_vertex, criterion, max_rate, cage_name)
    grid = AdaptiveGrid.of(tiles, frames)
    controls, refinement = patches.control_rows(control_of_vertex, len(control_points))
    polynomials = _polynomials(patches, grid)
    return VertexTable(len(control_points), patches.patch_count, grid, polynomials, controls, grid.copies(), refinement)


def _polynomials(patches: PatchTable, grid: AdaptiveGrid) -> tuple[VertexPolynomials, ...]:
    """The polynomials on which vertices lie. Vertices at equal parameters of patches of one class share a sample."""
    refined = patches.refined
    table = patches if refined is None else refined.table
    tile, uv = grid.vertex_parameters()
    corner = grid.tiles["corner"][tile]
    # Face h of the cage refined once lies at half-edge h of the cage, and begins there.
    patch_class, patch, _ = table.patch_at(corner if refined is None else table.topology.face_offsets[corner])
    order = np.lexsort((*uv, patch_class))
    is_new = np.ones(len(order), dtype=bool)
    is_new[1:] = (np.diff(uv[:, order]) != 0).any(axis=0) | (np.diff(patch_class[order]) != 0)
    distinct = order[is_new]
    counts = np.bincount(patch_class[distinct], minlength=len(table.classes))
    uv_of_class = np.split(np.ascontiguousarray(uv[:, distinct].T), np.cumsum(counts)[:-1])
    # Runs of one vertex each.
    kind = np.cumsum(is_new) - 1
    samples, ones = ragged.index_in_row(counts), np.ones_like(distinct)
    runs = VertexRuns(patch_class[distinct], ones, samples, kind, patch[order], order)
    return vertex_polynomials(table.scheme, table.classes, uv_of_class, runs)


@dataclass(frozen=True, eq=False)
class AdaptiveGrid:
    """An adaptive tessellation: vertices on the sides of tiles come first, then those inside tiles."""

    frames: PatchFrames
    tiles: Tiles  # In the order of the elements
    sides: Sides
    side_counts: IndexArray  # (t, m) int32: segments on each side of each tile
    # (n,) int32: position of each sample on the line of its side, without that at which the side ends
    position: IndexArray
    topology: Topology  # Of the elements. Samples on the same edges and vertices of it are one vertex.
    keeps_corner: NDArray[np.bool_] | None  # (t, m) bool or None: as for `stitched`

    @classmethod
    def of(cls, tiles: Tiles, frames: PatchFrames) -> AdaptiveGrid:
        """The grid of tiles. Tiles of two elements that meet more than once get more segments."""
        t, m, keeps_corner = frames.topology, frames.domain.corner_count, None
        needs_inner = (tiles["depth"] == 0) & _meets_twice(frames)[t.face[tiles["corner"]]]
        is_valence_two = (t.vertex_face_count > 0) & (t.vertex_face_count <= 2) & ~t.is_border_vertex
        if is_valence_two.any():
            # At vertices of valence 2, no triangle cuts off the corner of a tile: two tiles meet along both sides, and
            # both would have the same triangle.
            half_edge = vertices_at_corners(tiles, frames).T
            keeps_corner = (half_edge >= 0) & is_valence_two[t.face_vertices[half_edge]]
            needs_inner |= keeps_corner.any(axis=1)
        if needs_inner.any():
            # With inner samples, the only inner edges that join two points of the sides cut off a corner.
            tiles = tiles.copy()
            tiles["rates"][needs_inner] = np.maximum(tiles["rates"][needs_inner], 3 if m == 3 else 2)
        return cls(frames, tiles, *_sampled_sides(tiles, frames), t, keeps_corner)

    def cut(self, topology: Topology) -> AdaptiveGrid:
        """See `UniformGrid.cut`."""
        return replace(self, topology=topology)

    def vertices_of(self, other: Any) -> IntArray:
        """See `UniformGrid.vertices_of`."""
        vertices = np.empty(self.vertex_count, dtype=np.int64)
        vertices[self._sample_vertices()] = other._sample_vertices()
        return vertices

    @cached_property
    def _side(self) -> IndexArray:
        """``(n,)`` int32: side of each sample, ``m`` times the tile, plus the corner at which the side begins."""
        return np.repeat(np.arange(self.side_counts.size, dtype=np.int32), self.side_counts.ravel())

    def _numbered(self, edge: IndexArray, vertex: IndexArray) -> tuple[IndexArray, IndexArray]:
        """Number the samples on sides, equal points alike: those on edges and at vertices of equal numbers.

        Returns the number of each sample, and the first sample of each number.
        """
        m, count = self.side_counts.shape[1], len(self.position)
        on_sides = self.sides.points(edge, self._side, self.position)
        point, _ = ranked(np.concatenate([on_sides, self.sides.points(edge, slice(None), self.sides.end)]))
        # At a tile's corner, a side begins where another ends, and maybe a vertex is. Vertices come first.
        point += int(vertex.max(initial=-1)) + 1
        begin, end = point[ragged.starts(self.side_counts.ravel())], np.roll(point[count:].reshape(-1, m), 1, axis=1)
        half_edge = vertices_at_corners(self.tiles, self.frames).T.ravel()
        at_vertex = np.flatnonzero(half_edge >= 0)
        pairs = np.stack([begin, end.ravel()]), np.stack([begin[at_vertex], vertex[half_edge[at_vertex]]])
        return ranked(_least_joined(int(point.max(initial=0)) + 1, np.concatenate(pairs, axis=1))[point[:count]])

    @cached_property
    def _numbers(self) -> tuple[IndexArray, IndexArray]:
        return self._numbered(self.topology.edge, self.topology.face_vertices)

    @cached_property
    def _inner_counts(self) -> IntArray:
        return inner_counts(self.tiles["rates"], self.frames.domain.corner_count)

    @cached_property
    def vertex_count(self) -> int:
        """Vertices of the tessellation."""
        return len(self._numbers[1]) + int(self._inner_counts.sum())

    def copies(self) -> IntArray:
        """`VertexTable.copies`: vertices on the second side of each crease, and the same vertices on the first side."""
        frames = self.frames
        if not frames.has_copies:
            return np.empty((2, 0), dtype=np.int64)
        shared, first_of_shared = self._numbered(frames.edge, frames.vertex)
        number, first = self._numbers
        original = number[first_of_shared][shared[first]]
        pairs = np.stack([np.arange(len(first)), original])
        return pairs[:, pairs[0] != pairs[1]]

    def _sample_vertices(self) -> IndexArray:
        """The vertex of each sample, of the samples on sides and then of those inside tiles."""
        number, first = self._numbers
        return np.concatenate([number, np.arange(len(first), self.vertex_count, dtype=np.int32)])

    def triangles(self) -> NDArray[np.uint32]:
        """``(m, 3)`` vertices, counter-clockwise from outside, in the order of the elements."""
        return self._sample_vertices().take(self._sample_triangles()).view(np.uint32)

    def element(self) -> NDArray[np.uint32]:
        """``(m,)`` element of each triangle."""
        return self.frames.topology.face[self.tiles["corner"]][self._tile()].astype(np.uint32)

    def _triangle_counts(self) -> IntArray:
        """``(t,)`` triangles of each tile, by Euler's formula."""
        return self.side_counts.sum(axis=1) + 2 * self._inner_counts - 2

    def _tile(self) -> IndexArray:
        """``(n,)`` tile of each triangle, in ascending order."""
        return np.repeat(np.arange(len(self.tiles), dtype=np.int32), self._triangle_counts())

    def _sample_triangles(self) -> IndexArray:
        """``(n, 3)`` samples of each triangle. Samples on the sides of all tiles come first, then those inside tiles.

        Computed at each call: the result is rarely needed twice, and would take memory as long as the grid exists.
        """
        on_sides, inside, begin = (
            ragged.offsets(counts)
            for counts in (self.side_counts.sum(axis=1), self._inner_counts, self._triangle_counts())
        )
        triangles = np.empty((int(begin[-1]), 3), dtype=np.int32)
        for block in chunks_of(len(self.tiles), self.side_counts.shape[1]):
            samples = slice(on_sides[block.start], on_sides[block.stop])
            keeps_corner = None if self.keeps_corner is None else self.keeps_corner[block]
            rates, counts = self.tiles["rates"][block], self.side_counts[block]
            of_block = stitched(rates, SideSamples(counts, self._along(samples)), keeps_corner)
            count = samples.stop - samples.start
            first_inner = len(self.position) - count + inside[block.start]
            of_block += np.where(of_block >= count, first_inner, samples.start).astype(np.int32)
            triangles[begin[block.start] : begin[block.stop]] = of_block
        return triangles

    def _along(self, samples: IntArray | slice) -> FloatArray:
        """Positions of samples along their sides, in [0, 1): exact, as dyadic fractions."""
        begin, end, side = self.sides.begin, self.sides.end, self._side[samples]
        return (self.position[samples] - begin[side]) / (end - begin)[side]

    def _parameters(self, samples: IntArray | slice) -> tuple[IndexArray, FloatArray]:
        """The tile of some samples on sides and of all inner ones, and their parameters ``(2, n)`` in its patch."""
        tile, side = np.divmod(self._side[samples], self.side_counts.shape[1])
        corners = self.frames.domain.corners
        steps = np.roll(corners, -1, axis=0) - corners
        on_sides = corners.T[:, side] + steps.T[:, side] * self._along(samples)
        inner = np.repeat(np.arange(len(self.tiles), dtype=np.int32), self._inner_counts)
        inside = inner_steps(self.tiles["rates"], len(corners)).T / self.tiles["rates"][inner].T
        tile = np.concatenate([tile, inner])
        return tile, in_patch(self.tiles, tile, np.concatenate([on_sides, inside], axis=1))

    def vertex_parameters(self) -> tuple[IndexArray, FloatArray]:
        """Locate each vertex in one of its tiles. Returns the tile, (n,), and (2, n) parameters in the tile's patch."""
        return self._parameters(self._numbers[1])

    def _seen(self, tile: IntArray, near: FloatArray, *points: FloatArray) -> tuple[IntArray, list[FloatArray]]:
        """Locate points in elements, from parameters ``(2, n)`` in patches.

        Returns the corner of each element that is nearest to the parameters ``near``, and parameters ``(n, 2)`` in the
        element, starting at that corner.
        """
        frames, corner = self.frames, self.tiles["corner"][tile]
        face, domain = frames.topology.face[corner], frames.domain
        distances = [np.maximum(*np.abs(near - end[:, None])) for end in domain.corners]
        turn = np.where(frames.is_whole[face], np.argmin(distances, axis=0), 0)
        seen = []
        for uv in (np.ascontiguousarray(parameters.T) for parameters in points):
            for number in range(1, domain.corner_count):
                turned = np.flatnonzero(turn == number)
                uv[turned] = domain.rotation(number).inverse()(uv[turned])
            seen.append(uv * frames.scale[face][:, None])
        return np.choose(turn, half_edges_around(frames, corner)), seen

    @property
    def triangle_locations(self) -> tuple[IntArray, FloatArray]:
        """Locate the corners of triangles; computed at each call, as kernels keep the result.

        Returns
        -------
        corner : (m,) int32
            Corner of an element, a half-edge of `PatchTable.elements`.
        uv : (m, 3, 2) float64
            Parameters in the element, starting at that corner.
        """
        tile, (_, samples) = self._tile(), self._parameters(slice(None))
        middle = in_patch(self.tiles, tile, np.full((2, len(tile)), 1 / self.frames.domain.corner_count))
        corner, uv = self._seen(tile, middle, *(samples[:, column] for column in self._sample_triangles().T))
        return corner.astype(np.int32), np.stack(uv, axis=1)

    def locations(self) -> tuple[IntArray, FloatArray]:
        """See `UniformGrid.locations`."""
        tile, parameters = self.vertex_parameters()
        corner, (uv,) = self._seen(tile, parameters, parameters)
        return corner.astype(np.int64), uv


def _sampled_sides(tiles: Tiles, frames: PatchFrames) -> tuple[Sides, IndexArray, IndexArray]:
    """Choose the samples on sides. Returns `sides`, `side_counts` and `position` of an `AdaptiveGrid`."""
    along = [0, 1, 0, 1] if frames.domain.corner_count == 4 else [0, 0, 0]
    # Rounded up to powers of two.
    doublings = np.frexp(np.maximum(tiles["rates"][:, along], tiles["sides"]) - 0.5)[1]
    sides = sides_of(tiles, frames, int((doublings + tiles["depth"][:, None]).max(initial=0)))
    needed = 1 << doublings.ravel()
    # The points that sides need, with both ends, and how they are distributed on lines.
    points = ragged.index_in_row(needed + 1)
    points *= np.repeat((sides.end - sides.begin) // needed, needed + 1)
    points += np.repeat(sides.points(frames.edge, slice(None), sides.begin), needed + 1)
    number, first = ranked(points)
    last = np.cumsum(needed + 1) - 1
    begin, end, points = number[last - needed], number[last], points[first]
    counts = np.abs(end - begin)
    samples = np.repeat(begin, counts) + np.repeat(np.sign(end - begin), counts) * ragged.index_in_row(counts)
    position = (points[samples] & ((4 << sides.bits) - 1)).astype(np.int32)
    return sides, counts.reshape(doublings.shape), position


def _least_joined(
    count: int,
    pairs: IndexArray,  # (2, n)
) -> IndexArray:
    """``(count,)`` the least of all numbers that pairs join to each number, directly or through others."""
    least = np.arange(count, dtype=np.int32)
    while True:
        joined, of_pair = least.copy(), least[pairs].min(axis=0)
        for numbers in pairs:
            np.minimum.at(joined, numbers, of_pair)
        joined = joined[joined]
        if np.array_equal(joined, least):
            return least
        least = joined


def _meets_twice(frames: PatchFrames) -> NDArray[np.bool_]:
    """``(n_f,)`` whether two corners of each whole element are connected more than once.

    Connections are edges, and diagonals of quadrilaterals, of any element.
    """
    t, m = frames.topology, frames.domain.corner_count
    meets_twice = np.zeros(t.face_count, dtype=bool)
    whole = np.flatnonzero(frames.is_whole)
    corners = t.face_offsets[whole] + np.arange(m, dtype=np.int32)[:, None]
    # Each edge once, as one of its half-edges.
    first = corners[t.edge_half_edge[t.edge[corners]] == corners]
    second, twin = t.next[first], t.twin[first]
    if m == 4:
        first, second, twin = (
            np.concatenate([edges, *ends])
            for edges, ends in ((first, corners[:2]), (second, corners[2:]), (twin, corners[:2]))
        )
    ends = t.face_vertices[np.stack([first, second])].astype(np.int64)
    pairs = ends.min(axis=0) * t.vertex_count + ends.max(axis=0)
    _, pair, counts = np.unique(pairs, return_inverse=True, return_counts=True)
    is_double = (counts[pair] > 1) | (ends[0] == ends[1])
    beside = np.concatenate([first[is_double], twin[is_double]])
    meets_twice[t.face[beside[beside >= 0]]] = True
    return meets_twice & frames.is_whole
