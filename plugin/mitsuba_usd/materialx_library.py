"""The library of MaterialX: what its nodes are, and those that it builds of others."""

from __future__ import annotations

import importlib.util
from functools import cache
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import MaterialX

# Files that other renderers' shaders are in are left: only definitions and graphs are read.
_FOLDERS = ("stdlib", "pbrlib", "bxdf", "cmlib", "nprlib")


# What is said where the package is missing.
MISSING = 'MaterialX materials are ignored, as the package materialx is missing; pip install "mitsuba-subdivision[usd]"'


def has_materialx() -> bool:
    """Whether the package materialx is there."""
    return importlib.util.find_spec("MaterialX") is not None


@cache
def library() -> MaterialX.Document:
    """Definitions of all nodes of the standard libraries."""
    import MaterialX

    document = MaterialX.createDocument()
    path = MaterialX.getDefaultDataSearchPath()
    folders = [f"{root}/{name}" for root in MaterialX.getDefaultDataLibraryFolders() for name in _FOLDERS]
    MaterialX.loadLibraries(folders, path, document)
    return document


def numbers(text: str, kind: str) -> float | list[float] | str:
    """Value of MaterialX, of a type, as numbers; what is no number is an option."""
    if kind == "boolean":
        return float(text == "true")
    try:
        found = [float(each) for each in text.replace(",", " ").split()]
    except ValueError:
        return text
    if kind in ("string", "filename") or not found:
        return text
    return found[0] if len(found) == 1 else found
