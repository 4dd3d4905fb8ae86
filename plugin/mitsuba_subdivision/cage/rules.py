"""Rules of a cage (options in OpenSubdiv and USD): names, values, and the effect of boundary rules."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ..mesh.connectivity import Topology

# Names of rules and their values, as in OpenSubdiv and USD. The first value is the default.
RULES = {
    "boundary": ("edge_and_corner", "edge_only", "none"),
    "crease_method": ("uniform", "chaikin"),
    "triangle_rule": ("catmull_clark", "smooth"),
    "face_varying": ("corners_plus1", "none", "corners_only", "corners_plus2", "boundaries", "all"),
}


def boundary_corners(rule: str, t: Topology) -> NDArray[np.bool_]:
    """Return ``(n_v,)``: corners by the boundary rule: vertices with one face in "edge_and_corner"."""
    if rule != "edge_and_corner":
        return np.zeros(t.vertex_count, dtype=bool)
    return t.is_border_vertex & (t.vertex_face_count == 1)


def boundary_holes(rule: str, t: Topology, is_boundary: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Return ``(n_f,)``: faces that the boundary rule removes from the surface: with "none", those at a boundary.

    ``is_boundary``, ``(n_h,)``, is false for infinitely sharp half-edges, as faces there are part of the surface.
    """
    is_hole = np.zeros(t.face_count, dtype=bool)
    if rule == "none":
        is_hole[t.face[np.flatnonzero(t.ends_of(is_boundary)[t.face_vertices])]] = True
    return is_hole
