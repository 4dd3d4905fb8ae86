"""Numbering of uniform tessellations.

The two elements at an edge share the samples on it, so there are no cracks. Corners of the elements are numbered first,
then samples inside edges, then samples inside elements. The samples inside an edge, and those inside an element, have
consecutive numbers.
"""

from __future__ import annotations

from collections.abc import Iterator
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..mesh import IntArray, Topology, ragged
from ..schemes.domain import FloatArray, ParameterDomain

# Vertices per slice when computing triangles, so that arrays stay in a core's cache.
VERTICES_AT_ONCE = 1 << 16


class GridPart(NamedTuple):
    """A part of the grids of several patches, such as their inside or one of their sides.

    Where patches share samples, at corners and along edges, only the patch that evaluates them is in the part.
    """

    samples: IntArray  # (S,) int64: indices into the parameters of `UniformGrid.layout`
    offsets: IntArray  # (S,): from the first vertex of a patch to the vertex of each sample
    patches: IntArray  # (P,): patches in ascending order
    first_vertex: IntArray  # (P,): number to which each patch adds the offsets
    corners: IntArray  # (P,): a corner of each patch's element, not always the one at which the patch begins
    uv: FloatArray  # (S, 2) float64: parameters of the samples, starting at `corners`


class UniformGrid:
    """Numbering of a uniform tessellation: the same for all surfaces over the same elements.

    Each face of the topology that has corners is an element, each half-edge the corner at which it begins. An element
    that fits the domain is one grid with ``rate`` segments along each side. Any other polygon has a square grid at each
    of its corners, which reaches half way along the corner's two edges. For an even rate, these grids meet along
    spokes, which run from the midpoints of the edges to the polygon's centre. For an odd rate, strips of triangles join
    them, and a fan of triangles closes the middle. `AdaptiveGrid` has the same members.
    """

    def __init__(self, domain: ParameterDomain, topology: Topology, rate: int) -> None:
        self.domain, self.topology, self.rate = domain, topology, rate
        self._is_whole = topology.face_sizes == domain.corner_count
        self._corner_count = int(np.count_nonzero(topology.vertex_half_edge >= 0))
        # Whole cells from a corner of a polygon to the midpoints of its edges.
        self._half, self._is_odd = rate // 2, rate % 2 == 1
        # Steps from a corner of a polygon to samples inside its grid: for an even rate, the last one is on a spoke.
        self._inside = np.arange(1, self._half + self._is_odd)

    @cached_property
    def vertex_count(self) -> int:
        return self.inner_begin + int(self._inner_counts.sum())

    @cached_property
    def _inner_counts(self) -> IntArray:
        """``(n_f,)`` vertices strictly inside each element."""
        sizes, n = self.topology.face_sizes, len(self._inside)
        of_whole = (self.rate - 1) * (self.rate - 2) // 2 if self.domain.corner_count == 3 else (self.rate - 1) ** 2
        # Polygons have a centre and, for an even rate, spokes.
        return np.where(self._is_whole, of_whole, sizes * n * (n + (not self._is_odd)) + (sizes > 0))

    @cached_property
    def corner_vertex(self) -> NDArray[np.uint32]:
        """``(n_v,)`` number of each vertex of the topology; undefined where no face uses it."""
        return np.cumsum(self.topology.vertex_half_edge >= 0, dtype=np.uint32) - 1

    def edge_start(self, corners: IntArray) -> IntArray:
        """Number of the first vertex inside the edge that begins at each corner, along the edge's lowest half-edge."""
        start = self.topology.edge[corners].astype(np.int64)
        start *= self.rate - 1
        start += self._corner_count
        return start

    @cached_property
    def inner_begin(self) -> int:
        """Number of the first vertex inside an element."""
        return self._corner_count + self.topology.edge_count * (self.rate - 1)

    @cached_property
    def inner_start(self) -> IntArray:
        """``(n_f,)`` number of the first vertex inside each element."""
        return self.inner_begin + ragged.starts(self._inner_counts)

    def along(self, corners: IntArray, steps: IntArray) -> NDArray[np.uint32]:
        """Vertices ``steps``, 0 to ``rate``, along edges that begin at corners: ``(*corners.shape, len(steps))``."""
        # Corners are the last axis, as there are more corners than steps, and NumPy's inner loops should be long.
        step = steps.astype(np.uint32).reshape(-1, *[1] * corners.ndim)
        numbers = np.where(self._are_lowest(corners), step - 1, self.rate - 1 - step)
        numbers += self.edge_start(corners).astype(np.uint32)
        if (steps == 0).any():
            numbers[steps == 0] = self._at_corners(corners)
        if (steps == self.rate).any():
            numbers[steps == self.rate] = self._at_corners(self.topology.next[corners])
        return np.moveaxis(numbers, 0, -1)

    def _at_corners(self, corners: IntArray) -> NDArray[np.uint32]:
        return self.corner_vertex[self.topology.face_vertices[corners]]

    def _are_lowest(self, corners: IntArray) -> NDArray[np.bool_]:
        """Whether the half-edges that begin at corners are the lowest of their edges, whose elements evaluate these."""
        return self.topology.edge_half_edge[self.topology.edge[corners]] == corners

    def _whole_vertices(self, faces: IntArray) -> NDArray[np.uint32]:
        """``(f, S)`` vertices of whole elements, in the order of `_steps`."""
        # Faces are the last axis, so that NumPy's inner loops are long. Samples on the sides are assigned afterwards,
        # where each side ends where the next one begins.
        before = np.cumsum(self._is_inside, dtype=np.uint32) - self._is_inside
        vertices = np.add.outer(before, self.inner_start[faces].astype(np.uint32))
        corners = np.add.outer(np.arange(self.domain.corner_count, dtype=np.int32), self.topology.face_offsets[faces])
        for side, along in zip(self._sides, self.along(corners, np.arange(self.rate)), strict=True):
            vertices[side[:-1]] = along.T
        return np.ascontiguousarray(vertices.T)

    def _corner_vertices(self, corners: IntArray) -> NDArray[np.uint32]:
        """``(c, half + 1, half + 1)`` vertices of the grids at corners of polygons, indexed ``[:, v, u]``."""
        t, h, n = self.topology, self._half, len(self._inside)
        numbers = np.empty((len(corners), h + 1, h + 1), dtype=np.uint32)
        numbers[:, 1 : n + 1, 1 : n + 1] = self._corner_start(corners)[:, None, None] + np.arange(n**2).reshape(n, n)
        if not self._is_odd:
            # Two adjacent corners share a spoke.
            numbers[:, 1:-1, -1] = self._spoke_start(corners)[:, None] + np.arange(n)
            numbers[:, -1, 1:-1] = self._spoke_start(t.prev[corners])[:, None] + np.arange(n)
            numbers[:, -1, -1] = self.inner_start[t.face[corners]]
        steps = np.arange(h + 1)
        numbers[:, 0, :] = self.along(corners, steps)
        numbers[:, :, 0] = self.along(t.prev[corners], self.rate - steps)
        return numbers

    def _corner_start(self, corners: IntArray) -> IntArray:
        """First vertex inside the grid of each polygon corner. The polygon's centre comes before all grids."""
        t, face = self.topology, self.topology.face[corners]
        return self.inner_start[face] + 1 + (corners - t.face_offsets[face]) * len(self._inside) ** 2

    def _spoke_start(self, corners: IntArray) -> IntArray:
        """First vertex inside the spoke from the midpoint of the edge at each polygon corner, after all grids."""
        t, face, n = self.topology, self.topology.face[corners], len(self._inside)
        return self.inner_start[face] + 1 + t.face_sizes[face] * n**2 + (corners - t.face_offsets[face]) * n

    @cached_property
    def _steps(self) -> IntArray:
        """``(S, 2)`` grid indices along u and v of the samples of a whole element, u fastest."""
        return self.domain.indices(self.rate)

    def _sample_at(self, steps: FloatArray) -> IntArray:
        """Samples of a whole element with grid indices ``(.., 2)``."""
        u, v = np.rint(steps).astype(np.int64).T
        in_triangle = v * (v - 1) // 2 if self.domain.corner_count == 3 else 0
        return v * (self.rate + 1) - in_triangle + u

    @cached_property
    def _is_inside(self) -> NDArray[np.bool_]:
        """``(S,)`` whether each sample lies strictly inside a whole element."""
        return self.domain.inside(self._steps / self.rate) > 1 / (2 * self.rate)

    @cached_property
    def _sides(self) -> list[IntArray]:
        """Samples along each side of a whole element, counter-clockwise."""
        ends = zip(self.domain.corners, np.roll(self.domain.corners, -1, axis=0), strict=True)
        along = np.arange(self.rate + 1)[:, None]
        return [self._sample_at(self.rate * begin + along * (end - begin)) for begin, end in ends]

    @cached_property
    def triangle_counts(self) -> IntArray:
        """``(n_f,)`` triangles of each element."""
        of_whole = (self.domain.corner_count - 2) * self.rate**2
        return np.where(self._is_whole, of_whole, self.topology.face_sizes * len(self._corner_cells))

    def triangles(self) -> NDArray[np.uint32]:
        """``(m, 3)`` vertices, counter-clockwise from outside, in the order of the elements."""
        t, counts, cells = self.topology, self.triangle_counts, self._whole_cells
        start = ragged.starts(counts)
        triangles = np.empty((int(counts.sum()), 3), dtype=np.uint32)
        for faces in _slices(np.flatnonzero(self._is_whole), self.rate**2):
            vertices, count = self._whole_vertices(faces), len(faces) * len(cells)
            if start[faces[-1]] - start[faces[0]] == count - len(cells):
                # The faces' triangles are contiguous in memory, as on a cage of whole elements only.
                target = triangles[start[faces[0]] :][:count].reshape(len(faces), -1)
                np.take(vertices, cells.ravel(), axis=1, out=target, mode="clip")
            else:
                triangles[start[faces][:, None] + np.arange(len(cells))] = vertices[:, cells]
        cells = self._corner_cells
        for corners in _slices(t.half_edges_of(~self._is_whole), self._half**2 + 1):
            face = t.face[corners]
            first = start[face] + (corners - t.face_offsets[face]) * len(cells)
            grids, following = self._corner_vertices(corners), self._corner_vertices(t.next[corners])[:, -1]
            vertices = np.column_stack([grids.reshape(len(corners), -1), following, self.inner_start[face]])
            triangles[first[:, None] + np.arange(len(cells))] = vertices[:, cells]
        return triangles

    @cached_property
    def _whole_cells(self) -> IntArray:
        """``(T, 3)`` samples at the corners of each triangle of a whole element."""
        if self.domain.corner_count == 4:
            return _cut_cells(self.rate + 1, self.rate + 1)
        room, cells = self.rate - self._steps.sum(axis=1), []
        for least, corners in ((1, ((0, 0), (1, 0), (0, 1))), (2, ((1, 0), (1, 1), (0, 1)))):
            cells.append(self._sample_at(self._steps[room >= least][:, None] + np.array(corners)).T)
        return np.concatenate(cells)

    @cached_property
    def _corner_cells(self) -> IntArray:
        """``(T, 3)`` samples at the corners of each triangle of one corner of a polygon.

        Samples are the corner's grid; the next corner's last row, which a strip joins for an odd rate; and the centre.
        """
        count = self._half + 1
        cells, beyond = _cut_cells(count, count), count**2 + np.arange(count)
        if not self._is_odd:
            return cells
        strip = np.stack([np.arange(count) * count + self._half, beyond], axis=1).ravel()
        return np.concatenate([cells, strip[_cut_cells(count, 2)], [[count**2 - 1, beyond[-1], beyond[-1] + 1]]])

    def triangle_parameters(self) -> tuple[FloatArray, FloatArray]:
        """``(T, 3, 2)`` parameters of a whole element's triangles; and of those at one corner of another, from there.

        Some of these may reach beyond u = 1, into the patch of the next corner.
        """
        whole = (self._steps / self.rate)[self._whole_cells]
        if self.domain.corner_count == 3:
            return whole, np.empty((0, 3, 2))
        grid = self._corner_parameters
        # In this corner's parameters, the last row of the next corner's grid is a column beyond u = 1.
        beyond = np.stack([2 - grid[-1, :, 1], grid[-1, :, 0]], axis=1)
        return whole, np.concatenate([grid.reshape(-1, 2), beyond, [[1.0, 1.0]]])[self._corner_cells]

    @property
    def _corner_parameters(self) -> FloatArray:
        """``(half + 1, half + 1, 2)`` parameters of the grid at a corner of a polygon, indexed ``[v, u]``."""
        along = np.arange(self._half + 1) * 2 / self.rate
        return np.stack(np.meshgrid(along, along), axis=-1)

    def element(self) -> NDArray[np.uint32]:
        """``(m,)`` element of each triangle."""
        counts = self.triangle_counts
        # `repeat` is faster with a scalar.
        repeats = counts[0] if (counts == counts[0]).all() else counts
        return np.repeat(np.arange(self.topology.face_count, dtype=np.uint32), repeats)

    def layout(self, corners: IntArray, *, are_corners: bool = False) -> tuple[FloatArray, list[GridPart]]:
        """The grids of the patches that begin at ``corners``, which are all in whole elements or all not.

        With ``are_corners``, whole elements have patches at their corners, too, which meet at their centres. Returns
        the parameters of a patch's samples, ``(S, 2)``, starting at the corner at which the patch begins; and parts
        that together have every vertex that the patches, in the order of ``corners``, evaluate, once.
        """
        t, r = self.topology, self.rate
        face = t.face[corners]
        turns, is_whole = corners - t.face_offsets[face], self._is_whole[face[0]]
        if are_corners or not is_whole:
            return self._corner_layout(corners, turns, is_whole)
        uv, parts = self._steps / r, []
        # Samples inside, in the order of their numbers, of patches that begin at each corner.
        turns_of_patch, uv_inside = range(self.domain.corner_count), uv[self._is_inside]
        inside = [self._sample_at(r * self.domain.rotation(turn).inverse()(uv_inside)) for turn in turns_of_patch]
        for turn, samples in enumerate(inside):
            patches = np.flatnonzero(turns == turn)
            first, begin = self.inner_start[face[patches]], t.face_offsets[face[patches]]
            parts.append(GridPart(samples, np.arange(len(samples)), patches, first, begin, uv[inside[0]]))
        for side in self._sides:
            parts += self._side_parts(corners, side[:-1], np.arange(r) / r)
            corners = t.next[corners]
        return uv, parts

    def _side_parts(self, corners: IntArray, samples: IntArray, along: FloatArray) -> list[GridPart]:
        """Parts of samples on the edges that begin at corners ``(p,)``, at parameters ``along`` the edges."""
        uv, steps = np.stack([along, np.zeros_like(along)], axis=1), np.arange(len(samples))
        at_edge = np.flatnonzero(self._are_lowest(corners))
        at_vertex = np.flatnonzero(self.topology.vertex_half_edge[self.topology.face_vertices[corners]] == corners)
        inside, begin = corners[at_edge], corners[at_vertex]
        return [
            GridPart(samples[1:], steps[:-1], at_edge, self.edge_start(inside), inside, uv[1:]),
            GridPart(samples[:1], steps[:1], at_vertex, self._at_corners(begin), begin, uv[:1]),
        ]

    def _corner_layout(self, corners: IntArray, turns: IntArray, is_whole: bool) -> tuple[FloatArray, list[GridPart]]:
        """`layout` of patches at corners, which reach half way along two edges, and to the centre at (1, 1)."""
        t, r, count, grid = self.topology, self.rate, self._half + 1, self._corner_parameters
        # The element's centre is an additional sample after the grid. For an even rate, some samples of the grid are
        # evaluated otherwise: the last row, with the midpoint of the preceding edge, by the preceding corner's patch,
        # and the last sample of the grid is the centre itself.
        uv, index = np.append(grid.reshape(-1, 2), [[1.0, 1.0]], axis=0), np.arange(count**2).reshape(count, count)
        n, centre = len(self._inside), np.array([count**2])
        parts = self._side_parts(corners, index[0], grid[0, :, 0])

        def add(samples: IntArray, offsets: IntArray, patches: IntArray, first_vertex: IntArray) -> None:
            parts.append(GridPart(samples, offsets, patches, first_vertex, corners[patches], uv[samples]))

        previous = t.prev[corners]
        at_back = np.flatnonzero(self._are_lowest(previous))
        add(index[self._inside, 0], r - 1 - self._inside, at_back, self.edge_start(previous[at_back]))
        if not is_whole:
            patches, first = np.arange(len(corners)), np.flatnonzero(turns == 0)
            inside = index[1 : n + 1, 1 : n + 1].ravel()
            add(inside, np.arange(n**2), patches, self._corner_start(corners))
            add(centre, np.zeros(1, dtype=np.int64), first, self.inner_start[t.face[corners[first]]])
            if not self._is_odd:
                add(index[self._inside, -1], np.arange(n), patches, self._spoke_start(corners))
            return uv, parts
        # A patch evaluates the samples that are nearest to its corner and, for an even rate, those on its spoke; the
        # first corner's patch evaluates the centre.
        nearest = index[1 : n + 1, 1:].ravel()
        for turn in range(4):
            samples = nearest if turn or self._is_odd else np.append(nearest, centre)
            x, y = np.rint(r * self.domain.rotation(turn)(uv[samples] / 2)).astype(np.int64).T
            patches = np.flatnonzero(turns == turn)
            add(samples, (y - 1) * (r - 1) + x - 1, patches, self.inner_start[t.face[corners[patches]]])
        # The centre has parameters of 1 in a patch, and of 1/2 in the element.
        return uv, [part._replace(uv=part.uv / 2) for part in parts]

    def locations(self) -> tuple[IntArray, FloatArray]:
        """Locations of the vertices: half-edges of `PatchTable.elements`, and parameters ``(n, 2)`` from there."""
        t = self.topology
        half_edge, uv = np.zeros(self.vertex_count, dtype=np.int64), np.zeros((self.vertex_count, 2))
        for corners in (t.face_offsets[:-1][self._is_whole], t.half_edges_of(~self._is_whole)):
            for part in self.layout(corners)[1] if len(corners) else ():
                vertices = part.first_vertex.astype(np.int64)[:, None] + part.offsets
                half_edge[vertices] = part.corners[:, None]
                uv[vertices] = part.uv
        return half_edge, uv

    def cut(self, topology: Topology) -> UniformGrid:
        """The same triangles over elements cut along more edges, where vertices have a copy on each side."""
        return UniformGrid(self.domain, topology, self.rate)

    def vertices_of(self, other: Any) -> IntArray:
        """``(vertex_count,)`` the original of each vertex in a grid of which this one is a `cut`."""
        t, steps = self.topology, np.arange(1, self.rate)
        originals = np.empty(self.vertex_count, dtype=np.int64)
        originals[self.corner_vertex[t.face_vertices]] = other.corner_vertex[other.topology.face_vertices]
        originals[self.edge_start(t.edge_half_edge)[:, None] + steps - 1] = other.along(t.edge_half_edge, steps)
        originals[self.inner_begin :] = np.arange(other.inner_begin, other.vertex_count)
        return originals


