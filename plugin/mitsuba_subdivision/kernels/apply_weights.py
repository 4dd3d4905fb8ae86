"""Sampling weights times control points: a few kernels for a whole tessellation, differentiable, on any backend."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import drjit as dr
import numpy as np

from .array_types import NO_CONFLICTS, ArrayTypes
from .dense_batch import DenseBatch, padded_size
from .lanes import Batch
from .placement import Placement
from .product_batch import ProductBatch
from .sparse_matrix import SparseMatrix
from .unit_normal import Terms, UnitNormal

if TYPE_CHECKING:
    from ..tessellation import ClassStencils, VertexTable

# Classes with fewer samples than this share a kernel with others, as starting one would take longer than running it.
FEW_SAMPLES = 1 << 17


class WeightKernel:
    """The weights of a sampling table on the device, applied whenever the control points move.

    Building uploads the table. Applying it takes one kernel for each size of one-ring that many patches have, and one
    for regular patches, whose weights are products. Lanes of a class write vertices that follow each other. Points and
    tangents are linear in the control points: forward derivatives are the same map, reverse ones its transpose.

    Parameters
    ----------
    table : VertexTable
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
        self._refine: SparseMatrix | None = None
        self._refine_transposed: SparseMatrix | None = None
        if table.refinement is not None:
            self._refined_count = table.refinement.shape[0]
            self._refine = SparseMatrix(table.refinement, float_type, is_relative=True)
            self._refine_transposed = SparseMatrix(table.refinement.T.tocsr(), float_type, is_relative=False)
        self._place = self._types.indices(table.weld_target) if table.copies.size else None

    def __call__(self, control_points: Any, placement: Placement | None = None) -> tuple[Any, Any]:
        """Evaluate every vertex of the tessellation.

        Parameters
        ----------
        control_points : flat Dr.Jit float array, (3 control_count)
            x, y, z of each control point.
        placement : Placement, optional
            From the control points' space to that of the result. Applied to points and tangents after they are
            evaluated, so that normals are as exact far from the origin as near it. Not differentiable, see
            `EvaluatedVertices.attached`.

        Returns
        -------
        positions, normals : flat Dr.Jit float arrays, (3 vertex_count)
            Points, and unit normals along the cross product of the tangents, zero where a patch is folded or collapsed.
            Differentiable with respect to the control points, forward and backward, unless there is a placement.

        Raises
        ------
        ValueError
            If the number of control points is not that of the table.
        """
        if placement is None and dr.grad_enabled(control_points):
            return self.evaluated(dr.detach(control_points)).attached(control_points)
        self.require_control_points(control_points)
        # Tangents are not written, as no derivative needs them.
        positions, normals = self.sampled(
            dr.detach(control_points), 2, lambda point, *tangents: (point, UnitNormal(*tangents).value), placement
        )
        return self.welded(positions), normals

    def evaluated(self, control_points: Any, placement: Placement | None = None) -> EvaluatedVertices:
        """Evaluate every vertex with what derivatives need; arguments as for a call, detached.

        Raises
        ------
        ValueError
            If the number of control points is not that of the table.
        """
        self.require_control_points(control_points)
        return EvaluatedVertices(self, *self.sampled(control_points, 4, _with_tangents, placement))

    def require_control_points(self, control_points: Any) -> None:
        """Check that a flat array has as many coordinates as the table has of control points.

        Raises
        ------
        ValueError
            If not.
        """
        if dr.width(control_points) != 3 * self.control_count:
            raise ValueError(coordinates_expected(dr.width(control_points), self.control_count))

    def welded(self, positions: Any) -> Any:
        """The positions, with those on both sides of a crease the same, bit by bit; see `VertexTable.weld_target`."""
        return positions if self._place is None else self._types.gathered(positions, self._place)

    def sampled(
        self, control_points: Any, count: int, finish: Callable[..., tuple], placement: Placement | None = None
    ) -> tuple:
        """Evaluate ``count`` vectors at every vertex; flat, detached.

        Parameters
        ----------
        finish : callable
            Makes the vectors from a point, two tangents, and the `Terms` that these are sums of.
        placement : Placement, optional
            Applied to all of these first.
        """
        padded = self._types.padded(control_points if self._refine is None else self._refine(control_points))
        buffers: tuple[Any, ...] = tuple(dr.empty(self._types.float, 3 * self.vertex_count) for _ in range(count))

        def emit(vertex, point, du, dv, terms):
            if placement is not None:
                point, du, dv = placement.point(point), placement.direction(du), placement.direction(dv)
                terms = terms.placed(placement)
            for buffer, value in zip(buffers, finish(point, du, dv, terms), strict=True):
                dr.scatter(buffer, value, vertex, mode=NO_CONFLICTS)

        for batch in self._batches:
            batch.sample(padded, emit)
        return buffers

    def transposed(self, values: Sequence[Any], finish: Callable[..., tuple]) -> Any:
        """Sum weights times vectors over all vertices, per control point; flat, detached.

        Parameters
        ----------
        values : flat arrays of 3-vectors, one for each vertex
        finish : callable
            Makes of these, for a vertex, the three vectors that stand in place of its point and tangents.
        """
        dr.eval(values)

        def fetch(vertex):
            return finish(*(dr.gather(self._types.vector3, value, vertex) for value in values))

        sums: Any = dr.zeros(self._types.float, 3 * self._refined_count)
        for batch in self._batches:
            batch.add_transposed(fetch, sums)
        return sums if self._refine_transposed is None else self._refine_transposed(sums)


