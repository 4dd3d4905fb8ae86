"""Evaluation anywhere on the patches of a table: of points, or of other values that are subdivided as points are."""

from __future__ import annotations

from functools import partial

import numpy as np
from numpy.typing import DTypeLike

from ..evaluation.element import ElementSamples, evaluate_elements
from ..evaluation.equations import Evaluator
from ..mesh.connectivity import IndexArray, IntArray
from ..progress import counted
from ..schemes.domain import FloatArray
from .patch_table import PatchTable

# Samples are evaluated in runs of this many, which bounds temporary memory to some tens of megabytes.
CHUNK = 32768
# And of at most this many classes, whose pieces are prepared at once.
CLASSES = 512
# Of tips; that leaves a 64th of each to eigen-coordinates.
PIECE_LEVELS = 3


def evaluate_patches(
    patches: PatchTable,
    control_values: FloatArray,
    control_of_vertex: IntArray,
    half_edge: IntArray,
    uv: FloatArray,
    evaluator: Evaluator = "stabilized",
    dtype: DTypeLike = np.float64,
    derivatives: int = 1,
) -> ElementSamples:
    """Evaluate samples.

    Parameters
    ----------
    patches : PatchTable
    control_values : (n, k) float64
    control_of_vertex : (n_v,) int64
        0-based row of ``control_values`` at each mesh vertex.
    half_edge : (s,) int64
        The corner of an element where each sample's parameters are (0, 0), a half-edge of `PatchTable.elements`.
    uv : (s, 2) float64
        Parameters, seen from that corner.
    evaluator, dtype, derivatives
        As for `LimitSurface.evaluate`.
    """
    class_index, patch, patch_corner = patches.patch_at(half_edge)
    samples = ElementSamples.empty(len(uv), control_values.shape[1], dtype, derivatives)
    # Second derivatives, and single precision, have no bits to lose; and the other forms are about these levels.
    is_usual = evaluator == "stabilized" and derivatives == 1 and np.dtype(dtype) == np.float64
    piece_levels = PIECE_LEVELS if is_usual else 0
    # Sorted by class, a run of samples has few new classes, and few control points.
    order = np.argsort(class_index.astype(np.min_scalar_type(len(patches.classes))), kind="stable")
    first_control = np.array([each.first_control for each in patches.classes], dtype=np.int64)
    patch_count, size = np.array([each.controls.shape for each in patches.classes], dtype=np.int64).reshape(-1, 2).T
    # Column by column: operations along rows of three would be slow.
    columns = np.ascontiguousarray(control_values.T)
    extent = columns.max(axis=1, initial=-np.inf) - columns.min(axis=1, initial=np.inf)
    own_row = None if np.array_equal(control_of_vertex, np.arange(len(control_of_vertex))) else control_of_vertex
    for at in counted(_runs(class_index[order], order), "Evaluated patches"):
        of_class = class_index[at]
        pieces, element = patches.elements_of(of_class, piece_levels)
        first, step = first_control[of_class] + patch[at], patch_count[of_class]
        controls = partial(_control_values, patches.controls, control_values, own_row, first, step, size[of_class] - 1)
        evaluate_elements(
            pieces, element, controls, uv.take(at, axis=0), patch_corner[at], extent, evaluator, samples, at
        )
    return samples


def _control_values(
    controls: IndexArray,
    values: FloatArray,
    control_of_vertex: IntArray | None,
    first: IntArray,
    step: IntArray,
    last: IntArray,
    which: IntArray,
    count: int,
) -> FloatArray:
    """Control values of the patches that samples lie in.

    Parameters
    ----------
    controls : (n,) int32
        `PatchTable.controls`.
    values : (n, k) float64
    control_of_vertex : (n_v,) int64, or None
        0-based row of ``values`` at each mesh vertex; None where that is its own number.
    first, step, last : (s,) int64
        Of each sample's patch: index of its first control, stride to the next ones, and their number.
    which : (m,) int64
        Some of the samples.
    count : int

    Returns
    -------
    (count, m, k) float64
        The last control value again, where a patch has fewer.
    """
    columns = np.minimum(np.arange(count)[:, None], last.take(which))
    found = controls.take(columns * step.take(which) + first.take(which))
    return values.take(found if control_of_vertex is None else control_of_vertex.take(found), axis=0)


def _runs(class_index: IntArray, order: IntArray) -> list[IntArray]:
    """Samples in runs of at most `CHUNK`, of at most `CLASSES` classes; given in the order of these."""
    number = np.cumsum(class_index[1:] != class_index[:-1]) // CLASSES if len(order) > 1 else np.empty(0, np.int64)
    cuts = np.flatnonzero(number[1:] != number[:-1]) + 2 if len(number) else number
    runs = np.split(order, cuts) if len(order) else []
    return [part for run in runs for part in np.split(run, range(CHUNK, len(run), CHUNK))]
