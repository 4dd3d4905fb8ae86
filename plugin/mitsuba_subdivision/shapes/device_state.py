"""Arrays that answers read, shown to Dr.Jit where it freezes functions.

A frozen function (``@dr.freeze``) has to know of every array that it reads. Of a shape in Python, Dr.Jit finds what the
object itself holds, and does not look into objects of other classes.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from types import SimpleNamespace
from typing import Any

import drjit as dr

# Rooms whose objects have arrays of Dr.Jit.
_PACKAGE = __name__.partition(".")[0]
_ROOMS = (f"{_PACKAGE}.kernels.", f"{_PACKAGE}.shapes.")


class DeviceState:
    """Shows the arrays of an object and of all that it holds; to be kept by a shape.

    Parameters
    ----------
    owner : object
    """

    def __init__(self, owner: Any) -> None:
        self._owner = owner

    def _traverse_1_cb_ro(self, callback: Callable[..., Any]) -> None:
        dr.detail.traverse_py_cb_ro(self._arrays(), callback)

    def _traverse_1_cb_rw(self, callback: Callable[..., Any]) -> None:
        dr.detail.traverse_py_cb_rw(self._arrays(), callback)

    def _arrays(self) -> SimpleNamespace:
        return SimpleNamespace(arrays=list(_arrays_in(self._owner, set())))


def _arrays_in(value: Any, seen: set[int]) -> Iterator[Any]:
    """Arrays of Dr.Jit in a value, in objects of kernels and shapes, and in containers; each object once."""
    if id(value) in seen:
        return
    seen.add(id(value))
    kind = type(value)
    if dr.is_array_v(kind):
        if dr.is_jit_v(kind):
            yield value
    elif isinstance(value, dict):
        for each in value.values():
            yield from _arrays_in(each, seen)
    elif isinstance(value, (list, tuple)):
        for each in value:
            yield from _arrays_in(each, seen)
    elif kind.__module__.startswith(_ROOMS) and hasattr(value, "__dict__"):
        yield from _arrays_in(vars(value), seen)