def _batches(types: ArrayTypes, table: VertexTable) -> Iterator[Batch]:
    """All patches, shared out among a few kernels: classes padded to the same size, unless these have few samples."""
    # Not aligned, as kernels never read it in order or in packets.
    controls = types.index(table.controls)
    are_rounded = table.refinement is not None
    runs = table.runs.along_patches()
    counts = np.bincount(runs.class_of_kind, runs.counts * runs.run_counts, minlength=len(runs.classes))
    first = count = 0
    for index, stencils in enumerate(runs.classes):
        is_product = stencils.product is not None and counts[index] > FEW_SAMPLES
        is_other_size = first < index and _padded_size(stencils) != _padded_size(runs.classes[index - 1])
        if first < index and (is_product or (count > FEW_SAMPLES and is_other_size)):
            yield DenseBatch(types, runs.of_classes(first, index), controls, are_rounded)
            first, count = index, 0
        if is_product:
            yield ProductBatch(types, runs.of_classes(index, index + 1), controls, are_rounded)
            first = index + 1
        else:
            count += int(counts[index])
    if first < len(runs.classes):
        yield DenseBatch(types, runs.of_classes(first, len(runs.classes)), controls, are_rounded)


def _padded_size(stencils: ClassStencils) -> int:
    return padded_size(stencils.controls.shape[1])


@dataclass(frozen=True, eq=False)
class EvaluatedVertices:
    """Vertices of a tessellation, and what derivatives with respect to the control points need.

    Attributes
    ----------
    kernel : WeightKernel
    positions, normals, du, dv : flat Dr.Jit float arrays, (3 vertex_count)
        Points, unit normals and tangents; detached.
    """

    kernel: WeightKernel
    positions: Any
    normals: Any
    du: Any
    dv: Any

    def attached(
        self, control_points: Any, to_world: Any = None, on_backward: Callable[[Any], None] | None = None
    ) -> tuple[Any, Any]:
        """Positions and normals, with derivatives. Evaluates nothing.

        Parameters
        ----------
        control_points : flat Dr.Jit float array, (3 control_count)
            With derivatives or not.
        to_world : 4x4 Dr.Jit matrix, optional
            Affine map from their space to that of the positions, with derivatives or not.
        on_backward : callable, optional
            Called with the gradient by the control points in the world, whenever a gradient has passed backwards from
            the vertices. Dr.Jit then forgets the computation that it took, and the next gradient needs another.

        Returns
        -------
        positions, normals : flat Dr.Jit float arrays, (3 vertex_count)
        """
        positions, normals = dr.custom(_Evaluation, self, control_points, to_world, on_backward)
        return self.kernel.welded(positions), normals


class _Evaluation(dr.CustomOp):
    """Control points to points and normals: a linear map to points and tangents, and the normals of these.

    The values may come from object space, which is more exact. Derivatives are taken in the world, where points and
    tangents are weights times the control points in the world.
    """

    def eval(self, vertices, control_points, to_world, on_backward):
        self.vertices, self.control_points, self.to_world = vertices, control_points, to_world
        self.on_backward = on_backward
        # Copies, as Dr.Jit attaches derivatives to the arrays themselves that are returned.
        return type(vertices.positions)(vertices.positions), type(vertices.normals)(vertices.normals)

    def forward(self):
        kernel = self.vertices.kernel
        moved = self.grad_in("control_points")
        if self.to_world is not None:
            placement, change = (Placement.of(m, kernel.vector3) for m in (self.to_world, self.grad_in("to_world")))
            points, moved_points = (dr.unravel(kernel.vector3, v) for v in (self.control_points, moved))
            moved = dr.ravel(change.point(points) + placement.direction(moved_points))
        change = kernel.sampled(moved, 3, lambda *change: change[:3])
        tangents = (self.vertices.du, self.vertices.dv, *change[1:])
        du, dv, change_u, change_v = (dr.unravel(kernel.vector3, v) for v in tangents)
        self.set_grad_out((change[0], dr.ravel(UnitNormal(du, dv).forward(change_u, change_v))))

    def backward(self):
        kernel = self.vertices.kernel
        in_world = kernel.transposed(
            (*self.grad_out(), self.vertices.du, self.vertices.dv),
            lambda point, normal, du, dv: (point, *UnitNormal(du, dv).backward(normal)),
        )
        if self.to_world is None:
            self.set_grad_in("control_points", in_world)
        else:
            placement = Placement.of(self.to_world, kernel.vector3)
            points, gradient = (dr.unravel(kernel.vector3, v) for v in (self.control_points, in_world))
            self.set_grad_in("control_points", dr.ravel(placement.transposed(gradient)))
            self.set_grad_in("to_world", placement.gradient(type(self.to_world), points, gradient))
        if self.on_backward is not None:
            self.on_backward(in_world)

    def name(self):
        return "WeightKernel"


def _with_tangents(point: Any, du: Any, dv: Any, terms: Terms) -> tuple[Any, Any, Any, Any]:
    """Point, normal and tangents. Where there is no normal, it and the tangents are zero, and so are derivatives."""
    normal = UnitNormal(du, dv, terms)
    return point, normal.value, dr.select(normal.exists, du, 0), dr.select(normal.exists, dv, 0)


def coordinates_expected(count: int, control_count: int) -> str:
    """Say that ``count`` coordinates do not fit ``control_count`` control points."""
    return f"{count} coordinates; expected {3 * control_count}, x, y, z of {control_count} control points"
