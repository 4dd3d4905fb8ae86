"""Public names of a package that are imported when they are first used."""

from __future__ import annotations

import importlib
import sys
from collections.abc import Callable, Mapping


def deferred(
    package: str,  # Its `__name__`
    modules: Mapping[str, str],  # The module, within the package, of each name
) -> Callable[[str], object]:
    """Make the ``__getattr__`` of a package, which imports a name's module when the name is first used.

    A scene then waits for the modules only that it needs. No name may be that of a module of the package: importing
    that module would then replace the name.
    """

    def __getattr__(name: str) -> object:
        if name not in modules:
            raise AttributeError(f"module {package!r} has no attribute {name!r}")
        value = getattr(importlib.import_module(f".{modules[name]}", package), name)
        setattr(sys.modules[package], name, value)
        return value

    return __getattr__
