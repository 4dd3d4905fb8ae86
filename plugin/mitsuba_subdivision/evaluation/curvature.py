"""Gaussian and mean curvature, also near extraordinary points."""

from __future__ import annotations

import numpy as np

from ..mesh.connectivity import IntArray
from ..schemes.domain import FloatArray
from .equations import child_rows, times_powers
from .irregular_patch import IrregularPatch
from .normals import unit_normals

# Curvature near an extraordinary point goes with (|λ_4| / λ_2²)ⁿ. A ratio nearer to one than this counts as one.
CONSTANT = 1e-9


def curvature(first: FloatArray, second: FloatArray) -> FloatArray:
    """Curvatures from the fundamental forms.

    Parameters
    ----------
    first : (2, s, 3)
        Derivatives by u, by v.
    second : (3, s, 3)
        By uu, uv, vv.

    Returns
    -------
    (2, s)
        Gaussian and mean, the latter positive where the surface bends towards ``du x dv``.
    """
    du, dv = first
    with np.errstate(invalid="ignore", divide="ignore", over="ignore"):
        a, b, c = _dot(du, du), _dot(du, dv), _dot(dv, dv)
        normal = unit_normals(first.swapaxes(1, 2)).T
        e, f, g = (_dot(row, normal) for row in second)
        area = a * c - b * b
        return np.stack([(e * g - f * f) / area, (e * c - 2 * f * b + g * a) / (2 * area)])


def irregular_curvature(patch: IrregularPatch, uv: FloatArray, coordinates: FloatArray, which: IntArray) -> FloatArray:
    """Curvatures in an irregular patch, relative to the frame of its limit normal.

    Near the extraordinary point second derivatives are almost tangential, and rounding drowns their small part along
    the normal. So coordinates in the limit tangent plane and heights over it are summed apart. The coordinates go with
    powers of λ_2 and the heights with powers of λ_4, as the eigenvectors of λ_2 and λ_3 have no height at all. Every
    term of the second fundamental form has one height as a factor, so its power comes out in front.

    Parameters
    ----------
    uv : (s, 2) float64
        Parameters in the patch.
    coordinates : (e, K, 3)
        Eigen-coordinates of every element.
    which : (s,) int64
        Element of each sample.

    Returns
    -------
    (2, s)
        Gaussian and mean. At the extraordinary point itself 0 where the curvature vanishes there, else not a number.
    """
    level, rows = child_rows(patch.scheme, uv, patch.eigen_children.astype(coordinates.dtype), 2)
    largest, second_largest = patch.basis.subdominant, float(patch.basis.moduli[3])
    frame = _orthonormal_frames(coordinates)
    local = np.einsum("ekx,exf->ekf", coordinates, frame)
    local[:, :3, 2] = 0

    in_plane = times_powers(rows, level, patch.basis, largest)
    heights = times_powers(rows, level, patch.basis, second_largest)
    x, y = (np.einsum("dsk,sk->ds", in_plane, local[which, :, axis]) for axis in (0, 1))
    z = np.einsum("dsk,sk->ds", heights, local[which, :, 2])

    growth = second_largest / largest**2
    real = coordinates.dtype.type
    with np.errstate(invalid="ignore", divide="ignore", over="ignore", under="ignore"):
        # In units of λ_2ⁿ in the tangent plane and of λ_4ⁿ across it. The relief is the ratio of the two.
        relief = real(second_largest / largest) ** level.astype(real)
        normal = np.stack([y[1] * z[2] - z[1] * y[2], z[1] * x[2] - x[1] * z[2], x[1] * y[2] - y[1] * x[2]])
        e, f, g = normal[0] * x[3:] + normal[1] * y[3:] + normal[2] * z[3:]
        a, b, c = (x[i] * x[j] + y[i] * y[j] + relief**2 * z[i] * z[j] for i, j in ((1, 1), (1, 2), (2, 2)))
        area = relief**2 * (normal[0] ** 2 + normal[1] ** 2) + normal[2] ** 2
        power = real(growth) ** level.astype(real)
        gaussian = power**2 * (e * g - f * f) / area**2
        mean = power * (e * c - 2 * f * b + g * a) / (2 * area**1.5)
    found = np.stack([gaussian, mean])
    found[:, patch.scheme.domain.extent(uv) == 0] = 0 if growth < 1 - CONSTANT else np.nan
    return found


def _orthonormal_frames(coordinates: FloatArray) -> FloatArray:
    """Orthonormal frames ``(e, 3, 3)``: in columns, two tangents at the extraordinary point and the normal."""
    first = coordinates[:, 1]
    normal = unit_normals(coordinates[:, 1:3].transpose(1, 2, 0)).T
    with np.errstate(invalid="ignore", divide="ignore"):
        along = first / np.linalg.norm(first, axis=1, keepdims=True)
    return np.stack([along, np.cross(normal, along), normal], axis=2)


def _dot(a: FloatArray, b: FloatArray) -> FloatArray:
    return np.einsum("sx,sx->s", a, b)
