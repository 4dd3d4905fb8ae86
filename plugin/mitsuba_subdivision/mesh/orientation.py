"""Turning faces that are wound against their neighbours."""

from __future__ import annotations

import numpy as np

from .connectivity import IntArray, Topology


def turning_order(topology: Topology) -> IntArray | None:
    """Find an order of the face corners in which neighbouring faces are wound alike; None if they already are.

    Two faces are neighbours if they share an edge that no third face has. Of each connected piece the smaller part is
    turned; of two equal parts, the one without the piece's lowest face. A turned face keeps its first corner. Faces
    around a Möbius strip cannot all be wound alike; there as few neighbours as possible stay wound against each other.

    Returns
    -------
    (n_h,) int64
        The present number of each corner of the new order.
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
