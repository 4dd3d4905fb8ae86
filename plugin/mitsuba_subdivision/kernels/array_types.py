"""The Dr.Jit array types of a backend and a precision, and how arrays of vectors are laid out, read and gathered."""

from __future__ import annotations

import sys
from dataclasses import dataclass
from typing import Any

import drjit as dr
import numpy as np
from numpy.typing import DTypeLike, NDArray

# Bytes.
CACHE_LINE = 64


@dataclass(frozen=True)
class ArrayTypes:
    """Types of one backend and precision.

    Attributes
    ----------
    float, index, vector3, vector4 : type
        ``index`` holds unsigned integers of 32 bits.
    """

    float: type
    index: type
    vector3: type
    vector4: type

    @classmethod
    def of(cls, float_type: type) -> ArrayTypes:
        """The types of the same backend and precision as a flat array, such as ``drjit.llvm.ad.Float``."""
        arrays = sys.modules[float_type.__module__]
        suffix = "64" if dr.type_v(float_type) == dr.VarType.Float64 else ""
        return cls(float_type, arrays.UInt32, getattr(arrays, f"Array3f{suffix}"), getattr(arrays, f"Array4f{suffix}"))

    def indices(self, *parts: NDArray[np.integer]) -> Any:
        """Put integers on the device, flat and one array after the other."""
        return self.index(aligned(*parts, dtype=np.uint32))

    def padded(self, flat: Any) -> Any:
        """Pad flat 3-vectors to four numbers, which one packet load fetches."""
        v: Any = dr.unravel(self.vector3, flat)
        return dr.ravel(self.vector4(v.x, v.y, v.z, 0))

    def packet(self, padded: Any, index: Any) -> Any:
        """Fetch a padded 3-vector."""
        value: Any = dr.gather(self.vector4, padded, index)
        return self.vector3(value.x, value.y, value.z)

    def gathered(self, flat: Any, index: Any) -> Any:
        """Flat x, y, z of the 3-vectors at some indices; differentiable, forward and backward."""
        return dr.ravel(dr.gather(self.vector3, flat, index))


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
