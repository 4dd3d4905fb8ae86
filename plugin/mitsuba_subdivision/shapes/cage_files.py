"""Cages that several shapes have, of equal arrays or of one file, which is read again when it has changed."""

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
from ..cage.errors import noting_warnings, warn
from ..mesh.shared import Shared

# A file that has changed less than so many nanoseconds ago may change again without looking any different: times of
# files are no more exact than some milliseconds, and on some systems two seconds.
SETTLED = 2_000_000_000
# Of these files it is known that they refer to no others.
SUFFIXES = (".obj", ".ply")

_CAGES: Shared[ControlCage] = Shared()
# What has been warned of when they were made.
_WARNINGS: WeakKeyDictionary[ControlCage, list[str]] = WeakKeyDictionary()


def cage_of_file(path: str, **options: Any) -> ControlCage:
    """`ControlCage.from_file`: the same cage as for other shapes that are still there, if the file is the same.

    Raises
    ------
    CageError, OSError
        As `ControlCage.from_file`.

    Warns
    -----
    CageWarning
        Likewise, for each shape.
    """
    if os.path.splitext(path)[1].lower() not in SUFFIXES:
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


def cage_of_arrays(**arguments: Any) -> ControlCage:
    """`ControlCage.from_arrays`: the same cage as for other shapes that are still there, if all arguments are equal.

    Raises
    ------
    CageError
        As `ControlCage.from_arrays`.

    Warns
    -----
    CageWarning
        Likewise, for each shape.
    """
    return _shared(_digest(arguments), lambda: ControlCage.from_arrays(**arguments))


def _digest(value: Any) -> Hashable:
    """What is equal for equal arguments, and keeps no arrays."""
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
