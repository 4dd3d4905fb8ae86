"""Unit normals from tangents, and a test for points without a normal."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..schemes.domain import FloatArray

# Rounding error that a coordinate of a tangent may have, as a part of the sum of its absolute terms. A cross product
# that such errors explain counts as zero. In single precision this is the error of sums of some thirty terms. In double
# precision nothing comes near it; there is room for the errors of weights, which are right to 1e-14, and for control
# points that stand a hundred times farther from the origin than from each other.
# By the bits of a number.
TANGENT_ROUNDING = {32: 2.0**-19, 64: 2.0**-40}
# Control points that are sums of others are off by two roundings of their coordinates, however near to each other they
# stand. So their extent is taken to be at least this part of their distance from the origin.
LEAST_EXTENT = {32: 2.0**-3, 64: 2.0**-11}


def unit_normals(
    du: FloatArray, dv: FloatArray, weights: FloatArray | None = None, extent: FloatArray | None = None
) -> FloatArray:
    """Unit vectors along ``du x dv``, whatever the tangents' lengths.

    Parameters
    ----------
    du, dv : (..., 3) float
    weights, extent : optional
        As for `are_collapsed`. If given, the normal is zero where the tangents are collapsed.

    Returns
    -------
    (..., 3), zero where the cross product is zero.
    """
    with np.errstate(invalid="ignore", divide="ignore", over="ignore", under="ignore"):
        pair = _Pair.of(du, dv)
        normal, squared = pair.cross, pair.squared
        if weights is not None and extent is not None:
            collapsed = pair.is_rounding(weights, extent)
            normal[:, collapsed], squared[collapsed] = 0, 0
        normal /= np.sqrt(np.where(squared == 0, 1, squared))
    return normal.transpose(*range(1, normal.ndim), 0)


def are_collapsed(du: FloatArray, dv: FloatArray, weights: FloatArray, extent: FloatArray) -> NDArray[np.bool_]:
    """Whether tangents span no plane: the surface collapses to a curve or a point there, or is folded.

    Each coordinate of the cross product is compared with the rounding error that it may have. So tangents may have very
    different lengths, and a very thin cage still has normals.

    Parameters
    ----------
    du, dv : (..., 3) float
    weights : (2, ...) float
        For each tangent, the sum of the absolute weights of the control points in it.
    extent : (..., 3) float
        Extent of these control points along each axis. All arguments broadcast.

    Returns
    -------
    (...) bool
    """
    with np.errstate(invalid="ignore", divide="ignore", over="ignore", under="ignore"):
        return _Pair.of(du, dv).is_rounding(weights, extent)


@dataclass(frozen=True, eq=False)
class _Pair:
    """Two tangents, each divided by its longest component, and their cross product.

    Coordinates are the first axis of all arrays: operations along rows of three would be slow.
    """

    u: FloatArray
    v: FloatArray
    u_length: FloatArray
    v_length: FloatArray
    cross: FloatArray
    squared: FloatArray

    @classmethod
    def of(cls, du: FloatArray, dv: FloatArray) -> _Pair:
        # `numpy.moveaxis` does the same, and takes longer than the arithmetic on a small class.
        first = (-1, *range(du.ndim - 1))
        (u, u_length), (v, v_length) = (_with_unit_longest(tangent.transpose(first)) for tangent in (du, dv))
        cross = np.stack([u[1] * v[2] - u[2] * v[1], u[2] * v[0] - u[0] * v[2], u[0] * v[1] - u[1] * v[0]])
        return cls(u, v, u_length, v_length, cross, cross[0] ** 2 + cross[1] ** 2 + cross[2] ** 2)

    def is_rounding(self, weights: FloatArray, extent: FloatArray) -> NDArray[np.bool_]:
        """Whether the cross product is no longer than its rounding error may be."""
        tolerance = TANGENT_ROUNDING[8 * self.u.dtype.itemsize]
        error_u, error_v = tolerance * weights[0] / self.u_length, tolerance * weights[1] / self.v_length
        # First by a bound that is too large, but takes little time. Where tangents are zero the bound is not a number.
        suspect = ~(self.squared > 12 * ((error_u + error_v) * extent.max(axis=-1)) ** 2)
        if suspect.any():
            error_u, error_v = (np.broadcast_to(error, suspect.shape)[suspect] for error in (error_u, error_v))
            x, y, z = np.broadcast_to(extent, (*suspect.shape, 3))[suspect].T
            a, b, c = np.abs(self.u[:, suspect]) * error_v + np.abs(self.v[:, suspect]) * error_u
            bound = (b * z + c * y) ** 2 + (c * x + a * z) ** 2 + (a * y + b * x) ** 2
            suspect[suspect] = ~(self.squared[suspect] > bound)
        return suspect


def _with_unit_longest(tangent: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Tangents ``(3, ...)`` divided by their longest component, unless that is zero; and the longest component."""
    x, y, z = np.abs(tangent)
    longest = np.maximum(np.maximum(x, y), z)
    return tangent / np.where(longest == 0, 1, longest), longest
