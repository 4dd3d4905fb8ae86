"""The transfer function of sRGB (IEC 61966-2-1), from codes to linear values and back."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray


def decoded(codes: NDArray) -> NDArray:
    """Linear values of codes from 0 to 1."""
    return np.where(codes <= 0.04045, codes / 12.92, ((np.maximum(codes, 0.04045) + 0.055) / 1.055) ** 2.4)


def encoded(linear: NDArray) -> NDArray:
    """Codes of linear values from 0 to 1."""
    return np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear ** (1 / 2.4) - 0.055)
