"""Stencil weights times control points: a few differentiable kernels for a whole tessellation, on any backend."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import drjit as dr
import numpy as np

from .array_types import NO_CONFLICTS, ArrayTypes
from .control_values import WeightedValues
from .dense_batch import DenseBatch, padded_size
from .lanes import Batch
from .product_batch import ProductBatch
from .types import FloatBuffer, Vector3
from .unit_normal import RoundingBound, UnitNormal

if TYPE_CHECKING:
    from ..tessellation import ClassStencils, VertexTable

# Classes with fewer samples than this share a kernel, as launching one would take longer than running it.
FEW_SAMPLES = 1 << 17


class WeightKernel:
    """The weights of a sampling table on the device, applied whenever the control points move.

    Building uploads the table. Applying it takes one kernel for each size of one-ring that many patches have, and one
    for regular patches, whose weights are products. Lanes of a class write consecutive vertices. Points and tangents
    are linear in the control points: forward mode applies the same map, reverse mode its transpose.

    Parameters
    ----------
    float_type : type
        Flat Dr.Jit array of the control points, such as ``drjit.llvm.ad.Float``. Weights have its precision.
    """

    def __init__(self, table: VertexTable, float_type: type) -> None:
        self.vertex_count = table.vertex_count
        self.control_count = table.control_count
        self._types = ArrayTypes.of(float_type)
        self.vector3 = self._types.vector3
        self._batches = list(_batches(self._types, table))
        self._refined_count = table.control_count
        self._refinement: WeightedValues | None = None
        if table.refinement is not None:
            self._refined_count = table.refinement.shape[0]
            self._refinement = WeightedValues.shared(table.refinement, float_type)
        self._weld_target = self._types.indices(table.weld_target) if table.copies.size else None

    def __call__(self, control_points: FloatBuffer) -> tuple[FloatBuffer, FloatBuffer]:
        """Evaluate every vertex of the tessellation.

        Raises ValueError if the number of control points is not that of the table.

        Parameters
        ----------
        control_points : flat Dr.Jit float array, (3 control_count)
            x, y, z of each control point.

        Returns
        -------
        positions, normals : flat Dr.Jit float arrays, (3 vertex_count)
            Points, and unit normals along the cross product of the tangents, zero where a patch is folded or collapsed.
            Differentiable with respect to the control points, forward and backward.
        """
        if dr.grad_enabled(control_points):
            return self.evaluated(dr.detach(control_points)).attached(control_points)
        self.require_control_points(control_points)
        # Without derivatives, tangents are not written.
        positions, normals = self.sampled(
            control_points, 2, lambda point, *tangents: (point, UnitNormal(*tangents).value)
        )
        return self.welded(positions), normals

    def evaluated(self, control_points: FloatBuffer) -> EvaluatedVertices:
        """Evaluate every vertex and the tangents that derivatives need, from detached control points.

        Raises ValueError if the number of control points is not that of the table.
        """
        self.require_control_points(control_points)
        return EvaluatedVertices(self, *self.sampled(control_points, 4, _with_tangents))

    def require_control_points(self, control_points: FloatBuffer) -> None:
        """Check that a flat array has as many coordinates as the table has of control points.

        Raises ValueError if not.
        """
        if dr.width(control_points) != 3 * self.control_count:
            raise ValueError(coordinates_expected(dr.width(control_points), self.control_count))

    def welded(self, positions: FloatBuffer) -> FloatBuffer:
        """The positions, with both sides of a crease equal bit by bit; see `VertexTable.weld_target`."""
        return positions if self._weld_target is None else self._types.gathered(positions, self._weld_target)

    def sampled(self, control_points: FloatBuffer, count: int, finish: Callable[..., tuple]) -> tuple:
        """Evaluate ``count`` vectors at every vertex; flat, detached.

        Parameters
        ----------
        finish : callable
            Computes the vectors from a point, two tangents, and the `RoundingBound` of the tangents.
        """
        padded = self._types.padded(
            control_points if self._refinement is None else self._refinement.product(control_points)
        )
        buffers: tuple[FloatBuffer, ...] = tuple(
            dr.empty(self._types.float, 3 * self.vertex_count) for _ in range(count)
        )

        def emit(vertex, point, du, dv, bound):
            for buffer, value in zip(buffers, finish(point, du, dv, bound), strict=True):
                dr.scatter(buffer, value, vertex, mode=NO_CONFLICTS)

        for batch in self._batches:
            batch.sample(padded, emit)
        return buffers

    def transposed(self, values: Sequence[FloatBuffer], finish: Callable[..., tuple]) -> FloatBuffer:
        """Sum weights times vectors over all vertices, per control point; flat, detached.

        Parameters
        ----------
        finish : callable
            Computes from these, for a vertex, the three vectors that the weights of its point and tangents multiply.
        """
        dr.eval(values)

        def fetch(vertex):
            return finish(*(dr.gather(self._types.vector3, value, vertex) for value in values))

        sums: FloatBuffer = dr.zeros(self._types.float, 3 * self._refined_count)
        for batch in self._batches:
            batch.add_transposed(fetch, sums)
        return sums if self._refinement is None else self._refinement.transposed(sums)


def _batches(types: ArrayTypes, table: VertexTable) -> Iterator[Batch]:
    """All patches, grouped into a few kernels: classes of the same padded size; small classes share one kernel."""
    controls = types.indices(table.controls)
    are_rounded = table.refinement is not None
    vertex_stencils = table.vertex_stencils.along_patches()
    counts = np.bincount(
        vertex_stencils.class_of_kind,
        vertex_stencils.counts * vertex_stencils.run_counts,
        minlength=len(vertex_stencils.classes),
    )
    first = count = 0
    for index, stencils in enumerate(vertex_stencils.classes):
        is_product = stencils.product is not None and counts[index] > FEW_SAMPLES
        is_other_size = first < index and _padded_size(stencils) != _padded_size(vertex_stencils.classes[index - 1])
        if first < index and (is_product or (count > FEW_SAMPLES and is_other_size)):
            yield DenseBatch(types, vertex_stencils.of_classes(first, index), controls, are_rounded)
            first, count = index, 0
        if is_product:
            yield ProductBatch(types, vertex_stencils.of_classes(index, index + 1), controls, are_rounded)
            first = index + 1
        else:
            count += int(counts[index])
    if first < len(vertex_stencils.classes):
        yield DenseBatch(types, vertex_stencils.of_classes(first, len(vertex_stencils.classes)), controls, are_rounded)


def _padded_size(stencils: ClassStencils) -> int:
    return padded_size(stencils.controls.shape[1])


@dataclass(frozen=True, eq=False)
class EvaluatedVertices:
    """Vertices of a tessellation, with the tangents that their derivatives by the control points need."""

    kernel: WeightKernel
    # flat Dr.Jit float arrays, (3 vertex_count): points, unit normals and tangents; detached
    positions: FloatBuffer
    normals: FloatBuffer
    du: FloatBuffer
    dv: FloatBuffer

    def attached(self, control_points: FloatBuffer) -> tuple[FloatBuffer, FloatBuffer]:
        """Positions and normals attached to control points, without evaluating them.

        Dr.Jit forgets a computation once gradients have passed through it, and the next gradient needs another.

        Returns
        -------
        positions, normals : flat Dr.Jit float arrays, (3 vertex_count)
        """
        positions, normals = dr.custom(_Evaluation, self, control_points)
        return self.kernel.welded(positions), normals


class _Evaluation(dr.CustomOp):
    """Control points to points and normals: a linear map to points and tangents, and the normals of these."""

    def eval(self, vertices, control_points):  # noqa: ARG002 - what derivatives are by
        self.vertices = vertices
        # Copies, because Dr.Jit attaches derivatives to the returned arrays themselves.
        return type(vertices.positions)(vertices.positions), type(vertices.normals)(vertices.normals)

    def forward(self):
        kernel = self.vertices.kernel
        change = kernel.sampled(self.grad_in("control_points"), 3, lambda *change: change[:3])
        tangents = (self.vertices.du, self.vertices.dv, *change[1:])
        du, dv, change_u, change_v = (dr.unravel(kernel.vector3, v) for v in tangents)
        self.set_grad_out((change[0], dr.ravel(UnitNormal(du, dv).forward(change_u, change_v))))

    def backward(self):
        gradient = self.vertices.kernel.transposed(
            (*self.grad_out(), self.vertices.du, self.vertices.dv),
            lambda point, normal, du, dv: (point, *UnitNormal(du, dv).backward(normal)),
        )
        self.set_grad_in("control_points", gradient)

    def name(self):
        return "WeightKernel"


def _with_tangents(
    point: Vector3, du: Vector3, dv: Vector3, bound: RoundingBound
) -> tuple[Vector3, Vector3, Vector3, Vector3]:
    """Point, normal and tangents. Without a normal, it, the tangents and all derivatives are zero."""
    normal = UnitNormal(du, dv, bound)
    return point, normal.value, dr.select(normal.exists, du, 0), dr.select(normal.exists, dv, 0)


def coordinates_expected(count: int, control_count: int) -> str:
    """Message for ``count`` coordinates that do not fit ``control_count`` control points."""
    return f"{count} coordinates; expected {3 * control_count}, x, y, z of {control_count} control points"
