"""Samples anywhere on patches: evaluated, and as weights over control points in sparse matrices."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import DTypeLike

from ..evaluation.element import SurfaceSamples, evaluate_samples
from ..evaluation.equations import Evaluator
from ..evaluation.located_samples import LocatedSamples
from ..evaluation.patch_tree import patch_tree
from ..mesh import ragged
from ..mesh.connectivity import IntArray
from ..messages import counted
from ..schemes.domain import FloatArray
from ..schemes.scheme import StencilTable
from .patch_table import PatchClass, PatchTable

if TYPE_CHECKING:
    from scipy import sparse

# Weights per run of samples, for values and for each derivative, which bounds temporary memory to tens of megabytes.
WEIGHTS = 1 << 19


def located_runs(
    patches: PatchTable,
    # (s,) int64: class and corner of each sample, as from `PatchTable.patch_at`
    class_index: IntArray,
    corner: IntArray,
    uv: FloatArray,  # (s, 2) float64: parameters, starting at that corner
) -> Iterator[tuple[IntArray, LocatedSamples, list[PatchClass]]]:
    """Locate samples in runs of few classes: indices, locations, and the classes that are the elements of these."""
    scheme, classes = patches.scheme, patches.classes
    order = np.argsort(class_index.astype(np.min_scalar_type(len(classes))), kind="stable")
    runs = [order[part] for part in ragged.runs_of(patches.rings.vertex_counts[class_index[order]], WEIGHTS)]
    for run in counted(runs, "Located samples"):
        used, element = np.unique(class_index[run], return_inverse=True)
        run_classes = [classes[index] for index in used.tolist()]
        elements = [patch_tree(scheme, patch_class.signature) for patch_class in run_classes]
        yield run, LocatedSamples(scheme, elements, element, uv[run], corner[run]), run_classes


@dataclass(frozen=True, eq=False)
class PatchSampler:
    """Evaluates points, or other values that are subdivided like points, anywhere on patches."""

    patches: PatchTable
    control_values: FloatArray  # (n, k) float64
    # (n_v,) int64: 0-based row of ``control_values`` at each mesh vertex, by default those of the patches
    control_of_vertex: IntArray | None = None

    def evaluate(
        self,
        # (s,) int64: the corner where a sample's parameters are (0, 0), a half-edge of `PatchTable.elements`
        half_edge: IntArray,
        uv: FloatArray,  # (s, 2) float64: parameters, starting at that corner
        # As for `LimitSurface.evaluate`
        evaluator: Evaluator = "stabilized",
        dtype: DTypeLike = np.float64,
        derivatives: int = 1,
    ) -> SurfaceSamples:
        """Evaluate points, derivatives and normals at samples."""
        class_index, patch, corner = self.patches.patch_at(half_edge)
        samples = SurfaceSamples.empty(len(uv), self.control_values.shape[1], dtype, derivatives)
        for run, located, _ in located_runs(self.patches, class_index, corner, uv):
            controls = self.patches.rings.vertices_of(class_index[run], patch[run])
            points = [self._values.take(class_controls, axis=0) for class_controls in controls]
            of_run = evaluate_samples(located, points, self._extent, evaluator, dtype, derivatives)
            for values, run_values in zip(samples, of_run, strict=True):
                if values is not None and run_values is not None:
                    values[run] = run_values
        return samples

    @cached_property
    def _extent(self) -> FloatArray:
        """``(k,)`` range of the control values, maximum minus minimum."""
        return np.array([np.ptp(column) if len(column) else 0 for column in self.control_values.T])

    @cached_property
    def _values(self) -> FloatArray:
        """``(n_v, k)`` control values at the mesh's vertices."""
        of_patches = self.patches.control_of_vertex
        return self.control_values[of_patches if self.control_of_vertex is None else self.control_of_vertex]


class StencilMatrices(NamedTuple):
    """Samples of a limit surface as weights over the cage's control points.

    A matrix times ``(n_v, k)`` control points is ``(s, k)``: the field of the same name of `SurfaceSamples`, for any
    control points, and for other values that are subdivided like points. The weights do not depend on the positions of
    control points. The transpose of a matrix maps gradients by samples to gradients by control points.

    Attributes
    ----------
    p : (s, n_v) CSR array of float64
        Rows sum to one.
    dp_du, dp_dv : (s, n_v) CSR array of float64
        Derivatives by the (u, v) of the samples; rows sum to zero. At extraordinary points tangents, see
        `SurfaceSamples`.
    d2p_duu, d2p_duv, d2p_dvv : (s, n_v) CSR array of float64, or None
        Second derivatives, if requested. Not a number at an extraordinary point itself.
    """

    p: sparse.csr_array
    dp_du: sparse.csr_array
    dp_dv: sparse.csr_array
    d2p_duu: sparse.csr_array | None = None
    d2p_duv: sparse.csr_array | None = None
    d2p_dvv: sparse.csr_array | None = None


def stencil_matrices(
    patches: PatchTable,
    # Locations of the samples, as for `PatchSampler.evaluate`
    half_edge: IntArray,
    uv: FloatArray,
    # Returns (s_element, m, K) weights for each element, such as `limit_stencils`
    stencils: Callable[[LocatedSamples], list[FloatArray]],
    count: int,  # m, number of matrices
    # As for `PatchTable`, by default its own
    control_of_vertex: IntArray | None = None,
    control_count: int = 0,
) -> list[sparse.csr_array]:
    """Limit stencils of samples as ``m`` matrices ``(s, control_count)``."""
    if control_of_vertex is None:
        control_of_vertex, control_count = patches.control_of_vertex, patches.control_count
    class_index, patch, corner = patches.patch_at(half_edge)
    # Samples at the same parameters of patches of a class have the same weights.
    order = np.lexsort((*uv.T[::-1], corner, class_index))
    places = np.stack([class_index, corner, *uv.T])[:, order]
    begins = np.flatnonzero((np.diff(places, axis=1, prepend=-1) != 0).any(axis=0))
    distinct, ends = order[begins], np.append(begins, len(order))
    none = np.empty(0, dtype=np.int32), np.empty(0, dtype=np.int32), np.empty(0)
    entries = [[none] for _ in range(count)]
    for run, located, classes in located_runs(patches, class_index[distinct], corner[distinct], uv[distinct]):
        for patch_class, of_class, weights in zip(classes, located.slices(), stencils(located), strict=True):
            # The distinct samples of a class are consecutive.
            bounds = ends[run[of_class.start] : run[of_class.stop - 1] + 2]
            samples = order[bounds[0] : bounds[-1]].astype(np.int32)
            columns = control_of_vertex[patches.controls_of(patch_class)[patch[samples]]].astype(np.int32)
            rows = np.repeat(samples, columns.shape[1])
            repeated = np.repeat(weights, np.diff(bounds), axis=0)
            for matrix_entries, matrix_weights in zip(entries, repeated.swapaxes(0, 1), strict=False):
                matrix_entries.append((rows, columns.ravel(), matrix_weights.ravel()))
    matrices = [StencilTable.of(len(uv), control_count, *matrix_entries).matrix for matrix_entries in entries]
    for matrix in matrices:
        matrix.eliminate_zeros()
    return matrices
