"""Half-edge connectivity of polygon meshes, built by sorting."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from enum import IntEnum
from functools import cached_property
from typing import Any, TypeVar, overload

import numpy as np
from numpy.typing import NDArray

from . import ragged
from .semi_sharpness import SemiSharpness

# Integers of any width; docstrings say which, where that matters.
IntArray = NDArray[np.integer]
# Numbers of half-edges, faces and edges: half the memory, and so, of large cages, half the time.
IndexArray = NDArray[np.int32]
# Half-edges: many, or one.
HalfEdges = NDArray[np.integer] | np.integer | int
HalfEdgeArray = TypeVar("HalfEdgeArray", bound=NDArray[np.integer])
# From one half-edge to another, -1 beyond a border.
Walk = Callable[[int], Any]

# Long arrays are worked on in runs of this many.
RUN = 1 << 14
# Meshes of so few half-edges keep lists for walks.
FEW_HALF_EDGES = 1 << 13


class VertexRule(IntEnum):
    """Which mask moves a vertex when the mesh is refined, where the faces around it do not tell.

    AUTOMATIC: the smooth mask inside the mesh, the crease mask on a border. CORNER: none, the vertex stays. DART: the
    smooth mask, though the crease that ends there is cut into two border edges.
    """

    AUTOMATIC = 0
    CORNER = 1
    DART = 2


def runs_of(count: int) -> Iterator[slice]:
    """Successive runs of ``count`` entries, each so short that what is computed for it stays in a core's cache."""
    for begin in range(0, count, RUN):
        yield slice(begin, min(begin + RUN, count))


def gathered(values: NDArray, indices: NDArray[np.integer]) -> NDArray:
    """``values[indices]``; an index that is out of range takes the first or the last value.

    Works in runs, because NumPy first converts indices to 64 bits, and those of one run stay in the cache.
    """
    if len(indices) <= RUN:
        return values.take(indices, mode="clip")
    found = np.empty(indices.shape, dtype=values.dtype)
    for run in runs_of(len(indices)):
        values.take(indices[run], out=found[run], mode="clip")
    return found


