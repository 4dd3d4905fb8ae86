"""The only conversion of NumPy arrays to Dr.Jit's.

In LLVM variants, ``mi.Float(array)`` uses NumPy's memory without a copy. This can end the process in two ways: kernels
load whole packets, the last of which may reach beyond the array to an unmapped page; and a frozen function may drop
such an array while it is recorded.

- `mapped` maps a copy in NumPy's memory that reaches two packets beyond its values. All threads may read it, so that
  shapes share such tables.
- `upload` copies into Dr.Jit's own memory, and waits for the copy: for arrays of users.
"""

from __future__ import annotations

from typing import Any

import drjit as dr
import numpy as np
from numpy.typing import ArrayLike, NDArray

from .llvm import require_llvm

# Bytes of two packets of the widest numbers; alignment of arrays, as Dr.Jit compiles other kernels for unaligned ones.
PACKETS, CACHE_LINE = 256, 64


def upload(kind: type, *parts: ArrayLike) -> Any:
    """Copy arrays into one Dr.Jit array.

    Parameters
    ----------
    kind : type
        A flat array such as ``mi.Float`` or ``mi.UInt32``, an array of vectors such as ``mi.Point3f``, or a tensor such
        as ``mi.TensorXf``. In scalar variants of Mitsuba, a single number or vector is one of these, too.
    *parts : array_like
        Flattened and concatenated. Vectors are rows, as in an array of shape ``(n, 3)``. A tensor has the shape of its
        only part. Numbers are converted to the precision of ``kind``.

    Returns
    -------
    array of the type ``kind``

    Raises
    ------
    RuntimeError
        If Dr.Jit has loaded an LLVM library whose kernels end the process.
    """
    array = mapped(kind, *parts)
    if dr.is_jit_v(kind):
        array = dr.opaque(array)
        # Another thread, for instance one that loads a shape of this tensor, would not wait for the copy.
        dr.sync_thread()
    return array


def mapped(kind: type, *parts: ArrayLike) -> Any:
    """Make a Dr.Jit array like `upload`, but in a NumPy copy that ends two packets beyond the values.

    For arrays that no frozen function drops. Parameters and errors are as in `upload`.
    """
    if dr.backend_v(kind) == dr.JitBackend.LLVM:
        require_llvm()
    if dr.is_tensor_v(kind):
        (values,) = parts
        return kind(mapped(dr.array_t(kind), values), np.shape(values))
    if not dr.is_array_v(kind):
        (value,) = parts
        return kind(np.asarray(value).item())
    dtype = np.dtype(dr.type_v(kind).name.lower())
    if not dr.is_jit_v(kind):
        return kind(np.concatenate(parts, axis=None, dtype=dtype, casting="unsafe"))
    if dr.depth_v(kind) > 1:
        return dr.unravel(kind, mapped(dr.array_t(dr.value_t(kind)), *parts))
    size = dtype.itemsize * sum(np.size(part) for part in parts)
    memory = np.empty(size + CACHE_LINE + PACKETS, dtype=np.uint8)
    array: NDArray = memory[-memory.ctypes.data % CACHE_LINE :][:size].view(dtype)
    return kind(np.concatenate(parts, axis=None, out=array, casting="unsafe"))


def take_over(array: Any) -> None:
    """Move a user's array to Dr.Jit's own memory in place, unless it has derivatives."""
    if dr.is_jit_v(array) and not dr.grad_enabled(array):
        array[:] = dr.opaque(array)
