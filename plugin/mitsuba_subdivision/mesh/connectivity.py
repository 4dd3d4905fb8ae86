"""Half-edge connectivity of polygon meshes, built by sorting, and the semi-sharp edges and vertices of a mesh.

Sharpness is infinite from 10; below, it lasts for a number of refinements (semi-sharp). `Sharpness` (`cuts`) has that
of the tags of a control cage. `SemiSharpness` has that of a mesh that is cut along its infinitely sharp edges.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum
from functools import cached_property
from typing import TYPE_CHECKING, Literal

import numpy as np
from numpy.typing import NDArray

from . import ragged
from .ragged import IntArray, first_indices, sorted_order

if TYPE_CHECKING:
    from scipy import sparse

# Indices of half-edges, faces and edges. int32 halves the memory, and on large cages the time.
IndexArray = NDArray[np.int32]
FloatArray = NDArray[np.float64]

# Least sharpness that is infinite, as in OpenSubdiv.
INFINITE = 10.0

CreaseMethod = Literal["uniform", "chaikin"]


@dataclass(frozen=True, eq=False)
class SemiSharpness:
    """Semi-sharp edges and vertices of a mesh that is cut along its infinitely sharp edges.

    Copies of a vertex on the two sides of a cut must have the same position. So each copy has a row for every
    semi-sharp edge *across* the cut, which ends at another copy of the vertex.
    """

    # (n_h,) float64: sharpness of the edge of each half-edge, equal for twins; 0 for smooth edges and on borders
    edges: FloatArray
    # (n_h,) float64: sharpness after the next refinement of the half of the edge at the origin of the half-edge
    edges_refined: FloatArray
    vertices: FloatArray  # (n_v,) float64: sharpness of each vertex
    across_vertex: IntArray  # (m,) int64: vertex of the cut mesh, for each row of a semi-sharp edge across the cut
    across_sharpness: FloatArray  # (m,) float64: sharpness of the edge
    # (m,) float64: sharpness after the next refinement of the half of the edge at the vertex
    across_refined: FloatArray
    # (m,) bool: whether the edge makes the vertex sharp; others only contribute to the averages of Chaikin's method
    across_sharpens: NDArray[np.bool_]

    @classmethod
    def decaying(
        cls,
        origin: IntArray,  # (n_h,) int: vertex at which each half-edge begins
        # The following as in `SemiSharpness`
        edges: FloatArray,
        vertices: FloatArray,
        across_vertex: IntArray,
        across_sharpness: FloatArray,
        across_sharpens: NDArray[np.bool_],
        method: CreaseMethod,
    ) -> SemiSharpness | None:
        """Return the sharpness including that after the next refinement; None if nothing is sharp.

        Section 11 of plugin/MATHEMATICS.md has the decay [DeRose et al. 1998].
        """
        if not (edges.any() or vertices.any() or across_sharpness.any()):
            return None
        sharpness = averaged = np.concatenate([edges, across_sharpness])
        if method == "chaikin":
            vertex = np.concatenate([origin, across_vertex])
            total = np.bincount(vertex, sharpness, minlength=len(vertices))[vertex]
            other_count = np.bincount(vertex, sharpness > 0, minlength=len(vertices))[vertex] - 1
            mean = (total - sharpness) / np.maximum(other_count, 1)
            averaged = np.where((sharpness > 0) & (other_count > 0), 0.75 * sharpness + 0.25 * mean, sharpness)
        edges_refined, across_refined = np.split(_lowered(averaged), [len(edges)])
        return cls(edges, edges_refined, vertices, across_vertex, across_sharpness, across_refined, across_sharpens)

    @property
    def vertices_refined(self) -> FloatArray:
        """``(n_v,)`` sharpness of the vertices after the next refinement."""
        return _lowered(self.vertices)

    def refined(
        self,
        origin: IntArray,  # (n_h',) vertex at which each refined half-edge begins
        edges: FloatArray,  # (n_h',) sharpness of each refined half-edge: `edges_refined`, or 0 for new edges
        new_vertex_count: int,  # Number of vertices that the refinement adds after the present ones
        method: CreaseMethod,
    ) -> SemiSharpness | None:
        """Return the sharpness of the refined mesh."""
        vertices = np.concatenate([self.vertices_refined, np.zeros(new_vertex_count)])
        # Edges that have become smooth are removed, so that signatures of equal surroundings are equal.
        kept = self.across_refined > 0
        across = self.across_vertex[kept], self.across_refined[kept], self.across_sharpens[kept]
        return SemiSharpness.decaying(origin, edges, vertices, *across, method)


def _lowered(sharpness: FloatArray) -> FloatArray:
    return np.maximum(sharpness - 1, 0)


class VertexRule(IntEnum):
    """The mask of a vertex for refinement, where the faces around it do not determine it."""

    AUTOMATIC = 0  # Smooth mask inside the mesh, crease mask on a border
    CORNER = 1  # No mask: the vertex does not move
    DART = 2  # Smooth mask, although the crease that ends at the vertex is cut into two border edges


class Topology:
    """Half-edge connectivity of a polygon mesh.

    Half-edge ``h`` runs from ``face_vertices[h]`` to the next vertex of the same face, so that half-edges and face
    corners (face-vertices) have the same numbers. Faces are counter-clockwise from outside. A half-edge has at most one
    twin, which runs in the opposite direction; a half-edge without a twin lies on a border. The faces of a vertex form
    one fan: they are consecutive around it, from border to border or all around. Only the uncut mesh of a control cage
    may have vertices with several fans.

    Parameters
    ----------
    face_sizes : (n_f,) int64
        Number of corners of each face.
    face_vertices : (n_h,) int32
        0-based vertices of all faces, face by face.
    edge_names : (n_h,) int64, optional
        A number for each half-edge, equal for twins only. By default half-edges between the same two vertices are
        twins. A dual mesh needs names, as two of its faces may share several edges.
    rules : (n_v,) int8, optional
        A `VertexRule` for each vertex, later `vertex_rules`. By default all are automatic.
    semi_sharpness : SemiSharpness, optional
        Semi-sharp edges and vertices. By default there are none.
    """

    def __init__(
        self,
        vertex_count: int,
        face_sizes: IntArray,
        face_vertices: IntArray,
        edge_names: IntArray | None = None,
        rules: NDArray[np.int8] | None = None,
        semi_sharpness: SemiSharpness | None = None,
    ) -> None:
        self.vertex_count = vertex_count
        self.face_sizes = face_sizes
        self.face_vertices: IndexArray = np.asarray(face_vertices, dtype=np.int32)
        self.edge_names = edge_names
        self.vertex_rules = np.zeros(vertex_count, dtype=np.int8) if rules is None else rules
        self.semi_sharpness = semi_sharpness

    @property
    def face_count(self) -> int:
        return len(self.face_sizes)

    @property
    def half_edge_count(self) -> int:
        return len(self.face_vertices)

    @cached_property
    def face_offsets(self) -> IndexArray:
        """``(n_f + 1,)``: half-edges of face ``f`` are ``face_offsets[f]`` up to ``face_offsets[f + 1]``."""
        return ragged.offsets(self.face_sizes, np.int32)

    @cached_property
    def face(self) -> IndexArray:
        """``(n_h,)`` face of each half-edge."""
        return np.repeat(np.arange(self.face_count, dtype=np.int32), self.common_size or self.face_sizes)

    @cached_property
    def common_size(self) -> int:
        """Number of corners that every face has; 0 where faces differ."""
        size = int(self.face_sizes[0]) if self.face_count else 0
        return size if (self.face_sizes == size).all() else 0

    @cached_property
    def next(self) -> IndexArray:
        """``(n_h,)`` next half-edge of the face."""
        following = np.arange(1, self.half_edge_count + 1, dtype=np.int32)
        first, last = self._face_ends
        following[last] = following[first] - 1
        return following

    @cached_property
    def prev(self) -> IndexArray:
        """``(n_h,)`` previous half-edge of the face."""
        preceding = np.arange(-1, self.half_edge_count - 1, dtype=np.int32)
        first, last = self._face_ends
        preceding[first] = preceding[last] + 1
        return preceding

    @cached_property
    def turn(self) -> IndexArray:
        """``(n_h,)`` outgoing half-edge of the same vertex in the next face counter-clockwise; -1 beyond a border."""
        return self.twin[self.prev]

    @cached_property
    def turn_back(self) -> IndexArray:
        """``(n_h,)`` outgoing half-edge of the same vertex in the next face clockwise; -1 beyond a border."""
        return np.where(self.twin < 0, -1, self.next[self.twin])

    @property
    def _face_ends(self) -> tuple[slice, slice] | tuple[IntArray, IntArray]:
        """First and last half-edge of each face that has half-edges."""
        if size := self.common_size:
            return slice(0, None, size), slice(size - 1, None, size)
        present = self.face_sizes > 0
        return self.face_offsets[:-1][present], self.face_offsets[1:][present] - 1

    @cached_property
    def _edges(self) -> tuple[IndexArray, IndexArray, int]:
        """Edge and twin of each half-edge, and the number of edges, as returned by `paired`."""
        if self.edge_names is not None:
            return paired(self.edge_names)
        # Pairs of vertices are numbered row by row in a lower triangle, which takes one bit less than in a square.
        end = self.face_vertices[self.next]
        high = np.maximum(self.face_vertices, end).astype(np.int64)
        return paired(high * (high + 1) // 2 + np.minimum(self.face_vertices, end))

    @property
    def edge(self) -> IndexArray:
        """``(n_h,)`` 0-based undirected edge of each half-edge."""
        return self._edges[0]

    @property
    def twin(self) -> IndexArray:
        """``(n_h,)`` half-edge of the neighbouring face along the same edge, -1 on a border."""
        return self._edges[1]

    @property
    def edge_count(self) -> int:
        return self._edges[2]

    @cached_property
    def edge_half_edge(self) -> IndexArray:
        """``(n_e,)`` lowest half-edge of each edge."""
        return first_indices(self.edge, self.edge_count)

    @cached_property
    def edge_ends(self) -> IndexArray:
        """``(n_e, 2)`` read-only ends of different edges, the lower first; by the higher vertex, then the lower."""
        start, end = self.face_vertices.astype(np.int64), self.face_vertices[self.next]
        keys = np.unique(np.maximum(start, end) * self.vertex_count + np.minimum(start, end))
        ends = np.stack(np.divmod(keys, self.vertex_count)[::-1], axis=1).astype(np.int32)
        ends.flags.writeable = False
        return ends

    def laplacian(self) -> sparse.csr_array:
        """Return the uniform Laplacian of the edges: ``(n_v, n_v)``, with the degrees on the diagonal."""
        from scipy import sparse

        start, end = self.edge_ends[self.edge_ends[:, 0] != self.edge_ends[:, 1]].T
        rows, columns = np.concatenate([start, end]), np.concatenate([end, start])
        shape = self.vertex_count, self.vertex_count
        adjacency = sparse.coo_array((np.ones(len(rows)), (rows, columns)), shape=shape).tocsr()
        return sparse.csr_array(sparse.diags_array(adjacency.sum(axis=1)) - adjacency)

    @cached_property
    def vertex_half_edge(self) -> IndexArray:
        """``(n_v,)`` lowest outgoing half-edge of each vertex, -1 if no face uses the vertex."""
        return first_indices(self.face_vertices, self.vertex_count)

    @cached_property
    def vertex_face_count(self) -> IndexArray:
        """``(n_v,)`` number of faces at each vertex; for inner vertices this is the valence."""
        return np.bincount(self.face_vertices, minlength=self.vertex_count).astype(np.int32)

    @cached_property
    def open_fan_start(self) -> IndexArray:
        """``(n_v,)`` outgoing border half-edge of each border vertex, its most clockwise one; -1 inside."""
        start = np.full(self.vertex_count, -1, dtype=np.int32)
        open_edges = np.flatnonzero(self.twin < 0)
        start[self.face_vertices[open_edges]] = open_edges
        return start

    @cached_property
    def open_fan_end(self) -> IndexArray:
        """``(n_v,)`` incoming border half-edge of each border vertex; -1 inside."""
        end = np.full(self.vertex_count, -1, dtype=np.int32)
        open_edges = np.flatnonzero(self.twin < 0)
        end[self.face_vertices[self.next[open_edges]]] = open_edges
        return end

    def border_neighbours(self, vertices: IntArray) -> tuple[IndexArray, IndexArray]:
        """Return the border neighbours of border vertices: beside the most clockwise face, and beside the last."""
        first = self.next[self.open_fan_start[vertices]]
        return self.face_vertices[first], self.face_vertices[self.open_fan_end[vertices]]

    @cached_property
    def is_border_vertex(self) -> NDArray[np.bool_]:
        """``(n_v,)`` whether each vertex is on a border."""
        return self.ends_of(self.twin < 0)

    @cached_property
    def edge_sharpness(self) -> NDArray[np.float64]:
        """``(n_h, 3)`` sharpness of each half-edge's edge; after the next refinement, of its near half and far half."""
        semi = self.semi_sharpness
        if semi is None:
            return np.zeros((self.half_edge_count, 3))
        far_half = np.where(self.twin < 0, 0, semi.edges_refined[self.twin])
        return np.stack([semi.edges, semi.edges_refined, far_half], axis=1)

    @cached_property
    def is_semi_sharp_vertex(self) -> NDArray[np.bool_]:
        """``(n_v,)`` whether each vertex, or an edge at it, is semi-sharp, including edges across a cut."""
        semi = self.semi_sharpness
        if semi is None:
            return np.zeros(self.vertex_count, dtype=bool)
        is_semi_sharp = self.ends_of(semi.edges > 0) | (semi.vertices > 0)
        is_semi_sharp[semi.across_vertex] = True
        return is_semi_sharp

    def ends_of(self, is_chosen: NDArray[np.bool_]) -> NDArray[np.bool_]:
        """Return ``(n_v,)``: whether one of the half-edges selected by ``is_chosen`` begins or ends at each vertex."""
        is_end = np.zeros(self.vertex_count, dtype=bool)
        half_edges = np.flatnonzero(is_chosen)
        is_end[self.face_vertices[half_edges]] = True
        is_end[self.face_vertices[self.next[half_edges]]] = True
        return is_end

    @cached_property
    def vertex_fans(self) -> tuple[IntArray, IndexArray]:
        """Offsets ``(n_v + 1,)``, and outgoing half-edges of every inner vertex, counter-clockwise from its lowest."""
        counts = np.where(self.is_border_vertex, 0, self.vertex_face_count)
        offsets = ragged.offsets(counts)
        half_edges = np.empty(offsets[-1], dtype=np.int32)
        for valence in 1 + np.flatnonzero(np.bincount(counts)[1:]):
            vertices = np.flatnonzero(counts == valence)
            current = self.vertex_half_edge[vertices]
            for turn in range(valence):
                half_edges[offsets[vertices] + turn] = current
                current = self.turn[current]
        return offsets, half_edges

    def with_rules(self, rules: NDArray[np.int8] | None, semi_sharpness: SemiSharpness | None) -> Topology:
        """Return the same mesh with other rules. It shares the connectivity that is already computed."""
        same = Topology(self.vertex_count, self.face_sizes, self.face_vertices, self.edge_names, rules, semi_sharpness)
        for name, value in vars(self).items():
            if name not in ("vertex_rules", "semi_sharpness", "edge_sharpness", "is_semi_sharp_vertex"):
                vars(same)[name] = value
        return same

    def along_faces(self, half_edges: IntArray, counts: IntArray) -> NDArray[np.int64]:
        """Return ``(counts.sum(),)``: for each half-edge ``counts`` successive ones of its face, from itself on."""
        rows, face = ragged.ranges(half_edges, counts), self.face[half_edges]
        is_past = rows >= np.repeat(self.face_offsets[1:][face], counts)
        return rows - is_past * np.repeat(self.face_sizes[face], counts)

    def around_faces(self, half_edges: IntArray, count: int) -> list[IntArray]:
        """Return half-edges, and for each the ``count - 1`` following ones of its face, one after the other."""
        around = [half_edges]
        for _ in range(count - 1):
            around.append(self.next.take(around[-1]))
        return around

    def half_edges_of(self, is_chosen: NDArray[np.bool_]) -> IntArray:
        """Return the half-edges of the faces selected by ``is_chosen``, in ascending order."""
        return np.flatnonzero(np.repeat(is_chosen, self.common_size or self.face_sizes))


def paired(
    keys: IntArray,  # (n,) int: number of each half-edge, from 0, equal for half-edges of the same edge only
) -> tuple[IndexArray, IndexArray, int]:
    """Return the edge ``(n,)`` of each half-edge, in the order of keys, its twin ``(n,)``, and the number of edges.

    A twin is -1 where the edge has no other half-edge, and one of them where it has more than two.
    """
    order, begins = sorted_order(keys)
    edge, twin = np.empty_like(order), np.full_like(order, -1)
    edge[order] = np.cumsum(begins, dtype=np.int32) - 1
    second = np.flatnonzero(~begins)
    one, other = order[second - 1], order[second]
    twin[one], twin[other] = other, one
    return edge, twin, int(np.count_nonzero(begins))
