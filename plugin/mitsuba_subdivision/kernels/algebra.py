"""Vectors of three components, affine maps between object space and world space, and polynomials of two parameters.

Vectors are 3-vectors of Dr.Jit, or lists of three arrays of a device or the host. These operations take a fraction of
the tracing time of Dr.Jit's functions of the same names.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import reduce

import drjit as dr

from .array_types import Float, Mask, Matrix4, Value, Vector3


def dot(a: Sequence[Float], b: Sequence[Float]) -> Float:
    """Scalar product."""
    (a_x, a_y, a_z), (b_x, b_y, b_z) = a, b
    return dr.fma(a_x, b_x, dr.fma(a_y, b_y, a_z * b_z))


def cross(a: Vector3, b: Vector3) -> Vector3:
    """Cross product."""
    (a_x, a_y, a_z), (b_x, b_y, b_z) = a, b
    components = [dr.fma(a_y, b_z, -(a_z * b_y)), dr.fma(a_z, b_x, -(a_x * b_z)), dr.fma(a_x, b_y, -(a_y * b_x))]
    return like(components, a)


def unit(vector: Vector3) -> Vector3:
    """Normalize a vector; zero if its length is zero, infinite, or so small that its inverse is infinite."""
    # Divide by the largest component first, so that squares neither overflow nor underflow.
    largest = dr.detach(reduce(dr.maximum, [dr.abs(x) for x in vector]))
    scale = 1 / dr.select(largest > 0, largest, 1)
    exists = (largest > 0) & (scale > 0) & dr.isfinite(scale)
    scaled = [dr.select(exists, x * scale, 0) for x in vector]
    inverse = dr.select(exists, dr.rsqrt(dr.select(exists, dot(scaled, scaled), 1)), 0)
    return like([x * inverse for x in scaled], vector)


def added(a: Vector3, b: Vector3, factor: Float = 1) -> Vector3:
    """Return ``a + factor * b``."""
    return like([dr.fma(y, factor, x) for x, y in zip(a, b, strict=True)], a)


def combined(a: Sequence[Float], by_a: Float, b: Sequence[Float], by_b: Float) -> list[Float]:
    """Return ``by_a * a + by_b * b`` for vectors of any number of components."""
    return [dr.fma(x, by_a, y * by_b) for x, y in zip(a, b, strict=True)]


def selected(condition: Mask, a: Sequence[Float], b: Sequence[Float]) -> list[Float]:
    """Return ``a`` where a condition holds, and ``b`` elsewhere."""
    return [dr.select(condition, x, y) for x, y in zip(a, b, strict=True)]


def like(components: list, vector: Vector3) -> Vector3:
    """Make a vector of the same type as ``vector`` from three components."""
    return components if isinstance(vector, list) else type(vector)(*components)


def step_along(r: Vector3, d: Vector3, du: Vector3, dv: Vector3) -> tuple[Float, Float]:
    """Coefficients of ``du`` and ``dv`` in ``r``, written as a combination of ``du``, ``dv`` and ``d``."""
    d, du, dv = [*d], [*du], [*dv]
    across_v, across_u = cross(dv, d), cross(d, du)
    inverse = over(1, dot(du, across_v))
    return dot(r, across_v) * inverse, dot(r, across_u) * inverse


def over(value: Float, divisor: Float, otherwise: float = dr.inf) -> Float:
    """Divide two numbers, or return ``otherwise`` where the divisor is zero; never raises ZeroDivisionError."""
    exists = divisor != 0
    return dr.select(exists, value / dr.select(exists, divisor, 1), otherwise)


@dataclass(frozen=True, eq=False)
class AffineMap:
    """A linear map, then a translation."""

    rows: tuple[Sequence[Float], ...]  # The linear map
    translation: Sequence[Float]
    inverse: tuple[Sequence[Float], ...]  # Inverse of the linear map

    @classmethod
    def of(cls, matrix: Matrix4, inverse: Matrix4 | None = None) -> AffineMap:
        """The map of a 4x4 matrix of Dr.Jit or NumPy, whose last row is ignored.

        Of ``inverse``, only the linear part is read; a missing one is computed, and is differentiable.
        """
        rows = _rows(matrix)
        return cls(rows, [matrix[i, 3] for i in range(3)], _inverse(rows) if inverse is None else _rows(inverse))

    def point(self, point: Vector3) -> Vector3:
        """Map a point."""
        # Add the translation last: the coordinates of points far from the world's origin are then rounded once.
        return added(self.direction(point), self.translation)

    def direction(self, vector: Vector3) -> Vector3:
        """Map a vector without the translation."""
        return _product(self.rows, vector)

    def normal(self, normal: Vector3) -> Vector3:
        """Map a normal by the inverse transpose, without normalization. Reflections keep it on the outside."""
        return _product(zip(*self.inverse, strict=True), normal)

    def inverse_point(self, point: Vector3) -> Vector3:
        """Map a point by the inverse."""
        # Subtract the translation first: both points may be far from the world's origin.
        return self.inverse_direction(added(point, self.translation, -1))

    def inverse_direction(self, vector: Vector3) -> Vector3:
        """Map a vector by the inverse, without the translation."""
        return _product(self.inverse, vector)


def _rows(matrix: Matrix4) -> tuple[Sequence[Float], ...]:
    return tuple([matrix[i, 0], matrix[i, 1], matrix[i, 2]] for i in range(3))


def _product(rows: Iterable[Sequence[Float]], vector: Vector3) -> Vector3:
    return like([dot(row, vector) for row in rows], vector)


def _inverse(rows: tuple[Sequence[Float], ...]) -> tuple[Sequence[Float], ...]:
    # Divide by the largest entry, so that the determinant neither overflows nor underflows.
    scale = 1 / reduce(dr.maximum, [dr.abs(dr.detach(entry)) for row in rows for entry in row])
    x, y, z = ([entry * scale for entry in row] for row in rows)
    columns = cross(y, z), cross(z, x), cross(x, y)
    factor = scale / dot(x, columns[0])
    return tuple([column[i] * factor for column in columns] for i in range(3))


class Monomials:
    """Monomials that polynomials are linear combinations of."""

    def __init__(
        self,
        powers: Sequence[Sequence[int]],  # (m, 2) exponents of s and t
    ) -> None:
        self.powers = powers
        highest = max(b for _, b in powers)
        # For each power of t, the index of the monomial with each power of s, or None.
        self._columns: list[list[int | None]] = []
        for power in range(highest + 1):
            column = {a: index for index, (a, b) in enumerate(powers) if b == power}
            self._columns.append([column.get(a) for a in range(max(column, default=0) + 1)])

    def values(self, coefficients: Sequence[Value], s: Float, t: Float, derivatives: int = 1) -> tuple[Value, ...]:
        """Evaluate a polynomial from its m coefficients, which are numbers or vectors.

        Returns the value; derivatives by s and t; and if ``derivatives`` is 2, those by ss, st and tt.
        """
        along_s = [
            _horner([0 if k is None else coefficients[k] for k in column], s, derivatives) for column in self._columns
        ]
        value, by_t, by_tt = _horner([row[0] for row in along_s], t, derivatives)
        by_s, by_st, _ = _horner([row[1] for row in along_s if row[1] is not None], t, derivatives - 1)
        results = [value, by_s, by_t]
        if derivatives == 2:
            by_ss, _, _ = _horner([row[2] for row in along_s if row[2] is not None] or [None], t, 0)
            results += [by_ss, by_st, by_tt]
        return tuple(value * 0 if row is None else row for row in results)

    def each(self, s: Float, t: Float) -> list[tuple[Float, Float | None, Float | None]]:
        """The value of each monomial, and its derivatives by s and t; None for derivatives that are zero."""
        return [
            (
                _power(s, a) * _power(t, b),
                a * _power(s, a - 1) * _power(t, b) if a else None,
                b * _power(s, a) * _power(t, b - 1) if b else None,
            )
            for a, b in self.powers
        ]


def _power(x: Float, exponent: int) -> Float:
    product = 1.0
    for _ in range(exponent):
        product = product * x
    return product


def _horner(coefficients: list[Value], x: Float, derivatives: int) -> tuple[Value, Value, Value]:
    """Value and derivatives of a polynomial of one variable; None for derivatives that are zero."""
    value, first, half_second = coefficients[-1], None, None
    for coefficient in coefficients[-2::-1]:
        if derivatives == 2 and first is not None:
            half_second = first if half_second is None else dr.fma(half_second, x, first)
        if derivatives:
            first = value if first is None else dr.fma(first, x, value)
        value = dr.fma(value, x, coefficient)
    return value, first, None if half_second is None else 2 * half_second
