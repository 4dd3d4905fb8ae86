"""Public names of a package that are imported when they are first used."""

from __future__ import annotations

import importlib
import sys
from collections.abc import Callable, Iterable, Mapping


def deferred(
    package: str,  # Its `__name__`
    names: Mapping[str, Iterable[str]],  # Of each module within the package
) -> Callable[[str], object]:
    """Make the ``__getattr__`` of a package, which imports a name's module when the name is first used.

    A scene then waits for the modules only that it needs. No name may be that of a module of the package: importing
    that module would then replace the name.
    """
    module_of = {name: module for module, listed in names.items() for name in listed}

    def __getattr__(name: str) -> object:
        if name not in module_of:
            raise AttributeError(f"module {package!r} has no attribute {name!r}")
        value = getattr(importlib.import_module(f".{module_of[name]}", package), name)
        setattr(sys.modules[package], name, value)
        return value

    return __getattr__
