"""Cache of control cages: shapes with equal arrays or the same unchanged file share one cage."""

from __future__ import annotations

import os
import time as clock
from collections.abc import Callable, Hashable, Mapping
from dataclasses import fields
from hashlib import blake2b
from typing import Any
from weakref import WeakKeyDictionary

import numpy as np

from ..cage import ControlCage
from ..cage.attributes import Attribute
from ..cage.errors import noting_warnings, warn, without_warnings
from ..cage.source import CageSource
from ..files.formats import FORMATS
from ..mesh.shared import Shared

# A file modified less than this many nanoseconds ago may change without a new modification time: the resolution of
# file times is some milliseconds, and two seconds on some systems.
SETTLED = 2_000_000_000

_CAGES: Shared[ControlCage] = Shared()
# Warnings that each cage issued when it was built, repeated for each shape.
_WARNINGS: WeakKeyDictionary[ControlCage, list[str]] = WeakKeyDictionary()


def cage_of_file(path: str, **options: Any) -> ControlCage:
    """`ControlCage.from_file`, returning the cage of a living shape if the file is unchanged.

    Raises
    ------
    CageError, OSError
        As `ControlCage.from_file`.

    Warns
    -----
    CageWarning
        Likewise, for each shape.
    """
    found_format = FORMATS.get(os.path.splitext(path)[1].lower())
    if found_format is None or found_format.refers_to_files:
        return ControlCage.from_file(path, **options)
    found = os.stat(path)
    if abs(clock.time_ns() - found.st_mtime_ns) < SETTLED:
        return ControlCage.from_file(path, **options)
    key = (
        path,
        found.st_dev,
        found.st_ino,
        found.st_size,
        found.st_mtime_ns,
        found.st_ctime_ns,
        *sorted(options.items()),
    )
    return _shared(key, lambda: ControlCage.from_file(path, **options))


def cage_of_arrays(name: str | None, **arguments: Any) -> ControlCage:
    """`ControlCage.from_arrays`, returning the cage of a living shape if all arguments are equal.

    Parameters
    ----------
    name : str or None
        What messages call the cage. If there is one, the cage's warnings were given before, and are not repeated.
    **arguments
        Of `ControlCage.from_arrays`.

    Raises
    ------
    CageError
        As `ControlCage.from_arrays`.

    Warns
    -----
    CageWarning
        Likewise, for each shape without a name.
    """
    if name is None:
        return _shared(_digest(arguments), lambda: ControlCage.from_arrays(**arguments))
    with without_warnings():
        # Shapes of equal cages share one by different names: the first name is that of the cage.
        key = "named", _digest(arguments)
        return _shared(key, lambda: ControlCage.from_arrays(**arguments, source=CageSource(name)))


def _digest(value: Any) -> Hashable:
    """Cache key of an argument, which does not keep arrays alive."""
    if isinstance(value, Mapping):
        return tuple((name, _digest(each)) for name, each in value.items())
    if isinstance(value, Attribute):
        return _digest({each.name: getattr(value, each.name) for each in fields(value)})
    if isinstance(value, np.ndarray):
        return value.shape, str(value.dtype), blake2b(np.ascontiguousarray(value).data, digest_size=16).digest()
    return value


def _shared(key: Hashable, make: Callable[[], ControlCage]) -> ControlCage:
    is_new = False

    def made() -> ControlCage:
        nonlocal is_new
        is_new = True
        with noting_warnings() as noted:
            cage = make()
        _WARNINGS[cage] = noted
        return cage

    cage = _CAGES.get(key, made)
    for message in () if is_new else _WARNINGS[cage]:
        warn(message)
    return cage
