"""Registry of schemes by name: built-in schemes, and those that users register."""

from __future__ import annotations

import importlib
from copy import copy
from functools import lru_cache

from .scheme import Scheme, SchemeError

# Module and class of each built-in scheme. A scheme is created at its first use.
SCHEME_CLASSES = {"catmull_clark": "CatmullClark", "doo_sabin": "DooSabin", "loop": "Loop"}
_SCHEMES: dict[str, Scheme] = {}


def scheme_named(name: str) -> Scheme:
    """Return the scheme of a name.

    Raises
    ------
    SchemeError
        If the name is unknown; the message lists the known names.
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
    """Return the scheme with the rules of a cage: a copy, or the scheme itself if it has these rules.

    Raises
    ------
    SchemeError
        If the scheme does not support the rules. Only Catmull-Clark has another rule for triangles.
    """
    changed = {
        name: rule
        for name, rule, default in (
            ("crease_method", crease_method, "uniform"),
            ("triangle_rule", triangle_rule, "catmull_clark"),
        )
        if rule != (getattr(scheme, name) or default)
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
    """Register a scheme under its name, for `LimitSurface` and scenes. Replaces a scheme of the same name.

    Parameters
    ----------
    scheme : Scheme
        Its methods must always return the same results, as derived data is cached. `check_scheme` tests its rules.

    Raises
    ------
    SchemeError
        If it is not a `Scheme`, or has no name.
    """
    require_scheme(scheme)
    _SCHEMES[scheme.name] = scheme


def require_scheme(scheme: object) -> None:
    """Raise SchemeError unless an object is a scheme with a name."""
    if not isinstance(scheme, Scheme):
        label = f"the class {scheme.__name__}" if isinstance(scheme, type) else repr(scheme)
        raise SchemeError(f"scheme {label}; expected a scheme's name, or an object of a class derived from Scheme")
    if not isinstance(getattr(scheme, "name", None), str) or not scheme.name:
        raise SchemeError(f"{type(scheme).__name__} has no name; expected a string of one or more characters")
