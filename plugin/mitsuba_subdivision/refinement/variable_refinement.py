"""One refinement as a function of semi-sharpness, with its derivatives.

Semi-sharpness changes the masks at sharp features only, and these in one way: a vertex takes a share of its crease mask
or its corner mask, an edge point a share of its midpoint (`crease_masks`). So refined points are

    ``base c + scatter (weights * (differences c))``

with fixed sparse matrices: ``base`` makes the points without semi-sharpness, ``differences`` leads from these to what
each mask makes instead, and only the weights depend on sharpness.

Weights are piecewise linear in sharpness. On a piece, they depend on what is sharp before the refinement and
after it (`RefinementAt`).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from ..mesh.connectivity import IntArray, Topology, VertexRule
from ..mesh.semi_sharpness import CreaseMethod, SemiSharpness
from ..mesh.sharpness import INFINITE
from ..schemes.crease_masks import CREASE_NEIGHBOUR
from ..schemes.domain import FloatArray
from ..schemes.scheme import Scheme
from ..schemes.scheme_members import optional_member

if TYPE_CHECKING:
    from scipy import sparse


@dataclass(frozen=True, eq=False)
class VariableRefinement:
    """One refinement of a mesh that is cut along its infinitely sharp edges, for any semi-sharpness of some features.

    The features are first the semi-sharp edges, each seen from either end: half-edges that begin at a vertex, in
    increasing order, then edges across the cut from a vertex, as in `SemiSharpness`. Last come semi-sharp
    vertices. The matrices are fixed.

    Attributes
    ----------
    source : (n_f,) int64
        The feature of the refinement before whose sharpness each feature has; in the first refinement, the tag.
    base : (n', n) CSR array
        Stencils of the refined vertices where nothing is semi-sharp.
    differences : (n_w, n) CSR array
        For each weight, the stencil that it brings in, less the one that it replaces.
    scatter : (n', n_w) CSR array of ones
        The refined vertex that each weight belongs to.
    method : "uniform" or "chaikin"
    vertex : (n_f,) int64
        Vertex of each feature, as a place in the list of all vertices that have one.
    edge_count : int
        Number of features that are edges seen from an end.
    infinite_count : (n_u,) int64
        Number of infinitely sharp edges at each of these vertices.
    twin : (n_h,) int64
        For each half-edge among the features, the one from the other end.
    along, darts, corners, midpoints : (n,) int64
        What the weights, in this order, are of: features along which a vertex may get a crease; vertices at which an
        infinitely sharp crease ends, and a semi-sharp one may
        continue it; vertices that may become corners; one half-edge of each edge.
    """

    source: IntArray
    base: sparse.csr_array
    differences: sparse.csr_array
    scatter: sparse.csr_array
    method: CreaseMethod
    vertex: IntArray
    edge_count: int
    infinite_count: IntArray
    twin: IntArray
    along: IntArray
    darts: IntArray
    corners: IntArray
    midpoints: IntArray

    def sums(self, of_edges: NDArray) -> FloatArray:
        """``(n_u,)`` sums over the edges at each vertex, of ``(edge_count,)`` numbers."""
        return vertex_sums(self.vertex[: self.edge_count], of_edges, len(self.infinite_count))

    def sums_of_all(self, of_features: NDArray) -> FloatArray:
        """``(n_u,)`` sums over all features at each vertex."""
        return vertex_sums(self.vertex, of_features, len(self.infinite_count))


def sharp_features(semi: SemiSharpness) -> tuple[FloatArray, FloatArray]:
    """Sharpness of the features that are sharp, in the order of `VariableRefinement`: of edges, and of vertices."""
    edges, across, vertices = semi.edges, semi.across_sharpness, semi.vertices
    return np.concatenate([edges[edges > 0], across]), vertices[vertices > 0]


def variable_refinement(
    topology: Topology, scheme: Scheme, source: IntArray
) -> tuple[VariableRefinement, Topology, IntArray]:
    """Refine a mesh, for any semi-sharpness of the features that are sharp in it.

    Parameters
    ----------
    topology : Topology
        With semi-sharpness above 0 for each feature; how sharp it is does not matter.
    scheme : Scheme
        One whose masks at sharp features are those of `crease_masks`.
    source : (n_f,) int
        As `VariableRefinement` has it.

    Returns
    -------
    refinement : VariableRefinement
    refined : Topology
        With the same features sharp.
    source : (n,) int64
        For each feature of the refined mesh, in its order, the feature before from which it has its sharpness.
    """
    t, semi = topology, topology.semi_sharpness
    if semi is None:
        raise ValueError("a mesh without semi-sharp features; expected some whose sharpness is variable")
    half_edges, vertices = np.flatnonzero(semi.edges), np.flatnonzero(semi.vertices)
    edge_count = len(half_edges) + len(semi.across_vertex)
    # A refinement copies the lowered sharpness of an edge to its halves. With numbers in its place, the halves say
    # whose they are.
    number = np.arange(1.0, edge_count + 1)
    edges_refined = np.zeros(t.half_edge_count)
    edges_refined[half_edges], across_refined = number[: len(half_edges)], number[len(half_edges) :]
    lasting = np.where(semi.vertices > 0, INFINITE, 0)
    numbered = replace(semi, edges_refined=edges_refined, vertices=lasting, across_refined=across_refined)
    refined = scheme.refine(t.with_rules(t.rules, numbered)).topology
    assert refined.semi_sharpness is not None
    of_edges = sharp_features(refined.semi_sharpness)[0]
    source_after = np.concatenate([np.rint(of_edges).astype(np.int64) - 1, edge_count + np.arange(len(vertices))])

    at = np.concatenate([t.face_vertices[half_edges], semi.across_vertex, vertices]).astype(np.int64)
    base = scheme.refine(t.with_rules(t.rules, None)).stencils.matrix
    method: CreaseMethod = optional_member(scheme, "crease_method")
    return _with_matrices(t, refined, source, base, half_edges, at, edge_count, method), refined, source_after


def picking(columns: IntArray, count: int) -> sparse.csr_array:
    """Matrix that picks some of ``count`` values."""
    from scipy import sparse

    entries = np.ones(len(columns)), columns, np.arange(len(columns) + 1)
    return sparse.csr_array(entries, shape=(len(columns), count))


def _with_matrices(
    t: Topology,
    refined: Topology,
    source: IntArray,
    base: sparse.csr_array,
    half_edges: IntArray,
    at: IntArray,
    edge_count: int,
    method: CreaseMethod,
) -> VariableRefinement:
    """Find which weights there are, and the stencils that they bring in.

    Parameters
    ----------
    t, refined : Topology
        The mesh, and its refinement by the scheme.
    source, base
        As `VariableRefinement` has them.
    half_edges : (n_h,) int
        The first features.
    at : (n_f,) int
        Vertex of each feature.
    edge_count, method
        As `VariableRefinement` has them.
    """
    from scipy import sparse

    vertices, vertex = np.unique(at, return_inverse=True)
    rules = t.vertex_rules[vertices]
    infinite_count = np.where(rules == VertexRule.DART, 1, np.where(t.is_border_vertex[vertices], 2, 0))
    moves = (rules != VertexRule.CORNER) & (t.vertex_half_edge[vertices] >= 0)
    gets_crease = moves & (infinite_count < 2)
    along = np.flatnonzero(gets_crease[vertex[: len(half_edges)]])
    darts, corners = np.flatnonzero(gets_crease & (infinite_count == 1)), np.flatnonzero(moves)
    number = np.full(t.half_edge_count, -1)
    number[half_edges] = np.arange(len(half_edges))
    twin = number[t.twin[half_edges]]
    midpoints = np.flatnonzero(np.arange(len(half_edges)) < twin)

    # The crease mask takes a half of itself for each of the two edges.
    starts = np.concatenate([half_edges[along], t.open_fan_start[vertices[darts]]]).astype(np.int64)
    centre, ends = t.face_vertices[starts], t.face_vertices[t.next[starts]]
    n = t.vertex_count
    crease = (1 / 2 - CREASE_NEIGHBOUR) * picking(centre, n) + CREASE_NEIGHBOUR * picking(ends, n) - base[centre] / 2
    corner = picking(vertices[corners], n) - base[vertices[corners]]
    # The first refined faces lie at the old corners. They begin at the old vertex; next is the point of the edge.
    edge = half_edges[midpoints]
    edge_point = refined.face_vertices[refined.face_offsets[edge] + 1]
    start, end = picking(t.face_vertices[edge], n), picking(t.face_vertices[t.next[edge]], n)
    midpoint = (start + end) / 2 - base[edge_point]

    rows = np.concatenate([centre, vertices[corners], edge_point])
    scatter = sparse.csr_array((np.ones(len(rows)), (rows, np.arange(len(rows)))), shape=(base.shape[0], len(rows)))
    return VariableRefinement(
        source=source,
        base=base,
        differences=sparse.csr_array(sparse.vstack([crease, corner, midpoint])),
        scatter=scatter,
        method=method,
        vertex=vertex.ravel(),
        edge_count=edge_count,
        infinite_count=infinite_count,
        twin=twin,
        along=along,
        darts=darts,
        corners=corners,
        midpoints=midpoints,
    )


def vertex_sums(vertex: IntArray, values: NDArray, count: int) -> FloatArray:
    """``(count,)`` sums of the values at each vertex."""
    return np.asarray(np.bincount(vertex, values, minlength=count), dtype=np.float64)
