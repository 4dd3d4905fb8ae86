"""Caches: shapes with the same topology share one set of tables, and drop what only their creation needs."""

from __future__ import annotations

import zlib
from collections.abc import Callable, Hashable
from dataclasses import dataclass
from functools import cached_property
from threading import Lock, RLock
from typing import Any, TypeVar
from weakref import WeakValueDictionary

import numpy as np
from numpy.typing import NDArray

Value = TypeVar("Value")

_values: WeakValueDictionary[Hashable, Any] = WeakValueDictionary()
# A lock for each value in creation. If several threads request a value, one creates it and the others wait. Requests
# for other values are not blocked. After an error several threads may create the value.
_making: dict[Hashable, RLock] = {}
_lock = Lock()


class Content:
    """An array as part of a key. Arrays are equal if their values, types and shapes are equal."""

    __slots__ = ("_hash", "array")

    def __init__(
        self,
        array: NDArray | None,  # Must not be changed afterwards
    ) -> None:
        self.array: Any = array
        self._hash = 0 if array is None else hash((array.shape, zlib.crc32(np.ascontiguousarray(array).data)))

    def __hash__(self) -> int:
        return self._hash

    def __eq__(self, other: object) -> bool:
        if not isinstance(other, Content) or self._hash != other._hash:
            return False
        a, b = self.array, other.array
        if a is b or a is None or b is None:
            return a is b
        return a.dtype == b.dtype and np.array_equal(a, b)


@dataclass(frozen=True, eq=False)
class SharedArray:
    """An array as a shared value: on a device, or a NumPy array."""

    array: Any


def forget(*values: Any) -> None:
    """Drop cached properties of objects, which are computed again on demand."""
    for value in values:
        for name in [name for name, content in vars(type(value)).items() if isinstance(content, cached_property)]:
            vars(value).pop(name, None)


def shared(kind: Callable[..., Value], *arguments: Hashable) -> Value:
    """Return ``kind(*arguments)``, which is made once for equal arguments and shared while it is referenced."""
    return shared_by_key((kind, *arguments), lambda: kind(*arguments))


def shared_by_key(
    key: Hashable,  # Determines the value, and begins with its type. It is kept as long as the value.
    # Creates the value. It may request other values. It must not wait for Dr.Jit, which may meanwhile start other work
    # that requests the same value.
    make: Callable[[], Value],
) -> Value:
    """Return the value of a key; the first call creates it, and it is kept while it is referenced elsewhere."""
    with _lock:
        value = _values.get(key)
        if value is not None:
            return value
        making = _making.setdefault(key, RLock())
    with making:
        value = _values.get(key)
        try:
            if value is None:
                value = _values[key] = make()
            return value
        finally:
            with _lock:
                _making.pop(key, None)
