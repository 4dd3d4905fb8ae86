"""Vertices and triangles of uniform tessellations, shared along the edges of the elements.

Every edge carries the same samples seen from both sides, and each vertex of the tessellation has one number, so that
nothing can crack. Numbers go to the corners of the elements first, then to samples inside edges, then to samples inside
elements.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from ..cage.connectivity import IntArray, Topology
from ..schemes.domain import FloatArray


@dataclass(frozen=True, eq=False)
class GridPart:
    """Part of the grids of some patches, which one of the patches that share it evaluates for all.

    Attributes
    ----------
    samples : (S,) int64
        Indices into the grid.
    evaluates : (P,) bool
        Whether each patch is the one that evaluates the part.
    corners : (P,) int64
    uv : (S, 2) float64
        The samples' parameters from these corners.
    """

    samples: IntArray
    evaluates: NDArray[np.bool_]
    corners: IntArray
    uv: FloatArray


@dataclass(frozen=True, eq=False)
class GridLayout:
    """The grids of patches that begin at given corners.

    Attributes
    ----------
    uv : (S, 2) float64
        Parameters of the samples.
    vertices : (P, S) int64
        Number of each sample of each patch.
    parts : list of GridPart
        Together they hold every sample once that no other patch evaluates.
    """

    uv: FloatArray
    vertices: IntArray
    parts: list[GridPart]


class Grid(Protocol):
    """Numbering of a uniform tessellation.

    Attributes
    ----------
    topology : Topology
        Of the elements: each face is an element.
    rate : int
        Segments on every edge.
    vertex_count : int
    triangles : (m, 3) uint32
        Counter-clockwise from outside, in the order of the elements.
    element : (m,) uint32
        Element of each triangle.
    """

    topology: Topology
    rate: int
    vertex_count: int
    triangles: NDArray[np.uint32]
    element: NDArray[np.uint32]

    def layout(self, corners: IntArray) -> GridLayout:
        """Grids of patches that begin at these corners; all of elements of the same size."""
        ...


def edge_vertices(topology: Topology, rate: int, corners: IntArray, steps: IntArray) -> IntArray:
    """Vertices ``steps`` segments along half-edges: ``(p, len(steps))``; both ends included."""
    t = topology
    edge = t.edge[corners]
    forward = t.edge_half_edge[edge] == corners
    along = np.where(forward[:, None], steps, rate - steps)
    numbers = t.vertex_count + edge[:, None] * (rate - 1) + along - 1
    numbers = np.where(steps == 0, t.face_vertices[corners][:, None], numbers)
    return np.where(steps == rate, t.face_vertices[t.next[corners]][:, None], numbers)


def outline_parts(topology: Topology, corners: IntArray, sides: list[IntArray], along: FloatArray) -> list[GridPart]:
    """Edges and corners of whole elements.

    Parameters
    ----------
    corners : (p,) int64
    sides : list of (rate + 1,) int64
        Samples of the element's sides, one after the other, counter-clockwise from the corner on.
    along : (rate + 1,) float64
        Their parameters.
    """
    t, parts = topology, []
    uv = np.stack([along, np.zeros_like(along)], axis=1)
    for side in sides:
        owns_edge = t.edge_half_edge[t.edge[corners]] == corners
        owns_vertex = t.vertex_half_edge[t.face_vertices[corners]] == corners
        parts.append(GridPart(side[1:-1], owns_edge, corners, uv[1:-1]))
        parts.append(GridPart(side[:1], owns_vertex, corners, uv[:1]))
        corners = t.next[corners]
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
        t = self.topology
        return t.vertex_count + t.edge_count * (self.rate - 1) + np.cumsum(self._inner_counts) - self._inner_counts

    @property
    def vertex_count(self) -> int:
        """Vertices of the tessellation."""
        t = self.topology
        return t.vertex_count + t.edge_count * (self.rate - 1) + int(self._inner_counts.sum())

    def _edge_vertices(self, corners: IntArray, steps: IntArray) -> IntArray:
        return edge_vertices(self.topology, self.rate, corners, steps)

    def quad_vertices(self, corners: IntArray) -> IntArray:
        """Vertices of quadrilaterals named by a half-edge: ``(e, rate + 1, rate + 1)``, indexed ``[:, v, u]``."""
        t, r = self.topology, self.rate
        numbers = np.empty((len(corners), r + 1, r + 1), dtype=np.int64)
        along = np.arange(r + 1)
        face = t.face[corners]
        # Inside, numbers follow the face's own first corner, whichever corner names it here.
        corner = corners - t.face_offsets[face]
        own = self._inner_start[face][:, None, None] + np.arange((r - 1) ** 2).reshape(r - 1, r - 1)
        for turn in range(4):
            at = np.flatnonzero(corner == turn)
            numbers[at, 1:-1, 1:-1] = np.rot90(own[at], turn, axes=(1, 2))
        first = corners
        second = t.next[first]
        third = t.next[second]
        fourth = t.next[third]
        numbers[:, 0, :] = self._edge_vertices(first, along)
        numbers[:, :, -1] = self._edge_vertices(second, along)
        numbers[:, -1, ::-1] = self._edge_vertices(third, along)
        numbers[:, ::-1, 0] = self._edge_vertices(fourth, along)
        return numbers

    def corner_vertices(self, corners: IntArray) -> IntArray:
        """Vertices of polygon corners: ``(e, half + 1, half + 1)``, indexed ``[:, v, u]`` in steps of ``2 / rate``."""
        t, h = self.topology, self.half
        numbers = np.empty((len(corners), h + 1, h + 1), dtype=np.int64)
        face = t.face[corners]
        inner = self._inner_start[face] + 1
        corner = corners - t.face_offsets[face]
        along = np.arange(h + 1)
        if self.is_odd:
            own = inner + corner * h**2
            numbers[:, 1:, 1:] = own[:, None, None] + np.arange(h**2).reshape(h, h)
        else:
            size = t.face_sizes[face]
            own = inner + corner * (h - 1) ** 2
            numbers[:, 1:-1, 1:-1] = own[:, None, None] + np.arange((h - 1) ** 2).reshape(h - 1, h - 1)
            # Spokes from the middles of the edges to the centre are shared by two corners.
            spokes = inner + size * (h - 1) ** 2
            numbers[:, 1:-1, -1] = (spokes + corner * (h - 1))[:, None] + np.arange(h - 1)
            numbers[:, -1, 1:-1] = (spokes + (corner - 1) % size * (h - 1))[:, None] + np.arange(h - 1)
            numbers[:, -1, -1] = self.centre_vertices(corners)
        numbers[:, 0, :] = self._edge_vertices(corners, along)
        numbers[:, :, 0] = self._edge_vertices(t.prev[corners], self.rate - along)
        return numbers

    def centre_vertices(self, corners: IntArray) -> IntArray:
        """Vertices at the centres of the half-edges' polygons: ``(e,)``."""
        return self._inner_start[self.topology.face[corners]]

    @cached_property
    def _triangles_and_faces(self) -> tuple[NDArray[np.uint32], NDArray[np.uint32]]:
        t = self.topology
        quads = np.flatnonzero(t.face_sizes == 4)
        cells = [self.quad_vertices(t.face_offsets[quads])]
        owners = [quads]
        corners = np.flatnonzero((t.face_sizes != 4)[t.face])
        triangles, faces = [], []
        if len(corners):
            grids = self.corner_vertices(corners)
            cells.append(grids)
            owners.append(t.face[corners])
            if self.is_odd:
                # The next corner's grid meets this one's across the middle of their common edge.
                position = np.full(t.half_edge_count, -1)
                position[corners] = np.arange(len(corners))
                following = grids[position[t.next[corners]]]
                cells.append(np.stack([grids[:, :, -1], following[:, -1, :]], axis=2))
                owners.append(t.face[corners])
                centre = self.centre_vertices(corners)
                triangles.append(np.stack([grids[:, -1, -1], following[:, -1, -1], centre], axis=1))
                faces.append(t.face[corners])
        for grid, owner in zip(cells, owners, strict=True):
            rows, columns = grid.shape[1:]
            pattern = _cut_cells(rows, columns)
            numbers = grid.astype(np.uint32).reshape(len(grid), rows * columns)
            triangles.append(numbers[:, pattern].reshape(-1, 3))
            faces.append(np.repeat(owner, len(pattern)))
        triangles, faces = np.concatenate(triangles), np.concatenate(faces).astype(np.uint32)
        if len(corners):
            order = np.argsort(faces, kind="stable")
            triangles, faces = triangles[order], faces[order]
        return triangles.astype(np.uint32, copy=False), faces

    def layout(self, corners: IntArray) -> GridLayout:
        """Grids of patches; quadrilaterals are whole patches, other polygons have one at each corner."""
        is_quad = self.topology.face_sizes[self.topology.face[corners[0]]] == 4
        return self._quad_layout(corners) if is_quad else self._corner_layout(corners)

    def _quad_layout(self, corners: IntArray) -> GridLayout:
        count = self.rate + 1
        index = np.arange(count**2).reshape(count, count)
        inner = index[1:-1, 1:-1].ravel()
        uv = _lattice(count, 1, self.rate)
        parts = [GridPart(inner, np.ones(len(corners), dtype=bool), corners, uv[inner])]
        sides = [index[0], index[:, -1], index[-1, ::-1], index[::-1, 0]]
        parts += outline_parts(self.topology, corners, sides, uv[:count, 0])
        return GridLayout(uv, self.quad_vertices(corners).reshape(len(corners), -1), parts)

    def _corner_layout(self, corners: IntArray) -> GridLayout:
        t, count = self.topology, self.half + 1
        previous = t.prev[corners]
        every = np.ones(len(corners), dtype=bool)
        is_first = t.face_offsets[t.face[corners]] == corners
        owns_edge = t.edge_half_edge[t.edge[corners]] == corners
        owns_previous = t.edge_half_edge[t.edge[previous]] == previous
        owns_vertex = t.vertex_half_edge[t.face_vertices[corners]] == corners

        uv = np.concatenate([_lattice(count, 2, self.rate), [[1.0, 1.0]]])
        grids = self.corner_vertices(corners).reshape(len(corners), -1)
        centre = self.centre_vertices(corners)[:, None]
        # The centre comes last. For an even rate the grid's last row is the previous corner's last column, its share
        # of the previous edge's middle is that corner's too, and its far corner is the centre once more.
        index = np.arange(count**2).reshape(count, count)
        inner = slice(1, None) if self.is_odd else slice(1, -1)
        samples = [
            (index[inner, 1:].ravel(), every),
            (index[0, 1:], owns_edge),
            (index[inner, 0], owns_previous),
            (index[0, :1], owns_vertex),
            (np.array([count**2]), is_first),
        ]
        parts = [GridPart(chosen, evaluates, corners, uv[chosen]) for chosen, evaluates in samples]
        return GridLayout(uv, np.concatenate([grids, centre], axis=1), parts)

    @property
    def triangles(self) -> NDArray[np.uint32]:
        """``(m, 3)`` counter-clockwise from outside, in the order of the faces."""
        return self._triangles_and_faces[0]

    @property
    def element(self) -> NDArray[np.uint32]:
        """``(m,)`` face of each triangle."""
        return self._triangles_and_faces[1]


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
