"""The rules at borders, corners and semi-sharp features, which Catmull-Clark and Loop have in common.

A vertex with two sharp edges moves along them, to ``(6 S + a + b) / 8``; one with more, or that is sharp itself, stays;
one with none or one moves as any other. An edge's point is its middle while both halves stay sharp. Where a refinement
makes something smooth, the rules before and after are mixed by the sharpness that was left [DeRose et al. 1998; Hoppe
et al. 1994]. In all cases this is what OpenSubdiv computes (`Sdc::Crease`, `Sdc::Scheme`, `Vtr::Refinement`),
also where Chaikin's method ends an edge of a sharpness above one, which then has more than all of the middle.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..mesh.connectivity import IntArray, Topology, VertexRule
from .domain import FloatArray

_ALONG = 1 / 8


@dataclass(frozen=True, eq=False)
class SharpRules:
    """How a refinement's rules mix at each vertex and edge.

    Attributes
    ----------
    smooth : (n_v,) float64
        Share of the scheme's own rule in moving each vertex.
    own : (n_v,) float64
        Weight of the vertex itself in the others.
    rows, columns : (m,) int64;  weights : (m,) float64
        Further weights in them: of vertex ``columns`` in moving vertex ``rows``.
    sharp_edges : (n_h,) float64
        Share of the middle in each half-edge's edge point; both of an edge are equal, 1 on borders.
    """

    smooth: FloatArray
    own: FloatArray
    rows: IntArray
    columns: IntArray
    weights: FloatArray
    sharp_edges: FloatArray


def sharp_rules(topology: Topology) -> SharpRules:
    """Find the rules for every vertex and edge of a mesh."""
    t, semi = topology, topology.semi_sharpness
    border = t.twin < 0
    # The edges at each vertex: those that leave it, and the last one of an open fan, which leads to it.
    origin, end = t.face_vertices, t.face_vertices[t.next]
    centre = np.concatenate([origin, end[border]])
    far = np.concatenate([end, origin[border]])
    infinite = np.concatenate([border, np.ones(np.count_nonzero(border), dtype=bool)])
    if semi is None:
        before = _rules(t, centre, infinite, infinite)
        return _mixed(before, before, np.ones(t.vertex_count), centre, far, border.astype(float))

    nought = np.zeros(np.count_nonzero(border))
    sharpness, left = np.concatenate([semi.edges, nought]), np.concatenate([semi.edges_left, nought])
    vertices_left = semi.vertices_left
    acts = semi.beyond_acts
    beyond, beyond_left = (semi.beyond_vertex[acts & (sharp > 0)] for sharp in (semi.beyond, semi.beyond_left))
    before = _rules(t, centre, infinite, infinite | (sharpness > 0), semi.vertices > 0, beyond)
    after = _rules(t, centre, infinite, infinite | (left > 0), vertices_left > 0, beyond_left)

    # The mean of what was left of the sharpness of all that becomes smooth.
    at = np.concatenate([centre, np.arange(t.vertex_count), semi.beyond_vertex[acts]])
    was = np.concatenate([sharpness, semi.vertices, semi.beyond[acts]])
    becomes_smooth = (was > 0) & (np.concatenate([left, vertices_left, semi.beyond_left[acts]]) == 0)
    count = np.bincount(at[becomes_smooth], minlength=t.vertex_count)
    total = np.bincount(at[becomes_smooth], was[becomes_smooth], minlength=t.vertex_count)
    share = np.minimum(total / np.maximum(count, 1), 1)
    share[(before.sharp_count == after.sharp_count) | (before.sharp_count < 2)] = 1

    twin_left = semi.edges_left[np.maximum(t.twin, 0)]
    stays = border | ((semi.edges_left > 0) & (twin_left > 0))
    return _mixed(before, after, share, centre, far, np.where(stays, 1, semi.edges))


@dataclass(frozen=True, eq=False)
class _Rules:
    """Rules before or after a refinement.

    Attributes
    ----------
    sharp_count : (n_v,) int64
        Sharp edges at each vertex; 3 where it stays.
    weight : (n,) float64
        Whether each edge at a vertex is sharp; a half for each of the two borders that the one edge at a dart is.
    """

    sharp_count: IntArray
    weight: FloatArray


def _rules(
    t: Topology,
    centre: IntArray,
    infinite: NDArray[np.bool_],
    sharp: NDArray[np.bool_],
    sharp_vertices: NDArray[np.bool_] | None = None,
    beyond: IntArray | None = None,
) -> _Rules:
    weight = sharp.astype(float)
    weight[infinite & (t.vertex_rules == VertexRule.DART)[centre]] = 0.5
    count = np.rint(np.bincount(centre, weight, minlength=t.vertex_count)).astype(np.int64)
    stays = (t.vertex_rules == VertexRule.CORNER) | (t.vertex_half_edge < 0)
    if sharp_vertices is not None:
        stays |= sharp_vertices
        count += np.bincount(beyond, minlength=t.vertex_count)
    return _Rules(np.where(stays, 3, np.minimum(count, 3)), weight)


def _mixed(
    before: _Rules, after: _Rules, share: FloatArray, centre: IntArray, far: IntArray, sharp_edges: FloatArray
) -> SharpRules:
    smooth, own = np.zeros((2, len(share)))
    rows, columns, weights = [], [], []
    for rules, part in ((before, share), (after, 1 - share)):
        smooth += part * (rules.sharp_count < 2)
        own += part * np.array([0, 0, 1 - 2 * _ALONG, 1])[rules.sharp_count]
        along = np.flatnonzero((rules.weight > 0) & (rules.sharp_count == 2)[centre] & (part > 0)[centre])
        rows.append(centre[along])
        columns.append(far[along])
        weights.append(_ALONG * rules.weight[along] * part[centre[along]])
    return SharpRules(smooth, own, *(np.concatenate(parts) for parts in (rows, columns, weights)), sharp_edges)
