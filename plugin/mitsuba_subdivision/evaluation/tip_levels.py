"""The surface around an extraordinary point: three regular pieces at every level, and a bound of all later ones.

The point is ``ĉ_1``, and the pieces of level n have the Bernstein coefficients ``Φ Tⁿ ĉ``. So along any axis, all of
level n and later are within ``max_k Σ_{i ≥ 2} |φ_ki| |Tⁿ ĉ|_i`` of the point, where ``φ_ki`` is the largest entry of
``Φ Tʲ`` for any j: that for 0, but for Jordan blocks, whose powers grow before they shrink.
"""

from __future__ import annotations

from functools import lru_cache

import numpy as np

from ..schemes.domain import AffineMap, FloatArray
from .bernstein import regular_bernstein
from .equations import times_powers
from .irregular_patch import IrregularPatch

# Eigenvalues of Jordan blocks are at most a half, times some rounding: after so many levels their powers are below all
# before.
GROWING_LEVELS = 16
# Single precision tells nothing that is as near as this, in parameters and in sizes of the patch, apart from the point.
NEAREST = 2.0**-24


@lru_cache(maxsize=4096)
def level_rows(patch: IrregularPatch, level: int) -> FloatArray:
    """``(3, b, K)`` Bernstein coefficients of a level's regular pieces over the eigen-coordinates, read-only."""
    rows = _rows(patch)
    flat = rows.reshape(1, -1, rows.shape[2])
    found = times_powers(flat, np.full(flat.shape[1], level), patch.basis, 1.0).reshape(rows.shape)
    found.flags.writeable = False
    return found


def level_domains(patch: IrregularPatch, level: int) -> list[AffineMap]:
    """From the parameters of each of a level's regular pieces to those of the tip."""
    shrunk = AffineMap(np.eye(2) * 2.0**-level, np.zeros(2))
    return [shrunk @ child.inverse() for child in patch.scheme.domain.children[1:]]


def level_at_size(patch: IrregularPatch, size: float) -> int:
    """The first level at which the second eigenvalue has shrunk the tip to a size, in sizes of the patch."""
    return int(np.ceil(np.log(size) / np.log(patch.basis.subdominant)))


def distinct_levels(patch: IrregularPatch) -> int:
    """How many levels single precision tells apart from the point itself."""
    return int(np.ceil(np.log(NEAREST) / np.log(max(0.5, patch.basis.subdominant))))


def transition(patch: IrregularPatch, level: int) -> FloatArray:
    """``Tⁿ``, ``(K, K)``: makes the eigen-coordinates of child 0 after so many refinements."""
    return np.linalg.matrix_power(patch.basis.block_matrix(), level)


@lru_cache(maxsize=1024)
def rest_rows(patch: IrregularPatch) -> FloatArray:
    """How far the surface is from the extraordinary point at a level and all later ones, at most.

    Returns
    -------
    (r, K) float64, read-only
        Times absolute eigen-coordinates, those of the level by `transition`; the largest of the r sums is the bound.
        The sum with the largest entry of each column is one, too.
    """
    rows, step = _rows(patch).reshape(-1, len(patch.basis.eigenvalues)), transition(patch, 1)
    found = np.abs(rows)
    for _ in range(GROWING_LEVELS):
        rows = rows @ step
        np.maximum(found, np.abs(rows), out=found)
    found[:, 0] = 0
    # Of equal rows one will do.
    found = np.unique(found, axis=0)
    found.flags.writeable = False
    return found


def _rows(patch: IrregularPatch) -> FloatArray:
    return regular_bernstein(patch.scheme).of_controls @ patch.eigen_children
