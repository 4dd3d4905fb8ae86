"""Subdivision schemes: refinement rules, regular bases and parameter domains."""

from __future__ import annotations

from typing import TYPE_CHECKING

from ..deferred import deferred
from .scheme import (
    SCHEME_CLASSES,
    PhantomPoint,
    Refinement,
    Scheme,
    SchemeError,
    StencilTable,
    Unsupported,
    register_scheme,
    scheme_named,
    with_rules,
)

if TYPE_CHECKING:
    from .catmull_clark import CatmullClark
    from .doo_sabin import DooSabin
    from .loop import Loop

__all__ = [
    "CatmullClark",
    "DooSabin",
    "Loop",
    "PhantomPoint",
    "Refinement",
    "Scheme",
    "SchemeError",
    "StencilTable",
    "Unsupported",
    "register_scheme",
    "scheme_named",
    "with_rules",
]

__getattr__ = deferred(__name__, {module: (kind,) for module, kind in SCHEME_CLASSES.items()})
