"""Unit normals from tangents, and where there are none."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ..schemes.domain import FloatArray

# Tangents whose cross product is no longer than this, times that of one tangent and the terms that the other is the sum
# of, are parallel or zero: rounding alone may leave so much. In single precision it is that of sums of some thirty
# terms; in double precision, where nothing comes near it, it has room for the rounding of weights, which are right to
# 1e-14, and of control points that stand a hundred times farther from the origin than from each other.
COLLAPSED = {np.dtype(np.float32): 2.0**-19, np.dtype(np.float64): 2.0**-40}
# Control points that are sums of others miss their place by two roundings of their coordinates. So these, times this,
# are the least that terms are taken to be.
ROUNDED = {np.dtype(np.float32): 2.0**-3, np.dtype(np.float64): 2.0**-11}


def unit_normals(du: FloatArray, dv: FloatArray) -> FloatArray:
    """Unit vectors along ``du x dv``, whatever the tangents' lengths.

    Parameters
    ----------
    du, dv : (..., 3) float

    Returns
    -------
    (..., 3), zero where the cross product is.
    """
    # By components, as rows of three are too short for array operations.
    with np.errstate(invalid="ignore", divide="ignore", under="ignore"):
        (a, b, c), (d, e, f) = (_with_unit_longest(np.moveaxis(tangent, -1, 0))[0] for tangent in (du, dv))
        normal = np.stack(_cross((a, b, c), (d, e, f)))
        length = np.sqrt(normal[0] ** 2 + normal[1] ** 2 + normal[2] ** 2)
        normal /= np.where(length == 0, 1, length)
    return np.moveaxis(normal, 0, -1)


def are_collapsed(du: FloatArray, dv: FloatArray, du_terms: FloatArray, dv_terms: FloatArray) -> NDArray[np.bool_]:
    """Whether tangents span no plane but what rounding makes of them: the surface collapses there, or is folded.

    Each coordinate of the cross product is held against what rounding may leave of it, so that tangents may have very
    different lengths, and a thin cage a normal.

    Parameters
    ----------
    du, dv : (..., 3) float
    du_terms, dv_terms : (..., 3) float
        The size of the terms that each coordinate of the tangents is the sum of.

    Returns
    -------
    (...) bool
    """
    tolerance = COLLAPSED[np.dtype(du.dtype)]
    with np.errstate(invalid="ignore", divide="ignore", over="ignore", under="ignore"):
        u, u_length = _with_unit_longest(np.moveaxis(du, -1, 0))
        v, v_length = _with_unit_longest(np.moveaxis(dv, -1, 0))
        u_terms, v_terms = np.moveaxis(du_terms, -1, 0) / u_length, np.moveaxis(dv_terms, -1, 0) / v_length
        left = [
            abs(u[i]) * v_terms[j] + abs(u[j]) * v_terms[i] + abs(v[i]) * u_terms[j] + abs(v[j]) * u_terms[i]
            for i, j in ((1, 2), (2, 0), (0, 1))
        ]
        cross = _cross(u, v)
        squared, bound = (sum(x * x for x in vector) for vector in (cross, left))
        # Where nothing is left, this is not a number.
        return ~(squared > tolerance**2 * bound)


def _cross(a: FloatArray, b: FloatArray) -> list[FloatArray]:
    return [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]]


def _with_unit_longest(tangent: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Tangents ``(3, ...)`` with a longest component of one, unless they are zero, and its length before."""
    x, y, z = np.abs(tangent)
    longest = np.maximum(np.maximum(x, y), z)
    return tangent / np.where(longest == 0, 1, longest), longest
