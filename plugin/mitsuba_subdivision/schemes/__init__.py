"""Subdivision schemes: refinement rules, regular bases and parameter domains."""

from __future__ import annotations

import importlib
from copy import copy
from functools import lru_cache
from typing import TYPE_CHECKING

from ..deferred import deferred
from .members import optional_member
from .scheme import OptionalMembers, PhantomPoint, Refinement, Scheme, SchemeError, Unsupported
from .stencil_table import StencilTable

if TYPE_CHECKING:
    from .catmull_clark import CatmullClark
    from .doo_sabin import DooSabin
    from .loop import Loop

__all__ = [
    "CatmullClark",
    "DooSabin",
    "Loop",
    "OptionalMembers",
    "PhantomPoint",
    "Refinement",
    "Scheme",
    "SchemeError",
    "StencilTable",
    "Unsupported",
    "add_scheme",
    "scheme_named",
    "with_rules",
]

# Schemes of this package: each has a module of its name, and a class in it. They are made when they are first used.
_OWN = {"catmull_clark": "CatmullClark", "doo_sabin": "DooSabin", "loop": "Loop"}
_SCHEMES: dict[str, Scheme] = {}

__getattr__ = deferred(__name__, {kind: module for module, kind in _OWN.items()})


def scheme_named(name: str) -> Scheme:
    """Look a scheme up by name.

    Raises
    ------
    SchemeError
        If there is none of that name; the message lists those there are.
    """
    if name not in _SCHEMES:
        if name not in _OWN:
            raise SchemeError(f'unknown scheme "{name}"; known schemes: {", ".join(sorted({*_OWN, *_SCHEMES}))}')
        _SCHEMES[name] = getattr(importlib.import_module(f".{name}", __name__), _OWN[name])()
    return _SCHEMES[name]


@lru_cache(maxsize=256)
def with_rules(scheme: Scheme, crease_method: str, triangle_rule: str) -> Scheme:
    """The scheme with the rules of a cage: a copy, or the scheme itself if these are its rules.

    Raises
    ------
    SchemeError
        If the scheme has no such rules: only Catmull-Clark knows another one for triangles.
    """
    changed = {
        name: rule
        for name, rule, usual in (
            ("crease_method", crease_method, "uniform"),
            ("triangle_rule", triangle_rule, "catmull_clark"),
        )
        if rule != (optional_member(scheme, name) or usual)
    }
    for name, rule in changed.items():
        if optional_member(scheme, name) is None:
            raise SchemeError(f'the scheme {scheme.name} has no {name} "{rule}"')
    if not changed:
        return scheme
    scheme = copy(scheme)
    vars(scheme).update(changed)
    return scheme


def add_scheme(scheme: Scheme) -> None:
    """Add a scheme under its name, in place of any other of that name. Use `register_scheme`, which checks it."""
    _SCHEMES[scheme.name] = scheme
