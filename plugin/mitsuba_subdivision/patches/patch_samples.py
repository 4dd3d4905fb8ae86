"""Evaluation anywhere on the patches of a table: of points, or of other values that are subdivided as points are."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import DTypeLike, NDArray

from ..evaluation.element import element_stencils, evaluate_elements
from ..evaluation.equations import Evaluator
from ..mesh import ragged
from ..mesh.connectivity import IntArray
from ..progress import counted
from ..schemes.domain import FloatArray
from .patch_table import PatchTable, RefinedPatches

if TYPE_CHECKING:
    from scipy import sparse

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


def patch_weights(patches: PatchTable, row: IntArray, count: int, start: IntArray, uv: FloatArray) -> sparse.csr_array:
    """Weights of control values in the values at samples, see `evaluate_patches`.

    Parameters
    ----------
    patches : PatchTable
    row : (n_v,) int64
        0-based control value at each mesh vertex.
    count : int
        Number of control values.
    start, uv
        Samples.

    Returns
    -------
    (s, count) sparse array
        Rows sum to one.
    """
    from scipy import sparse

    refined = patches.refined
    if refined is None:
        return _weights(patches, row, count, start, uv)
    # Else there would be too many classes, see `RefinedPatches`.
    values = sparse.csr_array((np.ones(len(row)), (np.arange(len(row)), row)), shape=(len(row), count))
    rows = np.arange(refined.table.topology.vertex_count)
    at_samples = _weights(refined.table, rows, len(rows), *_in_refined(patches, refined, start, uv))
    return (at_samples @ (refined.matrix @ values)).tocsr()


def _weights(patches: PatchTable, row: IntArray, count: int, start: IntArray, uv: FloatArray) -> sparse.csr_array:
    """As `patch_weights`, class by class."""
    from scipy import sparse

    class_index, patch, corner = (found[start] for found in patches.patch_of_corner)
    widths = np.array([patch_class.controls.shape[1] for patch_class in patches.classes])
    offsets = ragged.offsets(widths[class_index])
    entries, columns = np.empty(offsets[-1]), np.empty(offsets[-1], dtype=np.int32)
    # Samples of the same class in the same place of their patches have the same weights.
    keys = np.stack([class_index, corner, *uv.T])
    order = np.lexsort(keys[::-1])
    is_new = np.concatenate([[True], (np.diff(keys[:, order], axis=1) != 0).any(axis=0)])[: len(order)]
    distinct = order[is_new]
    begins = np.flatnonzero(np.diff(class_index[order], prepend=-1))
    for of_class, stencil in zip(np.split(order, begins[1:]), np.split(np.cumsum(is_new) - 1, begins[1:]), strict=True):
        if not len(of_class):
            continue
        patch_class = patches.classes[class_index[of_class[0]]]
        own = distinct[stencil[0] : stencil[-1] + 1]
        stencils = element_stencils(patches.scheme, patch_class.signature, uv[own], corner[own])[0]
        for begin in range(0, len(of_class), CHUNK):
            at = of_class[begin : begin + CHUNK]
            places = offsets[at][:, None] + np.arange(stencils.shape[1])
            entries[places] = stencils[stencil[begin : begin + CHUNK] - stencil[0]]
            columns[places] = row[patch_class.controls[patch[at]]]
    weights = sparse.csr_array((entries, columns, offsets), shape=(len(start), count))
    weights.sum_duplicates()
    return weights


def _in_refined(
    patches: PatchTable, refined: RefinedPatches, start: IntArray, uv: FloatArray
) -> tuple[IntArray, FloatArray]:
    """Samples as the patches of the cage refined once have them: corners of faces there, and parameters."""
    t, domain = patches.elements, patches.scheme.domain
    start, uv = start.copy(), uv.copy()
    # Any other element has parameters for each of its corners already.
    whole = np.flatnonzero(patches.is_whole[t.face_of(start)])
    children = np.stack([child(uv[whole]) for child in domain.children])
    number = np.stack([domain.inside(each) for each in children]).argmax(axis=0)
    for corner in range(domain.corner_count):
        at = whole[number == corner]
        uv[at] = domain.rotation(corner).inverse()(children[corner, number == corner])
        later = whole[number > corner]
        start[later] = t.following(start[later])
    # Face h of the refined cage lies at half-edge h of the cage, and begins there.
    return refined.table.topology.face_offsets[start], uv
