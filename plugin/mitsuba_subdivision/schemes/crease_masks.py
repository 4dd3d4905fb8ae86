"""Masks at borders, creases, corners and semi-sharp features, which Catmull-Clark and Loop have in common.

A mask is the set of weights that makes a refined vertex of vertices before. The mask of a vertex depends on the sharp
edges that meet there; an edge on the border is sharp.

================  ======================================  ==================================
vertex            sharp edges there                       mask
================  ======================================  ==================================
smooth            none                                    the scheme's own
dart              one                                     the scheme's own
crease            two, with the far ends ``a`` and ``b``  ``(6 S + a + b) / 8``
corner            three or more, or the vertex is sharp   ``S``: the vertex stays
================  ======================================  ==================================

The point of a sharp edge is its midpoint, if both halves of the edge stay sharp. Where a refinement makes something
smooth, the masks before and after it are blended: the share of the masks before is the mean
sharpness of what becomes smooth there [DeRose et al. 1998; Hoppe et al. 1994].

OpenSubdiv computes the same (`Sdc::Crease`, `Sdc::Scheme`, `Vtr::Refinement`), also where Chaikin's method makes an
edge of a sharpness above one smooth: the share of the midpoint is then above one, too.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..mesh.connectivity import IntArray, Topology, VertexRule
from .domain import FloatArray

# Weight of each of the two neighbours in the crease mask.
CREASE_NEIGHBOUR = 1 / 8


@dataclass(frozen=True, eq=False)
class CreaseMasks:
    """Masks of all vertices and edges, as shares of the scheme's smooth masks and weights besides."""

    smooth: FloatArray  # (n_v,) float64: share of the scheme's smooth mask in the mask of each vertex
    own: FloatArray  # (n_v,) float64: weight of the vertex itself in the rest of its mask
    # (m,) int64;  weights : (m,) float64: further weights in the rest: of vertex ``columns`` in the mask of vertex
    # ``rows``
    rows: IntArray
    columns: IntArray
    weights: FloatArray
    # (n_h,) float64: share of the edge's midpoint in the point of each half-edge's edge; the rest is the scheme's
    # smooth mask. Equal on both half-edges of an edge, 1 on borders.
    midpoint: FloatArray


def crease_masks(topology: Topology) -> CreaseMasks:
    """Find the masks of every vertex and edge of a mesh."""
    t, semi = topology, topology.semi_sharpness
    border = t.twin < 0
    # Edges at each vertex: all that begin there, and the last one of an open fan, which ends there.
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
    across, was_across = semi.across_vertex[semi.across_sharpens], semi.across_sharpness[semi.across_sharpens]
    across_refined = semi.across_refined[semi.across_sharpens]
    before = _vertex_masks(t, centre, infinite, infinite | (sharpness > 0), semi.vertices > 0, across[was_across > 0])
    after = _vertex_masks(
        t, centre, infinite, infinite | (refined > 0), semi.vertices_refined > 0, across[across_refined > 0]
    )

    # The mean sharpness of all that becomes smooth. By Chaikin's method single edges are sharper than 1, and in meshes
    # that are cut along seams their mean is, too.
    at = np.concatenate([centre, np.arange(t.vertex_count), across])
    was = np.concatenate([sharpness, semi.vertices, was_across])
    becomes_smooth = (was > 0) & (np.concatenate([refined, semi.vertices_refined, across_refined]) == 0)
    count = np.bincount(at[becomes_smooth], minlength=t.vertex_count)
    total = np.bincount(at[becomes_smooth], was[becomes_smooth], minlength=t.vertex_count)
    share_before = np.minimum(total / np.maximum(count, 1), 1)
    share_before[(before[0] == after[0]) | (before[0] < 2)] = 1

    twin_refined = semi.edges_refined[np.maximum(t.twin, 0)]
    stays_sharp = border | ((semi.edges_refined > 0) & (twin_refined > 0))
    shares = [(before, share_before), (after, 1 - share_before)]
    return _blended(shares, centre, far, np.where(stays_sharp, 1, semi.edges))


def _vertex_masks(
    t: Topology,
    centre: IntArray,  # (n,) int: the vertex, for each edge at a vertex
    # (n,) bool: whether each of these edges is infinitely sharp; whether it is sharp at all
    infinite: NDArray[np.bool_],
    sharp: NDArray[np.bool_],
    sharp_vertices: NDArray[np.bool_],  # (n_v,) bool: vertices that are semi-sharp themselves
    across: IntArray,  # (m,) int: the vertex, for each semi-sharp edge across the cut that sharpens it
) -> tuple[IntArray, FloatArray]:
    """Find the mask of every vertex, before or after a refinement.

    Returns (n_v,) int64, the number of sharp edges at each vertex: 0 or 1 for the smooth mask, 2 for the crease mask, 3
    for the corner mask. More than three count as 3, and so does whatever else makes the vertex a corner. And (n,)
    float64, for each edge at a vertex, 1 if it is sharp and 0 if it is not. The one sharp edge at a dart is cut into
    two border edges, which count a half each.
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
    """Masks before and after a refinement, with the share of each at every vertex; the shares sum to one."""
    smooth, own = np.zeros((2, len(shares[0][1])))
    rows, columns, weights = [], [], []
    for (sharp_count, along), share in shares:
        smooth += share * (sharp_count < 2)
        # None beside the smooth mask; the vertex's weight in the crease mask; all of the corner mask.
        own += share * np.array([0, 0, 1 - 2 * CREASE_NEIGHBOUR, 1])[sharp_count]
        creased = np.flatnonzero((along > 0) & (sharp_count == 2)[centre] & (share > 0)[centre])
        rows.append(centre[creased])
        columns.append(far[creased])
        weights.append(CREASE_NEIGHBOUR * along[creased] * share[centre[creased]])
    return CreaseMasks(smooth, own, np.concatenate(rows), np.concatenate(columns), np.concatenate(weights), midpoint)
