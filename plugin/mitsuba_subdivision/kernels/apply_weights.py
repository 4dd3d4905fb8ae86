"""Sampling weights times control points: a few kernels for a whole tessellation, differentiable, on any backend."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from itertools import groupby
from typing import TYPE_CHECKING, Any

import drjit as dr

from .array_types import ArrayTypes
from .dense_batch import DenseBatch, filled
from .lanes import Batch
from .product_batch import ProductBatch
from .sparse_matrix import SparseMatrix

if TYPE_CHECKING:
    from ..tessellation import ClassPart, SampledClass, SamplingTable

# Tangents are divided by their longest component before their cross product, which else could under- or overflow. A
# component shorter than this means that the patch has collapsed to a point or a curve.
SHORTEST = 1e-30
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
            Points, and unit normals along the cross product of the tangents, zero where a patch has collapsed.
            Differentiable with respect to the control points, forward and backward.

        Raises
        ------
        ValueError
            If the number of control points is not that of the table.
        """
        if dr.width(control_points) != 3 * self.control_count:
            raise ValueError(coordinates_expected(dr.width(control_points), self.control_count))
        if dr.grad_enabled(control_points):
            points, du, dv = dr.custom(_LinearMap, self, control_points)
            positions, normals = dr.ravel(points), dr.ravel(_unit_normal(du, dv))
        else:
            # Tangents that no derivative needs are not written.
            positions, normals = self._sampled(control_points, 2, lambda point, du, dv: (point, _unit_normal(du, dv)))
        if self._welded is not None:
            positions = dr.ravel(dr.gather(self._types.vector3, positions, self._welded))
        return positions, normals

    def apply(self, control_points: Any) -> tuple[Any, Any, Any]:
        """Apply the linear map: points and two tangents of every vertex, as detached 3-vectors."""
        values = self._sampled(control_points, 3, lambda *values: values)
        return tuple(dr.unravel(self._types.vector3, value) for value in values)

    def _sampled(self, control_points: Any, count: int, finish: Callable[..., tuple]) -> tuple:
        """Evaluate ``count`` vectors, which ``finish`` makes of point and tangents, at every vertex; flat arrays."""
        padded = self._types.padded(control_points if self._refine is None else self._refine(control_points))
        buffers = tuple(dr.empty(self._types.float, 3 * self.vertex_count) for _ in range(count))

        def emit(vertex, *sample):
            for buffer, value in zip(buffers, finish(*sample), strict=True):
                dr.scatter(buffer, value, vertex)

        for batch in self._batches:
            batch.sample(padded, emit)
        return buffers

    def apply_transposed(self, point: Any, du: Any, dv: Any) -> Any:
        """Apply the transposed map: sum over vertices of weights times 3-vectors, per control point, flat."""
        padded = [self._types.padded(dr.ravel(value)) for value in (point, du, dv)]
        sums = dr.zeros(self._types.float, 3 * self._class_point_count)
        for batch in self._batches:
            batch.add_transposed(padded, sums)
        return sums if self._refine is None else self._refine_transposed(sums)


def _batches(types: ArrayTypes, table: SamplingTable) -> Iterator[Batch]:
    """All patches, by kernels that serve many each."""
    controls = types.indices(table.controls)
    batch: list[ClassPart] = []
    sample_count = 0
    for members, found in groupby(table.class_parts, lambda run: run.members):
        runs, own_count = list(found), len(members.controls) * members.weights.shape[1]
        if members.product is not None and own_count > FEW_SAMPLES:
            yield ProductBatch(types, runs, controls)
            continue
        if sample_count > FEW_SAMPLES and _width(members) != _width(batch[-1].members):
            yield DenseBatch(types, batch, controls)
            batch, sample_count = [], 0
        batch += runs
        sample_count += own_count
    if batch:
        yield DenseBatch(types, batch, controls)


def _width(members: SampledClass) -> int:
    return filled(members.controls.shape[1])


class _LinearMap(dr.CustomOp):
    """Control points to points and tangents, with the derivatives of a linear map."""

    def eval(self, kernel, control_points):
        self.kernel = kernel
        return kernel.apply(control_points)

    def forward(self):
        self.set_grad_out(self.kernel.apply(self.grad_in("control_points")))

    def backward(self):
        self.set_grad_in("control_points", self.kernel.apply_transposed(*self.grad_out()))

    def name(self):
        return "WeightKernel"


def coordinates_expected(count: int, control_count: int) -> str:
    """Say that ``count`` coordinates do not fit ``control_count`` control points."""
    return f"{count} coordinates; expected {3 * control_count}, x, y, z of {control_count} control points"


def _unit_normal(du: Any, dv: Any) -> Any:
    normal = dr.cross(_scaled(du), _scaled(dv))
    squared = dr.squared_norm(normal)
    # The inner selection keeps derivatives finite where the outer one takes zero.
    return dr.select(squared > 0, normal * dr.rsqrt(dr.select(squared > 0, squared, 1)), 0)


def _scaled(tangent: Any) -> Any:
    """Tangent with a longest component of one; the factor does not matter to the normal, nor to its derivative."""
    longest = dr.max(dr.abs(dr.detach(tangent)))
    return tangent * dr.rcp(dr.maximum(longest, SHORTEST))
