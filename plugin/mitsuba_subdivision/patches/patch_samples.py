"""Evaluation anywhere on the patches of a table: of points, or of other values that are subdivided as points are."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import DTypeLike, NDArray

from ..evaluation.element import evaluate_elements
from ..evaluation.equations import Evaluator
from ..mesh.connectivity import IntArray
from ..progress import counted
from ..schemes.domain import FloatArray
from .patch_table import PatchTable

# Samples are evaluated in runs of this many, which bounds temporary memory to some tens of megabytes.
CHUNK = 32768


@dataclass(frozen=True, eq=False)
class PatchSamples:
    """Values and derivatives at samples.

    Attributes
    ----------
    values : (1 + 2 or 1 + 5, s, k)
        The value; its derivatives by u and v; those by uu, uv and vv if asked for.
    frame : (2, s, k)
        Two tangents whose cross product is along the normal, at extraordinary points too.
    level : (s,) int64
        See `SurfaceSamples`.
    curvature : (2, s)
        Gaussian and mean. Not a number unless second derivatives are asked for.
    """

    values: FloatArray
    frame: FloatArray
    level: NDArray[np.int64]
    curvature: FloatArray


def evaluate_patches(
    patches: PatchTable,
    control_values: FloatArray,
    row: IntArray,
    start: IntArray,
    uv: FloatArray,
    evaluator: Evaluator = "stabilized",
    dtype: DTypeLike = np.float64,
    derivatives: int = 1,
) -> PatchSamples:
    """Evaluate samples.

    Parameters
    ----------
    patches : PatchTable
    control_values : (n, k) float64
    row : (n_v,) int64
        0-based row of ``control_values`` at each mesh vertex.
    start : (s,) int64
        The corner of an element where each sample's parameters are (0, 0), a half-edge of `PatchTable.elements`.
    uv : (s, 2) float64
        Parameters, seen from that corner.
    evaluator, dtype, derivatives
        As for `LimitSurface.evaluate`.
    """
    class_index, patch, patch_corner = (found[start] for found in patches.patch_of_corner)
    count, width = len(uv), control_values.shape[1]
    values = np.empty((3 if derivatives == 1 else 6, count, width), dtype=dtype)
    frame = np.empty((2, count, width), dtype=dtype)
    level = np.empty(count, dtype=np.int64)
    curvature = np.empty((2, count), dtype=dtype)
    # Sorted by class and patch, a run of samples needs few control points.
    order = np.lexsort((patch, class_index))
    begins = np.flatnonzero(np.diff(class_index[order], prepend=-1))
    for of_class in counted(np.split(order, begins[1:]) if count else [], "Evaluated classes of patches"):
        patch_class = patches.classes[class_index[of_class[0]]]
        for at in np.split(of_class, range(CHUNK, len(of_class), CHUNK)):
            chosen, which = np.unique(patch[at], return_inverse=True)
            found = evaluate_elements(
                patches.scheme,
                patch_class.signature,
                control_values[row[patch_class.controls[chosen]]],
                which,
                uv[at],
                patch_corner[at],
                evaluator,
                dtype,
                derivatives,
            )
            values[0, at], frame[:, at] = found.points, found.frame
            level[at], curvature[:, at] = found.level, found.curvature
            values[1:3, at] = found.tangents
            if derivatives == 2:
                values[3:, at] = found.second
    return PatchSamples(values, frame, level, curvature)
