"""Exact subdivision surfaces for Mitsuba 3.

Importing this package registers the shape ``subdivision`` in every variant, before or after ``mitsuba.set_variant``.
"""

from __future__ import annotations

import importlib

from .llvm import select_llvm

# Before Mitsuba loads Dr.Jit, which takes the first LLVM library it meets.
select_llvm()

from .shapes import register  # noqa: E402 - see above

register()

__version__ = "0.1.0"

# Imported when first used, so that a scene without subdivision surfaces does not wait for them.
_PLACES = {
    "Attribute": "cage",
    "CageError": "cage",
    "CageWarning": "cage",
    "ControlCage": "cage",
    "LimitSurface": "surface",
    "SchemeError": "schemes",
    "SurfaceSamples": "surface",
    "Tessellation": "tessellation",
    "limit_stencil": "surface",
    "loss_of_views": "shapes.views",
    "register_scheme": "evaluation.scheme_check",
}

__all__ = [*_PLACES, "register"]  # noqa: PLE0604 - names, though not spelt out


def __getattr__(name: str):
    if name not in _PLACES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    value = getattr(importlib.import_module(f".{_PLACES[name]}", __name__), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
