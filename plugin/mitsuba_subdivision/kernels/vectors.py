"""Operations on vectors of three components: 3-vectors of Dr.Jit, or lists of three arrays of a device or the host.

They take a fraction of the tracing time of Dr.Jit's functions of the same names. The module also has the tolerances of
Newton's method.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import reduce

import drjit as dr

from .array_types import ArrayTypes, Float, Vector3

# Longest Newton step, in parameters of an element: outside of its element, a polynomial may be far from the surface.
LONGEST_STEP = 0.5
# Tolerance of a Newton step's length, in parameters of a piece: a next step would be about as long as the square of
# this. The second one is for nearest points in double precision, which their derivatives depend on.
STEP_TOLERANCE, STEP_TOLERANCE_DOUBLE = 3e-4, 1e-7
# Rounding error of the difference of two points, relative to their coordinates: some units in the last place (ulp).
_ROUNDING_SINGLE, _ROUNDING_DOUBLE = 2.0**-21, 2.0**-50


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


def like(components: list, vector: Vector3) -> Vector3:
    """Make a vector of the same type as ``vector`` from three components."""
    return components if isinstance(vector, list) else type(vector)(*components)


def rounding(types: ArrayTypes) -> float:
    """Rounding error of the difference of two points, relative to their coordinates."""
    return _ROUNDING_DOUBLE if types.is_double else _ROUNDING_SINGLE


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
