"""Values of USD attributes and transforms of prims at a time.

Without a time, which the time code `EarliestTime` stands for, a value is the default, which does not depend on time, or
else the first sample. USD itself takes the sample first, and takes the schema's fallback before it at the default time.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from pxr import Gf, Usd


def time_of(attribute: Usd.Attribute, time: Usd.TimeCode) -> Usd.TimeCode:
    """Time code at which an attribute is read."""
    from pxr import Usd

    if not time.IsEarliestTime():
        return time
    default = Usd.TimeCode.Default()
    if not attribute.HasAuthoredValue():
        return default
    return default if attribute.GetResolveInfo(default).GetSource() == Usd.ResolveInfoSourceDefault else time


def value_at(attribute: Usd.Attribute, time: Usd.TimeCode) -> Any:
    """Value of an attribute."""
    return attribute.Get(time_of(attribute, time))


def require_types(prim: Usd.Prim, time: Usd.TimeCode) -> None:
    """Check that values of the attributes of a prim have the types that its schema says; USD reads others as none.

    Raises
    ------
    TypeError
    """
    for attribute in prim.GetAuthoredAttributes():
        value, declared = value_at(attribute, time), attribute.GetTypeName().defaultValue
        are_numbers = isinstance(value, (int, float)) and isinstance(declared, (int, float))
        if value is not None and declared is not None and not are_numbers and not isinstance(value, type(declared)):
            found, expected = type(value).__name__, type(declared).__name__
            raise TypeError(f"{attribute.GetName()} is of the type {found}; expected {expected}")


def local_to_world(
    prim: Usd.Prim, time_of: Callable[[Usd.Attribute], Usd.TimeCode], known: dict[str, Gf.Matrix4d] | None = None
) -> Gf.Matrix4d:
    """Transform of a prim to world space, for row vectors.

    Parameters
    ----------
    prim : Usd.Prim
    time_of : callable
        Time code at which an attribute is read. Operations may have different ones.
    known : dict, optional
        Transforms by path, to which those of the prim and the prims above are added.
    """
    from pxr import Gf, UsdGeom

    path = str(prim.GetPath())
    if known is not None and path in known:
        return known[path]
    matrix, resets = Gf.Matrix4d(1), prim.IsPseudoRoot()
    here = UsdGeom.Xformable(prim)
    if here:
        # Times of samples are not asked for: with timeCodesPerSecond = 0, USD looks for them for ever.
        for operation in reversed(here.GetOrderedXformOps()):
            matrix *= operation.GetOpTransform(time_of(operation.GetAttr()))
        resets = here.GetResetXformStack()
    if not resets:
        matrix *= local_to_world(prim.GetParent(), time_of, known)
    if known is not None:
        known[path] = matrix
    return matrix
