"""Subdivision schemes: refinement rules, regular bases and parameter domains."""

from __future__ import annotations

from .catmull_clark import CatmullClark
from .doo_sabin import DooSabin
from .loop import Loop
from .scheme import Refinement, Scheme, SchemeError, Unsupported

__all__ = [
    "CatmullClark",
    "DooSabin",
    "Loop",
    "Refinement",
    "Scheme",
    "SchemeError",
    "Unsupported",
    "add_scheme",
    "scheme_named",
]

_SCHEMES: dict[str, Scheme] = {scheme.name: scheme for scheme in (CatmullClark(), DooSabin(), Loop())}


def scheme_named(name: str) -> Scheme:
    """Look a scheme up by name.

    Raises
    ------
    SchemeError
        If there is none of that name; the message lists those there are.
    """
    if name not in _SCHEMES:
        raise SchemeError(f'unknown scheme "{name}"; known schemes: {", ".join(sorted(_SCHEMES))}')
    return _SCHEMES[name]


def add_scheme(scheme: Scheme) -> None:
    """Make a scheme known by its name, in place of any other of that name. Use `register_scheme`, which checks it."""
    _SCHEMES[scheme.name] = scheme
