"""Tiles, the parts of patches that have one grid each in an adaptive tessellation, and the vertices that they share.

A tile is a copy of its patch's domain, ``2^depth`` times smaller, with its own rates. Tiles are structured arrays of
`tile_type`. Frames place patches in the elements of a cage.

Tiles of different sizes and rates meet along lines: edges of elements, spokes of polygons, and lines inside patches.
The segments that a tile needs along a side are rounded up to a power of two, so that one of two rows of samples on a
line contains the other. A tile's triangles use all samples on its sides, of its neighbours too: there are no cracks.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..mesh import ragged
from ..mesh.connectivity import IndexArray, IntArray, Topology
from ..patches.patch_table import PatchTable
from ..schemes.domain import FloatArray, ParameterDomain
from .stitching import inner_counts, inner_steps, stitched
from .uniform_grid import first_sides

# Greatest depth of tiles around extraordinary points: single precision does not resolve smaller ones.
DEEPEST = 24

Tiles = NDArray[np.void]


@dataclass(frozen=True, eq=False)
class PatchFrames:
    """Placement of patches in the elements of a cage."""

    topology: Topology  # Of the elements
    domain: ParameterDomain
    # (n_f,) bool: whether each element is a single patch. The patches of other elements lie at a corner and reach half
    # way along its edges, and to the element's centre.
    is_whole: NDArray[np.bool_]
    scale: FloatArray  # (n_f,) float64: factor from a patch's parameters to its element's, starting at the same corner
    # (n_h,) int32: numbers of each half-edge's edge and first vertex, equal on both sides of a crease
    edge: IndexArray
    vertex: IndexArray
    # (n_h,) bool: whether positions along the edge of a half-edge are counted from the half-edge's end
    is_backward: NDArray[np.bool_]
    has_copies: bool  # Whether several edges or vertices of the topology have the same number

    @classmethod
    def of(cls, patches: PatchTable) -> PatchFrames:
        """The frames of a table's patches."""
        t, is_split, control_of_vertex = patches.elements, patches.refined is not None, patches.control_of_vertex
        is_whole = patches.is_whole & (not is_split)
        scale = np.where(patches.is_whole & is_split, 0.5, 1.0)
        half_edge = np.arange(t.half_edge_count, dtype=np.int32)
        edge = np.where(t.twin < 0, half_edge, np.minimum(half_edge, t.twin))
        is_backward = edge != half_edge
        start, border, has_copies = t.face_vertices, np.flatnonzero(t.twin < 0), False
        if patches.scheme.element == "face":
            has_copies = not np.array_equal(control_of_vertex, np.arange(len(control_of_vertex)))
            if has_copies:
                start = control_of_vertex.astype(np.int32)[start]
            edge[border] = first_sides(t, border, start)
            is_backward[border] = start[border] != start[edge[border]]
            has_copies |= bool((edge[border] != border).any())
        return cls(t, patches.scheme.domain, is_whole, scale, edge, start, is_backward, has_copies)


def tile_type(corner_count: int) -> np.dtype[np.void]:
    """The structured type of tiles over a domain with ``corner_count`` corners."""
    return np.dtype(
        [
            # Corner of the element at which the tile's patch begins, a half-edge of `PatchTable.elements`
            ("corner", np.int32),
            ("depth", np.int32),
            # Least u and v of the tile in its patch's domain, in units of ``2^-depth``
            ("origin", np.int32, 2),
            # Whether parameters run backwards, as in a triangle's middle child, with (0, 0) at ``origin + 1``
            ("is_flipped", np.bool_),
            # Halvings from an edge of the patch to a side of the tile; around extraordinary points, from an edge of a
            # ring
            ("halvings", np.int32),
            # Segments along u and v; equal over triangles
            ("rates", np.int32, 2),
            # Least segments on each side that lies on a feature edge, see `feature_edges`; 0 elsewhere
            ("sides", np.int32, corner_count),
        ]
    )


def whole_patches(corners: IntArray, corner_count: int) -> Tiles:
    """A tile for each patch that begins at ``corners``, without features."""
    tiles = np.zeros(len(corners), dtype=tile_type(corner_count))
    tiles["corner"], tiles["rates"] = corners, 1
    return tiles


