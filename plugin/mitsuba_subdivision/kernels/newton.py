"""Step limits and termination tolerances shared by the Newton searches over a surface."""

from __future__ import annotations

import drjit as dr

from .array_types import ArrayTypes
from .types import Float, Vector3
from .vectors import cross, dot

# Longest step, in parameters of an element: outside its element, a polynomial may be far from the surface.
LONGEST_STEP = 0.5
# A step shorter than this, in parameters of a piece, is the last: the next would be about as short as its square. The
# second is for nearest points in double precision, which derivatives start from.
STEP_TOLERANCE, STEP_TOLERANCE_DOUBLE = 3e-4, 1e-7
# Rounding error of the difference of two points, relative to their coordinates: some units in the last place.
_ROUNDING_SINGLE, _ROUNDING_DOUBLE = 2.0**-21, 2.0**-50


def rounding(types: ArrayTypes) -> float:
    """Rounding error of the difference of two points, relative to their coordinates."""
    return _ROUNDING_DOUBLE if types.is_double else _ROUNDING_SINGLE


def step_along(r: Vector3, d: Vector3, du: Vector3, dv: Vector3) -> tuple[Float, Float]:
    """Components of a vector ``r`` along two tangents, after removing its component along ``d``."""
    d, du, dv = [*d], [*du], [*dv]
    across_v, across_u = cross(dv, d), cross(d, du)
    inverse = over(1, dot(du, across_v))
    return dot(r, across_v) * inverse, dot(r, across_u) * inverse


def over(value: Float, divisor: Float, otherwise: float = dr.inf) -> Float:
    """A quotient; another number where the divisor is zero, which is an error for Python's numbers."""
    exists = divisor != 0
    return dr.select(exists, value / dr.select(exists, divisor, 1), otherwise)
