"""Affine maps on the device, between object space, in which surfaces are evaluated, and world space."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property, reduce

import drjit as dr

from .types import FloatBuffer, Matrix4, Vector3
from .vectors import cross, dot, unit


@dataclass(frozen=True, eq=False)
class AffineMap:
    """A linear map, then a translation.

    Attributes
    ----------
    columns : tuple of three 3-vectors
        Images of the axes under the linear map.
    translation : 3-vector
    """

    columns: tuple[Vector3, Vector3, Vector3]
    translation: Vector3

    @classmethod
    def of(cls, matrix: Matrix4, vector3: type) -> AffineMap:
        """The map of a 4x4 matrix, whose last row is not used.

        Parameters
        ----------
        matrix : 4x4 matrix
            Of Dr.Jit or NumPy.
        vector3 : type
            Dr.Jit array of three numbers.
        """
        x, y, z, translation = (vector3(*(matrix[row, column] for row in range(3))) for column in range(4))
        return cls((x, y, z), translation)

    def point(self, point: Vector3) -> Vector3:
        """Map a point."""
        # The translation comes last, so that points far from the world's origin are rounded once.
        return self.direction(point) + self.translation

    def direction(self, vector: Vector3) -> Vector3:
        """Map a vector without the translation."""
        return _combined(self.columns, vector)

    def normal(self, normal: Vector3) -> Vector3:
        """Map the direction of a normal by the inverse transpose; reflections keep it on the outside."""
        return type(normal)(*(dot(column, normal) for column in self._inverse))

    def inverse_point(self, point: Vector3) -> Vector3:
        """The point that is mapped to a given one."""
        # Subtract the translation first: both points may be far from the world's origin.
        return self.inverse_direction(point - self.translation)

    def inverse_direction(self, vector: Vector3) -> Vector3:
        """The vector that is mapped to a given one without the translation."""
        return _combined(self._inverse, vector)

    @cached_property
    def _inverse(self) -> tuple[Vector3, Vector3, Vector3]:
        """Columns of the inverse of the linear map."""
        # Divided by the largest entry, so that the determinant neither overflows nor underflows.
        scale = 1 / reduce(dr.maximum, [dr.abs(dr.detach(entry)) for column in self.columns for entry in column])
        x, y, z = (column * scale for column in self.columns)
        rows = cross(y, z), cross(z, x), cross(x, y)
        factor = scale / dot(x, rows[0])
        a, b, c = (type(x)(*(row[k] * factor for row in rows)) for k in range(3))
        return a, b, c


def placed(
    positions: FloatBuffer, normals: FloatBuffer, matrix: Matrix4, vector3: type
) -> tuple[FloatBuffer, FloatBuffer]:
    """Map flat positions and unit normals; differentiable with respect to all.

    Parameters
    ----------
    positions, normals : flat Dr.Jit arrays
    matrix : 4x4 Dr.Jit matrix
    vector3 : type
    """
    p: Vector3 = dr.unravel(vector3, positions)
    n: Vector3 = dr.unravel(vector3, normals)
    if dr.grad_enabled(matrix):
        matrix = dr.custom(_Spread, matrix, dr.width(p))
    to_world = AffineMap.of(matrix, vector3)
    return dr.ravel(to_world.point(p)), dr.ravel(unit(to_world.normal(n)))


def _combined(columns: tuple[Vector3, Vector3, Vector3], vector: Vector3) -> Vector3:
    x, y, z = columns
    return dr.fma(x, vector[0], dr.fma(y, vector[1], z * vector[2]))


class _Spread(dr.CustomOp):
    """Broadcasts one matrix to all points.

    Dr.Jit's own derivatives would sum over the points for each use of an entry, with a kernel for each sum.
    """

    def eval(self, matrix, count):
        self.count = count
        return matrix + dr.zeros(type(matrix), count)

    def forward(self):
        self.set_grad_out(self.grad_in("matrix") + dr.zeros(type(self.grad_in("matrix")), self.count))

    def backward(self):
        gradient = self.grad_out()
        dr.eval(gradient)
        self.set_grad_in("matrix", type(gradient)([[dr.sum(entry) for entry in row] for row in gradient]))

    def name(self):
        return "Spread"
