"""NumPy arrays aligned for Dr.Jit, which uses their memory without a copy."""

from __future__ import annotations

import numpy as np
from numpy.typing import DTypeLike, NDArray

# In bytes.
CACHE_LINE = 64


def aligned(*parts: NDArray, dtype: DTypeLike) -> NDArray:
    """Concatenate flattened arrays in memory that begins at a cache line.

    Dr.Jit uses NumPy's memory without a copy. If a kernel reads an array in order or in packets, Dr.Jit compiles one
    kernel for aligned arrays and another for unaligned ones. With all arrays aligned, the kernel cache always hits.
    """
    size = np.dtype(dtype).itemsize * sum(part.size for part in parts)
    memory = np.empty(size + CACHE_LINE, dtype=np.uint8)
    values = memory[-memory.ctypes.data % CACHE_LINE :][:size].view(dtype)
    return np.concatenate(parts, axis=None, out=values, casting="unsafe")
