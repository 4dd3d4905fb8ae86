"""Masks at borders, creases, corners and semi-sharp features, and their refinement, for Catmull-Clark and Loop.

A mask is the set of weights of coarse vertices for a refined vertex. The mask of a vertex depends on its number of
sharp edges; a border edge is sharp.

================  ======================================  ==================================
vertex            sharp edges                             mask
================  ======================================  ==================================
smooth            none                                    the scheme's smooth mask
dart              one                                     the scheme's smooth mask
crease            two, with the far ends ``a`` and ``b``  ``(6 S + a + b) / 8``
corner            three or more, or the vertex is sharp   ``S``: the vertex stays
================  ======================================  ==================================

The edge point of a sharp edge is its midpoint, if both halves of the edge stay sharp. Where edges or the vertex become
smooth in a refinement, the masks before and after it are blended. The weight of the mask before is the mean sharpness
of these features [DeRose et al. 1998; Hoppe et al. 1994].

OpenSubdiv computes the same (`Sdc::Crease`, `Sdc::Scheme`, `Vtr::Refinement`). Chaikin's method may make an edge with a
sharpness above one smooth; the weight of its midpoint is then above one, as in OpenSubdiv.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..mesh.connectivity import IntArray, Topology, VertexRule
from ..mesh.sharpness import CreaseMethod, SemiSharpness
from .domain import FloatArray

# Weight of each of the two neighbours in the crease mask.
CREASE_NEIGHBOUR = 1 / 8


@dataclass(frozen=True, eq=False)
class CreaseMasks:
    """Masks of all vertices and edges: the scheme's smooth masks times a factor, plus further weights."""

    smooth: FloatArray  # (n_v,) float64: factor of the scheme's smooth mask in the mask of each vertex
    at_vertex: FloatArray  # (n_v,) float64: further weight of the vertex itself
    # (m,) int64 and (m,) float64: further weights of neighbours: of vertex ``columns`` in the mask of vertex ``rows``
    rows: IntArray
    columns: IntArray
    weights: FloatArray
    # (n_h,) float64: factor of the midpoint in the edge point of each half-edge; that of the scheme's smooth mask is
    # one minus this. Equal for both half-edges of an edge, 1 on borders.
    midpoint: FloatArray


def crease_masks(topology: Topology) -> CreaseMasks:
    """Compute the masks of all vertices and edges of a mesh."""
    t, semi = topology, topology.semi_sharpness
    border = t.twin < 0
    # Edges at each vertex: the outgoing half-edges, and the last edge of an open fan, whose half-edge ends there.
    origin, end = t.face_vertices, t.face_vertices[t.next]
    centre = np.concatenate([origin, end[border]])
    far = np.concatenate([end, origin[border]])
    infinite = np.concatenate([border, np.ones(np.count_nonzero(border), dtype=bool)])
    no_vertices, no_edges = np.zeros(t.vertex_count, dtype=bool), np.zeros(0, dtype=np.int64)
    if semi is None:
        before = _vertex_masks(t, centre, infinite, infinite, no_vertices, no_edges)
        return _blended([(before, np.ones(t.vertex_count))], centre, far, border.astype(float))

    of_borders = np.zeros(np.count_nonzero(border))
    sharpness, refined = (np.concatenate([edges, of_borders]) for edges in (semi.edges, semi.edges_refined))
    across, across_sharpness = semi.across_vertex[semi.across_sharpens], semi.across_sharpness[semi.across_sharpens]
    across_refined = semi.across_refined[semi.across_sharpens]
    before = _vertex_masks(
        t, centre, infinite, infinite | (sharpness > 0), semi.vertices > 0, across[across_sharpness > 0]
    )
    after = _vertex_masks(
        t, centre, infinite, infinite | (refined > 0), semi.vertices_refined > 0, across[across_refined > 0]
    )

    # The mean sharpness of all features that become smooth. With Chaikin's method their sharpness may exceed 1, and in
    # meshes cut along seams so may the mean.
    vertex = np.concatenate([centre, np.arange(t.vertex_count), across])
    sharpness_before = np.concatenate([sharpness, semi.vertices, across_sharpness])
    becomes_smooth = (sharpness_before > 0) & (np.concatenate([refined, semi.vertices_refined, across_refined]) == 0)
    count = np.bincount(vertex[becomes_smooth], minlength=t.vertex_count)
    total = np.bincount(vertex[becomes_smooth], sharpness_before[becomes_smooth], minlength=t.vertex_count)
    weight_before = np.minimum(total / np.maximum(count, 1), 1)
    weight_before[(before[0] == after[0]) | (before[0] < 2)] = 1

    twin_refined = semi.edges_refined[np.maximum(t.twin, 0)]
    stays_sharp = border | ((semi.edges_refined > 0) & (twin_refined > 0))
    shares = [(before, weight_before), (after, 1 - weight_before)]
    return _blended(shares, centre, far, np.where(stays_sharp, 1, semi.edges))


