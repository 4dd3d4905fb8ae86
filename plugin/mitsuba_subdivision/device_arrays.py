"""NumPy's values as arrays of Dr.Jit: the only place that converts them.

``mi.Float(array)`` takes NumPy's memory without a copy in LLVM variants. That has two dangers: kernels load whole
packets, so the last load may reach beyond the array, where the process ends if no page is mapped; and a frozen function
that drops such an array ends the process, too. The arrays that `upload` returns are in Dr.Jit's own memory, which is
aligned and padded.
"""

from __future__ import annotations

from typing import Any

import drjit as dr
import numpy as np
from numpy.typing import ArrayLike, NDArray

from .llvm import require_llvm


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
    if dr.backend_v(kind) == dr.JitBackend.LLVM:
        require_llvm()
    if dr.is_tensor_v(kind):
        (values,) = parts
        return kind(upload(dr.array_t(kind), values), np.shape(values))
    if not dr.is_array_v(kind):
        (value,) = parts
        return kind(np.asarray(value).item())
    array: NDArray = np.concatenate(parts, axis=None, dtype=dr.type_v(kind).name.lower(), casting="unsafe")
    if not dr.is_jit_v(kind):
        return kind(array)
    if dr.depth_v(kind) > 1:
        return dr.unravel(kind, upload(dr.array_t(dr.value_t(kind)), array))
    # A copy by Dr.Jit: it reads no more than the array has, and is complete before NumPy's memory is freed.
    return dr.opaque(kind(array))


def take_over(array: Any) -> None:
    """Move an array of Dr.Jit to Dr.Jit's own memory, in place.

    For arrays that users assign to parameters: they are often made of NumPy's. One with derivatives stays where it is.
    """
    if dr.is_jit_v(array) and not dr.grad_enabled(array):
        array[:] = dr.opaque(array)
