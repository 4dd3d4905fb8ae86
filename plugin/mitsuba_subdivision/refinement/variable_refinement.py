"""One refinement as a function of semi-sharpness, with its derivatives.

Semi-sharpness changes the masks at sharp features only, and these in one way: a vertex takes a share of its crease mask
or its corner mask, an edge point a share of its midpoint (`crease_masks`). So refined points are

    ``base c + scatter (weights * (differences c))``

with fixed sparse matrices: ``base`` makes the points without semi-sharpness, ``differences`` leads from these to what
each mask makes instead, and only the weights depend on sharpness.

Weights are piecewise linear in sharpness. What they are on a piece depends on what is sharp before the refinement and
after it. Where a sharpness lies between two pieces, its rate of change decides (`FeatureSharpness`).
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
from ..schemes.members import optional_member
from ..schemes.scheme import Scheme

if TYPE_CHECKING:
    from scipy import sparse

BoolArray = NDArray[np.bool_]

# A vertex of this many sharp edges is a corner, as is one that is sharp itself.
_CORNER = 3


@dataclass(frozen=True, eq=False)
class FeatureSharpness:
    """Sharpness of the features of a `VariableRefinement`, and on which side of a change of rules it is.

    Attributes
    ----------
    sharpness : (n,) float64
    rate : (n,) float64
        How it changes. A sharpness of exactly 1 that falls becomes smooth; one that rises does not. One that does
        neither is what it is: 0 is smooth, and 1 becomes smooth.
    is_sharp : (n,) bool
        Whether it is above 0, or is 0 and rises.
    """

    sharpness: FloatArray
    rate: FloatArray
    is_sharp: BoolArray

    @classmethod
    def of(cls, sharpness: FloatArray, rate: FloatArray) -> FeatureSharpness:
        """Sharpness that changes at a rate."""
        return cls(sharpness, rate, _is_above(sharpness, 0, rate))

    def at(self, features: IntArray) -> FeatureSharpness:
        """Sharpness of some features."""
        return FeatureSharpness(self.sharpness[features], self.rate[features], self.is_sharp[features])


@dataclass(frozen=True, eq=False)
class VariableRefinement:
    """One refinement of a mesh that is cut along its infinitely sharp edges, for any semi-sharpness of some features.

    The features are first the semi-sharp edges, each seen from either end: half-edges that begin at a vertex, in
    increasing order, then edges across the cut from a vertex, as in `SemiSharpness`. Last come semi-sharp
    vertices. The matrices are fixed.

    Attributes
    ----------
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
        infinitely sharp crease ends, and may go on; vertices that may become corners; one half-edge of each edge.
    """

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

    def at(self, features: FeatureSharpness) -> RefinementAt:
        """Weights, and what is left of the sharpness, for some sharpness."""
        return RefinementAt.of(self, features)

    def sums(self, of_edges: NDArray) -> FloatArray:
        """``(n_u,)`` sums over the edges at each vertex, of ``(edge_count,)`` numbers."""
        return _sums(self.vertex[: self.edge_count], of_edges, len(self.infinite_count))

    def sums_of_all(self, of_features: NDArray) -> FloatArray:
        """``(n_u,)`` sums over all features at each vertex."""
        return _sums(self.vertex, of_features, len(self.infinite_count))


@dataclass(frozen=True, eq=False)
class RefinementAt:
    """A `VariableRefinement` at some sharpness, with derivatives on the piece that the sharpness is on.

    Attributes
    ----------
    refinement : VariableRefinement
    weights : (n_w,) float64
    left : FeatureSharpness
        What the refinement leaves of each feature's sharpness.
    own, others : (n_f,), (edge_count,) float64
        Shares of the sharpness itself, and of the sum over all edges at the vertex, in the average that decays.
    slope : (n_u,) float64
        Change of a vertex's share of the mask before, by the sum of all sharpness that ends there.
    ends : (n_f,) bool
        Whether the feature becomes smooth.
    change : (n_w - n_m,) float64
        How the weights at vertices change with the share of the mask before.
    is_blended : (n_m,) bool
        Whether edge points take less than all of their midpoints.
    """

    refinement: VariableRefinement
    weights: FloatArray
    left: FeatureSharpness
    own: FloatArray
    others: FloatArray
    slope: FloatArray
    ends: BoolArray
    change: FloatArray
    is_blended: BoolArray

    @classmethod
    def of(cls, refinement: VariableRefinement, features: FeatureSharpness) -> RefinementAt:
        """Evaluate a refinement. The rules are those of `crease_masks` and of `SemiSharpness.decaying`."""
        r, sharpness, is_sharp = refinement, features.sharpness, features.is_sharp
        averaged, own, others = _averaged(r, features)
        rate = _change_of_average(r, own, others, features.rate)
        stays = _is_above(averaged, 1, rate)
        left = FeatureSharpness(np.where(stays, averaged - 1, 0), np.where(stays, rate, 0), stays)

        sharpens = np.where(np.arange(len(sharpness)) < r.edge_count, 1, _CORNER)
        before = np.minimum(r.infinite_count + r.sums_of_all(sharpens * is_sharp), _CORNER)
        after = np.minimum(r.infinite_count + r.sums_of_all(sharpens * stays), _CORNER)
        ends = is_sharp & ~stays
        # The share of the mask before is the mean of what ends. It is one at most: what ends is below one, or has been
        # averaged to be so, and averages are in the order of what is averaged, and have the same sum.
        number = np.maximum(r.sums_of_all(ends), 1)
        is_mixed = (before != after) & (before >= 2)
        share = np.where(is_mixed, r.sums_of_all(ends * sharpness) / number, 1)
        slope = np.where(is_mixed, 1 / number, 0)

        with_after = _masks(r, after, stays)
        change = _masks(r, before, is_sharp) - with_after
        is_blended = ~(stays[r.midpoints] & stays[r.twin[r.midpoints]])
        of_edges = np.where(is_blended, sharpness[r.midpoints], 1)
        weights = np.concatenate([with_after + change * share[_weight_vertex(r)], of_edges])
        return cls(r, weights, left, own, others, slope, ends, change, is_blended)

    def moves(self, points: FloatArray) -> FloatArray:
        """``(n_w, m)`` how refined points change with the weights, for points ``(n, m)`` before."""
        return self.refinement.differences @ points

    def refined(self, points: FloatArray, moves: FloatArray) -> FloatArray:
        """``(n', m)`` refined points, for points before and `moves` of these."""
        return self.refinement.base @ points + self.refinement.scatter @ (self.weights[:, None] * moves)

    def forward(self, direction: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Change of the weights ``(n_w,)`` and of what is left ``(n_f,)``, for one of the sharpness."""
        r = self.refinement
        share = self.slope * r.sums_of_all(self.ends * direction)
        weights = [self.change * share[_weight_vertex(r)], self.is_blended * direction[r.midpoints]]
        left = self.left.is_sharp * _change_of_average(r, self.own, self.others, direction)
        return np.concatenate(weights), left

    def backward(self, of_weights: FloatArray, of_left: FloatArray) -> FloatArray:
        """Gradient by the sharpness ``(n_f,)``, for gradients by the weights and by what is left."""
        r, n = self.refinement, len(self.change)
        shares = _sums(_weight_vertex(r), self.change * of_weights[:n], len(self.slope))
        found = self.ends * (self.slope * shares)[r.vertex]
        found[r.midpoints] += self.is_blended * of_weights[n:]
        of_average = self.left.is_sharp * of_left
        found += self.own * of_average
        of_edges = slice(r.edge_count)
        found[of_edges] += r.sums(self.others * of_average[of_edges])[r.vertex[of_edges]]
        return found


@dataclass(frozen=True, eq=False)
class RefinedFeatures:
    """A `VariableRefinement` and the mesh that it makes.

    Attributes
    ----------
    refinement : VariableRefinement
    topology : Topology
        Refined, with the same features sharp.
    source : (n,) int64
        For each feature of the refined mesh, in its order, the feature before whose `RefinementAt.left` it has.
    """

    refinement: VariableRefinement
    topology: Topology
    source: IntArray


def sharp_features(semi: SemiSharpness) -> tuple[FloatArray, FloatArray]:
    """Sharpness of the features that are sharp, in the order of `VariableRefinement`: of edges, and of vertices."""
    edges, across, vertices = semi.edges, semi.across_sharpness, semi.vertices
    return np.concatenate([edges[edges > 0], across]), vertices[vertices > 0]


def variable_refinement(topology: Topology, scheme: Scheme) -> RefinedFeatures:
    """Refine a mesh, for any semi-sharpness of the features that are sharp in it.

    Parameters
    ----------
    topology : Topology
        With semi-sharpness above 0 for each feature; how sharp it is does not matter.
    scheme : Scheme
        One whose masks at sharp features are those of `crease_masks`.
    """
    t, semi = topology, topology.semi_sharpness
    if semi is None:
        raise ValueError("a mesh without semi-sharp features; expected some whose sharpness is variable")
    half_edges, vertices = np.flatnonzero(semi.edges), np.flatnonzero(semi.vertices)
    edge_count = len(half_edges) + len(semi.across_vertex)
    # A refinement copies what it leaves of a sharpness to halves of edges. With numbers in place of what is left, the
    # halves tell whose they are.
    number = np.arange(1.0, edge_count + 1)
    edges_refined = np.zeros(t.half_edge_count)
    edges_refined[half_edges], across_refined = number[: len(half_edges)], number[len(half_edges) :]
    lasting = np.where(semi.vertices > 0, INFINITE, 0)
    numbered = replace(semi, edges_refined=edges_refined, vertices=lasting, across_refined=across_refined)
    refined = scheme.refine(t.with_rules(t.rules, numbered)).topology
    assert refined.semi_sharpness is not None
    of_edges = sharp_features(refined.semi_sharpness)[0]
    source = np.concatenate([np.rint(of_edges).astype(np.int64) - 1, edge_count + np.arange(len(vertices))])

    at = np.concatenate([t.face_vertices[half_edges], semi.across_vertex, vertices]).astype(np.int64)
    base = scheme.refine(t.with_rules(t.rules, None)).stencils.matrix
    method: CreaseMethod = optional_member(scheme, "crease_method")
    return RefinedFeatures(_with_matrices(t, refined, base, half_edges, at, edge_count, method), refined, source)


def picking(places: IntArray, count: int) -> sparse.csr_array:
    """Matrix that picks the values at some places of ``count`` values."""
    from scipy import sparse

    entries = np.ones(len(places)), places, np.arange(len(places) + 1)
    return sparse.csr_array(entries, shape=(len(places), count))


def _with_matrices(
    t: Topology,
    refined: Topology,
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
        The mesh, and what the scheme makes of it.
    base : (n', n) CSR array
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
    place = np.full(t.half_edge_count, -1)
    place[half_edges] = np.arange(len(half_edges))
    twin = place[t.twin[half_edges]]
    midpoints = np.flatnonzero(np.arange(len(half_edges)) < twin)

    # The crease mask takes a half of itself for each of the two edges.
    starts = np.concatenate([half_edges[along], t.open_fan_start[vertices[darts]]]).astype(np.int64)
    centre, ends = t.face_vertices[starts], t.face_vertices[t.next[starts]]
    n = t.vertex_count
    crease = (1 / 2 - CREASE_NEIGHBOUR) * picking(centre, n) + CREASE_NEIGHBOUR * picking(ends, n) - base[centre] / 2
    corner = picking(vertices[corners], n) - base[vertices[corners]]
    # The first refined faces lie at the old corners. They begin at the old vertex and go on to the point of the edge.
    edge = half_edges[midpoints]
    edge_point = refined.face_vertices[refined.face_offsets[edge] + 1]
    start, end = picking(t.face_vertices[edge], n), picking(t.face_vertices[t.next[edge]], n)
    midpoint = (start + end) / 2 - base[edge_point]

    rows = np.concatenate([centre, vertices[corners], edge_point])
    scatter = sparse.csr_array((np.ones(len(rows)), (rows, np.arange(len(rows)))), shape=(base.shape[0], len(rows)))
    return VariableRefinement(
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


def _sums(places: IntArray, values: NDArray, count: int) -> FloatArray:
    return np.asarray(np.bincount(places, values, minlength=count), dtype=np.float64)


def _is_above(value: FloatArray, bound: float, rate: FloatArray) -> BoolArray:
    return (value > bound) | ((value == bound) & (rate > 0))


def _averaged(r: VariableRefinement, features: FeatureSharpness) -> tuple[FloatArray, FloatArray, FloatArray]:
    """What one is taken from, and `RefinementAt.own` and `others`, of which it consists."""
    sharpness = features.sharpness
    own, others = np.ones(len(sharpness)), np.zeros(r.edge_count)
    if r.method == "uniform":
        return sharpness, own, others
    of_edges, is_sharp, vertex = sharpness[: r.edge_count], features.is_sharp[: r.edge_count], r.vertex[: r.edge_count]
    number = (r.sums(is_sharp)[vertex] - 1).clip(1)
    is_mixed = is_sharp & (r.sums(is_sharp)[vertex] > 1)
    others = np.where(is_mixed, 1 / 4 / number, 0)
    own[: r.edge_count] = np.where(is_mixed, 3 / 4 - others, 1)
    # As `SemiSharpness.decaying` has it: rounding must not make smooth what is sharp there.
    mean = (r.sums(of_edges)[vertex] - of_edges) / number
    averaged = sharpness.copy()
    averaged[: r.edge_count] = np.where(is_mixed, 0.75 * of_edges + 0.25 * mean, of_edges)
    return averaged, own, others


def _change_of_average(r: VariableRefinement, own: FloatArray, others: FloatArray, direction: FloatArray) -> FloatArray:
    found = own * direction
    of_edges = slice(r.edge_count)
    found[of_edges] += others * r.sums(direction[of_edges])[r.vertex[of_edges]]
    return found


def _weight_vertex(r: VariableRefinement) -> IntArray:
    """Vertex of each weight but the last, which are of edges."""
    return np.concatenate([r.vertex[r.along], r.darts, r.corners])


def _masks(r: VariableRefinement, sharp_count: IntArray, is_sharp: BoolArray) -> FloatArray:
    """Weights at vertices whose masks are those of some sharp edges: 1 for what the mask consists of."""
    is_creased = sharp_count == 2
    along = is_creased[r.vertex[r.along]] & is_sharp[r.along]
    return np.concatenate([along, is_creased[r.darts], sharp_count[r.corners] == _CORNER]).astype(np.float64)
