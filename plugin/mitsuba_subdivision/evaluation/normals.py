"""Unit normals from tangents."""

from __future__ import annotations

import numpy as np

from ..schemes.domain import FloatArray


def unit_normals(du: FloatArray, dv: FloatArray) -> FloatArray:
    """Unit vectors along ``du x dv``, whatever the tangents' lengths.

    Parameters
    ----------
    du, dv : (s, 3) float

    Returns
    -------
    (s, 3), not a number where the tangents are parallel or zero.
    """
    with np.errstate(invalid="ignore", divide="ignore", under="ignore"):
        du = du / np.abs(du).max(axis=1, keepdims=True)
        dv = dv / np.abs(dv).max(axis=1, keepdims=True)
        normal = np.cross(du, dv)
        return normal / np.linalg.norm(normal, axis=1, keepdims=True)
