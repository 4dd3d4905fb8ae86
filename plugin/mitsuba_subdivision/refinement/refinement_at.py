"""A refinement at some sharpness: weights of its masks, and their derivatives."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from ..mesh.connectivity import IntArray
from ..schemes.domain import FloatArray
from .variable_refinement import VariableRefinement, vertex_sums

if TYPE_CHECKING:
    from scipy import sparse

BoolArray = NDArray[np.bool_]

# A vertex of this many sharp edges is a corner, as is one that is sharp itself.
_CORNER = 3


@dataclass(frozen=True, eq=False)
class FeatureSharpness:
    """Sharpness of the features of a `VariableRefinement`, and on which side of a change of masks it is.

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
class RefinementAt:
    """A `VariableRefinement` at some sharpness, with derivatives on the piece that the sharpness is on.

    Attributes
    ----------
    refinement : VariableRefinement
    weights : (n_w,) float64
    refined : FeatureSharpness
        Each feature's sharpness after the refinement.
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
    refined: FeatureSharpness
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
        refined = FeatureSharpness(np.where(stays, averaged - 1, 0), np.where(stays, rate, 0), stays)

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
        return cls(r, weights, refined, own, others, slope, ends, change, is_blended)

    def moves(self, points: FloatArray) -> FloatArray:
        """``(n_w, m)`` derivatives of refined points by the weights, for points ``(n, m)`` before."""
        return self.refinement.differences @ points

    def points(self, points: FloatArray, moves: FloatArray | None = None) -> FloatArray:
        """``(n', m)`` refined points, for points before and their `moves`, if these are known."""
        moves = self.moves(points) if moves is None else moves
        return self.refinement.base @ points + self.refinement.scatter @ (self.weights[:, None] * moves)

    def matrix(self) -> sparse.csr_array:
        """``(n', n)`` stencils of the refined points."""
        from scipy import sparse

        r = self.refinement
        return r.base + r.scatter @ sparse.diags_array(self.weights) @ r.differences

    def forward(self, direction: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Change of the weights ``(n_w,)`` and of the refined sharpness ``(n_f,)``, for one of the sharpness."""
        r = self.refinement
        share = self.slope * r.sums_of_all(self.ends * direction)
        weights = [self.change * share[_weight_vertex(r)], self.is_blended * direction[r.midpoints]]
        refined = self.refined.is_sharp * _change_of_average(r, self.own, self.others, direction)
        return np.concatenate(weights), refined

    def backward(self, of_weights: FloatArray, of_refined: FloatArray) -> FloatArray:
        """Gradient by the sharpness ``(n_f,)``, for gradients by the weights and by the refined sharpness."""
        r, n = self.refinement, len(self.change)
        shares = vertex_sums(_weight_vertex(r), self.change * of_weights[:n], len(self.slope))
        found = self.ends * (self.slope * shares)[r.vertex]
        found[r.midpoints] += self.is_blended * of_weights[n:]
        of_average = self.refined.is_sharp * of_refined
        found += self.own * of_average
        of_edges = slice(r.edge_count)
        found[of_edges] += r.sums(self.others * of_average[of_edges])[r.vertex[of_edges]]
        return found


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
    # As in `SemiSharpness.decaying`: rounding must not smooth an edge that is sharp there.
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
