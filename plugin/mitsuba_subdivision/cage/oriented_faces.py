"""Orientation of the faces of a cage, and cuts at non-manifold edges, with warnings or errors."""

from __future__ import annotations

import numpy as np

from ..mesh.connectivity import IntArray, Topology
from ..mesh.manifold import NonManifold, fan_counts, fan_labels, is_manifold, is_repeated, runs_with_twin, separated
from .errors import CageSource, number_of, warn

# Maximum number of items of a kind that a message names.
SHOWN = 3


def oriented_faces(
    given: Topology, source: CageSource, strict: bool
) -> tuple[Topology, NonManifold | None, IntArray | None]:
    """Turn over faces with a winding opposite to their neighbours', and cut the mesh at non-manifold edges.

    Returns the topology, in which half-edges of non-manifold edges have no twin, and vertices may have several fans;
    non-manifold edges and vertices, None for a manifold; and, if faces were turned over, (n_h,) int64, the given face
    corner of each face corner of the topology.

    With ``strict``, raises CageError if a face has a vertex twice, an edge has more than two faces, neighbouring faces
    have opposite windings, or the faces of a vertex are not one fan. Without ``strict``, warns about faces that were
    turned over, and about non-manifold edges and vertices.
    """
    if is_manifold(given):
        return given, None, None
    if strict:
        _require_distinct_corners(given, source)
        _require_two_faces(given, source)
        _require_opposite_directions(given, source)
        _require_single_fans(given, source)
    topology, order = given, turning_order(given)
    if order is not None:
        topology = Topology(given.vertex_count, given.face_sizes, given.face_vertices[order])
        turned = np.unique(given.face[order != np.arange(len(order))])
        warn(
            f"{source.name}: {len(turned)} of {number_of(given.face_count, 'face')} turned over, as they were wound "
            f"against their neighbours: {source.faces(turned, SHOWN)} (numbers count from {source.index_base})"
        )
    separate, non_manifold = separated(topology)
    if non_manifold is None:
        return separate, None, order
    warn(_description(separate, non_manifold, source))
    return separate, non_manifold, order


def _description(topology: Topology, non_manifold: NonManifold, source: CageSource) -> str:
    """Return the warning about non-manifold edges and vertices: the number of each kind, and the first ones."""
    t = topology
    repeats = np.unique(t.face[is_repeated(t)])
    half_edges = np.flatnonzero(non_manifold.is_edge & ~non_manifold.is_own_edge)
    # One half-edge of each edge.
    crowded = half_edges[np.unique(non_manifold.edge[half_edges], return_index=True)[1]]
    pinched = np.flatnonzero(fan_counts(t, fan_labels(t)[1]) > 1)
    pinched = pinched[~t.ends_of(non_manifold.is_edge)[pinched]]
    kinds = (
        ("edge", "of more than two faces, or of two in one direction", crowded, lambda edge: _edge_at(t, edge, source)),
        ("vertex", "between separate fans", pinched, source.vertex),
        ("face", "with a vertex more than once", repeats, lambda face: source.faces(np.array([face]))),
    )
    parts = []
    for noun, problem, indices, name in kinds:
        if count := len(indices):
            names = ", ".join(map(name, indices[:SHOWN].tolist()))
            parts.append(f"{number_of(count, noun)} {problem} ({names}{', ...' if count > SHOWN else ''})")
    return (
        f"{source.name}: the faces are no manifold: {'; '.join(parts)}. Such edges are infinitely sharp, and such "
        "vertices are corners or lie on creases along these edges, as in OpenSubdiv; strict makes this an error "
        f"(numbers count from {source.index_base})"
    )


def _require_distinct_corners(topology: Topology, source: CageSource) -> None:
    t = topology
    repeated = np.flatnonzero(is_repeated(t))
    if len(repeated):
        faces = np.unique(t.face[repeated])
        first = repeated[t.face[repeated] == faces[0]]
        problem = f"has {source.vertex(t.face_vertices[first].min())} more than once"
        raise source.error(source.at_face(faces[0]), problem, "distinct vertices", len(faces), "face")


def _require_two_faces(topology: Topology, source: CageSource) -> None:
    t = topology
    crowded = np.flatnonzero(np.bincount(t.edge) > 2)
    if len(crowded):
        half_edges = np.flatnonzero(t.edge == crowded[0])
        faces = t.face[half_edges]
        problem = f"is one of {len(faces)} at {_edge_at(t, half_edges[0], source)}: {source.faces(faces)}"
        expected = "a manifold surface, at most 2 faces at an edge"
        raise source.error(source.at_face(faces[0]), problem, expected, len(crowded), "edge")


def _require_opposite_directions(topology: Topology, source: CageSource) -> None:
    t = topology
    same_way = np.flatnonzero(runs_with_twin(t))
    if len(same_way):
        first = same_way[0]
        neighbour = source.faces(t.face[t.twin[[first]]])
        problem = f"and {neighbour} both run along {_edge_at(t, first, source)} in this direction"
        expected = "opposite directions, all faces counter-clockwise from outside"
        raise source.error(source.at_face(t.face[first]), problem, expected, len(same_way) // 2, "edge")


def _require_single_fans(topology: Topology, source: CageSource) -> None:
    t = topology
    fan, is_first = fan_labels(t)
    pinched = np.flatnonzero(fan_counts(t, is_first) > 1)
    if len(pinched):
        corners = np.flatnonzero(t.face_vertices == pinched[0])
        labels = np.unique(fan[corners])
        fans = [source.faces(t.face[corners[fan[corners] == label]]) for label in labels[:SHOWN]]
        more = " | ..." if len(labels) > SHOWN else ""
        problem = f"joins {len(labels)} separate fans: " + " | ".join(fans) + more
        expected = "one fan of faces around a vertex"
        raise source.error(source.at_vertex(pinched[0]), problem, expected, len(pinched), "vertex")


def _edge_at(topology: Topology, half_edge: int, source: CageSource) -> str:
    start, end = topology.face_vertices[[half_edge, topology.next[half_edge]]]
    return source.edge(start, end)


def turning_order(topology: Topology) -> IntArray | None:
    """Find an order of the face corners with consistent winding; None if the winding is already consistent.

    Two faces are neighbours if they share an edge that no third face has. In each connected component the smaller part
    is turned over; of two equal parts, the one without the component's lowest face. A turned face keeps its first
    corner. Faces around a Möbius strip have no consistent winding; there as few pairs of neighbours as possible remain
    inconsistent.

    Returns (n_h,) int64: the present index of each corner of the new order.
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
    is_new = np.ones(len(order), dtype=bool)
    is_new[1:] = (np.diff(first) != 0) | (np.diff(second) != 0)
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
    corner_order = np.arange(t.half_edge_count)
    corners = t.half_edges_of(is_turned)
    begin, size = t.face_offsets[t.face[corners]], t.face_sizes[t.face[corners]]
    corner_order[corners] = begin + (size - (corners - begin)) % size
    return corner_order
