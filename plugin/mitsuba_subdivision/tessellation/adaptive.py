"""Adaptive tessellations, refined until an error criterion holds: their numbering, locations and triangles.

Tiles of different sizes and rates meet along lines: edges of elements, spokes of polygons, and lines inside patches.
The segments that a tile needs along a side are rounded up to a power of two, so that one of two rows of samples on a
line contains the other. A tile's triangles use all samples on its sides, of its neighbours too: there are no cracks.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

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
from .tiles import EDGE, UNIT, PatchFrames, Tiles, corner_points, sizes
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
    tile, parameters = grid.vertex_parameters()
    corner = grid.tiles["corner"][tile]
    # Face h of the cage refined once lies at half-edge h of the cage, and begins there.
    patch_class, patch, _ = table.patch_at(corner if refined is None else table.topology.face_offsets[corner])
    uv = parameters / UNIT
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


# Bits of a position along an edge, in parts of `UNIT`, and of a sort key.
BITS, MOST_BITS = EDGE.bit_length(), 63


@dataclass(frozen=True, eq=False)
class AdaptiveGrid:
    """An adaptive tessellation: vertices on the sides of tiles come first, then those inside tiles."""

    frames: PatchFrames
    tiles: Tiles  # In the order of the elements
    side: IndexArray  # (n,) int32: side of each sample: ``m`` times the tile, plus the corner at which the side begins
    along: FloatArray  # (n,) float64: position of each sample along its side, in [0, 1): exact, as a dyadic fraction
    topology: Topology  # Of the elements. Samples on the same edges and vertices of it are one vertex.
    keeps_corner: NDArray[np.bool_] | None  # (t, m) bool or None: as for `stitched`

    @classmethod
    def of(cls, tiles: Tiles, frames: PatchFrames) -> AdaptiveGrid:
        """The grid of tiles. Tiles of two elements that meet more than once get more segments."""
        t, m = frames.topology, frames.domain.corner_count
        is_valence_two = (t.vertex_face_count > 0) & (t.vertex_face_count <= 2) & ~t.is_border_vertex
        # At vertices of valence 2, no triangle cuts off the corner of a tile: two tiles meet along both sides, and both
        # would have the same triangle.
        keeps_corner = _at_vertices(is_valence_two, tiles, frames) if is_valence_two.any() else None
        needs_inner = (tiles["depth"] == 0) & frames.meets_twice[t.face[tiles["corner"]]]
        if keeps_corner is not None:
            needs_inner |= keeps_corner.any(axis=1)
        if needs_inner.any():
            # With inner samples, the only inner edges that join two points of the sides cut off a corner.
            least = np.where(needs_inner, 3 if m == 3 else 2, 1).astype(np.int32)
            tiles = tiles.copy()
            tiles["rates"] = np.maximum(tiles["rates"], least[:, None])
        else:
            keeps_corner = None
        return cls(frames, tiles, *_samples_on_sides(tiles, frames), t, keeps_corner)

    def cut(self, topology: Topology) -> AdaptiveGrid:
        """See `Grid.cut`."""
        return replace(self, topology=topology)

    def vertices_of(self, other: AdaptiveGrid) -> IntArray:
        """See `Grid.vertices_of`."""
        vertices = np.empty(self.vertex_count, dtype=np.int64)
        vertices[self._sample_vertices()] = other._sample_vertices()
        return vertices

    @property
    def _corner_count(self) -> int:
        return self.frames.domain.corner_count

    def _numbered(self, edge: IndexArray, vertex: IndexArray) -> tuple[IndexArray, IndexArray]:
        """Number the samples on sides, equal points alike, as `PatchFrames.names` identifies them.

        Returns the number of each sample, and the first sample of each number.
        """
        name, position = np.empty(len(self.side), dtype=np.int64), np.empty((2, len(self.side)), dtype=np.int32)
        corners = self._corners()
        for block in chunks_of(len(self.side)):
            side = self.side[block]
            points = self._on_sides(corners, side, self.along[block]).astype(np.int32)
            corner = self.tiles["corner"][side // self._corner_count]
            name[block], position[:, block] = self.frames.names(corner, points, edge, vertex)
        del corners
        shift = _unused_bits(position)
        (x, y), bits = position >> shift, BITS - shift
        return _ranked(_joined(name, x.astype(np.int64) << bits | y, 2 * bits))

    @cached_property
    def _numbers(self) -> tuple[IndexArray, IndexArray]:
        return self._numbered(self.topology.edge, self.topology.face_vertices)

    @property
    def _inner_counts(self) -> IntArray:
        return inner_counts(self.tiles["rates"], self._corner_count)

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

    @cached_property
    def _side_counts(self) -> IntArray:
        """``(t, m)`` segments on each side of each tile."""
        m = self._corner_count
        return np.bincount(self.side, minlength=m * len(self.tiles)).astype(np.int32).reshape(-1, m)

    def _triangle_counts(self) -> IntArray:
        """``(t,)`` triangles of each tile, by Euler's formula."""
        counts: IntArray = self._side_counts.sum(axis=1) + 2 * self._inner_counts - 2
        return counts

    def _tile(self) -> IndexArray:
        """``(n,)`` tile of each triangle, in ascending order."""
        return np.repeat(np.arange(len(self.tiles), dtype=np.int32), self._triangle_counts())

    def _sample_triangles(self) -> IndexArray:
        """``(n, 3)`` samples of each triangle. Samples on the sides of all tiles come first, then those inside tiles.

        Computed at each call: the result is rarely needed twice, and would take memory as long as the grid exists.
        """
        m = self._corner_count
        on_sides = ragged.offsets(self._side_counts.sum(axis=1))
        inside, begin = (ragged.offsets(counts) for counts in (self._inner_counts, self._triangle_counts()))
        triangles = np.empty((int(begin[-1]), 3), dtype=np.int32)
        for block in chunks_of(len(self.tiles), m):
            along = self.along[on_sides[block.start] : on_sides[block.stop]]
            keeps_corner = None if self.keeps_corner is None else self.keeps_corner[block]
            sides = SideSamples(self._side_counts[block], along)
            block_triangles = stitched(self.tiles["rates"][block], sides, keeps_corner)
            is_inner = block_triangles >= len(along)
            first_inner = len(self.side) - len(along) + inside[block.start]
            block_triangles += np.where(is_inner, first_inner, on_sides[block.start]).astype(np.int32)
            triangles[begin[block.start] : begin[block.stop]] = block_triangles
        return triangles

    def _corners(self) -> IndexArray:
        """``(2, m t)`` points at which the sides of all tiles begin, in their patches, in parts of `UNIT`."""
        return corner_points(self.tiles, self.frames.domain).reshape(2, -1)

    def _on_sides(self, corners: IndexArray, side: IntArray, along: FloatArray) -> FloatArray:
        """``(2, n)`` points at positions along sides, in their patches, in parts of `UNIT`; for `_corners`."""
        m = self._corner_count
        begin, end = corners[:, side], corners[:, side + np.where(side % m == m - 1, 1 - m, 1)]
        return begin + (end - begin) * along

    def _inner_parameters(self) -> tuple[IndexArray, FloatArray]:
        """The tile of each inner sample, and its parameters ``(2, n)`` in the tile's patch, in parts of `UNIT`."""
        tile = np.repeat(np.arange(len(self.tiles), dtype=np.int32), self._inner_counts)
        steps = inner_steps(self.tiles["rates"], self._corner_count) / self.tiles["rates"][tile]
        return tile, self._in_patch(tile, steps.T)

    def _in_patch(self, tile: IntArray, uv: FloatArray) -> FloatArray:
        """``(2, n)`` parameters in patches, in parts of `UNIT`, from parameters in tiles."""
        parameters = np.where(self.tiles["is_flipped"][tile], 1 - uv, uv)
        parameters += self.tiles["origin"][tile].T
        parameters *= sizes(self.tiles)[tile]
        return parameters

    def vertex_parameters(self) -> tuple[IndexArray, FloatArray]:
        """Locate each vertex in one of its tiles.

        Returns
        -------
        tile : (n,) int32
        parameters : (2, n) float64
            In the tile's patch, in parts of `UNIT`.
        """
        _, first = self._numbers
        tile, parameters = self._inner_parameters()
        corners = self._corners()
        on_sides = self._on_sides(corners, self.side[first], self.along[first])
        tile = np.concatenate([self.side[first] // self._corner_count, tile])
        return tile, np.concatenate([on_sides, parameters], axis=1)

    def _seen(self, tile: IntArray, turn: IntArray, parameters: FloatArray) -> FloatArray:
        """``(n, 2)`` parameters in elements, starting ``turn`` corners after the patch's first one."""
        uv: FloatArray = np.ascontiguousarray(parameters.T) / UNIT
        domain = self.frames.domain
        for corner in range(1, domain.corner_count):
            turned = np.flatnonzero(turn == corner)
            if len(turned):
                uv[turned] = domain.rotation(corner).inverse()(uv[turned])
        return uv * self.frames.scale[self.frames.topology.face[self.tiles["corner"][tile]]][:, None]

    def _nearest_corner(self, tile: IntArray, parameters: FloatArray) -> tuple[IntArray, IntArray]:
        """Find the nearest corner of each patch. Returns its turn, see `_seen`, and the half-edge that begins there."""
        t, domain = self.frames.topology, self.frames.domain
        is_whole = self.frames.is_whole[t.face[self.tiles["corner"][tile]]]
        corners = domain.corners * UNIT
        distances = [np.maximum(*np.abs(parameters - corner[:, None])) for corner in corners]
        turn = np.where(is_whole, np.argmin(distances, axis=0), 0)
        corner = self.tiles["corner"][tile]
        for step in range(1, domain.corner_count):
            corner = np.where(turn >= step, t.next[corner], corner)
        return turn, corner

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
        tile, triangles = self._tile(), self._sample_triangles()
        middle = self._in_patch(tile, np.full((2, len(tile)), 1 / self._corner_count))
        turn, corner = self._nearest_corner(tile, middle)
        corners = self._corners()
        on_sides = self._on_sides(corners, self.side, self.along)
        samples = np.concatenate([on_sides, self._inner_parameters()[1]], axis=1)
        uv = [self._seen(tile, turn, samples[:, triangles[:, i]]) for i in range(3)]
        return corner.astype(np.int32), np.stack(uv, axis=1)

    def locations(self) -> tuple[IntArray, FloatArray]:
        """See `Grid.locations`."""
        tile, parameters = self.vertex_parameters()
        turn, corner = self._nearest_corner(tile, parameters)
        return corner.astype(np.int64), self._seen(tile, turn, parameters)


def _at_vertices(marked: NDArray[np.bool_], tiles: Tiles, frames: PatchFrames) -> NDArray[np.bool_]:
    """``(t, m)`` whether corners of tiles lie at marked vertices."""
    t, m = frames.topology, frames.domain.corner_count
    points = corner_points(tiles, frames.domain).reshape(2, -1)
    name, _ = frames.names(np.repeat(tiles["corner"], m), points, t.edge, t.face_vertices)
    is_vertex = name < t.vertex_count
    is_vertex[is_vertex] = marked[name[is_vertex]]
    return is_vertex.reshape(-1, m)


def _samples_on_sides(tiles: Tiles, frames: PatchFrames) -> tuple[IndexArray, FloatArray]:
    """Choose the samples on the sides of all tiles. Returns `AdaptiveGrid.side` and `AdaptiveGrid.along`."""
    line, begin, length = _lines(tiles, frames)
    needed = np.maximum(
        tiles["rates"][:, [0, 1, 0, 1] if frames.domain.corner_count == 4 else [0, 0, 0]], tiles["sides"]
    )
    # Rounded up to powers of two.
    counts = 1 << np.frexp(needed.ravel() - 0.5)[1]
    step = length // counts
    shift = _unused_bits(begin | step)
    keys = np.left_shift(line, BITS - shift, dtype=np.int64)
    keys |= begin >> shift
    points = ragged.index_in_row(counts + 1)
    points *= np.repeat(step >> shift, counts + 1)
    points += np.repeat(keys, counts + 1)
    del line, begin, step, needed
    # First and last sample of each side among the sorted samples of all lines.
    number, first = _ranked(points)
    end = np.cumsum(counts + 1, dtype=np.int32) - 1
    begin, end, points = number[end - counts], number[end], points[first]
    del number, first
    counts = np.abs(end - begin)
    side = np.repeat(np.arange(len(counts), dtype=np.int32), counts)
    sample = ragged.index_in_row(counts)
    sample *= np.sign(length)[side]
    sample += begin[side]
    along = points[sample]
    along -= keys[side]
    del sample, keys, points
    return side, along / (length >> shift)[side]


def _unused_bits(positions: IndexArray) -> int:
    """Number of lowest bits that are zero in all positions: most tessellations use few of the bits."""
    used = int(np.bitwise_or.reduce(positions, axis=None)) | EDGE
    return (used & -used).bit_length() - 1


def _lines(tiles: Tiles, frames: PatchFrames) -> tuple[IndexArray, IndexArray, IndexArray]:
    """Find the lines on which the sides of tiles lie, numbered such that equal lines have equal numbers.

    Returns the line of each side, the position on it at which the side begins, and the side's signed length.
    """
    m = frames.domain.corner_count
    name = np.empty(m * len(tiles), dtype=np.int64)
    level, begin, length = np.empty((3, m * len(tiles)), dtype=np.int32)
    for block in chunks_of(len(tiles), m):
        corners = corner_points(tiles[block], frames.domain)
        quarter = (np.roll(corners, -1, axis=2) - corners) // 4
        corner, positions = np.repeat(tiles["corner"][block], m), []
        axis = np.tile([0, 1, 2] if m == 3 else [0, 1, 0, 1], len(corners[0]))
        for steps in (1, 2):
            names, (x, y) = frames.names(corner, (corners + steps * quarter).reshape(2, -1), frames.edge, frames.vertex)
            # Lines inside a patch run along u, along v or, in triangles, along the diagonal. Other lines have names.
            axis = np.where(names >= frames.first_inside, axis, 0)
            positions.append(np.where(axis == 0, x, y))
        block_sides = slice(m * block.start, m * block.stop)
        name[block_sides], length[block_sides] = 3 * names + axis, 4 * (positions[1] - positions[0])
        begin[block_sides] = 2 * positions[0] - positions[1]
        level[block_sides] = np.select([axis == 0, axis == 2], [y, x], x + y if m == 3 else x)
    shift = _unused_bits(level)
    return _ranked(_joined(name, level >> shift, BITS - shift))[0], begin, length


def _ranked(keys: IntArray) -> tuple[IndexArray, IndexArray]:
    """Rank integers from 0 on, equal ones alike. Returns the ranks, and the first index of each rank."""
    order, begins = ragged.sorted_order(keys)
    number = np.empty(len(keys), dtype=np.int32)
    number[order] = np.cumsum(begins, dtype=np.int32) - 1
    return number, order[begins]


def _joined(high: IntArray, low: IntArray, bits: int) -> NDArray[np.int64]:
    """``(n,)`` sort keys of pairs of integers, of which ``low`` has ``bits`` bits."""
    if int(high.max(initial=0)).bit_length() + bits > MOST_BITS:
        # Ranks need 31 bits at most.
        high, low, bits = _ranked(high)[0], _ranked(low)[0], 31
    return high.astype(np.int64) << bits | low
