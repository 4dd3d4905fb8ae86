"""Cages of files that several shapes name: a file is read again when it has changed."""

from __future__ import annotations

import os
import time as clock
from typing import Any
from weakref import WeakKeyDictionary

from ..cage import ControlCage
from ..cage.errors import noting_warnings, warn
from ..mesh.shared import Shared

# A file that has changed less than so many nanoseconds ago may change again without looking any different: times of
# files are no more exact than some milliseconds, and on some systems two seconds.
SETTLED = 2_000_000_000
# Of these files it is known that they refer to no others.
SUFFIXES = (".obj", ".ply")

_CAGES: Shared[ControlCage] = Shared()
# What reading them has warned of.
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
    key = (path, found.st_dev, found.st_ino, found.st_size, found.st_mtime_ns, *sorted(options.items()))
    is_new = False

    def read() -> ControlCage:
        nonlocal is_new
        is_new = True
        with noting_warnings() as noted:
            cage = ControlCage.from_file(path, **options)
        _WARNINGS[cage] = noted
        return cage

    cage = _CAGES.get(key, read)
    for message in () if is_new else _WARNINGS[cage]:
        warn(message)
    return cage
