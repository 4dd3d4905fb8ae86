"""Vertices and triangles of uniform tessellations, shared along the edges of the elements.

Every edge carries the same samples seen from both sides, and each vertex of the tessellation has one number, so that
nothing can crack. Numbers go to the corners of the elements first, then to samples inside edges, then to samples inside
elements; those of one edge, and of one element, follow each other.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from ..cage.connectivity import IntArray, Topology
from ..schemes.domain import FloatArray

VertexArray = NDArray[np.uint32]

# Triangles are made in runs of about this many vertices, which stay in a core's cache.
RUN = 1 << 16


@dataclass(frozen=True, eq=False)
class GridPart:
    """Samples whose vertices follow each other, and the patches that evaluate them; of several that share them, one.

    Attributes
    ----------
    samples : (S,) int64
        Indices into the grid of a patch.
    patches : (P,) int64
        Ascending.
    first_vertex : (P,) int64
        Sample ``s`` of the part is vertex ``first_vertex + s``.
    corners : (P,) int64
        Corners of elements, which the samples may be counted from, too.
    uv : (S, 2) float64
        The samples' parameters from these corners.
    """

    samples: IntArray
    patches: IntArray
    first_vertex: IntArray
    corners: IntArray
    uv: FloatArray

    def after(self, count: int) -> GridPart:
        """The part, for patches that are numbered after others."""
        return replace(self, patches=self.patches + count) if count else self


@dataclass(frozen=True, eq=False)
class GridLayout:
    """The grids of patches that begin at given corners.

    Attributes
    ----------
    uv : (S, 2) float64
        Parameters of the samples.
    parts : list of GridPart
        Together they hold every vertex once that no other patch evaluates.
    """

    uv: FloatArray
    parts: list[GridPart]


class Grid(Protocol):
    """Numbering of a uniform tessellation.

    Attributes
    ----------
    topology : Topology
        Of the elements: each face is an element.
    rate : int
        Segments on every edge.
    outline : Outline
        Numbering of the vertices on edges.
    vertex_count : int
    """

    topology: Topology
    rate: int
    outline: Outline
    vertex_count: int

    def layout(self, corners: IntArray) -> GridLayout:
        """Grids of patches that begin at these corners; all whole elements, or all not."""
        ...

    def triangles(self) -> VertexArray:
        """``(m, 3)`` counter-clockwise from outside, in the order of the elements."""
        ...

    def element(self) -> NDArray[np.uint32]:
        """``(m,)`` element of each triangle."""
        ...


@dataclass(frozen=True, eq=False)
class Outline:
    """Numbering of the vertices at corners and on edges.

    Parameters
    ----------
    topology : Topology
    rate : int
    """

    topology: Topology
    rate: int

    @cached_property
    def corner_vertex(self) -> IntArray:
        """``(n_v,)`` number of each vertex of the topology; those that no face uses have none of their own."""
        return np.cumsum(self._is_used) - 1

    def edge_start(self, corners: IntArray) -> IntArray:
        """Number of the first vertex inside the edges that begin at corners, counted along the lowest half-edges."""
        start = self.topology.edge[corners]
        start *= self.rate - 1
        start += self._corner_count
        return start

    @cached_property
    def vertex_count(self) -> int:
        return self._corner_count + self.topology.edge_count * (self.rate - 1)

    @cached_property
    def _corner_count(self) -> int:
        return int(np.count_nonzero(self._is_used))

    @cached_property
    def _is_used(self) -> NDArray[np.bool_]:
        return self.topology.vertex_half_edge >= 0

    def along(self, corners: IntArray, steps: IntArray) -> VertexArray:
        """Vertices ``steps`` segments along half-edges: ``(p, len(steps))``; both ends included."""
        t = self.topology
        is_forward = self.owns_edge[corners]
        start = self.edge_start(corners) + np.where(is_forward, -1, self.rate - 1)
        sign = np.where(is_forward, 1, -1).astype(np.int32)
        # Sums wrap around 2^32, so that signs do no harm.
        numbers = start.astype(np.uint32)[:, None] + (sign[:, None] * steps.astype(np.int32)).astype(np.uint32)
        numbers[:, steps == 0] = self.corner_vertex[t.face_vertices[corners]][:, None]
        numbers[:, steps == self.rate] = self.corner_vertex[t.face_vertices[t.next[corners]]][:, None]
        return numbers

    @cached_property
    def owns_edge(self) -> NDArray[np.bool_]:
        """``(n_h,)`` whether the element of each corner evaluates the edge that begins there: the lowest one."""
        twin = self.topology.twin
        return (twin < 0) | (twin > np.arange(len(twin)))

    @cached_property
    def owns_vertex(self) -> NDArray[np.bool_]:
        """``(n_h,)`` whether the element of each corner evaluates the vertex there."""
        owns = np.zeros(self.topology.half_edge_count, dtype=bool)
        owns[self.topology.vertex_half_edge[self._is_used]] = True
        return owns

    def edge_part(self, owners: IntArray, corners: IntArray, samples: IntArray, uv: FloatArray) -> GridPart:
        """The first samples inside edges, for patches and the corners where their edges begin."""
        return GridPart(samples, owners, self.edge_start(corners), corners, uv)

    def vertex_part(self, owners: IntArray, corners: IntArray, sample: IntArray) -> GridPart:
        """One sample at the vertices of corners."""
        first = self.corner_vertex[self.topology.face_vertices[corners]]
        return GridPart(sample, owners, first, corners, np.zeros((1, 2)))

    def parts(self, corners: IntArray, sides: list[IntArray], along: FloatArray) -> list[GridPart]:
        """Edges and corners of whole elements.

        Parameters
        ----------
        corners : (p,) int64
        sides : list of (rate + 1,) int64
            Samples of the element's sides, one after the other, counter-clockwise from the corner on.
        along : (rate + 1,) float64
            Their parameters.
        """
        parts = []
        uv = np.stack([along, np.zeros_like(along)], axis=1)
        for side in sides:
            owners = np.flatnonzero(self.owns_edge[corners])
            parts.append(self.edge_part(owners, corners[owners], side[1:-1], uv[1:-1]))
            owners = np.flatnonzero(self.owns_vertex[corners])
            parts.append(self.vertex_part(owners, corners[owners], side[:1]))
            corners = self.topology.next[corners]
        return parts


@dataclass(frozen=True, eq=False)
class QuadGrid:
    """Numbering of a tessellation over unit squares, see `Grid`.

    A quadrilateral is a grid of ``rate x rate`` cells. Another polygon is, at each of its corners, a grid that reaches
    half way along the corner's two edges; for an odd rate, strips join these grids and a fan closes the middle.

    Parameters
    ----------
    topology : Topology
        Of the elements: each face is an element.
    rate : int
    """

    topology: Topology
    rate: int

    @cached_property
    def outline(self) -> Outline:
        return Outline(self.topology, self.rate)

    @property
    def half(self) -> int:
        """Whole cells from a corner of a polygon to the middle of its edges."""
        return self.rate // 2

    @property
    def is_odd(self) -> bool:
        return self.rate % 2 == 1

    @cached_property
    def _inner_counts(self) -> IntArray:
        """``(n_f,)`` vertices strictly inside each face."""
        sizes = self.topology.face_sizes
        # Rate 1 leaves a polygon's corners no grid of their own, only the centre.
        per_corner = self.half**2 if self.is_odd else self.half * (self.half - 1)
        # Vertices on a border are no elements of a dual mesh: faces without corners.
        return np.where(sizes == 4, (self.rate - 1) ** 2, sizes * per_corner + (sizes > 0))

    @cached_property
    def _inner_start(self) -> IntArray:
        """``(n_f,)`` number of the first vertex inside each face."""
        return self.outline.vertex_count + np.cumsum(self._inner_counts) - self._inner_counts

    @cached_property
    def vertex_count(self) -> int:
        """Vertices of the tessellation."""
        return self.outline.vertex_count + int(self._inner_counts.sum())

    def quad_vertices(self, faces: IntArray) -> VertexArray:
        """Vertices of quadrilaterals: ``(e, rate + 1, rate + 1)``, indexed ``[:, v, u]``."""
        t, r = self.topology, self.rate
        numbers = np.empty((len(faces), r + 1, r + 1), dtype=np.uint32)
        along = np.arange(r + 1)
        inner = np.arange((r - 1) ** 2, dtype=np.uint32).reshape(r - 1, r - 1)
        numbers[:, 1:-1, 1:-1] = self._inner_start[faces].astype(np.uint32)[:, None, None] + inner
        first = t.face_offsets[faces]
        numbers[:, 0, :] = self.outline.along(first, along)
        numbers[:, :, -1] = self.outline.along(first + 1, along)
        numbers[:, -1, ::-1] = self.outline.along(first + 2, along)
        numbers[:, ::-1, 0] = self.outline.along(first + 3, along)
        return numbers

    def corner_vertices(self, corners: IntArray) -> VertexArray:
        """Vertices of polygon corners: ``(e, half + 1, half + 1)``, indexed ``[:, v, u]`` in steps of ``2 / rate``."""
        t, h = self.topology, self.half
        numbers = np.empty((len(corners), h + 1, h + 1), dtype=np.uint32)
        along = np.arange(h + 1)
        own = self._corner_start(corners)
        if self.is_odd:
            numbers[:, 1:, 1:] = own[:, None, None] + np.arange(h**2).reshape(h, h)
        else:
            numbers[:, 1:-1, 1:-1] = own[:, None, None] + np.arange((h - 1) ** 2).reshape(h - 1, h - 1)
            # Spokes from the middles of the edges to the centre are shared by two corners.
            numbers[:, 1:-1, -1] = self._spoke_start(corners)[:, None] + np.arange(h - 1)
            numbers[:, -1, 1:-1] = self._spoke_start(t.prev[corners])[:, None] + np.arange(h - 1)
            numbers[:, -1, -1] = self.centre_vertices(corners)
        numbers[:, 0, :] = self.outline.along(corners, along)
        numbers[:, :, 0] = self.outline.along(t.prev[corners], self.rate - along)
        return numbers

    def centre_vertices(self, corners: IntArray) -> IntArray:
        """Vertices at the centres of the half-edges' polygons: ``(e,)``."""
        return self._inner_start[self.topology.face[corners]]

    def _corner_start(self, corners: IntArray) -> IntArray:
        """First vertex inside each polygon corner's own grid; the polygon's centre comes before them all."""
        t, size = self.topology, self.half if self.is_odd else self.half - 1
        return self.centre_vertices(corners) + 1 + (corners - t.face_offsets[t.face[corners]]) * size**2

    def _spoke_start(self, corners: IntArray) -> IntArray:
        """First vertex inside the spoke from the middle of each half-edge, for an even rate."""
        t, inside = self.topology, self.half - 1
        face = t.face[corners]
        place = t.face_sizes[face] * inside**2 + (corners - t.face_offsets[face]) * inside
        return self._inner_start[face] + 1 + place

    @cached_property
    def _triangle_counts(self) -> IntArray:
        """``(n_f,)`` triangles of each face."""
        sizes = self.topology.face_sizes
        return np.where(sizes == 4, 2 * self.rate**2, sizes * self._corner_triangles)

    @property
    def _corner_triangles(self) -> int:
        """Triangles of one corner of a polygon."""
        return 2 * self.half**2 + (2 * self.half + 1 if self.is_odd else 0)

    def triangles(self) -> VertexArray:
        """``(m, 3)`` counter-clockwise from outside, in the order of the faces."""
        t = self.topology
        counts = self._triangle_counts
        start = np.cumsum(counts) - counts
        found = np.empty((int(counts.sum()), 3), dtype=np.uint32)
        cells = _cut_cells(self.rate + 1, self.rate + 1)
        for faces in runs(np.flatnonzero(t.face_sizes == 4), self.rate**2):
            numbers = self.quad_vertices(faces).reshape(len(faces), -1)
            if faces[-1] - faces[0] + 1 == len(faces):
                # Neighbours in memory, as on a cage of quadrilaterals only.
                target = found[start[faces[0]] :][: len(faces) * len(cells)].reshape(len(faces), -1)
                np.take(numbers, cells.ravel(), axis=1, out=target, mode="clip")
            else:
                found[start[faces][:, None] + np.arange(len(cells))] = numbers[:, cells]
        for corners in runs(np.flatnonzero((t.face_sizes != 4)[t.face]), self.half**2 + 1):
            place = corners - t.face_offsets[t.face[corners]]
            at = start[t.face[corners]] + place * self._corner_triangles
            found[at[:, None] + np.arange(self._corner_triangles)] = self._triangles_of_corners(corners)
        return found

    def _triangles_of_corners(self, corners: IntArray) -> VertexArray:
        """Triangles of each polygon corner: ``(e, n, 3)``."""
        grids = self.corner_vertices(corners)
        count = self.half + 1
        found = [grids.reshape(len(corners), -1)[:, _cut_cells(count, count)]]
        if self.is_odd:
            # The next corner's grid meets this one's across the middle of their common edge.
            following = self.corner_vertices(self.topology.next[corners])[:, -1, :]
            strip = np.stack([grids[:, :, -1], following], axis=2).reshape(len(corners), -1)
            centre = self.centre_vertices(corners).astype(np.uint32)
            found.append(strip[:, _cut_cells(count, 2)])
            found.append(np.stack([grids[:, -1, -1], following[:, -1], centre], axis=1)[:, None])
        return np.concatenate(found, axis=1)

    def element(self) -> NDArray[np.uint32]:
        """``(m,)`` face of each triangle."""
        counts = self._triangle_counts
        # One count for all repeats faster than one for each.
        equal = counts[0] if (counts == counts[0]).all() else counts
        return np.repeat(np.arange(self.topology.face_count, dtype=np.uint32), equal)

    def layout(self, corners: IntArray) -> GridLayout:
        """Grids of patches; quadrilaterals are whole patches, other polygons have one at each corner."""
        is_quad = self.topology.face_sizes[self.topology.face[corners[0]]] == 4
        return self._quad_layout(corners) if is_quad else self._corner_layout(corners)

    def _quad_layout(self, corners: IntArray) -> GridLayout:
        t, count = self.topology, self.rate + 1
        index = np.arange(count**2).reshape(count, count)
        uv = _lattice(count, 1, self.rate)
        inner = index[1:-1, 1:-1].ravel()
        parts = []
        face = t.face[corners]
        turns = corners - t.face_offsets[face]
        # Inside, numbers follow the face's own first corner, whichever corner the patch begins at.
        for turn in range(4):
            patches = np.flatnonzero(turns == turn)
            own = face[patches]
            turned = np.rot90(index, -turn)[1:-1, 1:-1].ravel()
            parts.append(GridPart(turned, patches, self._inner_start[own], t.face_offsets[own], uv[inner]))
        sides = [index[0], index[:, -1], index[-1, ::-1], index[::-1, 0]]
        return GridLayout(uv, parts + self.outline.parts(corners, sides, uv[:count, 0]))

    def _corner_layout(self, corners: IntArray) -> GridLayout:
        t, count = self.topology, self.half + 1
        outline, previous = self.outline, t.prev[corners]
        every = np.arange(len(corners))
        is_first = np.flatnonzero(t.face_offsets[t.face[corners]] == corners)
        owns_edge = np.flatnonzero(outline.owns_edge[corners])
        owns_previous = np.flatnonzero(outline.owns_edge[previous])
        owns_vertex = np.flatnonzero(outline.owns_vertex[corners])

        # The centre comes last. For an even rate the grid's last row is the previous corner's last column, its share
        # of the previous edge's middle is that corner's too, and its far corner is the centre once more.
        uv = np.concatenate([_lattice(count, 2, self.rate), [[1.0, 1.0]]])
        index = np.arange(count**2).reshape(count, count)
        inside = slice(1, None) if self.is_odd else slice(1, -1)
        grid, spoke, edge = index[inside, inside].ravel(), index[inside, -1], index[0, 1:]
        # Along the previous edge, numbers rise towards the corner.
        back = index[inside, 0][::-1]
        before_corner = outline.edge_start(previous[owns_previous]) + (self.rate - 1 - len(back))
        centre = np.array([count**2])
        parts = [
            GridPart(grid, every, self._corner_start(corners), corners, uv[grid]),
            outline.edge_part(owns_edge, corners[owns_edge], edge, uv[edge]),
            GridPart(back, owns_previous, before_corner, corners[owns_previous], uv[back]),
            outline.vertex_part(owns_vertex, corners[owns_vertex], index[0, :1]),
            GridPart(centre, is_first, self.centre_vertices(corners[is_first]), corners[is_first], uv[centre]),
        ]
        if not self.is_odd:
            parts.append(GridPart(spoke, every, self._spoke_start(corners), corners, uv[spoke]))
        return GridLayout(uv, parts)


