"""The least tessellation rates that meet a limit."""

from __future__ import annotations

import sys

import numpy as np

from ..mesh.connectivity import IntArray
from ..schemes.domain import FloatArray

# In place of zero, where it would divide. Not NumPy's finfo: where Dr.Jit computes without subnormals, NumPy before 2.3
# warns of it.
TINY = sys.float_info.min
# Excess over an integer that counts as rounding error and does not round a rate up.
RATE_ROUNDING = 1e-9
# Offsets of the integers to try from the one below the best real number.
TRIED = (-1, 0, 1)
# Above any number of segments.
MOST = 1 << 20


def least_product(forms: FloatArray) -> IntArray:
    """Integers whose product is least, of those with ``A / n_u^2 + 2 B / (n_u n_v) + C / n_v^2`` no more than one.

    Parameters
    ----------
    forms : (f, 3, t) float64
        A, B and C, not negative; ``f`` of them, each of which is to be no more than one.

    Returns
    -------
    (t, 2) int64
    """
    forms = np.minimum(forms, MOST)
    a, b, c = np.maximum(forms.max(axis=0), TINY)
    # Of real numbers those with the least product have A / n_u^2 = C / n_v^2.
    rate = np.sqrt(2 + 2 * b / (np.sqrt(a) * np.sqrt(c)))
    tried = []
    for away in TRIED:
        tried.append(_with_other(forms, np.floor(rate * np.sqrt(a)) + away))
        tried.append(_with_other(forms[:, ::-1], np.floor(rate * np.sqrt(c)) + away)[:, ::-1])
    found = np.stack(tried)
    best = np.argmin(found.prod(axis=2) + 1e-3 * found.sum(axis=2), axis=0)
    return found[best, np.arange(len(best))].astype(np.int64)


def _with_other(forms: FloatArray, first: FloatArray) -> FloatArray:
    """``(t, 2)`` the given first rates, raised where infeasible, and the least second rates for them."""
    a, b, c = forms[:, 0], forms[:, 1], forms[:, 2]
    first = np.clip(np.maximum(first, np.floor(np.sqrt(a.max(axis=0))) + 1), 1, MOST)
    left, linear = 1 - a / first**2, b / first
    # Of c y^2 + 2 linear y = left, for y = 1 / second.
    second = ((linear + np.sqrt(linear**2 + c * left)) / left).max(axis=0)
    return np.stack([first, rounded_up(second)], axis=1)


def rounded_up(values: FloatArray) -> IntArray:
    """Round up to integers of at least 1, ignoring rounding errors above an integer."""
    return np.clip(np.ceil(values - RATE_ROUNDING), 1, MOST).astype(np.int64)
