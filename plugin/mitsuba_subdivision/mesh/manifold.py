"""Edges and vertices where a mesh is no oriented manifold, and their rules.

The rules are OpenSubdiv's (`Vtr::Level::completeTopologyFromFaceVertices`, `orderVertexFacesAndEdges`,
`Far::TopologyRefinerFactoryBase::prepareComponentTagsAndSharpness`). One step comes before them, which OpenSubdiv
leaves to its users: faces that are wound against their neighbours are turned (`orientation`).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from .connectivity import IntArray, Topology

# Faces with more corners than this are checked by sorting, vertices with more faces by pointer doubling.
FEW_CORNERS = 8
FEW_FACES = 200


@dataclass(frozen=True, eq=False)
class NonManifold:
    """Edges and vertices that are no oriented manifold.

    An edge is non-manifold if it has more than two faces, if its two faces run along it in the same direction, if one
    face has it twice, or if it joins a vertex to itself. Non-manifold edges are infinitely sharp. A vertex is
    non-manifold if it has such an edge or several fans. Then it is a corner, with one exception: a vertex of two
    non-manifold edges and three fans or more, each of which runs from one of these edges to the other, lies on a crease
    along the two.
    """

    # (n_h,) bool: whether each half-edge belongs to a non-manifold edge. None of these have twins.
    is_edge: NDArray[np.bool_]
    # (n_h,) bool: whether no other face shares the edge of each of these half-edges. An edge that joins a vertex to
    # itself is the face's own, and so is an edge that the face has a second time.
    is_own_edge: NDArray[np.bool_]
    # (n_h,) int32: A number for each half-edge that it shares with all half-edges between the same two vertices
    edge: NDArray[np.int32]
    is_vertex: NDArray[np.bool_]  # (n_v,) bool: whether each vertex is non-manifold
    # (n_v,) bool: whether it lies on a crease of two non-manifold edges; the other non-manifold vertices are corners
    is_crease: NDArray[np.bool_]
    closed_fans: IntArray  # (n,) int64: the lowest half-edge of every closed fan, at vertices of several fans

    @property
    def is_corner(self) -> NDArray[np.bool_]:
        """``(n_v,)`` whether each vertex is a corner because it is non-manifold."""
        return self.is_vertex & ~self.is_crease


def is_manifold(topology: Topology) -> bool:
    """Whether a mesh is an oriented manifold, where no face has a vertex twice."""
    t = topology
    if not _corners_differ(t):
        return False
    # An edge with a twin counts for two half-edges, one without for one.
    if 2 * t.edge_count - np.count_nonzero(t.twin < 0) != t.half_edge_count:
        return False
    return not runs_with_twin(t).any() and _has_single_fans(t)


def _corners_differ(topology: Topology) -> bool:
    """Whether no face has a vertex twice. Small faces that are all of one size are checked without sorting."""
    size = topology.common_size
    if not 0 < size <= FEW_CORNERS:
        return not is_repeated(topology).any()
    corners = topology.face_vertices.reshape(-1, size).T
    return not any((corners[i] == corners[j]).any() for i in range(size) for j in range(i))


def is_repeated(topology: Topology) -> NDArray[np.bool_]:
    """``(n_h,)`` whether the vertex at each face corner is also at an earlier corner of the face."""
    t = topology
    # Equal vertices of a face become neighbours when (face, vertex) pairs are sorted.
    return _is_later(t.face.astype(np.int64) * t.vertex_count + t.face_vertices)


def _is_later(keys: IntArray) -> NDArray[np.bool_]:
    """Whether an equal key precedes each key."""
    order = np.argsort(keys, kind="stable")
    later = np.zeros(len(keys), dtype=bool)
    later[order[1:]] = keys[order[1:]] == keys[order[:-1]]
    return later


def runs_with_twin(topology: Topology) -> NDArray[np.bool_]:
    """``(n_h,)`` whether each half-edge has a twin of the same direction."""
    t = topology
    return (t.twin >= 0) & (t.face_vertices == t.face_vertices[t.twin])


def _has_single_fans(topology: Topology) -> bool:
    """Whether the faces of each vertex are one fan.

    Turns about many vertices at once, by as many faces as each has. The fan must end then, and not before.
    """
    t = topology
    if t.vertex_face_count.max() > FEW_FACES:
        return not (fan_counts(t, fan_labels(t)[1]) > 1).any()
    count = t.vertex_face_count
    start = np.where(t.open_fan_start < 0, t.vertex_half_edge, t.open_fan_start)[count > 0]
    current, count = start, count[count > 0]
    for faces in range(1, 1 + int(count.max(initial=0))):
        current = t.turn(current)
        ends = (current < 0) | (current == start)
        if (ends != (count == faces)).any():
            return False
        if ends.any():
            start, current, count = (values[~ends] for values in (start, current, count))
    return True


def fan_labels(topology: Topology) -> tuple[IntArray, NDArray[np.bool_]]:
    """Number the fan of each face corner.

    Found by pointer doubling: after ``r`` rounds each corner knows of the next ``2**r`` corners counter-clockwise, so
    that a vertex of many faces takes a few rounds more, and not a walk around it.

    Returns (n_h,) int, equal for corners of one fan and different for others; and (n_h,) bool, true at one of each fan.
    """
    corners = np.arange(topology.half_edge_count)
    jump = topology.turn(corners)
    is_end = jump < 0
    jump[is_end] = corners[is_end]
    lowest = np.minimum(corners, jump)
    for _ in range(int(topology.vertex_face_count.max() - 1).bit_length()):
        lowest = np.minimum(lowest, lowest[jump])
        jump = jump[jump]
    # An open fan is labelled by its last corner, a closed one by its lowest.
    is_open = is_end[jump]
    return np.where(is_open, jump, lowest), np.where(is_open, is_end, lowest == corners)


def fan_counts(topology: Topology, is_first: NDArray[np.bool_]) -> IntArray:
    """``(n_v,)`` number of fans at each vertex, given where one corner of each fan is."""
    return np.bincount(topology.face_vertices[is_first], minlength=topology.vertex_count)


def separated(topology: Topology) -> tuple[Topology, NonManifold | None]:
    """The mesh with its non-manifold edges cut, and where it was no manifold; None if it was one."""
    t = topology
    start, end = t.face_vertices, t.face_vertices[t.next]
    sides = np.bincount(t.edge, minlength=t.edge_count)
    has_no_length = start == end
    is_again = _is_later(t.edge.astype(np.int64) * t.face_count + t.face)
    is_odd = np.zeros(t.edge_count, dtype=bool)
    is_odd[t.edge[has_no_length | is_again | runs_with_twin(t) | (sides[t.edge] > 2)]] = True
    edges = is_odd[t.edge]
    face_count = sides - np.bincount(t.edge[is_again], minlength=t.edge_count)
    is_own_edge = edges & (has_no_length | is_again | (face_count[t.edge] == 1))

    separate = t
    if edges.any():
        names = t.edge.astype(np.int64)
        names[edges] = t.edge_count + np.arange(np.count_nonzero(edges))
        separate = Topology(t.vertex_count, t.face_sizes, t.face_vertices, names)
    fan, is_first = fan_labels(separate)
    vertices = fan_counts(t, is_first) > 1
    closed = np.flatnonzero(is_first & (separate.turn(np.arange(t.half_edge_count)) >= 0))
    closed = closed[vertices[start[closed]]]
    vertices[start[edges]] = vertices[end[edges]] = True
    if not vertices.any():
        return separate, None

    def edges_at(half_edges: IntArray) -> IntArray:
        """``(n_v,)`` number of some edges that end at each vertex, given one half-edge of each edge."""
        return np.bincount(np.concatenate([start[half_edges], end[half_edges]]), minlength=t.vertex_count)

    edge_count = edges_at(t.edge_half_edge)
    creases = vertices & (edges_at(t.edge_half_edge[is_odd]) == 2) & (t.vertex_face_count > edge_count)
    creases &= edges_at(np.flatnonzero(is_own_edge | (separate.twin < 0) & ~edges)) == 0
    begins = np.flatnonzero(edges)
    comes_back = t.edge[begins] == t.edge[t.prev[fan[begins]]]
    # A vertex with fans that do not run along the crease moves along it in OpenSubdiv; here it stays.
    creases[start[begins[comes_back]]] = creases[start[closed]] = False
    return separate, NonManifold(edges, is_own_edge, t.edge, vertices, creases, closed)
