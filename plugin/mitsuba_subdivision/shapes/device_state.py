"""Exposes the Dr.Jit arrays of a shape's helper objects to frozen functions.

A frozen function (``@dr.freeze``) has to know every array that it reads. Dr.Jit finds the arrays that a Python shape
itself holds, but does not look into objects of other classes.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from types import SimpleNamespace
from typing import Any

import drjit as dr

# Packages whose objects hold Dr.Jit arrays.
_PACKAGE = __name__.partition(".")[0]
_PACKAGES = (f"{_PACKAGE}.kernels.", f"{_PACKAGE}.shapes.")


class DeviceState:
    """Exposes the arrays of an object, and of the objects that it holds, to Dr.Jit; a shape keeps one.

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
    elif kind.__module__.startswith(_PACKAGES) and hasattr(value, "__dict__"):
        yield from _arrays_in(vars(value), seen)
