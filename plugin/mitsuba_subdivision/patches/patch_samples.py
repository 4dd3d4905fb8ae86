"""Evaluation anywhere on the patches of a table: of points, or of other values that are subdivided as points are."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property, partial

import numpy as np
from numpy.typing import DTypeLike

from ..evaluation.element import ElementSamples, evaluate_elements
from ..evaluation.equations import Evaluator
from ..mesh.connectivity import IntArray
from ..progress import counted
from ..schemes.domain import FloatArray
from .patch_table import PatchTable

# Samples are evaluated in runs of this many, which bounds temporary memory to some tens of megabytes.
CHUNK = 32768
# And of at most this many classes, whose pieces are prepared at once; of fewer in fans of very many faces, where the
# weights of a part over the one-ring are many.
CLASSES = 512
WEIGHTS = 1 << 24
# Of tips; that leaves a 64th of each to eigen-coordinates.
PIECE_LEVELS = 3


@dataclass(frozen=True, eq=False)
class PatchSampler:
    """Evaluates points, or other values that are subdivided as points are, anywhere on patches.

    Parameters
    ----------
    patches : PatchTable
    control_values : (n, k) float64
    control_of_vertex : (n_v,) int64
        0-based row of ``control_values`` at each mesh vertex.
    """

    patches: PatchTable
    control_values: FloatArray
    control_of_vertex: IntArray

    def evaluate(
        self,
        half_edge: IntArray,
        uv: FloatArray,
        evaluator: Evaluator = "stabilized",
        dtype: DTypeLike = np.float64,
        derivatives: int = 1,
    ) -> ElementSamples:
        """Evaluate samples.

        Parameters
        ----------
        half_edge : (s,) int64
            The corner of an element where each sample's parameters are (0, 0), a half-edge of `PatchTable.elements`.
        uv : (s, 2) float64
            Parameters, seen from that corner.
        evaluator, dtype, derivatives
            As for `LimitSurface.evaluate`.
        """
        class_index, patch, patch_corner = self.patches.patch_at(half_edge)
        samples = ElementSamples.empty(len(uv), self.control_values.shape[1], dtype, derivatives)
        # Second derivatives, and single precision, have no bits to lose; and the other forms are about these levels.
        is_usual = evaluator == "stabilized" and derivatives == 1 and np.dtype(dtype) == np.float64
        piece_levels = PIECE_LEVELS if is_usual else 0
        # Sorted by class, a run of samples has few new classes, and few control points.
        order = np.argsort(class_index.astype(np.min_scalar_type(len(self.patches.classes))), kind="stable")
        for at in counted(_runs(class_index[order], order, self.patches.control_counts), "Evaluated patches"):
            of_class = class_index[at]
            pieces, element = self.patches.elements_of(of_class, piece_levels)
            last = self.patches.control_counts[of_class] - 1
            controls = partial(self._controls, self.patches.first_controls[of_class] + patch[at] * (last + 1), last)
            evaluate_elements(
                pieces, element, controls, uv.take(at, axis=0), patch_corner[at], self._extent, evaluator, samples, at
            )
        return samples

    @cached_property
    def _extent(self) -> FloatArray:
        """``(k,)`` extent of all control values."""
        return np.array([np.ptp(column) if len(column) else 0 for column in self.control_values.T])

    @cached_property
    def _values(self) -> FloatArray:
        """Control values of the mesh's vertices, three with a fourth of zero."""
        # Rows of 32 bytes are gathered in half the time of rows of 24.
        width = self.control_values.shape[1]
        values = np.zeros((len(self.control_of_vertex), 4 if width == 3 else width))
        values[:, :width] = self.control_values[self.control_of_vertex]
        return values

    def _controls(self, first: IntArray, last: IntArray, which: IntArray, columns: IntArray) -> FloatArray:
        """Control values of the patches that samples lie in: ``(K, m, k)``, or a fourth column more.

        Parameters
        ----------
        first, last : (s,) int64
            Of each sample's patch: index of its first control in `PatchTable.rings`, and how far after it the last is.
        which : (m,) int64
            Some of the samples.
        columns : (K,) int64
            Some control points of a one-ring; the last one in place of those that a patch has not.
        """
        index = np.minimum(columns[:, None], last.take(which))
        index += first.take(which)
        return self._values.take(self.patches.rings.take(index), axis=0)


def _runs(class_index: IntArray, order: IntArray, control_counts: IntArray) -> list[IntArray]:
    """Samples in runs of at most `CHUNK`, of at most `CLASSES` classes; given in the order of these."""
    weights = np.maximum(control_counts[class_index] ** 2, WEIGHTS // CLASSES)
    weights[1:][class_index[1:] == class_index[:-1]] = 0
    # The number of the run in which each sample's class begins.
    number = (np.cumsum(weights) - 1) // WEIGHTS
    runs = np.split(order, np.flatnonzero(np.diff(number)) + 1) if len(order) else []
    return [part for run in runs for part in np.split(run, range(CHUNK, len(run), CHUNK))]
