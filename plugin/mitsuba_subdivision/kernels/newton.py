"""What searches over a surface by Newton's method have in common: how long steps are, and when they end."""

from __future__ import annotations

from typing import Any

import drjit as dr

from .array_types import ArrayTypes
from .vectors import cross

# Longest step, in parameters of an element: polynomials may be far off outside theirs, and the surface another one.
LONGEST_STEP = 0.5
# A step shorter than this, in parameters of a piece, is the last: the next would be about as short as its square. For
# nearest points in double precision, whose derivatives go on from there.
LAST_STEP, LAST_STEP_DOUBLE = 3e-4, 1e-7
# What rounding leaves of the difference of two points, in sizes of their coordinates: some units of either.
_ROUNDING_SINGLE, _ROUNDING_DOUBLE = 2.0**-21, 2.0**-50


def rounding(types: ArrayTypes) -> float:
    """What rounding leaves of the difference of two points, as a part of their coordinates."""
    return _ROUNDING_DOUBLE if types.is_double else _ROUNDING_SINGLE


def step_along(r: Any, d: Any, du: Any, dv: Any) -> tuple[Any, Any]:
    """How far along two tangents a vector ``r`` leads, but for what of it is along ``d``."""
    across_v, across_u = cross(dv, d), cross(d, du)
    inverse = over(1, dr.dot(du, across_v))
    return dr.dot(r, across_v) * inverse, dr.dot(r, across_u) * inverse


def over(value: Any, divisor: Any) -> Any:
    """A quotient; infinite where the divisor is zero, also in scalar variants, where that would be an error."""
    exists = divisor != 0
    return dr.select(exists, value / dr.select(exists, divisor, 1), dr.inf)