def _vertex_masks(
    t: Topology,
    centre: IntArray,  # (n,) int: the vertex of each pair of a vertex and an edge at it
    infinite: NDArray[np.bool_],  # (n,) bool: whether the edge of each pair is infinitely sharp
    sharp: NDArray[np.bool_],  # (n,) bool: whether it is infinitely sharp or semi-sharp
    sharp_vertices: NDArray[np.bool_],  # (n_v,) bool: semi-sharp vertices
    across: IntArray,  # (m,) int: the vertex of each semi-sharp edge across the cut that sharpens it
) -> tuple[IntArray, FloatArray]:
    """Determine the mask of every vertex, before or after a refinement.

    Returns (n_v,) int64, the number of sharp edges at each vertex: 0 or 1 for the smooth mask, 2 for the crease mask, 3
    for the corner mask. It is also 3 for more edges and for other corners. And (n,) float64, for each pair 1 if the
    edge is sharp and 0 if not. The sharp edge of a dart is cut into two border edges, which count 1/2 each.
    """
    along = sharp.astype(float)
    along[infinite & (t.vertex_rules == VertexRule.DART)[centre]] = 0.5
    count = np.rint(np.bincount(centre, along, minlength=t.vertex_count)).astype(np.int64)
    count += np.bincount(across, minlength=t.vertex_count)
    stays = (t.vertex_rules == VertexRule.CORNER) | (t.vertex_half_edge < 0) | sharp_vertices
    return np.where(stays, 3, np.minimum(count, 3)), along


def _blended(
    shares: list[tuple[tuple[IntArray, FloatArray], FloatArray]], centre: IntArray, far: IntArray, midpoint: FloatArray
) -> CreaseMasks:
    """Blend the masks before and after a refinement with their weights at each vertex, which sum to one."""
    smooth, at_vertex = np.zeros((2, len(shares[0][1])))
    rows, columns, weights = [], [], []
    for (sharp_count, along), share in shares:
        smooth += share * (sharp_count < 2)
        # The vertex's weight beside the smooth mask (none), in the crease mask and in the corner mask.
        at_vertex += share * np.array([0, 0, 1 - 2 * CREASE_NEIGHBOUR, 1])[sharp_count]
        creased = np.flatnonzero((along > 0) & (sharp_count == 2)[centre] & (share > 0)[centre])
        rows.append(centre[creased])
        columns.append(far[creased])
        weights.append(CREASE_NEIGHBOUR * along[creased] * share[centre[creased]])
    return CreaseMasks(
        smooth, at_vertex, np.concatenate(rows), np.concatenate(columns), np.concatenate(weights), midpoint
    )


def kept_rules(topology: Topology, new_count: int) -> NDArray[np.int8] | None:
    """Return the vertex rules after a refinement that keeps the vertices and appends new ones."""
    if topology.rules is None:
        return None
    return np.concatenate([topology.rules, np.zeros(new_count, dtype=np.int8)])


def kept_sharpness(
    topology: Topology,
    # (n_h',) int: `Topology.face_vertices` of the refined mesh. The faces at coarse corners come first, each listed
    # from the coarse vertex on.
    face_vertices: NDArray[np.integer],
    # Index of the last edge in each of these faces. The first and the last edge are halves of coarse edges.
    last: int,
    new_count: int,  # Number of appended vertices
    method: CreaseMethod,
) -> SemiSharpness | None:
    """Return the semi-sharp features after a refinement that keeps the vertices and creates a face at every corner."""
    semi, t = topology.semi_sharpness, topology
    if semi is None:
        return None
    edges = np.zeros(len(face_vertices))
    corners = edges[: t.half_edge_count * (last + 1)].reshape(t.half_edge_count, last + 1)
    corners[:, 0] = semi.edges_refined
    ahead = t.turn(np.arange(t.half_edge_count))
    corners[:, last] = np.where(ahead < 0, 0, semi.edges_refined[ahead])
    return semi.refined(face_vertices, edges, new_count, method)
