"""Vertices of a tessellation on any backend: points and unit normals of polynomials."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial

import drjit as dr
import numpy as np

from ..evaluation.normals import LEAST_EXTENT, TANGENT_ROUNDING
from ..mesh import ragged
from ..mesh.shared import shared
from ..patches.piece_table import PACKET
from ..tessellation.vertex_table import VertexPolynomials, VertexTable
from .algebra import AffineMap, Monomials, unit
from .array_types import (
    NO_CONFLICTS,
    SUMS,
    ArrayTypes,
    Float,
    FloatBuffer,
    Index,
    IndexBuffer,
    Matrix4,
    Vector3,
    replayed,
)
from .linear_maps import SparseMatrix, WeightBlocks, attached

# Least divisor when `UnitNormal` divides a tangent by its longest component, so that the cross product neither under-
# nor overflows. A shorter tangent means that the patch has collapsed to a point or a curve.
SHORTEST = 1e-30


class VertexKernel:
    """A tessellation on the device, evaluated whenever its control points move.

    Points and tangents are linear in the control points: forward mode applies the same map, reverse mode its transpose.
    Weights have the precision of ``float_type``, the flat array of control points, such as ``drjit.llvm.ad.Float``.
    """

    def __init__(self, table: VertexTable, float_type: type) -> None:
        self.vertex_count, self.control_count = table.vertex_count, table.patches.control_count
        self._types = types = ArrayTypes(float_type)
        controls, refinement = table.patches.control_rows()
        self._refined_count = self.control_count if refinement is None else refinement.row_count
        self._refinement = None if refinement is None else shared(SparseMatrix, refinement, float_type)
        indices, are_rounded = types.indices(controls), refinement is not None
        self._parts = [_Part(types, part, indices, are_rounded) for part in table.polynomials]
        self._weld_target = types.indices(table.weld_target) if table.copies.size else None

    def __call__(self, control_points: FloatBuffer) -> tuple[FloatBuffer, FloatBuffer]:
        """Points and unit normals, flat, from x, y, z of each control point; differentiable, forward and backward.

        Normals have the direction of the cross product of the tangents, and are zero where a patch is folded or
        collapsed. Raises ValueError if the number of control points is not that of the table.
        """
        return self.attached(control_points, *self.evaluated(dr.detach(control_points)))

    def evaluated(self, control_points: FloatBuffer) -> tuple[FloatBuffer, FloatBuffer]:
        """Points and unit normals from detached control points; raises as a call does."""
        if dr.width(control_points) != 3 * self.control_count:
            raise ValueError(coordinates_expected(dr.width(control_points), self.control_count))
        vertices: tuple[FloatBuffer, FloatBuffer] = self._evaluated(control_points)
        return vertices

    @replayed
    def _evaluated(
        self, control_points: FloatBuffer, change: FloatBuffer | None = None
    ) -> tuple[FloatBuffer, FloatBuffer]:
        """Points and normals, or their directional derivatives for a change of the control points; flat, detached."""
        padded, padded_change = self._padded(control_points), None if change is None else self._padded(change)
        kind, size = self._types.float, 3 * self.vertex_count
        buffers: tuple[FloatBuffer, FloatBuffer] = dr.empty(kind, size), dr.empty(kind, size)
        for part in self._parts:
            part.evaluate(padded, buffers, padded_change)
        positions, normals = buffers
        # Bitwise equal on both sides of a crease: see `VertexTable.weld_target`
        if self._weld_target is not None:
            positions = self._types.gathered(positions, self._weld_target)
        return positions, normals

    def attached(
        self, control_points: FloatBuffer, positions: FloatBuffer, normals: FloatBuffer
    ) -> tuple[FloatBuffer, FloatBuffer]:
        """Attach the results of `evaluated` to the control points, if these are differentiated.

        Needed once for each gradient: Dr.Jit removes a computation from its graph once gradients have passed through.
        """
        derivatives = (partial(function, dr.detach(control_points)) for function in (self._evaluated, self.gradient))
        vertices: tuple[FloatBuffer, FloatBuffer] = attached((positions, normals), control_points, *derivatives)
        return vertices

    @replayed
    def gradient(self, control_points: FloatBuffer, positions: FloatBuffer, normals: FloatBuffer) -> FloatBuffer:
        """Gradient by the control points, from the gradients by points and normals; flat, detached."""
        if self._weld_target is not None:
            welded: Vector3 = dr.unravel(self._types.vector3, positions)
            positions = dr.zeros(self._types.float, 3 * self.vertex_count)
            dr.scatter_add(positions, welded, self._weld_target, mode=SUMS)
        dr.eval(positions, normals)
        padded = self._padded(control_points)
        sums: FloatBuffer = dr.zeros(self._types.float, PACKET * self._refined_count)
        for part in self._parts:
            part.add_transposed(padded, positions, normals, sums)
        gradient = self._types.unpadded(sums, self._refined_count)
        return gradient if self._refinement is None else self._refinement.transposed(gradient)

    def _padded(self, control_points: FloatBuffer) -> FloatBuffer:
        points = control_points if self._refinement is None else self._refinement.product(control_points)
        return self._types.padded(points)


class _Part:
    """Vertices on polynomials with the same monomials. Each lane loops over the vertices of one polynomial."""

    def __init__(self, types: ArrayTypes, part: VertexPolynomials, controls: IndexBuffer, are_rounded: bool) -> None:
        self._types, self._monomials = types, Monomials(part.powers.tolist())
        bits = 64 if types.is_double else 32
        # Rounding error of the tangents, relative to the extent of the control points; and the least extent, relative
        # to the first control point.
        self._rounding = types.floats((TANGENT_ROUNDING[bits] * part.tangent_weights)[part.block])
        self._least_extent = LEAST_EXTENT[bits] if are_rounded else 0
        columns = np.column_stack([part.blocks, ragged.starts(part.blocks[:, 2])])
        self._blocks = WeightBlocks(types, part.weights, columns, controls, part.block, part.patch)
        self._first_run, self._kind, self._first_vertex, self._first_entry, self._offset = map(
            types.indices, (part.first_run, part.kind, part.first_vertex, part.first_entry, part.offset)
        )
        self._st = types.floats(part.st)
        # Whether each polynomial has one vertex, as on planes: then a loop would take longer to trace than to run.
        self._are_single = len(part.kind) == len(part.block) and bool((np.diff(part.first_entry)[part.kind] == 1).all())

    def evaluate(self, padded: FloatBuffer, buffers: Sequence[FloatBuffer], change: FloatBuffer | None = None) -> None:
        """Scatter points and normals, or their directional derivatives for a change of the control points."""
        coefficients, *bound = self._coefficients(padded)
        changes = None if change is None else self._blocks.vectors(change)[0]

        def add(vertex, s, t):
            p, du, dv = self._monomials.values(coefficients, s, t)
            normal = UnitNormal(du, dv, *bound)
            n = normal.value
            if changes is not None:
                p, change_u, change_v = self._monomials.values(changes, s, t)
                n = normal.forward(change_u, change_v)
            for buffer, value in zip(buffers, (p, n), strict=True):
                dr.scatter(buffer, value, vertex, mode=NO_CONFLICTS)
            return ()

        self._loop((), add, "vertices")

    def add_transposed(self, padded: FloatBuffer, by_p: FloatBuffer, by_n: FloatBuffer, sums: FloatBuffer) -> None:
        """Scatter-add gradients by padded control points, from the gradients by points and normals."""
        types = self._types
        coefficients, *bound = self._coefficients(padded)

        def add(vertex, s, t, *gradients):
            _, du, dv = self._monomials.values(coefficients, s, t)
            p, n = (dr.gather(types.vector3, buffer, vertex) for buffer in (by_p, by_n))
            by_u, by_v = UnitNormal(du, dv, *bound).backward(n)
            totals = []
            for (monomial, monomial_s, monomial_t), gradient in zip(self._monomials.each(s, t), gradients, strict=True):
                total = dr.fma(p, monomial, gradient)
                total = total if monomial_s is None else dr.fma(by_u, monomial_s, total)
                totals.append(total if monomial_t is None else dr.fma(by_v, monomial_t, total))
            return tuple(totals)

        zero: Vector3 = dr.zeros(types.vector3, self._blocks.count)
        gradients = self._loop(tuple(types.vector3(zero) for _ in self._monomials.powers), add, "vertex_gradients")
        self._blocks.add_transposed(gradients, sums)

    def _coefficients(self, padded: FloatBuffer) -> tuple[list[Vector3], Float, Vector3]:
        """The coefficients of each lane's polynomial; rounding error and extent for `UnitNormal`."""
        types = self._types
        coefficients, origin, extent = self._blocks.vectors(padded)
        rounding: Float = dr.gather(types.float, self._rounding, dr.arange(types.index, self._blocks.count))
        return coefficients, rounding, dr.maximum(extent, dr.abs(origin) * self._least_extent)

    def _loop(self, start: tuple, add: Callable[..., tuple], label: str) -> tuple:
        """Call ``add`` for each vertex of each lane's polynomial, with its index, its parameters and the state."""
        types = self._types
        lane: Index = dr.arange(types.index, self._blocks.count)

        def range_of(run):
            """The first vertex of a run, and its entries."""
            kind, first_vertex = (dr.gather(types.index, column, run) for column in (self._kind, self._first_vertex))
            return first_vertex, *(dr.gather(types.index, self._first_entry, kind + end) for end in (0, 1))

        def add_entry(first_vertex, entry, *state):
            vertex = first_vertex + dr.gather(types.index, self._offset, entry)
            s, t = dr.gather(types.vector2, self._st, entry)
            return add(vertex, s, t, *state)

        def add_run(run, *state):
            first_vertex, entry, end = range_of(run)
            _, *state = dr.while_loop(
                (entry, *state),
                lambda entry, *_: entry < end,
                lambda entry, *state: (entry + 1, *add_entry(first_vertex, entry, *state)),
                label=f"{label}_of_run",
            )
            return run + 1, *state

        if self._are_single:
            return add_entry(*range_of(lane)[:2], *start)
        run, end = (dr.gather(types.index, self._first_run, lane + end) for end in (0, 1))
        _, *state = dr.while_loop((run, *start), lambda run, *_: run < end, add_run, label=label)
        return tuple(state)


