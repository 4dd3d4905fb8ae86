"""Half-edge connectivity of polygon meshes, built by sorting."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from enum import IntEnum
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from . import ragged
from .sharpness import SemiSharpness

# Integers of any width; docstrings say which, where that matters.
IntArray = NDArray[np.integer]
# Numbers of half-edges, faces and edges: half the memory, and so, of large cages, half the time.
IndexArray = NDArray[np.int32]
# Many, or one.
HalfEdges = NDArray[np.integer] | int

# Long arrays are worked on in runs of this many.
RUN = 1 << 14


class VertexRule(IntEnum):
    """How refinement moves a vertex where its place in the mesh does not say all.

    AUTOMATIC: by all its neighbours inside, along the border on a boundary. CORNER: not at all. DART: by all its
    neighbours, though a sharp edge that ends there makes two border edges.
    """

    AUTOMATIC = 0
    CORNER = 1
    DART = 2


def runs_of(count: int) -> Iterator[slice]:
    """Successive runs, short enough that what is computed for one stays in a core's cache."""
    for begin in range(0, count, RUN):
        yield slice(begin, min(begin + RUN, count))


def gathered(values: NDArray, indices: NDArray[np.integer]) -> NDArray:
    """``values[indices]`` for indices in range; what is out of it takes the first or the last value.

    In runs, as NumPy makes 64-bit indices of all others first: those of a run stay in the cache.
    """
    if len(indices) <= RUN:
        return values.take(indices, mode="clip")
    found = np.empty(indices.shape, dtype=values.dtype)
    for run in runs_of(len(indices)):
        values.take(indices[run], out=found[run], mode="clip")
    return found


