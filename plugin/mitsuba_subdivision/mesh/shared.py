"""Values made once and shared: shapes of one topology share one set of tables."""

from __future__ import annotations

import zlib
from collections.abc import Callable, Hashable
from dataclasses import dataclass
from threading import Lock, RLock
from typing import Any, Generic, TypeVar
from weakref import WeakValueDictionary

import numpy as np
from numpy.typing import NDArray

Value = TypeVar("Value")


class Content:
    """An array as part of a key: equal to others with the same numbers, of the same type, in the same shape."""

    __slots__ = ("_array", "_hash")

    def __init__(
        self,
        array: NDArray | None,  # Not to be changed afterwards
    ) -> None:
        self._array = array
        self._hash = 0 if array is None else hash((array.shape, zlib.crc32(np.ascontiguousarray(array).data)))

    def __hash__(self) -> int:
        return self._hash

    def __eq__(self, other: object) -> bool:
        if not isinstance(other, Content) or self._hash != other._hash:
            return False
        a, b = self._array, other._array
        if a is b or a is None or b is None:
            return a is b
        return a.dtype == b.dtype and np.array_equal(a, b)


@dataclass(frozen=True, eq=False)
class SharedArray:
    """An array as a value of `Shared`: on a device, or of NumPy."""

    array: Any


class LaterArray:
    """An array as a value of `Shared` that is made when the value is there: what makes it may wait for Dr.Jit."""

    # Without a dictionary, so that Dr.Jit does not take it for a shape's state.
    __slots__ = ("__weakref__", "_array")

    def __init__(self) -> None:
        self._array: Any = None

    def get(self, make: Callable[[], Any]) -> Any:
        """The array, made at the first call."""
        if self._array is None:
            self._array = make()
        return self._array


class Shared(Generic[Value]):
    """Values by keys, each made at its first use and kept while it is referenced elsewhere."""

    def __init__(self) -> None:
        self._values: WeakValueDictionary[Hashable, Any] = WeakValueDictionary()
        # Of several threads that request a value, one makes it and others wait, those of other values do not. After an
        # error, several may make it.
        self._making: dict[Hashable, RLock] = {}
        self._lock = Lock()

    def get(
        self,
        key: Hashable,  # Of what all of the value follows from. Held for as long as the value lives.
        # Makes the value if there is none. It may request other values. It must not wait for Dr.Jit, which
        # may begin other work meanwhile that asks for the same value.
        make: Callable[[], Value],
    ) -> Value:
        """The value of a key."""
        with self._lock:
            found = self._values.get(key)
            if found is not None:
                return found
            making = self._making.setdefault(key, RLock())
        with making:
            found = self._values.get(key)
            try:
                if found is None:
                    found = self._values[key] = make()
                return found
            finally:
                with self._lock:
                    self._making.pop(key, None)
