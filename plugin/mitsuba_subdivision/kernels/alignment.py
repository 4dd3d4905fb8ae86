"""Memory that Dr.Jit uses where it lies."""

from __future__ import annotations

import numpy as np
from numpy.typing import DTypeLike, NDArray

# Bytes.
CACHE_LINE = 64


def aligned(*parts: NDArray, dtype: DTypeLike) -> NDArray:
    """Put arrays flat and one after the other into memory that begins at a cache line.

    Dr.Jit uses NumPy's memory where it lies. If a kernel reads an array in order or in packets, Dr.Jit compiles one
    kernel for an aligned array and another for one that is not. With all arrays aligned, a kernel that was compiled
    before is always found again.
    """
    size = np.dtype(dtype).itemsize * sum(part.size for part in parts)
    memory = np.empty(size + CACHE_LINE, dtype=np.uint8)
    values = memory[-memory.ctypes.data % CACHE_LINE :][:size].view(dtype)
    return np.concatenate(parts, axis=None, out=values, casting="unsafe")
