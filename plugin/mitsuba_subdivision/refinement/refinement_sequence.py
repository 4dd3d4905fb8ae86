"""Several refinements as one function of semi-sharpness and points, with its derivatives."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from ..mesh.connectivity import IntArray, Topology
from ..schemes.domain import FloatArray
from ..schemes.scheme import Scheme
from .variable_refinement import FeatureSharpness, RefinementAt, VariableRefinement, variable_refinement

if TYPE_CHECKING:
    from scipy import sparse


@dataclass(frozen=True, eq=False)
class RefinementSequence:
    """Refinements of a mesh that is cut along its infinitely sharp edges, as functions of some tags' sharpness.

    Attributes
    ----------
    refinements : list of VariableRefinement
    sources : list of (n_f,) int64
        Where the features of each refinement have their sharpness from: features of the one before, or for the first
        one, tags.
    counts : list of int
        The number of tags, then of the features of each refinement but the last.
    """

    refinements: list[VariableRefinement]
    sources: list[IntArray]
    counts: list[int]

    def at(self, tags: FeatureSharpness) -> SequenceAt:
        """Evaluate all refinements."""
        found: list[RefinementAt] = []
        for refinement, source in zip(self.refinements, self.sources, strict=True):
            before = found[-1].left if found else tags
            found.append(refinement.at(before.at(source)))
        return SequenceAt(self, found)


def refinement_sequence(
    topology: Topology, scheme: Scheme, length: int, tags: IntArray, tag_count: int
) -> tuple[RefinementSequence, Topology]:
    """Refine a mesh several times; return the refined mesh, too.

    Parameters
    ----------
    topology, scheme
        As `variable_refinement` takes them.
    length : int
        Number of refinements.
    tags : (n_f,) int
        The tag of each feature of the mesh.
    tag_count : int
    """
    refinements, sources, counts = [], [tags], [tag_count]
    for _ in range(length):
        found = variable_refinement(topology, scheme)
        topology = found.topology
        refinements.append(found.refinement)
        counts.append(len(sources[-1]))
        sources.append(found.source)
    return RefinementSequence(refinements, sources[:-1], counts[:-1]), topology


@dataclass(frozen=True, eq=False)
class SequenceAt:
    """A `RefinementSequence` at some sharpness.

    Attributes
    ----------
    sequence : RefinementSequence
    evaluated : list of RefinementAt
    """

    sequence: RefinementSequence
    evaluated: list[RefinementAt]

    def points(self, points: FloatArray) -> FloatArray:
        """Refined points ``(n', m)`` of points ``(n, m)`` of the cut mesh."""
        for at in self.evaluated:
            points = at.refined(points, at.moves(points))
        return points

    def matrix(self) -> sparse.csr_array:
        """``(n', n)`` stencils of the refined points."""
        from scipy import sparse

        found = sparse.eye_array(self.evaluated[0].refinement.base.shape[1], format="csr")
        for at in self.evaluated:
            r = at.refinement
            found = (r.base + r.scatter @ sparse.diags_array(at.weights) @ r.differences) @ found
        return sparse.csr_array(found)

    def linearization(self, points: FloatArray) -> SequenceLinearization:
        """Derivatives of refined points at some points ``(n, m)``."""
        moves = []
        for at in self.evaluated:
            moves.append(at.moves(points))
            points = at.refined(points, moves[-1])
        return SequenceLinearization(self, moves)


@dataclass(frozen=True, eq=False)
class SequenceLinearization:
    """Derivatives of refined points by sharpness and points, as products with the Jacobian and its transpose.

    Attributes
    ----------
    at : SequenceAt
    moves : list of (n_w, m) float64
        Of each refinement, how refined points change with the weights.
    """

    at: SequenceAt
    moves: list[FloatArray]

    def forward(self, of_tags: FloatArray, of_points: FloatArray) -> FloatArray:
        """Change of refined points ``(n', m)``, for changes of the tags' sharpness and of points."""
        points, of_features = of_points, of_tags
        for at, source, moves in zip(self.at.evaluated, self.at.sequence.sources, self.moves, strict=True):
            of_weights, of_left = at.forward(of_features[source])
            points = at.refined(points, at.moves(points)) + at.refinement.scatter @ (of_weights[:, None] * moves)
            of_features = of_left
        return points

    def backward(self, by_points: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Gradients by the tags' sharpness and by points ``(n, m)``, for one by refined points ``(n', m)``."""
        sequence = self.at.sequence
        stages = zip(self.at.evaluated, sequence.sources, sequence.counts, self.moves, strict=True)
        by_left = np.zeros(len(sequence.sources[-1]))
        for at, source, count, moves in reversed(list(stages)):
            r = at.refinement
            by_moves = r.scatter.T @ by_points
            by_features = at.backward((by_moves * moves).sum(axis=1), by_left)
            by_left = np.bincount(source, by_features, minlength=count).astype(np.float64)
            by_points = r.base.T @ by_points + r.differences.T @ (at.weights[:, None] * by_moves)
        return by_left, by_points
