"""Edges, triangles and the Laplacian of a cage's own mesh, for fitting."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from ..mesh import ragged
from ..mesh.connectivity import IndexArray, Topology
from .validation import read_only

if TYPE_CHECKING:
    from scipy import sparse


def edges_of(topology: Topology) -> IndexArray:
    """``(n_e, 2)`` int32 ends of each edge, once, the lower number first; sorted by the higher one, then the lower.

    Edges between the same two vertices count as one, as where a mesh is no manifold.
    """
    start, end = topology.face_vertices, topology.face_vertices[topology.next]
    low, high = np.minimum(start, end).astype(np.int64), np.maximum(start, end).astype(np.int64)
    keys = np.unique(high * topology.vertex_count + low)
    high, low = np.divmod(keys, topology.vertex_count)
    return read_only(np.stack([low, high], axis=1).astype(np.int32))


def triangles_of(topology: Topology) -> IndexArray:
    """``(n, 3)`` int32 vertices of triangles that fan out from each face's first vertex, in the order of the faces."""
    counts = topology.face_sizes - 2
    first = np.repeat(topology.face_offsets[:-1], counts)
    step = first + ragged.index_in_row(counts)
    return read_only(topology.face_vertices[np.stack([first, step + 1, step + 2], axis=1)])


def laplacian_of(edges: IndexArray, vertex_count: int) -> sparse.csr_array:
    """``(n_v, n_v)`` Laplacian of a graph: the number of neighbours on the diagonal, -1 for each neighbour."""
    from scipy import sparse

    one, other = edges[edges[:, 0] != edges[:, 1]].T
    rows, columns = np.concatenate([one, other]), np.concatenate([other, one])
    shape = vertex_count, vertex_count
    adjacency = sparse.coo_array((np.ones(len(rows)), (rows, columns)), shape=shape).tocsr()
    return sparse.csr_array(sparse.diags_array(adjacency.sum(axis=1)) - adjacency)
