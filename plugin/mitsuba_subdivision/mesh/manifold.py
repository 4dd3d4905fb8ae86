"""Non-manifold edges and vertices of a mesh, and their rules.

The rules are those of OpenSubdiv (`Vtr::Level::completeTopologyFromFaceVertices`, `orderVertexFacesAndEdges`,
`Far::TopologyRefinerFactoryBase::prepareComponentTagsAndSharpness`). Before they are applied, faces with a winding
opposite to their neighbours' are turned over (`turning_order`), which OpenSubdiv leaves to its users.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from .connectivity import IntArray, Topology
from .ragged import reversed_order, sorted_order

# Most corners of faces, all of one size, whose vertices are compared without sorting.
FEW_CORNERS = 8


@dataclass(frozen=True, eq=False)
class NonManifold:
    """Non-manifold edges and vertices, by the rules that `ControlCage` states."""

    # (n_h,) bool: whether the edge of each half-edge is non-manifold. These half-edges have no twins.
    is_edge: NDArray[np.bool_]
    # (n_h,) bool: whether the edge of each half-edge is non-manifold, but belongs to one face only. This includes edges
    # that join a vertex to itself, and the second occurrence of an edge in a face.
    has_one_face: NDArray[np.bool_]
    edge: NDArray[np.int32]  # (n_h,) int32: edge of each half-edge, equal for all between the same two vertices
    is_vertex: NDArray[np.bool_]  # (n_v,) bool: whether each vertex is non-manifold
    # (n_v,) bool: whether each vertex is on a crease of two non-manifold edges; other non-manifold vertices are corners
    is_crease: NDArray[np.bool_]
    closed_fans: IntArray  # (n,) int64: lowest half-edge of every closed fan at vertices with several fans

    @property
    def is_corner(self) -> NDArray[np.bool_]:
        """``(n_v,)`` non-manifold vertices that are corners."""
        return self.is_vertex & ~self.is_crease


def is_manifold(topology: Topology) -> bool:
    """Return whether a mesh is an oriented manifold, and no face has a vertex twice."""
    t, size = topology, topology.common_size
    if 0 < size <= FEW_CORNERS:
        corners = t.face_vertices.reshape(-1, size).T
        if any((corners[i] == corners[j]).any() for i in range(size) for j in range(i)):
            return False
    elif is_repeated(t).any():
        return False
    # An edge with twins accounts for two half-edges, an edge without for one.
    if 2 * t.edge_count - np.count_nonzero(t.twin < 0) != t.half_edge_count:
        return False
    return not runs_with_twin(t).any() and _has_single_fans(t)


def is_repeated(topology: Topology) -> NDArray[np.bool_]:
    """Return ``(n_h,)``: whether the vertex at each face corner is also at an earlier corner of the face."""
    t = topology
    # A (face, vertex) pair as one number.
    return is_later(t.face.astype(np.int64) * t.vertex_count + t.face_vertices)


def is_later(keys: IntArray) -> NDArray[np.bool_]:
    """Return whether an equal key precedes each key."""
    order, is_new = sorted_order(keys)
    later = np.empty(len(keys), dtype=bool)
    later[order] = ~is_new
    return later


def runs_with_twin(topology: Topology) -> NDArray[np.bool_]:
    """Return ``(n_h,)``: whether each half-edge has a twin with the same direction."""
    t = topology
    return (t.twin >= 0) & (t.face_vertices == t.face_vertices[t.twin])


def _has_single_fans(topology: Topology) -> bool:
    """Return whether the faces of each vertex form one fan, which ends after as many faces as the vertex has."""
    t = topology
    count = t.vertex_face_count
    start = np.where(t.open_fan_start < 0, t.vertex_half_edge, t.open_fan_start)[count > 0]
    current, count = start, count[count > 0]
    for faces in range(1, 1 + int(count.max(initial=0))):
        current = t.turn[current]
        ends = (current < 0) | (current == start)
        if (ends != (count == faces)).any():
            return False
        if ends.any():
            start, current, count = (values[~ends] for values in (start, current, count))
    return True


def fan_labels(topology: Topology) -> tuple[IntArray, NDArray[np.bool_]]:
    """Return ``(n_h,)`` labels, equal for corners of one fan only, and ``(n_h,)``, true at one corner of each fan.

    Uses pointer doubling: after ``r`` rounds each corner covers the next ``2**r`` corners counter-clockwise.
    """
    corners = np.arange(topology.half_edge_count)
    jump = topology.turn.copy()
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
    """Return ``(n_v,)`` number of fans at each vertex; ``is_first`` is true at one corner of each fan."""
    return np.bincount(topology.face_vertices[is_first], minlength=topology.vertex_count)


def separated(topology: Topology) -> tuple[Topology, NonManifold | None]:
    """Return the mesh with its non-manifold edges cut, and its `NonManifold`, None if the mesh is a manifold."""
    t = topology
    start, end = t.face_vertices, t.face_vertices[t.next]
    sides = np.bincount(t.edge, minlength=t.edge_count)
    is_loop = start == end
    is_second = is_later(t.edge.astype(np.int64) * t.face_count + t.face)
    is_non_manifold = np.zeros(t.edge_count, dtype=bool)
    is_non_manifold[t.edge[is_loop | is_second | runs_with_twin(t) | (sides[t.edge] > 2)]] = True
    edges = is_non_manifold[t.edge]
    face_count = sides - np.bincount(t.edge[is_second], minlength=t.edge_count)
    has_one_face = edges & (is_loop | is_second | (face_count[t.edge] == 1))

    separate = t
    if edges.any():
        names = t.edge.astype(np.int64)
        names[edges] = t.edge_count + np.arange(np.count_nonzero(edges))
        separate = Topology(t.vertex_count, t.face_sizes, t.face_vertices, names)
    fan, is_first = fan_labels(separate)
    vertices = fan_counts(t, is_first) > 1
    closed = np.flatnonzero(is_first & (separate.turn >= 0))
    closed = closed[vertices[start[closed]]]
    vertices[start[edges]] = vertices[end[edges]] = True
    if not vertices.any():
        return separate, None

    def edges_at(half_edges: IntArray) -> IntArray:
        """Return ``(n_v,)``: how many of some edges end at each vertex; ``half_edges`` has one of each edge."""
        return np.bincount(np.concatenate([start[half_edges], end[half_edges]]), minlength=t.vertex_count)

    edge_count = edges_at(t.edge_half_edge)
    creases = vertices & (edges_at(t.edge_half_edge[is_non_manifold]) == 2) & (t.vertex_face_count > edge_count)
    creases &= edges_at(np.flatnonzero(has_one_face | (separate.twin < 0) & ~edges)) == 0
    begins = np.flatnonzero(edges)
    returns_to_edge = t.edge[begins] == t.edge[t.prev[fan[begins]]]
    # Where some fans do not run along the crease, OpenSubdiv applies the crease mask; here the vertex is a corner.
    creases[start[begins[returns_to_edge]]] = creases[start[closed]] = False
    return separate, NonManifold(edges, has_one_face, t.edge, vertices, creases, closed)


def turning_order(topology: Topology) -> IntArray | None:
    """Find an order ``(n_h,)`` of the face corners with consistent winding; None if it is already consistent.

    Two faces are neighbours if they share an edge that no third face has. In each connected component the smaller part
    is turned over; of two equal parts, the one without the component's lowest face. A turned face keeps its first
    corner. Where there is no consistent winding, as on a Möbius strip, as few neighbours as possible are inconsistent.
    """
    t = topology
    one = np.flatnonzero((t.twin > np.arange(t.half_edge_count)) & (np.bincount(t.edge)[t.edge] == 2))
    other = t.twin[one]
    # Ignore edges that join a vertex to itself, and edges that a face has twice.
    joins = (t.face[one] != t.face[other]) & (t.face_vertices[one] != t.face_vertices[t.next[one]])
    one, other = one[joins], other[joins]
    disagrees = t.face_vertices[one] == t.face_vertices[other]
    if not disagrees.any():
        return None
    from scipy import sparse
    from scipy.sparse.csgraph import connected_components, minimum_spanning_tree

    # A spanning tree of each component with as few inconsistent edges as possible; along a tree all faces can be made
    # consistent. SciPy before 1.16 requires 32-bit indices.
    first, second = np.sort(np.stack([t.face[one], t.face[other]]), axis=0).astype(np.int32)
    order = np.lexsort((disagrees, second, first))
    first, second, disagrees = first[order], second[order], disagrees[order]
    is_new = (np.diff(first, prepend=-1) != 0) | (np.diff(second, prepend=-1) != 0)
    count = t.face_count
    costs = (1 + disagrees[is_new], (first[is_new], second[is_new]))
    tree = minimum_spanning_tree(sparse.coo_array(costs, shape=(count, count))).tocoo()

    # A graph with two nodes for each face, unturned and turned. Consistent neighbours are connected unturned to
    # unturned and turned to turned, inconsistent ones unturned to turned.
    is_opposite = tree.data > 1
    starts = np.concatenate([tree.row, tree.row + count])
    ends = np.concatenate([tree.col + count * is_opposite, tree.col + count * ~is_opposite])
    graph = sparse.coo_array((np.ones(len(starts), dtype=bool), (starts, ends)), shape=(2 * count, 2 * count))
    unturned, turned = connected_components(graph, directed=False)[1].reshape(2, count)
    _, lowest, component = np.unique(np.minimum(unturned, turned), return_index=True, return_inverse=True)
    is_turned = unturned != unturned[lowest][component]
    is_turned ^= (2 * np.bincount(component, is_turned) > np.bincount(component))[component]
    if not is_turned.any():
        return None
    return np.where(is_turned[t.face], reversed_order(t.face_sizes), np.arange(t.half_edge_count))
