"""Names in USD files, and their meanings in a control cage."""

from __future__ import annotations

import re

from ..cage.attributes import Interpolation

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
