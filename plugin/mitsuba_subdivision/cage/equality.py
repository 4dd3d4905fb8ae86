"""Whether two pieces of plain data are the same: contents of files at two times, or in two frames."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import fields, is_dataclass
from typing import Any

import numpy as np

from .contents import CageContents
from .source import CageSource


def same(a: Any, b: Any, but: frozenset[str] = frozenset()) -> bool:
    """Whether nested records, mappings, lists, arrays and values are equal; their sources are not compared.

    Parameters
    ----------
    but : frozenset of str
        Fields of ``a`` and ``b`` themselves that may differ.
    """
    if a is b or (isinstance(a, CageSource) and isinstance(b, CageSource)):
        return True
    if isinstance(a, np.ndarray) and isinstance(b, np.ndarray):
        return np.array_equal(a, b)
    if isinstance(a, np.ndarray) or isinstance(b, np.ndarray):
        return False
    if is_dataclass(a):
        names = [each.name for each in fields(a) if each.name not in but]
        return type(a) is type(b) and all(same(getattr(a, name), getattr(b, name)) for name in names)
    if isinstance(a, Mapping) and isinstance(b, Mapping):
        return a.keys() == b.keys() and all(same(a[key], b[key]) for key in a)
    if isinstance(a, (list, tuple)) and isinstance(b, (list, tuple)):
        return len(a) == len(b) and all(map(same, a, b))
    return bool(a == b)


def same_topology(a: CageContents, b: CageContents) -> bool:
    """Whether two cages differ in their positions only."""
    return len(a.positions) == len(b.positions) and same(a, b, frozenset({"positions"}))
