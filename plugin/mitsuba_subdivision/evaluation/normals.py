"""Unit normals from tangents."""

from __future__ import annotations

import numpy as np

from ..schemes.domain import FloatArray


def unit_normals(du: FloatArray, dv: FloatArray) -> FloatArray:
    """Unit vectors along ``du x dv``, whatever the tangents' lengths.

    Parameters
    ----------
    du, dv : (..., 3) float

    Returns
    -------
    (..., 3), not a number where the tangents are parallel or zero.
    """
    # By components, as rows of three are too short for array operations.
    with np.errstate(invalid="ignore", divide="ignore", under="ignore"):
        (a, b, c), (d, e, f) = (_with_unit_longest(np.moveaxis(tangent, -1, 0)) for tangent in (du, dv))
        normal = np.stack([b * f - c * e, c * d - a * f, a * e - b * d])
        normal /= np.sqrt(normal[0] ** 2 + normal[1] ** 2 + normal[2] ** 2)
    return np.moveaxis(normal, 0, -1)


def _with_unit_longest(tangent: FloatArray) -> FloatArray:
    """Tangents ``(3, ...)`` with a longest component of one."""
    x, y, z = np.abs(tangent)
    return tangent / np.maximum(np.maximum(x, y), z)
