"""Polygon meshes: half-edges, sharpness, cuts and seams, and the one-rings of elements."""

from . import ragged
from .connectivity import IntArray, Topology
from .triangulation import triangle_corners

__all__ = ["IntArray", "Topology", "ragged", "triangle_corners"]
