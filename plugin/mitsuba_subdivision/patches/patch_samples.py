"""Evaluation anywhere on the patches of a table: of points, or of other values that are subdivided as points are."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import DTypeLike

from ..evaluation.divided_element import element_of
from ..evaluation.element import ElementSamples, evaluate_samples
from ..evaluation.equations import Evaluator
from ..evaluation.sample_weights import LocatedSamples
from ..mesh.connectivity import IntArray
from ..progress import counted
from ..schemes.domain import FloatArray
from .patch_table import PatchTable

# Samples are evaluated in runs of so many weights of each kind, which bounds temporary memory to tens of megabytes.
WEIGHTS = 1 << 19


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
        scheme, classes = self.patches.scheme, self.patches.classes
        class_index, patch, corner = self.patches.patch_at(half_edge)
        samples = ElementSamples.empty(len(uv), self.control_values.shape[1], dtype, derivatives)
        # Sorted by class, a run of samples has few classes, and few control points.
        order = np.argsort(class_index.astype(np.min_scalar_type(len(classes))), kind="stable")
        ends = np.cumsum(self.patches.control_counts[class_index[order]]) // WEIGHTS
        runs = np.split(order, np.flatnonzero(np.diff(ends)) + 1) if len(order) else []
        for at in counted(runs, "Evaluated patches"):
            used, element = np.unique(class_index[at], return_inverse=True)
            own = [classes[index] for index in used.tolist()]
            elements = [element_of(scheme, each.signature) for each in own]
            located = LocatedSamples(scheme, elements, element, uv[at], corner[at])
            controls = [
                each.controls.take(patch[at[of_element]], axis=0)
                for each, of_element in zip(own, located.slices(), strict=True)
            ]
            points = [self._values.take(indices, axis=0) for indices in controls]
            samples.put(at, evaluate_samples(located, points, self._extent, evaluator, dtype, derivatives))
        return samples

    @cached_property
    def _extent(self) -> FloatArray:
        """``(k,)`` extent of all control values."""
        return np.array([np.ptp(column) if len(column) else 0 for column in self.control_values.T])

    @cached_property
    def _values(self) -> FloatArray:
        """``(n_v, k)`` control values of the mesh's vertices."""
        return self.control_values[self.control_of_vertex]
