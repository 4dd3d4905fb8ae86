"""Rules of a cage, which OpenSubdiv and USD call options: their names, and what boundary rules do."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ..mesh.connectivity import Topology

# Rules by name and the values of each, as OpenSubdiv and USD name them. The first value is the default.
RULES = {
    "boundary": ("edge_and_corner", "edge_only", "none"),
    "crease_method": ("uniform", "chaikin"),
    "triangle_rule": ("catmull_clark", "smooth"),
    "face_varying": ("corners_plus1", "none", "corners_only", "corners_plus2", "boundaries", "all"),
}


def boundary_corners(rule: str, t: Topology) -> NDArray[np.bool_]:
    """``(n_v,)`` whether a boundary rule makes each vertex a corner: with "edge_and_corner", those of one face."""
    if rule != "edge_and_corner":
        return np.zeros(t.vertex_count, dtype=bool)
    return t.is_border_vertex & (t.vertex_face_count == 1)


def boundary_holes(rule: str, t: Topology, is_boundary: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """``(n_f,)`` whether a boundary rule leaves each face out: with "none", those at a boundary.

    ``is_boundary``, ``(n_h,)``, has no infinitely sharp half-edges, which the surface reaches.
    """
    found = np.zeros(t.face_count, dtype=bool)
    if rule == "none":
        found[t.face[np.flatnonzero(t.ends_of(is_boundary)[t.face_vertices])]] = True
    return found