def placed(
    positions: FloatBuffer, normals: FloatBuffer, matrix: Matrix4, vector3: type
) -> tuple[FloatBuffer, FloatBuffer]:
    """Map flat positions and unit normals; differentiable with respect to these and the matrix."""
    p: Vector3 = dr.unravel(vector3, positions)
    n: Vector3 = dr.unravel(vector3, normals)
    if dr.grad_enabled(matrix):
        # With Dr.Jit's derivatives, each use of an entry would add a sum over the points, in a separate kernel.
        zero = dr.zeros(type(matrix), dr.width(p))
        matrix = attached(dr.detach(matrix) + zero, matrix, lambda change: change + zero, _summed)
    to_world = AffineMap.of(matrix)
    return dr.ravel(to_world.point(p)), dr.ravel(unit(to_world.normal(n)))


def _summed(gradient: Matrix4) -> Matrix4:
    dr.eval(gradient)
    return type(gradient)([[dr.sum(entry) for entry in row] for row in gradient])


def coordinates_expected(count: int, control_count: int) -> str:
    """Message for ``count`` coordinates that do not fit ``control_count`` control points."""
    return f"{count} coordinates; expected {3 * control_count}, x, y, z of {control_count} control points"


class UnitNormal:
    """Unit normal along the cross product of two tangents; zero where these are parallel."""

    def __init__(
        self,
        # Tangents, of any Dr.Jit type, detached: derivatives are `forward` and `backward`
        du: Vector3,
        dv: Vector3,
        # Rounding error of a tangent, relative to the extent of the points that it is a sum of: their largest distance
        # from the first one, along each axis. The normal is also zero where tangents are parallel within this error, as
        # in `evaluation.normals.unit_normals`.
        rounding: Float,
        extent: Vector3,
    ) -> None:
        # The normal does not depend on the tangents' lengths; its derivative does by these factors.
        self._scale_u, self._scale_v = (dr.rcp(dr.maximum(dr.max(dr.abs(x)), SHORTEST)) for x in (du, dv))
        self._du, self._dv = du * self._scale_u, dv * self._scale_v
        cross = dr.cross(self._du, self._dv)
        squared = dr.squared_norm(cross)
        # Components of one tangent times the error of the other; products with the extent bound the error of each
        # component of the cross product of parallel tangents.
        error_u, error_v = rounding * self._scale_u, rounding * self._scale_v
        a, b = dr.fma(dr.abs(self._du), error_v, dr.abs(self._dv) * error_u), extent
        squared_error = (
            dr.square(dr.fma(a.y, b.z, a.z * b.y))
            + dr.square(dr.fma(a.z, b.x, a.x * b.z))
            + dr.square(dr.fma(a.x, b.y, a.y * b.x))
        )
        self._inverse_length = dr.select(squared > squared_error, dr.rsqrt(squared), 0)
        self.value = cross * self._inverse_length

    def forward(self, change_u: Vector3, change_v: Vector3) -> Vector3:
        """Directional derivative of the normal for changes of the tangents; zero where there is no normal."""
        change = dr.cross(change_u * self._scale_u, self._dv) + dr.cross(self._du, change_v * self._scale_v)
        return self._across(change)

    def backward(self, gradient: Vector3) -> tuple[Vector3, Vector3]:
        """Gradients by the tangents, from the gradient by the normal; zero where there is no normal."""
        across = self._across(gradient)
        return dr.cross(self._dv, across) * self._scale_u, dr.cross(across, self._du) * self._scale_v

    def _across(self, vector: Vector3) -> Vector3:
        """Component of a vector perpendicular to the normal, divided by the length of the cross product."""
        return (vector - self.value * dr.dot(self.value, vector)) * self._inverse_length
