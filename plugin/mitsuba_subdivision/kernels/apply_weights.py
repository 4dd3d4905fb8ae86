"""Sampling weights times control points: a few kernels for a whole tessellation, differentiable, on any backend."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from itertools import groupby
from typing import TYPE_CHECKING, Any

import drjit as dr

from .array_types import ArrayTypes
from .dense_batch import DenseBatch, filled
from .lanes import Batch
from .placement import Placement
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

    def __call__(self, control_points: Any, place: Placement | None = None) -> tuple[Any, Any]:
        """Evaluate every vertex of the tessellation.

        Parameters
        ----------
        control_points : flat Dr.Jit float array, (3 control_count)
            x, y, z of each control point.
        place : Placement, optional
            From the control points' space to that of the result. Applied to points and tangents as they are evaluated,
            so that far-off places cost normals nothing. Has no derivatives, see `EvaluatedVertices.attached`.

        Returns
        -------
        positions, normals : flat Dr.Jit float arrays, (3 vertex_count)
            Points, and unit normals along the cross product of the tangents, zero where a patch is folded or collapsed.
            Differentiable with respect to the control points, forward and backward, unless there is a place.

        Raises
        ------
        ValueError
            If the number of control points is not that of the table.
        """
        if place is None and dr.grad_enabled(control_points):
            return self.evaluated(dr.detach(control_points)).attached(control_points)
        self._check(control_points)
        # Tangents that no derivative needs are not written.
        positions, normals = self.sampled(
            dr.detach(control_points), 2, lambda point, *tangents: (point, UnitNormal(*tangents).value), place
        )
        return self._welded_positions(positions), normals

    def evaluated(self, control_points: Any, place: Placement | None = None) -> EvaluatedVertices:
        """Evaluate every vertex with what derivatives need; arguments as for a call, detached.

        Raises
        ------
        ValueError
            If the number of control points is not that of the table.
        """
        self._check(control_points)
        return EvaluatedVertices(self, *self.sampled(control_points, 4, _with_tangents, place))

    def _check(self, control_points: Any) -> None:
        if dr.width(control_points) != 3 * self.control_count:
            raise ValueError(coordinates_expected(dr.width(control_points), self.control_count))

    def _welded_positions(self, positions: Any) -> Any:
        if self._welded is None:
            return positions
        return dr.ravel(dr.gather(self._types.vector3, positions, self._welded))

    def sampled(
        self, control_points: Any, count: int, finish: Callable[..., tuple], place: Placement | None = None
    ) -> tuple:
        """Evaluate ``count`` vectors at every vertex; flat, detached.

        Parameters
        ----------
        finish : callable
            Makes the vectors of a point, two tangents, and the `Terms` that these are sums of.
        place : Placement, optional
            Applied to all of these first.
        """
        padded = self._types.padded(control_points if self._refine is None else self._refine(control_points))
        buffers = tuple(dr.empty(self._types.float, 3 * self.vertex_count) for _ in range(count))

        def emit(vertex, point, du, dv, terms):
            if place is not None:
                point, du, dv = place.point(point), place.direction(du), place.direction(dv)
                terms = terms.placed(place)
            for buffer, value in zip(buffers, finish(point, du, dv, terms), strict=True):
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


@dataclass(frozen=True, eq=False)
class EvaluatedVertices:
    """Vertices of a tessellation, and what derivatives by the control points need.

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
        """Positions and normals, with derivatives; evaluates nothing.

        Parameters
        ----------
        control_points : flat Dr.Jit float array, (3 control_count)
            With derivatives or not.
        to_world : 4x4 Dr.Jit matrix, optional
            Affine map from their space to that of the positions, with derivatives or not.
        on_backward : callable, optional
            Called whenever gradients have passed from the vertices, with that by the control points in the world.
            Dr.Jit forgets the way that they took, so that others would no longer find it.

        Returns
        -------
        positions, normals : flat Dr.Jit float arrays, (3 vertex_count)
        """
        positions, normals = dr.custom(_Evaluation, self, control_points, to_world, on_backward)
        return self.kernel._welded_positions(positions), normals


class _Evaluation(dr.CustomOp):
    """Control points to points and normals: a linear map to points and tangents, and the normals of these.

    Points and tangents in the world are weights times the control points in the world, however exactly their values
    have been found: derivatives are taken there.
    """

    def eval(self, vertices, control_points, to_world, on_backward):
        self.vertices, self.control_points, self.to_world = vertices, control_points, to_world
        self.on_backward = on_backward
        # As they are, Dr.Jit would take them for its own.
        return type(vertices.positions)(vertices.positions), type(vertices.normals)(vertices.normals)

    def forward(self):
        kernel = self.vertices.kernel
        moved = self.grad_in("control_points")
        if self.to_world is not None:
            place, change = (Placement.of(m, kernel.vector3) for m in (self.to_world, self.grad_in("to_world")))
            points = (dr.unravel(kernel.vector3, v) for v in (self.control_points, moved))
            moved = dr.ravel(change.point(next(points)) + place.direction(next(points)))
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
            place = Placement.of(self.to_world, kernel.vector3)
            points, gradient = (dr.unravel(kernel.vector3, v) for v in (self.control_points, in_world))
            self.set_grad_in("control_points", dr.ravel(place.transposed(gradient)))
            self.set_grad_in("to_world", place.gradient(type(self.to_world), points, gradient))
        if self.on_backward is not None:
            self.on_backward(in_world)

    def name(self):
        return "WeightKernel"


def _with_tangents(point: Any, du: Any, dv: Any, terms: Terms) -> tuple[Any, Any, Any, Any]:
    """Point, normal, and the tangents whose normal it is: zero where there is none, and so are its derivatives."""
    normal = UnitNormal(du, dv, terms)
    return point, normal.value, dr.select(normal.exists, du, 0), dr.select(normal.exists, dv, 0)


def coordinates_expected(count: int, control_count: int) -> str:
    """Say that ``count`` coordinates do not fit ``control_count`` control points."""
    return f"{count} coordinates; expected {3 * control_count}, x, y, z of {control_count} control points"
