"""Values of USD attributes and transforms of prims at a time.

Without a time, which the time code `EarliestTime` stands for, a value is the default, which does not depend on time, or
else the first sample. USD itself takes the sample first, and takes the schema's fallback before it at the default time.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

from ..cage.attributes import Interpolation

if TYPE_CHECKING:
    from pxr import Gf, Usd

# Attributes of a mesh that are rules of a cage. Chaikin's rule has none.
RULE_ATTRIBUTES = {
    "boundary": "interpolateBoundary",
    "triangle_rule": "triangleSubdivisionRule",
    "face_varying": "faceVaryingLinearInterpolation",
}
# Values of subdivisionScheme, for surfaces that are smooth and for those that are not.
SCHEMES = {"catmullClark": "catmull_clark", "loop": "loop"}
FLAT_SCHEMES = ("none", "bilinear")
INTERPOLATIONS: dict[str, Interpolation] = {"vertex": "vertex", "varying": "varying", "faceVarying": "face_varying"}
# Primvars that are texture coordinates by their name; the first is written.
TEXCOORDS = ("st", "UVMap", "texcoords")
# Values of purpose for prims that renderers do not show.
HIDDEN_PURPOSES = ("guide", "proxy")


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
    """Value of an attribute; None if there is no such attribute."""
    return attribute.Get(time_of(attribute, time)) if attribute else None


def require_types(prim: Usd.Prim, time: Usd.TimeCode) -> None:
    """Raise TypeError unless values of a prim's attributes have the types of its schema; USD reads others as none."""
    for attribute in prim.GetAuthoredAttributes():
        value, declared = value_at(attribute, time), attribute.GetTypeName().defaultValue
        are_numbers = isinstance(value, (int, float)) and isinstance(declared, (int, float))
        if value is not None and declared is not None and not are_numbers and not isinstance(value, type(declared)):
            found, expected = type(value).__name__, type(declared).__name__
            raise TypeError(f"{attribute.GetName()} is of the type {found}; expected {expected}")


def local_to_world(
    prim: Usd.Prim,
    # Time code at which an attribute is read. Operations may have different ones.
    time_of: Callable[[Usd.Attribute], Usd.TimeCode],
    # Transforms by path, to which those of the prim and the prims above are added
    known: dict[str, Gf.Matrix4d] | None = None,
) -> Gf.Matrix4d:
    """Transform of a prim to world space, for row vectors."""
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


def token(name: str) -> str:
    """USD's name of a rule: ``edgeAndCorner`` for ``edge_and_corner``."""
    return re.sub("_(.)", lambda match: match[1].upper(), name)


def rule_name(token: str) -> str:
    """The rule of a USD name: ``edge_and_corner`` for ``edgeAndCorner``."""
    return re.sub("([A-Z])", lambda match: f"_{match[1].lower()}", token)


def is_possible(name: str) -> bool:
    """Whether a primvar can have this name."""
    from pxr import Sdf

    return Sdf.Path.IsValidNamespacedIdentifier(name)
