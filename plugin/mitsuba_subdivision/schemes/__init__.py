"""Subdivision schemes: refinement rules, regular bases and parameter domains."""

from .catmull_clark import CatmullClark
from .domain import FloatArray, ParameterDomain, ParameterMap
from .doo_sabin import DooSabin
from .loop import Loop
from .scheme import (
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

__all__ = [
    "BUILT_IN", "CatmullClark", "DooSabin", "FloatArray", "Loop", "ParameterDomain", "ParameterMap", "PhantomPoint",
    "Refinement", "Scheme", "SchemeError", "StencilTable", "Unsupported", "register_scheme", "scheme_named",
    "with_rules",
]  # fmt: skip

BUILT_IN = tuple(kind.name for kind in (CatmullClark, DooSabin, Loop))  # Names of the schemes of this package
for _kind in (CatmullClark, DooSabin, Loop):
    register_scheme(_kind())
