"""Derivatives of refined points by the sharpness of creases and corners."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike

from ..cage.errors import CageError
from ..mesh.connectivity import IntArray
from ..schemes.domain import FloatArray
from .refinement_at import RefinementAt

if TYPE_CHECKING:
    from scipy import sparse


@dataclass(frozen=True, eq=False)
class SharpnessLinearization:
    """Derivatives of `VariableSharpness.points` at some sharpness and control points: its Jacobian, for products.

    Attributes
    ----------
    steps : list of RefinementAt
        The refinements, at the sharpness.
    moves : list of (n_w, m) float64
        Of each refinement, derivatives of refined points by the weights.
    unknown : (n,) int64
        The tags whose sharpness is unknown, among all tags.
    tag_count : int
    spread, kept : CSR array
        From control points to vertices of the cut mesh, and from vertices of the refined cut mesh to refined points.
    """

    steps: list[RefinementAt]
    moves: list[FloatArray]
    unknown: IntArray
    tag_count: int
    spread: sparse.csr_array
    kept: sparse.csr_array

    def forward(
        self, sharpness_direction: ArrayLike | None = None, control_points_direction: ArrayLike | None = None
    ) -> FloatArray:
        """Product with the Jacobian: the change of points along a direction.

        Parameters
        ----------
        sharpness_direction : (n,) array, optional
        control_points_direction : (n_v, m) array, optional
            An omitted direction is zero.

        Returns
        -------
        (n', m) float64

        Raises
        ------
        CageError
            If a direction has another shape.
        """
        of_sharpness: FloatArray = np.zeros(self.tag_count)
        of_control: FloatArray = np.zeros((self.spread.shape[1], self.moves[0].shape[1]))
        if sharpness_direction is not None:
            of_sharpness[self.unknown] = _shaped(sharpness_direction, self.unknown.shape)
        if control_points_direction is not None:
            of_control = _shaped(control_points_direction, of_control.shape)
        points = self.spread @ of_control
        for step, moves in zip(self.steps, self.moves, strict=True):
            of_weights, refined = step.forward(of_sharpness[step.refinement.source])
            points = step.points(points) + step.refinement.scatter @ (of_weights[:, None] * moves)
            of_sharpness = refined
        return self.kept @ points

    def backward(self, gradient: ArrayLike) -> tuple[FloatArray, FloatArray]:
        """Product with the Jacobian's transpose: gradients by sharpness and by control points.

        Parameters
        ----------
        gradient : (n', m) array
            By points.

        Returns
        -------
        sharpness : (n,) float64
        control_points : (n_v, m) float64

        Raises
        ------
        CageError
            If the gradient has another shape.
        """
        by_points = self.kept.T @ _shaped(gradient, (self.kept.shape[0], self.moves[0].shape[1]))
        by_sharpness = np.zeros(len(self.steps[-1].refined.sharpness))
        counts = [self.tag_count, *(len(step.refined.sharpness) for step in self.steps[:-1])]
        for step, moves, count in reversed(list(zip(self.steps, self.moves, counts, strict=True))):
            r = step.refinement
            by_moves = r.scatter.T @ by_points
            by_features = step.backward((by_moves * moves).sum(axis=1), by_sharpness)
            by_sharpness = np.bincount(r.source, by_features, minlength=count).astype(np.float64)
            by_points = r.base.T @ by_points + r.differences.T @ (step.weights[:, None] * by_moves)
        return by_sharpness[self.unknown], self.spread.T @ by_points


def _shaped(values: ArrayLike, shape: tuple[int, ...]) -> FloatArray:
    found = np.asarray(values, dtype=np.float64)
    if found.shape != shape:
        raise CageError(f"a direction or gradient of shape {found.shape}; expected {shape}")
    return found
