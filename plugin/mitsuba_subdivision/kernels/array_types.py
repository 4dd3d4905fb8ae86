"""The Dr.Jit arrays that go with a flat array of floats, on its backend and in its precision."""

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
        """Those that go with a flat array, such as ``drjit.llvm.ad.Float``."""
        arrays = sys.modules[float_type.__module__]
        suffix = "64" if dr.type_v(float_type) == dr.VarType.Float64 else ""
        return cls(float_type, arrays.UInt32, getattr(arrays, f"Array3f{suffix}"), getattr(arrays, f"Array4f{suffix}"))

    def indices(self, *parts: NDArray[np.integer]) -> Any:
        """Put integers on the device, flat and one array after the other."""
        return self.index(aligned(*parts, dtype=np.uint32))

    def padded(self, flat: Any) -> Any:
        """Pad flat 3-vectors to four numbers, which one packet load fetches."""
        v = dr.unravel(self.vector3, flat)
        return dr.ravel(self.vector4(v.x, v.y, v.z, 0))

    def packet(self, padded: Any, index: Any) -> Any:
        """Fetch a padded 3-vector."""
        value = dr.gather(self.vector4, padded, index)
        return self.vector3(value.x, value.y, value.z)


def aligned(*parts: NDArray, dtype: DTypeLike) -> NDArray:
    """Put arrays flat and one after the other into memory that begins at a cache line.

    Dr.Jit takes NumPy's memory as it lies. Arrays that it reads in order or in packets make one kernel where they are
    aligned, another where they are not: whether a kernel has been compiled before must not be a matter of luck.
    """
    size = np.dtype(dtype).itemsize * sum(part.size for part in parts)
    memory = np.empty(size + CACHE_LINE, dtype=np.uint8)
    values = memory[-memory.ctypes.data % CACHE_LINE :][:size].view(dtype)
    return np.concatenate(parts, axis=None, out=values, casting="unsafe")
