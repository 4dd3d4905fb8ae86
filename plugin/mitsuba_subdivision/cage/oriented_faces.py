"""Faces of a cage turned over and cut into an oriented manifold, with a warning or an error."""

from __future__ import annotations

import numpy as np

from ..mesh.connectivity import IntArray, Topology
from ..mesh.manifold import NonManifold, fan_counts, fan_labels, is_manifold, is_repeated, runs_with_twin, separated
from .errors import number_of, warn
from .source import CageSource

# A warning names this many things of a kind.
SHOWN = 3


def oriented_faces(
    given: Topology, source: CageSource, strict: bool
) -> tuple[Topology, NonManifold | None, IntArray | None]:
    """Turn over faces that are wound against their neighbours, and cut the mesh at non-manifold edges.

    Returns the topology, in which half-edges of non-manifold edges have no twin, and non-manifold vertices have several
    fans; where the faces are not a manifold, None if they are one everywhere; and, if faces were turned over, (n_h,)
    int64: which given face corner became each face corner of the topology.

    Raises CageError, with ``strict``, if a face has a vertex twice, an edge more than two faces, neighbouring faces are
    wound against each other, or the faces of a vertex are not one fan. Without, warns about faces that were turned
    over, and about edges and vertices that are non-manifold.
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
    separate, found = separated(topology)
    if found is None:
        return separate, None, order
    warn(_description(separate, found, source))
    return separate, found, order


def _description(topology: Topology, found: NonManifold, source: CageSource) -> str:
    """Text of the warning about non-manifold edges and vertices: how many of each kind, and the first of them."""
    t = topology
    repeats = np.unique(t.face[is_repeated(t)])
    half_edges = np.flatnonzero(found.is_edge & ~found.is_own_edge)
    # One half-edge of each edge.
    crowded = half_edges[np.unique(found.edge[half_edges], return_index=True)[1]]
    fans = np.flatnonzero(fan_counts(t, fan_labels(t)[1]) > 1)
    fans = fans[~t.ends_of(found.is_edge)[fans]]
    kinds = (
        ("edge", "of more than two faces, or of two in one direction", crowded, lambda edge: _edge_at(t, edge, source)),
        ("vertex", "between separate fans", fans, source.vertex),
        ("face", "with a vertex more than once", repeats, lambda face: source.faces(np.array([face]))),
    )
    parts = []
    for noun, what, indices, name in kinds:
        if count := len(indices):
            names = ", ".join(map(name, indices[:SHOWN].tolist()))
            parts.append(f"{number_of(count, noun)} {what} ({names}{', ...' if count > SHOWN else ''})")
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
    """Find an order of the face corners in which neighbouring faces are wound alike; None if they already are.

    Two faces are neighbours if they share an edge that no third face has. Of each connected piece the smaller part is
    turned; of two equal parts, the one without the piece's lowest face. A turned face keeps its first corner. Faces
    around a Möbius strip cannot all be wound alike; there as few neighbours as possible stay wound against each other.

    Returns (n_h,) int64: the present number of each corner of the new order.
    """
    t = topology
    one = np.flatnonzero((t.twin > np.arange(t.half_edge_count)) & (np.bincount(t.edge)[t.edge] == 2))
    other = t.twin[one]
    # An edge that joins a vertex to itself does not count, and a face that has an edge twice is no neighbour of itself.
    joins = (t.face[one] != t.face[other]) & (t.face_vertices[one] != t.face_vertices[t.next[one]])
    one, other = one[joins], other[joins]
    disagrees = t.face_vertices[one] == t.face_vertices[other]
    if not disagrees.any():
        return None
    from scipy import sparse
    from scipy.sparse.csgraph import connected_components, minimum_spanning_tree

    # A tree of neighbours over each piece, of as few that disagree as possible. Along a tree all can be made to agree.
    # SciPy before 1.16 takes graphs with indices of 32 bits only.
    first, second = np.sort(np.stack([t.face[one], t.face[other]]), axis=0).astype(np.int32)
    order = np.lexsort((disagrees, second, first))
    first, second, disagrees = first[order], second[order], disagrees[order]
    is_new = np.ones(len(order), dtype=bool)
    is_new[1:] = (np.diff(first) != 0) | (np.diff(second) != 0)
    count = t.face_count
    costs = (1 + disagrees[is_new], (first[is_new], second[is_new]))
    tree = minimum_spanning_tree(sparse.coo_array(costs, shape=(count, count))).tocoo()

    # A graph that has every face twice, as it is and turned. It joins neighbours that agree, both as they are or both
    # turned, and neighbours that disagree, one as it is to the other one turned.
    is_opposite = tree.data > 1
    starts = np.concatenate([tree.row, tree.row + count])
    ends = np.concatenate([tree.col + count * is_opposite, tree.col + count * ~is_opposite])
    graph = sparse.coo_array((np.ones(len(starts), dtype=bool), (starts, ends)), shape=(2 * count, 2 * count))
    as_is, turned = connected_components(graph, directed=False)[1].reshape(2, count)
    _, lowest, piece = np.unique(np.minimum(as_is, turned), return_index=True, return_inverse=True)
    is_turned = as_is != as_is[lowest][piece]
    is_turned ^= (2 * np.bincount(piece, is_turned) > np.bincount(piece))[piece]
    if not is_turned.any():
        return None
    found = np.arange(t.half_edge_count)
    corners = t.half_edges_of(is_turned)
    begin, size = t.face_offsets[t.face[corners]], t.face_sizes[t.face[corners]]
    found[corners] = begin + (size - (corners - begin)) % size
    return found
