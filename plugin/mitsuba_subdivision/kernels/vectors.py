"""Operations on vectors whose versions in Dr.Jit take several times as long to trace."""

from __future__ import annotations

from typing import Any

import drjit as dr


def cross(a: Any, b: Any) -> Any:
    """The cross product of two 3-vectors."""
    (a_x, a_y, a_z), (b_x, b_y, b_z) = a, b
    return type(a)(
        dr.fma(a_y, b_z, -(a_z * b_y)),
        dr.fma(a_z, b_x, -(a_x * b_z)),
        dr.fma(a_x, b_y, -(a_y * b_x)),
    )
