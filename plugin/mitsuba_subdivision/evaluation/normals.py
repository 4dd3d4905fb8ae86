"""Unit normals from tangents, and where there are none."""

from __future__ import annotations

from dataclasses import dataclass

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


def unit_normals(
    du: FloatArray, dv: FloatArray, weights: FloatArray | None = None, reach: FloatArray | None = None
) -> FloatArray:
    """Unit vectors along ``du x dv``, whatever the tangents' lengths.

    Parameters
    ----------
    du, dv : (..., 3) float
    weights, reach : optional
        As for `are_collapsed`; where tangents are, the normal is zero, too.

    Returns
    -------
    (..., 3), zero where the cross product is.
    """
    with np.errstate(invalid="ignore", divide="ignore", over="ignore", under="ignore"):
        pair = _Pair.of(du, dv)
        normal, squared = pair.cross, pair.squared
        if weights is not None and reach is not None:
            collapsed = pair.is_left(weights, reach)
            normal[:, collapsed], squared[collapsed] = 0, 0
        normal /= np.sqrt(np.where(squared == 0, 1, squared))
    return np.moveaxis(normal, 0, -1)


def are_collapsed(du: FloatArray, dv: FloatArray, weights: FloatArray, reach: FloatArray) -> NDArray[np.bool_]:
    """Whether tangents span no plane but what rounding makes of them: the surface collapses there, or is folded.

    Each coordinate of the cross product is held against what rounding may leave of it, so that tangents may have very
    different lengths, and a thin cage a normal.

    Parameters
    ----------
    du, dv : (..., 3) float
    weights : (2, ...) float
        Sums of the absolute weights of which each tangent is made.
    reach : (..., 3) float
        How far the weighted points reach along each axis. All of these broadcast.

    Returns
    -------
    (...) bool
    """
    with np.errstate(invalid="ignore", divide="ignore", over="ignore", under="ignore"):
        return _Pair.of(du, dv).is_left(weights, reach)


@dataclass(frozen=True, eq=False)
class _Pair:
    """Two tangents, coordinates first, divided by their longest components, and their cross product.

    By components, as rows of three are too short for array operations.
    """

    u: FloatArray
    v: FloatArray
    u_length: FloatArray
    v_length: FloatArray
    cross: FloatArray
    squared: FloatArray

    @classmethod
    def of(cls, du: FloatArray, dv: FloatArray) -> _Pair:
        (u, u_length), (v, v_length) = (_with_unit_longest(np.moveaxis(tangent, -1, 0)) for tangent in (du, dv))
        cross = np.stack([u[1] * v[2] - u[2] * v[1], u[2] * v[0] - u[0] * v[2], u[0] * v[1] - u[1] * v[0]])
        return cls(u, v, u_length, v_length, cross, cross[0] ** 2 + cross[1] ** 2 + cross[2] ** 2)

    def is_left(self, weights: FloatArray, reach: FloatArray) -> NDArray[np.bool_]:
        """Whether the cross product is no longer than what rounding may leave of it."""
        tolerance = COLLAPSED[np.dtype(self.u.dtype)]
        left_u, left_v = tolerance * weights[0] / self.u_length, tolerance * weights[1] / self.v_length
        # First by a bound that is greater, but one number; where the tangents are zero, it is not a number.
        suspect = ~(self.squared > 12 * ((left_u + left_v) * reach.max(axis=-1)) ** 2)
        if suspect.any():
            left_u, left_v = (np.broadcast_to(left, suspect.shape)[suspect] for left in (left_u, left_v))
            x, y, z = np.broadcast_to(reach, (*suspect.shape, 3))[suspect].T
            a, b, c = np.abs(self.u[:, suspect]) * left_v + np.abs(self.v[:, suspect]) * left_u
            bound = (b * z + c * y) ** 2 + (c * x + a * z) ** 2 + (a * y + b * x) ** 2
            suspect[suspect] = ~(self.squared[suspect] > bound)
        return suspect


def _with_unit_longest(tangent: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Tangents ``(3, ...)`` with a longest component of one, unless they are zero, and its length before."""
    x, y, z = np.abs(tangent)
    longest = np.maximum(np.maximum(x, y), z)
    return tangent / np.where(longest == 0, 1, longest), longest
