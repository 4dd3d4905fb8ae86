"""The table of schemes, by name: those of this package, and those that users add."""

from __future__ import annotations

import importlib
from copy import copy
from functools import lru_cache

from .scheme import Scheme, SchemeError

# The module and the class of each scheme of this package; the scheme is made when it is first used.
SCHEME_CLASSES = {"catmull_clark": "CatmullClark", "doo_sabin": "DooSabin", "loop": "Loop"}
_SCHEMES: dict[str, Scheme] = {}


def scheme_named(name: str) -> Scheme:
    """Look a scheme up by name.

    Raises
    ------
    SchemeError
        If there is none of that name; the message lists those there are.
    """
    if name not in _SCHEMES:
        if name not in SCHEME_CLASSES:
            raise SchemeError(
                f'unknown scheme "{name}"; known schemes: {", ".join(sorted({*SCHEME_CLASSES, *_SCHEMES}))}'
            )
        _SCHEMES[name] = getattr(importlib.import_module(f".{name}", __package__), SCHEME_CLASSES[name])()
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
        if rule != (getattr(scheme, name) or usual)
    }
    for name, rule in changed.items():
        if getattr(scheme, name) is None:
            raise SchemeError(f'the scheme {scheme.name} has no {name} "{rule}"')
    if not changed:
        return scheme
    scheme = copy(scheme)
    vars(scheme).update(changed)
    return scheme


def register_scheme(scheme: Scheme) -> None:
    """Register a scheme under its name, for `LimitSurface` and scenes, in place of any other of that name.

    Parameters
    ----------
    scheme : Scheme
        Its methods must not change between calls; data derived from them is kept. `check_scheme` tries its rules.

    Raises
    ------
    SchemeError
        If it is no `Scheme`, or has no name.
    """
    require_scheme(scheme)
    _SCHEMES[scheme.name] = scheme


def require_scheme(scheme: object) -> None:
    """Check that an object is a scheme, with a name."""
    if not isinstance(scheme, Scheme):
        what = f"the class {scheme.__name__}" if isinstance(scheme, type) else repr(scheme)
        raise SchemeError(f"scheme {what}; expected a scheme's name, or an object of a class derived from Scheme")
    if not isinstance(getattr(scheme, "name", None), str) or not scheme.name:
        raise SchemeError(f"{type(scheme).__name__} has no name; expected a string of one or more characters")
