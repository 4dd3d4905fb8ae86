"""What frozen functions (``@dr.freeze``) need of a shape.

A frozen function has to know every array that it reads. Dr.Jit finds the arrays that a Python shape itself holds, but
does not look into objects of other classes. What its first call records runs again at the later ones, without Python.
So nothing is read back while it records, checks of values among it, and all tables are on the device before.
"""

from __future__ import annotations

import gc
import weakref
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from types import MethodType, SimpleNamespace
from typing import Any

import drjit as dr

from ..mesh.shared import SharedArray

# Packages whose objects hold Dr.Jit arrays.
_PACKAGE = __name__.partition(".")[0]
_PACKAGES = (f"{_PACKAGE}.kernels.", f"{_PACKAGE}.shapes.")


@contextmanager
def paused_collection() -> Iterator[None]:
    """Pause the collector; a context manager and a decorator.

    A collector that was disabled stays disabled. With overlapping threads, it runs again at the latest when all end.
    """
    was_enabled = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if was_enabled:
            gc.enable()


def is_recording() -> bool:
    """Whether a frozen function is being recorded, so that values of arrays cannot be read."""
    return bool(dr.flag(dr.JitFlag.FreezingScope))


class DeviceState:
    """Exposes the arrays of a shape, and of the objects that it holds, to Dr.Jit; a shape keeps one."""

    def __init__(
        self,
        shape: Any,  # Not kept alive
    ) -> None:
        self._shape = weakref.ref(shape)
        # Whether a frozen function has seen the arrays. Dr.Jit goes on reading its tables, which are in NumPy's memory.
        self.is_frozen = False

    # A scene that the garbage collector frees while a frozen function is called ends the process.
    @paused_collection()
    def _traverse_1_cb_ro(self, callback: Callable[..., Any]) -> None:
        dr.detail.traverse_py_cb_ro(self._arrays(), callback)

    @paused_collection()
    def _traverse_1_cb_rw(self, callback: Callable[..., Any]) -> None:
        dr.detail.traverse_py_cb_rw(self._arrays(), callback)

    def _arrays(self) -> SimpleNamespace:
        self.is_frozen, shape = True, self._shape()
        return SimpleNamespace(arrays=[] if shape is None else list(_arrays_in(vars(shape), {id(self)})))


def _arrays_in(value: Any, seen: set[int]) -> Iterator[Any]:
    """Arrays of Dr.Jit in a value, in objects of kernels and shapes, and in containers; each object once."""
    if id(value) in seen:
        return
    seen.add(id(value))
    kind = type(value)
    if dr.is_array_v(kind):
        if dr.is_jit_v(kind):
            yield value
    elif isinstance(value, (dict, list, tuple)):
        for each in value.values() if isinstance(value, dict) else value:
            yield from _arrays_in(each, seen)
    elif isinstance(value, partial):
        yield from _arrays_in(value.func, seen)
    elif isinstance(value, MethodType):
        yield from _arrays_in(value.__self__, seen)
    elif isinstance(value, SharedArray) or (kind.__module__.startswith(_PACKAGES) and hasattr(value, "__dict__")):
        for name in getattr(kind, "UPLOADED_LATER", ()):
            getattr(value, name)
        yield from _arrays_in(vars(value), seen)