def _cut_cells(rows: int, columns: int) -> IntArray:
    """``(cells * 2, 3)`` triangles of a grid of ``rows x columns`` vertices.

    Diagonals start at the grid's corners and do not cut these off: two grids that meet in two edges, at a vertex of
    valence 2, would both have the same triangle there.
    """
    index = np.arange(rows * columns).reshape(rows, columns)
    a, b, c, d = (part.ravel() for part in (index[:-1, :-1], index[:-1, 1:], index[1:, 1:], index[1:, :-1]))
    v, u = np.indices((rows - 1, columns - 1)).reshape(2, -1)
    across = (2 * u + 1 > columns - 1) != (2 * v + 1 > rows - 1)
    a, b, c, d = (np.where(across, second, first) for first, second in ((a, b), (b, c), (c, d), (d, a)))
    return np.stack([a, b, c, a, c, d], axis=1).reshape(-1, 3)


def _slices(indices: IntArray, size: int) -> Iterator[IntArray]:
    """Split indices, of ``size`` vertices each, into slices of about `VERTICES_AT_ONCE` vertices."""
    length = max(1, VERTICES_AT_ONCE // size)
    return (indices[begin : begin + length] for begin in range(0, len(indices), length))


def first_sides(topology: Topology, border: IntArray, start: IntArray) -> IntArray:
    """The first of the half-edges ``border`` that joins the same points as each of them, as the sides of a crease do.

    ``start``, ``(n_h,)``, is the point at which half-edges begin.
    """
    ends = np.stack([start[border], start[topology.next[border]]]).astype(np.int64)
    pairs = ends.min(axis=0) * (int(start.max(initial=0)) + 1) + ends.max(axis=0)
    _, first, pair = np.unique(pairs, return_index=True, return_inverse=True)
    return border[first[pair]]