def runs(indices: IntArray, size: int) -> Iterator[IntArray]:
    """Cut indices into runs, each of about `RUN` numbers where an index stands for ``size``."""
    length = max(1, RUN // size)
    for begin in range(0, len(indices), length):
        yield indices[begin : begin + length]


def _cut_cells(rows: int, columns: int) -> IntArray:
    """Triangles of a grid of ``rows x columns`` vertices, as indices into it: ``(cells * 2, 3)``.

    Diagonals run from the grid's corners, not across them: two cells that meet in two edges, at a vertex of valence 2,
    would have a triangle in common.
    """
    index = np.arange(rows * columns).reshape(rows, columns)
    a, b, c, d = (part.ravel() for part in (index[:-1, :-1], index[:-1, 1:], index[1:, 1:], index[1:, :-1]))
    v, u = np.indices((rows - 1, columns - 1)).reshape(2, -1)
    across = (2 * u + 1 > columns - 1) != (2 * v + 1 > rows - 1)
    a, b, c, d = (np.where(across, second, first) for first, second in ((a, b), (b, c), (c, d), (d, a)))
    return np.stack([a, b, c, a, c, d], axis=1).reshape(-1, 3)


def _lattice(count: int, numerator: int, denominator: int) -> FloatArray:
    """Parameters of a ``count x count`` grid, u fastest: ``(count * count, 2)``."""
    along = np.arange(count) * numerator / denominator
    return np.stack(np.meshgrid(along, along), axis=-1).reshape(-1, 2)