@dataclass(frozen=True, eq=False)
class Topology:
    """Faces of a polygon mesh and the half-edges that join them.

    Half-edge ``h`` runs from ``face_vertices[h]`` to the next vertex of the same face, so half-edges and face corners
    share one numbering. Faces are counter-clockwise from outside. Every half-edge has one twin at most, which runs in
    the opposite direction, and the faces of a vertex are one fan. A control cage's own mesh may have vertices of
    several fans until it is cut.

    Parameters
    ----------
    vertex_count : int
    face_sizes : (n_f,) int64
        Corners per face.
    face_vertices : (n_h,) int32
        0-based vertices of all faces, one after the other.
    edge_names : (n_h,) int64, optional
        A number for each half-edge that it shares with its twin only. By default edges are named by their two
        vertices; a dual mesh, where two faces may meet along several edges, needs others.
    rules : (n_v,) int8, optional
        A `VertexRule` for each vertex. By default all automatic.
    semi_sharpness : SemiSharpness, optional
        Of edges and vertices. By default nothing is semi-sharp.
    """

    vertex_count: int
    face_sizes: IntArray
    face_vertices: IndexArray
    edge_names: IntArray | None = None
    rules: NDArray[np.int8] | None = None
    semi_sharpness: SemiSharpness | None = None

    def __post_init__(self) -> None:
        object.__setattr__(self, "face_vertices", np.asarray(self.face_vertices, dtype=np.int32))

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
        """Corners of every face; 0 where faces differ."""
        size = int(self.face_sizes[0]) if self.face_count else 0
        return size if (self.face_sizes == size).all() else 0

    @cached_property
    def next(self) -> IndexArray:
        """``(n_h,)`` half-edge that follows in the same face."""
        following = np.arange(1, self.half_edge_count + 1, dtype=np.int32)
        first, last = self._face_ends
        following[last] = following[first] - 1
        return following

    @cached_property
    def prev(self) -> IndexArray:
        """``(n_h,)`` half-edge that precedes in the same face."""
        preceding = np.arange(-1, self.half_edge_count - 1, dtype=np.int32)
        first, last = self._face_ends
        preceding[first] = preceding[last] + 1
        return preceding

    @property
    def _face_ends(self) -> tuple[slice, slice] | tuple[IntArray, IntArray]:
        """First and last half-edge of each face that has any."""
        if size := self.common_size:
            return slice(0, None, size), slice(size - 1, None, size)
        present = self.face_sizes > 0
        return self.face_offsets[:-1][present], self.face_offsets[1:][present] - 1

    def _edge_order(self) -> tuple[IndexArray, NDArray[np.bool_]]:
        """Half-edges sorted by their undirected edge, then by number, and whether each one begins a new edge."""
        count, begins = self.half_edge_count, np.ones(self.half_edge_count, dtype=bool)
        bits = np.uint64(count.bit_length())
        if self._edge_key_count << int(bits) <= 1 << 64:
            # Numbers sort several times faster than indices into them.
            keys = np.empty(count, dtype=np.uint64)
            for run, own in self._edge_keys():
                np.left_shift(own.astype(np.uint64), bits, out=keys[run])
                keys[run] |= np.arange(run.start, run.stop, dtype=np.uint64)
            keys.sort()
            order = np.empty(count, dtype=np.int32)
            np.bitwise_and(keys, (np.uint64(1) << bits) - np.uint64(1), out=order, casting="unsafe")
            keys >>= bits
        else:
            keys = np.concatenate([own for _, own in self._edge_keys()])
            order = np.argsort(keys, kind="stable").astype(np.int32)
            keys = keys[order]
        np.not_equal(keys[1:], keys[:-1], out=begins[1:])
        return order, begins

    @property
    def _edge_key_count(self) -> int:
        if self.edge_names is not None:
            return int(self.edge_names.max(initial=0)) + 1
        return self.vertex_count * (self.vertex_count + 1) // 2

    def _edge_keys(self) -> Iterator[tuple[slice, IntArray]]:
        """Runs of half-edges, and numbers that they share with their twins only."""
        for run in runs_of(self.half_edge_count):
            if self.edge_names is not None:
                yield run, self.edge_names[run]
                continue
            start = self.face_vertices[run]
            end = self.face_vertices.take(self.following(np.arange(run.start, run.stop, dtype=np.int32)))
            high = np.maximum(start, end).astype(np.int64)
            # A triangular number and the lower end tell pairs apart in one bit less than a square would.
            yield run, (high * (high + 1) >> 1) + np.minimum(start, end)

    @cached_property
    def _edges(self) -> tuple[IndexArray, IndexArray, int]:
        """Edge and twin of each half-edge, and how many edges there are; made together, as both take the order."""
        order, begins = self._edge_order()
        edge, twin = np.empty_like(order), np.full_like(order, -1)
        edge_count = 0
        for run in runs_of(len(order)):
            number = np.cumsum(begins[run], dtype=np.int32)
            edge[order[run]] = number + (edge_count - 1)
            edge_count += int(number[-1])
            second = run.start + np.flatnonzero(~begins[run])
            one, other = order[second - 1], order[second]
            twin[one], twin[other] = other, one
        return edge, twin, edge_count

    @property
    def edge(self) -> IndexArray:
        """``(n_h,)`` 0-based undirected edge of each half-edge."""
        return self._edges[0]

    @property
    def twin(self) -> IndexArray:
        """``(n_h,)`` half-edge of the neighbouring face along the same edge, -1 on a boundary."""
        return self._edges[1]

    @property
    def edge_count(self) -> int:
        return self._edges[2]

    @cached_property
    def edge_half_edge(self) -> IndexArray:
        """``(n_e,)`` lowest half-edge of each edge."""
        return _lowest(self.edge, self.edge_count)

    @cached_property
    def vertex_half_edge(self) -> IndexArray:
        """``(n_v,)`` lowest outgoing half-edge of each vertex, -1 where no face uses it."""
        return _lowest(self.face_vertices, self.vertex_count)

    @cached_property
    def vertex_face_count(self) -> IndexArray:
        """``(n_v,)`` faces at each vertex; in the interior this is the valence."""
        return np.bincount(self.face_vertices, minlength=self.vertex_count).astype(np.int32)

    @cached_property
    def open_fan_start(self) -> IndexArray:
        """``(n_v,)`` outgoing half-edge on the boundary, the most clockwise of each boundary vertex; -1 inside."""
        start = np.full(self.vertex_count, -1, dtype=np.int32)
        open_edges = np.flatnonzero(self.twin < 0)
        start[self.face_vertices[open_edges]] = open_edges
        return start

    @cached_property
    def is_boundary_vertex(self) -> NDArray[np.bool_]:
        """``(n_v,)`` whether a boundary edge ends at the vertex."""
        return self.ends_of(self.twin < 0)

    def ends_of(self, is_chosen: NDArray[np.bool_]) -> NDArray[np.bool_]:
        """``(n_v,)`` whether some half-edge begins or ends at the vertex; ``is_chosen`` says which half-edges count."""
        found = np.zeros(self.vertex_count, dtype=bool)
        half_edges = np.flatnonzero(is_chosen)
        found[self.face_vertices[half_edges]] = True
        found[self.face_vertices[self.following(half_edges)]] = True
        return found

    @cached_property
    def vertex_fans(self) -> tuple[IntArray, IndexArray]:
        """Outgoing half-edges of every interior vertex, counter-clockwise from its lowest.

        Returns
        -------
        offsets : (n_v + 1,) int64
        half_edges : (n,) int32
            Those of vertex ``v`` are ``offsets[v]`` up to ``offsets[v + 1]``; vertices on a boundary have none.
        """
        counts = np.where(self.is_boundary_vertex, 0, self.vertex_face_count)
        offsets = ragged.offsets(counts)
        half_edges = np.empty(offsets[-1], dtype=np.int32)
        for valence in np.unique(counts[counts > 0]):
            vertices = np.flatnonzero(counts == valence)
            current = self.vertex_half_edge[vertices]
            for turn in range(valence):
                half_edges[offsets[vertices] + turn] = current
                current = self.turn(current)
        return offsets, half_edges

    @cached_property
    def vertex_rules(self) -> NDArray[np.int8]:
        """``(n_v,)`` a `VertexRule` for each vertex."""
        return np.zeros(self.vertex_count, dtype=np.int8) if self.rules is None else self.rules

    def with_rules(self, rules: NDArray[np.int8] | None, semi_sharpness: SemiSharpness | None) -> Topology:
        """Same mesh with other rules; what was computed of its connectivity is kept."""
        same = Topology(self.vertex_count, self.face_sizes, self.face_vertices, self.edge_names, rules, semi_sharpness)
        for name, value in vars(self).items():
            if name not in ("rules", "vertex_rules", "semi_sharpness"):
                vars(same)[name] = value
        return same

    def half_edges_of(self, is_chosen: NDArray[np.bool_]) -> IntArray:
        """Half-edges of some faces, ascending; ``is_chosen`` says for each face whether it is one of these."""
        return np.flatnonzero(np.repeat(is_chosen, self.common_size or self.face_sizes))

    # Amid quadrilaterals only, what follows is computed: that is faster than to look it up, and tables are not made.

    def face_of(self, half_edges: HalfEdges) -> IndexArray:
        """`face` of some half-edges; computed wherever faces have the same size."""
        return half_edges // self.common_size if self.common_size else _looked_up(self.face, half_edges)

    def following(self, half_edges: HalfEdges) -> IndexArray:
        """`next` of some half-edges."""
        if self.common_size != 4:
            return _looked_up(self.next, half_edges)
        return (half_edges + 1) & 3 | half_edges & ~3

    def preceding(self, half_edges: HalfEdges) -> IndexArray:
        """`prev` of some half-edges."""
        if self.common_size != 4:
            return _looked_up(self.prev, half_edges)
        return (half_edges - 1) & 3 | half_edges & ~3

    def turn(self, half_edge: HalfEdges) -> IndexArray:
        """Outgoing half-edge of the same vertex in the next face counter-clockwise, -1 past a boundary."""
        return _looked_up(self.twin, self.preceding(half_edge))

    def turn_back(self, half_edge: HalfEdges) -> IndexArray:
        """Outgoing half-edge of the same vertex in the next face clockwise, -1 past a boundary."""
        beyond = _looked_up(self.twin, half_edge)
        # Of one half-edge, a number, no array of none.
        return np.where(beyond < 0, -1, self.following(beyond))[()]


def _looked_up(values: IndexArray, index: HalfEdges) -> IndexArray:
    """NumPy takes many faster than by brackets, one more slowly."""
    return gathered(values, index) if isinstance(index, np.ndarray) else values[index]


def _lowest(named: IndexArray, count: int) -> IndexArray:
    """``(count,)`` the first place of each number, -1 where it is missing."""
    first = np.full(count, -1, dtype=np.int32)
    # Of values for the same place, the last one stays.
    for run in reversed(list(runs_of(len(named)))):
        first[named[run][::-1]] = np.arange(run.stop - 1, run.start - 1, -1, dtype=np.int32)
    return first
