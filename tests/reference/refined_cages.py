"""Cages and their refinements for tests of borders and creases."""

from __future__ import annotations

import numpy as np
from mitsuba_subdivision import ControlCage, LimitSurface
from mitsuba_subdivision.cage.creases import CutMesh


def sheet(columns, rows, *, triangles=False, **options):
    """Flat sheet of squares, or of triangles."""
    positions = [[i, j, 0.0] for j in range(rows + 1) for i in range(columns + 1)]
    quads = [
        [a, a + 1, a + columns + 2, a + columns + 1]
        for a in (j * (columns + 1) + i for j in range(rows) for i in range(columns))
    ]
    faces = [half for a, b, c, d in quads for half in ([a, b, c], [a, c, d])] if triangles else quads
    return ControlCage(positions, faces, **options)


def refined(surface):
    """The surface of the cut mesh refined once; its element at each half-edge is the corner there."""
    cut = surface.cage.cut_mesh
    refinement = surface.scheme.refine(cut.topology)
    t = refinement.topology
    cage = ControlCage.from_arrays(
        refinement.matrix @ surface.cage.positions[cut.vertex], t.face_sizes, t.face_vertices, boundary="edge_only"
    )
    # Its own rules and edges: what a cage of these faces has not.
    vars(cage)["cut_mesh"] = CutMesh(t, np.arange(t.vertex_count))
    object.__setattr__(cage, "topology", t)
    return LimitSurface(cage, surface.scheme)
