"""Limit stencils as sparse matrices: samples and their derivatives as weights over control points."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from ..evaluation.element import derivative_stencils, element_stencils
from ..mesh.connectivity import IntArray
from ..mesh.signature import Signature
from ..messages import counted
from ..schemes.domain import FloatArray
from ..schemes.scheme import StencilTable
from .patch_table import PatchTable, RefinedPatches

if TYPE_CHECKING:
    from scipy import sparse

# Weights per run of samples, for points and for each derivative, which bounds temporary memory.
CHUNK = 1 << 19


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


# Rows of ``d`` sparse matrices with the same structure: row indices ``(n,)``; column indices ``(n, K)``, of which equal
# ones in a row add up; weights ``(d, n, K)``.
StencilRows = tuple[IntArray, IntArray, FloatArray]


def joined_matrices(parts: Iterable[StencilRows], count: int, shape: tuple[int, int]) -> list[sparse.csr_array]:
    """Assemble ``count`` sparse matrices from their rows, given in any order."""
    entries: list[list[tuple[IntArray, IntArray, FloatArray]]] = [[] for _ in range(count)]
    for part_rows, part_columns, part_weights in parts:
        columns = part_columns.astype(np.int32).ravel()
        rows = np.repeat(part_rows.astype(np.int32), part_columns.shape[1])
        for matrix_entries, weights in zip(entries, part_weights, strict=True):
            matrix_entries.append((rows, columns, weights.ravel()))
    none = np.empty(0, dtype=np.int32), np.empty(0, dtype=np.int32), np.empty(0)
    matrices = [StencilTable.of(*shape, none, *matrix_entries).matrix for matrix_entries in entries]
    for matrix in matrices:
        matrix.eliminate_zeros()
    return matrices


def sample_matrices(
    patches: PatchTable,
    control_of_vertex: IntArray,  # (n_v,) int64: 0-based control point at each mesh vertex
    control_count: int,
    # Locations of the samples
    half_edge: IntArray,
    uv: FloatArray,
    derivatives: int = 1,
) -> StencilMatrices:
    """Limit stencils of samples, which are given as for `PatchSampler.evaluate`."""

    def stencils(signature: Signature, uv: FloatArray, corner: IntArray) -> FloatArray:
        return derivative_stencils(patches.scheme, signature, uv, corner, derivatives)

    rows = _rows(patches, control_of_vertex, half_edge, uv, stencils)
    return StencilMatrices(*joined_matrices(rows, 3 if derivatives == 1 else 6, (len(uv), control_count)))


def vertex_matrices(
    patches: PatchTable,
    control_of_vertex: IntArray,
    control_count: int,
    half_edge: IntArray,
    uv: FloatArray,
    count: int = 3,
) -> list[sparse.csr_array]:
    """Weights of points and two tangents (``count`` 3), or of points (1); fast for the vertices of a tessellation.

    Other arguments are as for `sample_matrices`, and tangents as of `element_stencils`.
    """
    from scipy import sparse

    def stencils(signature: Signature, uv: FloatArray, corner: IntArray) -> FloatArray:
        return element_stencils(patches.scheme, signature, uv, corner)[:count]

    refined = patches.refined
    if refined is None:
        rows = _rows(patches, control_of_vertex, half_edge, uv, stencils)
        return joined_matrices(rows, count, (len(uv), control_count))
    # The cage has too many classes of patches: evaluate on the cage refined once.
    refined_vertices = np.arange(refined.table.topology.vertex_count)
    rows = _rows(refined.table, refined_vertices, *_in_refined(patches, refined, half_edge, uv), stencils)
    mesh_of_control = sparse.csr_array(
        (np.ones(len(control_of_vertex)), (np.arange(len(control_of_vertex)), control_of_vertex)),
        shape=(len(control_of_vertex), control_count),
    )
    refinement = refined.matrix @ mesh_of_control
    shape = len(uv), len(refined_vertices)
    return [(weights @ refinement).tocsr() for weights in joined_matrices(rows, count, shape)]


def _rows(
    patches: PatchTable,
    control_of_vertex: IntArray,
    half_edge: IntArray,
    uv: FloatArray,
    # From a class's signature, and the parameters and patch corners of its samples, to ``(d, s, K)`` weights
    stencils: Callable[[Signature, FloatArray, IntArray], FloatArray],
) -> Iterator[StencilRows]:
    class_index, patch, patch_corner = patches.patch_at(half_edge)
    order = np.lexsort((*uv.T[::-1], patch_corner, class_index))
    begins = np.flatnonzero(np.diff(class_index[order], prepend=-1))
    for class_samples in counted(np.split(order, begins)[1:], "Weights of patch classes"):
        patch_class = patches.classes[class_index[class_samples[0]]]
        length = max(1, CHUNK // patch_class.controls.shape[1])
        for run in np.split(class_samples, range(length, len(class_samples), length)):
            # Samples at the same parameters of their patches have the same weights.
            places = np.stack([patch_corner[run], *uv[run].T])
            is_new = (np.diff(places, axis=1, prepend=-1) != 0).any(axis=0)
            distinct = run[is_new]
            weights = stencils(patch_class.signature, uv[distinct], patch_corner[distinct])
            controls = control_of_vertex[patch_class.controls[patch[run]]]
            yield run, controls, weights[:, np.cumsum(is_new) - 1]


def _in_refined(
    patches: PatchTable, refined: RefinedPatches, half_edge: IntArray, uv: FloatArray
) -> tuple[IntArray, FloatArray]:
    """Locate samples in the cage refined once. Returns corners of its faces, and parameters."""
    t, domain = patches.elements, patches.scheme.domain
    half_edge, uv = half_edge.copy(), uv.copy()
    # In elements that are not whole, every corner has a patch, whose parameters are already those of the refined face.
    whole = np.flatnonzero(patches.is_whole[t.face[half_edge]])
    child, uv_in_child = domain.first_child(uv[whole].T)
    for corner in range(domain.corner_count):
        uv[whole[child == corner]] = domain.rotation(corner).inverse()(uv_in_child.T[child == corner])
        later = whole[child > corner]
        half_edge[later] = t.next[half_edge[later]]
    # Face h of the refined cage lies at half-edge h of the cage, and begins there.
    return refined.table.topology.face_offsets[half_edge], uv
