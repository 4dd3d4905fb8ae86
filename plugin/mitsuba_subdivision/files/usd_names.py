"""Names of USD's subdivision attributes and their values."""

from __future__ import annotations

import re

# Attributes of a mesh that are rules of a cage. Chaikin's rule has none.
RULE_ATTRIBUTES = {
    "boundary": "interpolateBoundary",
    "triangle_rule": "triangleSubdivisionRule",
    "face_varying": "faceVaryingLinearInterpolation",
}
SCHEMES = {"catmullClark": "catmull_clark", "loop": "loop"}
INTERPOLATIONS = {"vertex": "vertex", "varying": "varying", "faceVarying": "face_varying"}


def token(name: str) -> str:
    """USD's name of a rule: ``edgeAndCorner`` of ``edge_and_corner``."""
    return re.sub("_(.)", lambda match: match[1].upper(), name)


def rule_name(token: str) -> str:
    """The rule of a USD name: ``edge_and_corner`` of ``edgeAndCorner``."""
    return re.sub("([A-Z])", lambda match: f"_{match[1].lower()}", token)
