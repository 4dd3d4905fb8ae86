"""Masks at borders, creases, corners and semi-sharp features, and their refinement, for Catmull-Clark and Loop.

A mask is the set of weights of coarse vertices for a refined vertex. That of a vertex depends on its number of sharp
edges; a border edge is sharp. Where edges or the vertex become smooth in a refinement, the masks before and after it
are blended. Sections 10 and 11 of plugin/MATHEMATICS.md have the masks and the blend. OpenSubdiv computes the same
(`Sdc::Crease`, `Sdc::Scheme`, `Vtr::Refinement`).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ..mesh.connectivity import CreaseMethod, IntArray, SemiSharpness, Topology, VertexRule
from .domain import FloatArray

CREASE_NEIGHBOUR = 1 / 8  # Weight of each of the two neighbours in the crease mask


def crease_masks(
    topology: Topology,
) -> tuple[FloatArray, FloatArray, tuple[IntArray, IntArray, FloatArray], FloatArray]:
    """Compute the masks of all vertices and edges of a mesh: a factor of the scheme's smooth masks, and more weights.

    Returns, for each vertex, the factor of the smooth mask, and a further weight of the vertex itself; further weights
    of neighbours, as vertices, neighbours and weights; and for each half-edge, the factor of the midpoint in the edge
    point. That of the smooth mask is one minus this. It is equal for both half-edges of an edge, and 1 on borders.
    """
    t, semi = topology, topology.semi_sharpness
    border = t.twin < 0
    # Edges at each vertex: the outgoing half-edges, and the last edge of an open fan, whose half-edge ends there.
    origin, end = t.face_vertices, t.face_vertices[t.next]
    centre, far = np.concatenate([origin, end[border]]), np.concatenate([end, origin[border]])
    infinite = np.concatenate([border, np.ones(np.count_nonzero(border), dtype=bool)])
    # Sharpness of these edges, of vertices, and of edges across cuts that sharpen a vertex. There is a row for the
    # masks before a refinement and, with semi-sharp features, one for those after it.
    row_count = 1 if semi is None else 2
    edges, vertices = np.zeros((row_count, len(centre))), np.zeros((row_count, t.vertex_count))
    across_vertex: IntArray = np.zeros(0, dtype=np.int64)
    across = np.zeros((row_count, 0))
    if semi is not None:
        edges[:, : t.half_edge_count] = semi.edges, semi.edges_refined
        vertices[:] = semi.vertices, semi.vertices_refined
        across_vertex = semi.across_vertex[semi.across_sharpens]
        across = np.stack([semi.across_sharpness, semi.across_refined])[:, semi.across_sharpens]

    # 1 for a sharp edge, 0 for others. The sharp edge of a dart is cut into two border edges, which count 1/2 each.
    along = (infinite | (edges > 0)).astype(float)
    along[:, infinite & (t.vertex_rules == VertexRule.DART)[centre]] = 0.5
    counts = [
        np.rint(np.bincount(centre, sharp_edges, minlength=t.vertex_count))
        + np.bincount(across_vertex, sharpness > 0, minlength=t.vertex_count)
        for sharp_edges, sharpness in zip(along, across, strict=True)
    ]
    is_corner = (t.vertex_rules == VertexRule.CORNER) | (t.vertex_half_edge < 0) | (vertices > 0)
    # Number of sharp edges at each vertex: 0 or 1 for the smooth mask, 2 for the crease mask, 3 for the corner mask.
    sharp_count = np.where(is_corner, 3, np.minimum(counts, 3)).astype(np.int64)

    share, midpoint = np.ones(sharp_count.shape), border.astype(float)
    if semi is not None:
        # Mean sharpness of all that becomes smooth. With Chaikin's method it may exceed 1.
        before, after = np.concatenate([edges, vertices, across], axis=1)
        is_smoothed = (before > 0) & (after == 0)
        at = np.concatenate([centre, np.arange(t.vertex_count), across_vertex])[is_smoothed]
        count = np.bincount(at, minlength=t.vertex_count)
        total = np.bincount(at, before[is_smoothed], minlength=t.vertex_count)
        share[0] = np.minimum(total / np.maximum(count, 1), 1)
        share[0, (sharp_count[0] == sharp_count[1]) | (sharp_count[0] < 2)] = 1
        share[1] = 1 - share[0]
        stays_sharp = (semi.edges_refined > 0) & (semi.edges_refined[np.maximum(t.twin, 0)] > 0)
        midpoint = np.where(border | stays_sharp, 1, semi.edges)
    smooth = (share * (sharp_count < 2)).sum(axis=0)
    # The vertex's weight beside the smooth mask (none), in the crease mask and in the corner mask.
    at_vertex = (share * np.array([0, 0, 1 - 2 * CREASE_NEIGHBOUR, 1])[sharp_count]).sum(axis=0)
    row, edge = np.nonzero((along > 0) & ((sharp_count == 2) & (share > 0))[:, centre])
    weights = CREASE_NEIGHBOUR * along[row, edge] * share[row, centre[edge]]
    return smooth, at_vertex, (centre[edge], far[edge], weights), midpoint


def kept_sharpness(
    topology: Topology,
    face_vertices: NDArray[np.integer],  # (n_h',) int: `Topology.face_vertices` of the refined mesh
    last: int,  # Index of the last edge in each of the faces at coarse corners
    new_count: int,  # Number of appended vertices
    method: CreaseMethod,
) -> SemiSharpness | None:
    """Return the semi-sharp features after a refinement that keeps the vertices and creates a face at every corner.

    These faces come first, from the coarse vertex on. Their first and last edges are halves of coarse ones.
    """
    semi, t = topology.semi_sharpness, topology
    if semi is None:
        return None
    edges = np.zeros(len(face_vertices))
    corners = edges[: t.half_edge_count * (last + 1)].reshape(t.half_edge_count, last + 1)
    corners[:, 0] = semi.edges_refined
    corners[:, last] = np.where(t.turn < 0, 0, semi.edges_refined[t.turn])
    return semi.refined(face_vertices, edges, new_count, method)