class Topology:
    """Faces of a polygon mesh and the half-edges that join them.

    Half-edge ``h`` runs from ``face_vertices[h]`` to the next vertex of the same face, so that half-edges and face
    corners (face-vertices) have the same numbers. Faces are counter-clockwise from outside. A half-edge has one twin at
    most, which runs in the opposite direction; one without a twin lies on a border. The faces of a vertex are one fan:
    they follow each other around it, from border to border or all around. Only the mesh that a control cage is made of
    may have vertices of several fans, until it is cut.

    Parameters
    ----------
    vertex_count : int
    face_sizes : (n_f,) int64
        Number of corners of each face.
    face_vertices : (n_h,) int32
        0-based vertices of all faces, one after the other.
    edge_names : (n_h,) int64, optional
        A number for each half-edge that it shares with its twin alone. By default half-edges between the same two
        vertices are twins. That does not do for a dual mesh, where two faces may meet along several edges.
    rules : (n_v,) int8, optional
        A `VertexRule` for each vertex. By default all are automatic.
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
        self.rules = rules
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
        """``(n_h,)`` the half-edge that follows each one in its face."""
        following = np.arange(1, self.half_edge_count + 1, dtype=np.int32)
        first, last = self._face_ends
        following[last] = following[first] - 1
        return following

    @cached_property
    def prev(self) -> IndexArray:
        """``(n_h,)`` the half-edge that precedes each one in its face."""
        preceding = np.arange(-1, self.half_edge_count - 1, dtype=np.int32)
        first, last = self._face_ends
        preceding[first] = preceding[last] + 1
        return preceding

    @property
    def _face_ends(self) -> tuple[slice, slice] | tuple[IntArray, IntArray]:
        """First and last half-edge of each face that has half-edges."""
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
        """Runs of half-edges, with a number for each half-edge that it shares with its twin alone."""
        for run in runs_of(self.half_edge_count):
            if self.edge_names is not None:
                yield run, self.edge_names[run]
                continue
            start = self.face_vertices[run]
            end = self.face_vertices.take(self.following(np.arange(run.start, run.stop, dtype=np.int32)))
            high = np.maximum(start, end).astype(np.int64)
            # Pairs are numbered as in a triangle with a row for each higher end: one bit less than a square would take.
            yield run, (high * (high + 1) >> 1) + np.minimum(start, end)

    @cached_property
    def _edges(self) -> tuple[IndexArray, IndexArray, int]:
        """Edge and twin of each half-edge, and the number of edges; found together, as all need the sorted order."""
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
        """``(n_h,)`` half-edge of the neighbouring face along the same edge, -1 on a border."""
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
        """``(n_v,)`` outgoing half-edge on the border, the most clockwise one of each border vertex; -1 inside."""
        start = np.full(self.vertex_count, -1, dtype=np.int32)
        open_edges = np.flatnonzero(self.twin < 0)
        start[self.face_vertices[open_edges]] = open_edges
        return start

    @cached_property
    def is_border_vertex(self) -> NDArray[np.bool_]:
        """``(n_v,)`` whether a border edge ends at the vertex."""
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
            Those of vertex ``v`` are ``offsets[v]`` up to ``offsets[v + 1]``; vertices on a border have none.
        """
        counts = np.where(self.is_border_vertex, 0, self.vertex_face_count)
        offsets = ragged.offsets(counts)
        half_edges = np.empty(offsets[-1], dtype=np.int32)
        for valence in 1 + np.flatnonzero(np.bincount(counts)[1:]):
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
        """The same mesh with other rules. It shares all that has been computed of the connectivity."""
        same = Topology(self.vertex_count, self.face_sizes, self.face_vertices, self.edge_names, rules, semi_sharpness)
        for name, value in vars(self).items():
            if name not in ("rules", "vertex_rules", "semi_sharpness"):
                vars(same)[name] = value
        return same

    def half_edges_of(self, is_chosen: NDArray[np.bool_]) -> IntArray:
        """Half-edges of some faces in ascending order; ``is_chosen`` says which faces."""
        return np.flatnonzero(np.repeat(is_chosen, self.common_size or self.face_sizes))

    # In large meshes where all faces are quadrilaterals, these are computed. That is faster than to look them up, and
    # saves the tables. In small ones, what takes time is the number of operations.

    @cached_property
    def _is_computed(self) -> bool:
        return self.common_size == 4 and self.half_edge_count > RUN

    @overload
    def face_of(self, half_edges: np.integer | int) -> np.integer | int: ...
    @overload
    def face_of(self, half_edges: HalfEdgeArray) -> HalfEdgeArray: ...
    def face_of(self, half_edges: HalfEdges) -> HalfEdges:
        """`face` of some half-edges."""
        return half_edges // self.common_size if self.common_size else _looked_up(self.face, half_edges)

    @overload
    def following(self, half_edges: np.integer | int) -> np.integer | int: ...
    @overload
    def following(self, half_edges: HalfEdgeArray) -> HalfEdgeArray: ...
    def following(self, half_edges: HalfEdges) -> HalfEdges:
        """`next` of some half-edges."""
        if not self._is_computed:
            return _looked_up(self.next, half_edges)
        return (half_edges + 1) & 3 | half_edges & ~3

    @overload
    def preceding(self, half_edges: np.integer | int) -> np.integer | int: ...
    @overload
    def preceding(self, half_edges: HalfEdgeArray) -> HalfEdgeArray: ...
    def preceding(self, half_edges: HalfEdges) -> HalfEdges:
        """`prev` of some half-edges."""
        if not self._is_computed:
            return _looked_up(self.prev, half_edges)
        return (half_edges - 1) & 3 | half_edges & ~3

    def turn(self, half_edge: HalfEdges) -> IndexArray:
        """Outgoing half-edge of the same vertex in the next face counter-clockwise; -1 beyond a border."""
        if self._is_computed:
            return _looked_up(self.twin, self.preceding(half_edge))
        return _looked_up(self._turned, half_edge)

    @cached_property
    def _turned(self) -> IndexArray:
        """``(n_h,)`` `turn` of each half-edge: looked up several times for each."""
        return gathered(self.twin, self.prev)

    def turn_back(self, half_edge: HalfEdges) -> IndexArray:
        """Outgoing half-edge of the same vertex in the next face clockwise; -1 beyond a border."""
        beyond = _looked_up(self.twin, half_edge)
        # The brackets make a number of an array without dimensions, which one half-edge leads to.
        return np.where(beyond < 0, -1, self.following(beyond))[()]

    def walks(self) -> tuple[Walk, Walk, Walk]:
        """`turn`, `turn_back` and `following`, for one half-edge at a time."""
        if self.half_edge_count > FEW_HALF_EDGES:
            return self.turn, self.turn_back, self.following
        turn, turn_back, following = self._walk_lists
        return turn.__getitem__, turn_back.__getitem__, following.__getitem__

    @cached_property
    def _walk_lists(self) -> tuple[list[int], list[int], list[int]]:
        """``(n_h,)`` where `walks` lead from each half-edge; lists are faster than arrays for one at a time."""
        every = np.arange(self.half_edge_count, dtype=np.int32)
        return self.turn(every).tolist(), self.turn_back(every).tolist(), self.following(every).tolist()


def _looked_up(values: IndexArray, index: HalfEdges) -> IndexArray:
    """``values[index]``: NumPy's ``take`` is faster than brackets for many indices, but slower for one."""
    return gathered(values, index) if isinstance(index, np.ndarray) else values[index]


def _lowest(named: IndexArray, count: int) -> IndexArray:
    """``(count,)`` the first place at which each number from 0 on stands, -1 for a number that is missing."""
    first = np.full(count, -1, dtype=np.int32)
    # Written backwards, as the last value written to a place stays.
    for run in reversed(list(runs_of(len(named)))):
        first[named[run][::-1]] = np.arange(run.stop - 1, run.start - 1, -1, dtype=np.int32)
    return first
