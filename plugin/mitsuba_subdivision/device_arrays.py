"""NumPy's values as arrays of Dr.Jit: the only place that converts them.

``mi.Float(array)`` takes NumPy's memory without a copy in LLVM variants. That has two dangers: kernels load whole
packets, so the last load may reach beyond the array, where the process ends if no page is mapped; and a frozen function
that drops such an array while it is recorded ends the process, too.

- `mapped` maps a copy in NumPy's memory that reaches two packets beyond its values. All threads may read it at once,
  so that shapes share such tables.
- `upload` copies into Dr.Jit's own memory, and waits for that: for arrays that users hold and give away.
"""

from __future__ import annotations

from typing import Any

import drjit as dr
import numpy as np
from numpy.typing import ArrayLike, NDArray

from .llvm import require_llvm

# Bytes of two packets of the widest numbers that kernels load, and of the alignment of arrays: Dr.Jit compiles one
# kernel for aligned arrays and another one for others.
PACKETS, CACHE_LINE = 256, 64


def upload(kind: type, *parts: ArrayLike) -> Any:
    """Copy arrays into one of Dr.Jit.

    Parameters
    ----------
    kind : type
        A flat array such as ``mi.Float`` or ``mi.UInt32``, an array of vectors such as ``mi.Point3f``, or a tensor such
        as ``mi.TensorXf``. In scalar variants of Mitsuba, a single number or vector is one of these, too.
    *parts : array_like
        Flattened and concatenated. Vectors lie one after the other, as in an array of shape ``(n, 3)``. A tensor is
        made of one part, whose shape it has. Numbers are converted to the precision of ``kind``.

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
        # Another thread, such as one that loads a shape of this tensor, would not wait for the copy.
        dr.sync_thread()
    return array


def mapped(kind: type, *parts: ArrayLike) -> Any:
    """Make an array of Dr.Jit as `upload` does, in a copy of NumPy's that ends two packets beyond the values.

    For arrays that no frozen function drops. Parameters and errors are those of `upload`.
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
    """Move an array that a user assigns to Dr.Jit's own memory, in place, unless it has derivatives."""
    if dr.is_jit_v(array) and not dr.grad_enabled(array):
        array[:] = dr.opaque(array)