def child(tiles: Tiles, number: int, domain: ParameterDomain) -> Tiles:
    """Child ``number`` of each tile, in the order of `ParameterDomain.children`."""
    children, m = tiles.copy(), domain.corner_count
    is_middle = m == 3 and number == 3
    # Origin of the child relative to the tile's corner (0, 0), in units of half a tile.
    step = np.array([0, 0] if is_middle else domain.corners[number], dtype=np.int32)
    children["origin"] = 2 * tiles["origin"] + np.where(tiles["is_flipped"][:, None], 1 - step, step)
    children["depth"] += 1
    children["halvings"] += 1
    children["is_flipped"] ^= is_middle
    # A child at a corner shares the sides that meet there.
    shared = [] if is_middle else [number, (number - 1) % m]
    children["sides"] = 0
    children["sides"][:, shared] = -(-tiles["sides"][:, shared] // 2)
    return children


def in_patch(tiles: Tiles, tile: IntArray, uv: FloatArray) -> FloatArray:
    """``(2, n)`` parameters in patches, from the tile of each point and its parameters ``(2, n)`` there."""
    parameters = np.where(tiles["is_flipped"][tile], 1 - uv, uv)
    parameters += tiles["origin"].T[:, tile]
    parameters *= np.ldexp(1.0, -tiles["depth"])[tile]
    return parameters


class Sides(NamedTuple):
    """The lines on which sides of tiles lie, with an entry for each side, tile by tile.

    A spoke joins the midpoint of an edge to the polygon's centre, and separates two patches at its corners.
    """

    half_edge: IntArray  # (m t,) int32: half-edge of the element on whose edge the side lies, or -1
    line: IntArray  # (m t,) int32: number of any other line, from ``n_h`` on
    # (m t,) int32: positions on the line at which the side begins and ends, in parts of ``2^-bits`` of a patch's side
    begin: IntArray
    end: IntArray
    bits: int

    def at_vertices(self, corner_count: int) -> IndexArray:
        """``(t, m)`` half-edge that begins at the element's vertex at each corner of tiles; -1 at other corners."""
        half_edge = self.half_edge.reshape(-1, corner_count)
        return np.where(np.roll(half_edge, 1, axis=1) >= 0, half_edge, -1)

    def points(self, edge: IndexArray, side: IntArray | slice, position: IntArray) -> NDArray[np.int64]:
        """``(n,)`` sort keys of positions on lines, equal for equal points on edges with equal numbers ``edge``."""
        line = np.where(self.half_edge >= 0, edge[self.half_edge], self.line)
        # Edges are two sides of patches long.
        return np.left_shift(line, self.bits + 2, dtype=np.int64)[side] | position


def sides_of(tiles: Tiles, frames: PatchFrames, bits: int) -> Sides:
    """Find the lines of the sides of tiles, whose positions ``bits`` are enough for."""
    t, m, unit = frames.topology, frames.domain.corner_count, 1 << bits
    corner, flipped, is_whole = tiles["corner"], tiles["is_flipped"], frames.is_whole[t.face[tiles["corner"]]]
    steps = frames.domain.corners.T.astype(np.int32)[..., None]
    points = tiles["origin"].T[:, None] + np.where(flipped, 1 - steps, steps)
    points <<= bits - tiles["depth"]
    # Lines inside a patch run along u, along v or, in triangles, along the diagonal.
    side, along = np.arange(m), np.array([0, 1, 1] if m == 3 else [0, 1, 0, 1])
    begin, end = points[along, side], np.roll(points, -1, axis=1)[along, side]
    level = points[[1, 0, 0] if m == 3 else 1 - along, side]
    if m == 3:
        level[1] += begin[1]
    on_border = level == np.array([0, unit, 0] if m == 3 else [0, unit, unit, 0])[:, None]
    # The patch of a polygon's corner has parts of the edges that begin and end there, and of both spokes from these.
    around = np.stack(t.around_faces(corner, m))
    around[2:] = np.where(is_whole, around[2:], t.prev[corner])
    around[1] = np.where(is_whole, around[1], corner)
    on_edge = on_border & (is_whole | (side % 3 == 0)[:, None])
    is_backward = on_edge & (frames.is_backward[around] != (side >= 2)[:, None])
    begin, end = (np.where(is_backward, 2 * unit - at, at) for at in np.stack([begin, end]) << (on_edge & is_whole))
    line, inside = t.half_edge_count + around, ~on_border
    names = 3 * np.broadcast_to(corner, inside.shape)[inside].astype(np.int64)
    names += np.broadcast_to((side if m == 3 else side % 2)[:, None], inside.shape)[inside]
    line[inside] = 2 * t.half_edge_count + ranked(names << bits + 1 | level[inside])[0]
    half_edge, line, begin, end = (column.T.ravel() for column in (np.where(on_edge, around, -1), line, begin, end))
    return Sides(half_edge, line, begin, end, bits)


def ranked(keys: IntArray) -> tuple[IndexArray, IndexArray]:
    """Rank integers from 0 on, equal ones alike. Returns the ranks, and the first index of each rank."""
    order, begins = ragged.sorted_order(keys)
    number = np.empty(len(keys), dtype=np.int32)
    number[order] = np.cumsum(begins, dtype=np.int32) - 1
    return number, order[begins]


@dataclass(frozen=True, eq=False)
class AdaptiveGrid:
    """An adaptive tessellation: vertices on the sides of tiles come first, then those inside tiles."""

    frames: PatchFrames
    tiles: Tiles  # In the order of the elements
    sides: Sides
    side_counts: IndexArray  # (t, m) int32: segments on each side of each tile
    # (n,) int32: position of each sample on the line of its side, without that at which the side ends
    position: IndexArray
    topology: Topology  # Mesh of the elements. Samples on the same edge or vertex of it are one vertex.
    keeps_corner: NDArray[np.bool_]  # (t, m): as for `stitched`

    @classmethod
    def of(cls, tiles: Tiles, frames: PatchFrames) -> AdaptiveGrid:
        """The grid of tiles. Tiles of two elements that meet more than once get more segments."""
        t, m = frames.topology, frames.domain.corner_count
        keeps_corner = np.broadcast_to(False, (len(tiles), m))
        needs_inner = (tiles["depth"] == 0) & _meets_twice(frames)[t.face[tiles["corner"]]]
        is_valence_two = (t.vertex_face_count > 0) & (t.vertex_face_count <= 2) & ~t.is_border_vertex
        if is_valence_two.any():
            # At vertices of valence 2, no triangle cuts off the corner of a tile: two tiles meet along both sides, and
            # both would have the same triangle.
            half_edge = sides_of(tiles, frames, int(tiles["depth"].max(initial=0))).at_vertices(m)
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
        half_edge = self.sides.at_vertices(m).ravel()
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

    @property
    def _triangle_counts(self) -> IntArray:
        # By Euler's formula.
        return self.side_counts.sum(axis=1) + 2 * self._inner_counts - 2

    def _tile(self) -> IndexArray:
        """``(n,)`` tile of each triangle, in ascending order."""
        return np.repeat(np.arange(len(self.tiles), dtype=np.int32), self._triangle_counts)

    def _sample_triangles(self) -> IndexArray:
        """``(n, 3)`` samples of each triangle, those on sides first; not kept, as it is rarely needed twice."""
        counts_of_tiles = self.side_counts.sum(axis=1), self._inner_counts, self._triangle_counts
        on_sides, inside, begin = map(ragged.offsets, counts_of_tiles)
        triangles = np.empty((int(begin[-1]), 3), dtype=np.int32)
        for block in ragged.chunks_of(len(self.tiles), self.side_counts.shape[1]):
            samples = slice(on_sides[block.start], on_sides[block.stop])
            rates, counts = self.tiles["rates"][block], self.side_counts[block]
            of_block = stitched(rates, counts, self._along(samples), self.keeps_corner[block])
            count = samples.stop - samples.start
            first_inner = len(self.position) - count + inside[block.start]
            of_block += np.where(of_block >= count, first_inner, samples.start).astype(np.int32)
            triangles[begin[block.start] : begin[block.stop]] = of_block
        return triangles

    def _along(self, samples: IntArray | slice) -> FloatArray:
        """Positions of samples along their sides, in [0, 1): exact, as dyadic fractions."""
        side = self._side[samples]
        begin, end = self.sides.begin[side], self.sides.end[side]
        return (self.position[samples] - begin) / (end - begin)

    def parameters(self, samples: IntArray | slice | None = None) -> tuple[IndexArray, FloatArray]:
        """Tiles and parameters ``(2, n)`` of samples on sides, by default one for each vertex, and of inner ones."""
        samples = self._numbers[1] if samples is None else samples
        tile, side = np.divmod(self._side[samples], self.side_counts.shape[1])
        corners = self.frames.domain.corners
        steps = np.roll(corners, -1, axis=0) - corners
        on_sides = corners.T[:, side] + steps.T[:, side] * self._along(samples)
        inner = np.repeat(np.arange(len(self.tiles), dtype=np.int32), self._inner_counts)
        inside = inner_steps(self.tiles["rates"], len(corners)).T / self.tiles["rates"][inner].T
        tile = np.concatenate([tile, inner])
        return tile, in_patch(self.tiles, tile, np.concatenate([on_sides, inside], axis=1))

    def _seen(self, tile: IntArray, near: FloatArray, *points: FloatArray) -> tuple[IntArray, list[FloatArray]]:
        """The corners of elements nearest to ``near``, and ``(n, 2)`` parameters from there of points in patches."""
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
        return np.choose(turn, frames.topology.around_faces(corner, domain.corner_count)), seen

    @property
    def triangle_locations(self) -> tuple[IntArray, FloatArray]:
        """A corner of an element for each triangle, and parameters ``(m, 3, 2)`` from there; kernels keep them."""
        tile, (_, samples) = self._tile(), self.parameters(slice(None))
        middle = in_patch(self.tiles, tile, np.full((2, len(tile)), 1 / self.frames.domain.corner_count))
        corner, uv = self._seen(tile, middle, *(samples[:, column] for column in self._sample_triangles().T))
        return corner.astype(np.int32), np.stack(uv, axis=1)

    def locations(self) -> tuple[IntArray, FloatArray]:
        """See `UniformGrid.locations`."""
        tile, parameters = self.parameters()
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


def _least_joined(count: int, pairs: IndexArray) -> IndexArray:
    """``(count,)`` the least number that pairs ``(2, n)`` join to each number, directly or through others."""
    least = np.arange(count, dtype=np.int32)
    while True:
        joined = least.copy()
        np.minimum.at(joined, pairs.ravel(), np.tile(least[pairs].min(axis=0), 2))
        joined = joined[joined]
        if np.array_equal(joined, least):
            return least
        least = joined


def _meets_twice(frames: PatchFrames) -> NDArray[np.bool_]:
    """``(n_f,)`` whether two corners of each whole element are connected twice, by edges or by diagonals."""
    t, m = frames.topology, frames.domain.corner_count
    whole = np.flatnonzero(frames.is_whole)
    first = t.face_offsets[whole] + np.arange(m, dtype=np.int32)[:, None]
    second, connection = t.next[first], t.edge[first]
    if m == 4:
        second, connection = np.concatenate([second, first[2:]]), np.concatenate([connection, t.edge_count + first[:2]])
        first = np.concatenate([first, first[:2]])
    ends = t.face_vertices[np.stack([first, second])].astype(np.int64)
    pairs = ends.min(axis=0) * t.vertex_count + ends.max(axis=0)
    _, once = np.unique(connection, return_index=True)
    names, counts = np.unique(pairs.ravel()[once], return_counts=True)
    meets_twice = np.zeros(t.face_count, dtype=bool)
    meets_twice[whole] = ((counts[np.searchsorted(names, pairs)] > 1) | (ends[0] == ends[1])).any(axis=0)
    return meets_twice
