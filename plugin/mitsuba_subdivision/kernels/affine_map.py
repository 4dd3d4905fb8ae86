"""Affine maps on the device, between object space, in which surfaces are evaluated, and world space."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import reduce

import drjit as dr

from .array_types import Float, FloatBuffer, Matrix4, Vector3
from .linear_maps import attached
from .vectors import cross, dot, like, unit


@dataclass(frozen=True, eq=False)
class AffineMap:
    """A linear map, then a translation."""

    rows: tuple[Sequence[Float], ...]  # The linear map
    translation: Sequence[Float]
    inverse: tuple[Sequence[Float], ...]  # Inverse of the linear map

    @classmethod
    def of(
        cls,
        # Of Dr.Jit or NumPy. A missing inverse is computed, and is differentiable.
        matrix: Matrix4,
        inverse: Matrix4 | None = None,
    ) -> AffineMap:
        """The map of a 4x4 matrix, whose last row is ignored."""
        rows = _rows(matrix)
        return cls(rows, [matrix[i, 3] for i in range(3)], _inverse(rows) if inverse is None else _rows(inverse))

    def point(self, point: Vector3) -> Vector3:
        """Map a point."""
        # Add the translation last: the coordinates of points far from the world's origin are then rounded once.
        return like([x + y for x, y in zip(self.direction(point), self.translation, strict=True)], point)

    def direction(self, vector: Vector3) -> Vector3:
        """Map a vector without the translation."""
        return like([dot(row, vector) for row in self.rows], vector)

    def normal(self, normal: Vector3) -> Vector3:
        """Map a normal by the inverse transpose, without normalization. Reflections keep it on the outside."""
        return like([dot(column, normal) for column in zip(*self.inverse, strict=True)], normal)

    def inverse_point(self, point: Vector3) -> Vector3:
        """Map a point by the inverse."""
        # Subtract the translation first: both points may be far from the world's origin.
        return self.inverse_direction(like([x - y for x, y in zip(point, self.translation, strict=True)], point))

    def inverse_direction(self, vector: Vector3) -> Vector3:
        """Map a vector by the inverse, without the translation."""
        return like([dot(row, vector) for row in self.inverse], vector)


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


def _rows(matrix: Matrix4) -> tuple[Sequence[Float], ...]:
    return tuple([matrix[i, k] for k in range(3)] for i in range(3))


def _inverse(rows: tuple[Sequence[Float], ...]) -> tuple[Sequence[Float], ...]:
    # Divide by the largest entry, so that the determinant neither overflows nor underflows.
    scale = 1 / reduce(dr.maximum, [dr.abs(dr.detach(entry)) for row in rows for entry in row])
    x, y, z = ([entry * scale for entry in row] for row in rows)
    columns = cross(y, z), cross(z, x), cross(x, y)
    factor = scale / dot(x, columns[0])
    return tuple([column[i] * factor for column in columns] for i in range(3))


def _summed(gradient: Matrix4) -> Matrix4:
    dr.eval(gradient)
    return type(gradient)([[dr.sum(entry) for entry in row] for row in gradient])
