"""Sampling weights times control points: a few kernels for a whole tessellation, differentiable, on any backend."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from itertools import groupby
from typing import TYPE_CHECKING, Any

import drjit as dr

from .array_types import ArrayTypes
from .dense_batch import DenseBatch, filled
from .lanes import Batch
from .product_batch import ProductBatch
from .sparse_matrix import SparseMatrix
from .unit_normal import Terms, UnitNormal

if TYPE_CHECKING:
    from ..tessellation import ClassPart, SampledClass, SamplingTable

# Fewer samples than this do not get a kernel of their own: its start would take longer.
FEW_SAMPLES = 1 << 17


class WeightKernel:
    """The weights of a sampling table on the device, applied whenever the control points move.

    Building uploads the table; applying it takes one kernel for each size of one-ring that many patches have, and one
    for regular patches, whose weights are products. Lanes of a class write vertices that follow each other. Points and
    tangents are linear in the control points, so that their forward derivatives are the same map, and their reverse
    ones its transpose.

    Parameters
    ----------
    table : SamplingTable
    float_type : type
        Flat Dr.Jit array of the control points, such as ``drjit.llvm.ad.Float``. Weights get its precision.
    """

    def __init__(self, table: SamplingTable, float_type: type) -> None:
        self.vertex_count = table.vertex_count
        self.control_count = table.control_count
        self._types = ArrayTypes.of(float_type)
        self.vector3 = self._types.vector3
        self._batches = list(_batches(self._types, table))
        self._class_point_count = table.control_count
        self._refine, self._refine_transposed = None, None
        if table.matrix is not None:
            self._class_point_count = table.matrix.shape[0]
            self._refine = SparseMatrix(table.matrix, float_type, is_relative=True)
            self._refine_transposed = SparseMatrix(table.matrix.T.tocsr(), float_type, is_relative=False)
        self._welded = self._types.indices(table.welded) if table.copies.size else None

    def __call__(self, control_points: Any) -> tuple[Any, Any]:
        """Evaluate every vertex of the tessellation.

        Parameters
        ----------
        control_points : flat Dr.Jit float array, (3 control_count)
            x, y, z of each control point.

        Returns
        -------
        positions, normals : flat Dr.Jit float arrays, (3 vertex_count)
            Points, and unit normals along the cross product of the tangents, zero where a patch is folded or collapsed.
            Differentiable with respect to the control points, forward and backward.

        Raises
        ------
        ValueError
            If the number of control points is not that of the table.
        """
        if dr.width(control_points) != 3 * self.control_count:
            raise ValueError(coordinates_expected(dr.width(control_points), self.control_count))
        if dr.grad_enabled(control_points):
            positions, normals = dr.custom(_Evaluation, self, control_points)
        else:
            # Tangents that no derivative needs are not written.
            positions, normals = self.sampled(
                control_points, 2, lambda point, du, dv, terms: (point, UnitNormal(du, dv, terms).value)
            )
        if self._welded is not None:
            positions = dr.ravel(dr.gather(self._types.vector3, positions, self._welded))
        return positions, normals

    def sampled(self, control_points: Any, count: int, finish: Callable[..., tuple]) -> tuple:
        """Evaluate ``count`` vectors at every vertex; flat, detached.

        Parameters
        ----------
        finish : callable
            Makes the vectors of a point, two tangents, and the `Terms` that these are sums of.
        """
        padded = self._types.padded(control_points if self._refine is None else self._refine(control_points))
        buffers = tuple(dr.empty(self._types.float, 3 * self.vertex_count) for _ in range(count))

        def emit(vertex, *sample):
            for buffer, value in zip(buffers, finish(*sample), strict=True):
                dr.scatter(buffer, value, vertex)

        for batch in self._batches:
            batch.sample(padded, emit)
        return buffers

    def transposed(self, values: Sequence[Any], finish: Callable[..., tuple]) -> Any:
        """Sum weights times vectors over all vertices, per control point; flat, detached.

        Parameters
        ----------
        values : flat arrays of 3-vectors, one for each vertex
        finish : callable
            Makes of these, for a vertex, what point and tangents are replaced by.
        """
        dr.eval(values)

        def fetch(vertex):
            return finish(*(dr.gather(self._types.vector3, value, vertex) for value in values))

        sums = dr.zeros(self._types.float, 3 * self._class_point_count)
        for batch in self._batches:
            batch.add_transposed(fetch, sums)
        return sums if self._refine is None else self._refine_transposed(sums)


def _batches(types: ArrayTypes, table: SamplingTable) -> Iterator[Batch]:
    """All patches, by kernels that serve many each."""
    # Looked up, never read in order: it may lie where it does.
    controls = types.index(table.controls)
    are_rounded = table.matrix is not None
    batch: list[ClassPart] = []
    sample_count = 0
    for members, found in groupby(table.class_parts, lambda run: run.members):
        runs, own_count = list(found), len(members.controls) * members.weights.shape[1]
        if members.product is not None and own_count > FEW_SAMPLES:
            yield ProductBatch(types, runs, controls, are_rounded)
            continue
        if sample_count > FEW_SAMPLES and _width(members) != _width(batch[-1].members):
            yield DenseBatch(types, batch, controls, are_rounded)
            batch, sample_count = [], 0
        batch += runs
        sample_count += own_count
    if batch:
        yield DenseBatch(types, batch, controls, are_rounded)


def _width(members: SampledClass) -> int:
    return filled(members.controls.shape[1])


class _Evaluation(dr.CustomOp):
    """Control points to points and normals: a linear map to points and tangents, and the normals of these."""

    def eval(self, kernel, control_points):
        self.kernel = kernel
        positions, normals, self.du, self.dv = kernel.sampled(control_points, 4, _with_tangents)
        return positions, normals

    def forward(self):
        change = self.kernel.sampled(self.grad_in("control_points"), 3, lambda *change: change[:3])
        du, dv, change_u, change_v = (dr.unravel(self.kernel.vector3, v) for v in (self.du, self.dv, *change[1:]))
        self.set_grad_out((change[0], dr.ravel(UnitNormal(du, dv).forward(change_u, change_v))))

    def backward(self):
        self.set_grad_in(
            "control_points",
            self.kernel.transposed(
                (*self.grad_out(), self.du, self.dv),
                lambda point, normal, du, dv: (point, *UnitNormal(du, dv).backward(normal)),
            ),
        )

    def name(self):
        return "WeightKernel"


def _with_tangents(point: Any, du: Any, dv: Any, terms: Terms) -> tuple[Any, Any, Any, Any]:
    """Point, normal, and the tangents whose normal it is: zero where there is none, and so are its derivatives."""
    normal = UnitNormal(du, dv, terms)
    return point, normal.value, dr.select(normal.exists, du, 0), dr.select(normal.exists, dv, 0)


def coordinates_expected(count: int, control_count: int) -> str:
    """Say that ``count`` coordinates do not fit ``control_count`` control points."""
    return f"{count} coordinates; expected {3 * control_count}, x, y, z of {control_count} control points"
