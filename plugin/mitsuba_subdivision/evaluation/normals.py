"""Unit normals from tangents, and a test for points without a normal."""

from __future__ import annotations

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
# The least number of full precision, in place of a length of zero.
LEAST_LENGTH = {32: 2.0**-126, 64: 2.0**-1022}


def unit_normals(
    tangents: FloatArray,  # (2, 3, ...) float
    # (2, ...) float: for each tangent, the sum of the absolute weights of the control points in it
    weights: FloatArray | None = None,
    extent: FloatArray | None = None,  # (3, ...) float: extent of these control points along each axis
) -> FloatArray:
    """Unit vectors along the cross products of pairs of tangents, whatever the tangents' lengths.

    Coordinates come before samples: operations along rows of three would be slow.

    Returns
    -------
    (3, ...)
        Zero where the cross product is zero; with weights and extent also where it is but rounding, as tangents span no
        plane: the surface collapses to a curve or a point there, or is folded. Each coordinate of the cross product is
        compared with the rounding error that it may have. So tangents may have very different lengths, and a very thin
        cage still has normals.
    """
    with np.errstate(invalid="ignore", divide="ignore", over="ignore", under="ignore"):
        longest = np.maximum(np.abs(tangents).max(axis=1), LEAST_LENGTH[8 * tangents.dtype.itemsize])
        pair = tangents / longest[:, None]
        (a, b, c), (x, y, z) = pair
        normal = np.stack([b * z - c * y, c * x - a * z, a * y - b * x])
        squared = np.einsum("x...,x...->...", normal, normal)
        if weights is not None and extent is not None:
            collapsed = _are_rounding(pair, squared, weights / longest, extent)
            normal[:, collapsed], squared[collapsed] = 0, 0
        normal /= np.sqrt(np.where(squared == 0, 1, squared))
    return normal


def _are_rounding(
    pair: FloatArray,  # (2, 3, ...): tangents, each divided by its longest component
    squared: FloatArray,  # (...): squared lengths of their cross products
    weights: FloatArray,  # (2, ...): divided by the longest components, too
    extent: FloatArray,  # (3, ...)
) -> NDArray[np.bool_]:
    """Whether cross products are no longer than their rounding errors may be."""
    error = TANGENT_ROUNDING[8 * pair.dtype.itemsize] * weights
    # First by a bound that is too large, but takes little time. Where tangents are zero it may be not a number.
    suspect = ~(squared > 12 * ((error[0] + error[1]) * extent.max(axis=0)) ** 2)
    if suspect.any():
        (error_u, error_v), (u, v) = error[:, suspect], np.abs(pair[:, :, suspect])
        x, y, z = np.broadcast_to(extent, pair.shape[1:])[:, suspect]
        a, b, c = u * error_v + v * error_u
        bound = (b * z + c * y) ** 2 + (c * x + a * z) ** 2 + (a * y + b * x) ** 2
        suspect[suspect] = ~(squared[suspect] > bound)
    return suspect
