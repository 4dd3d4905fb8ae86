"""Cages and their refinements for tests of borders and creases."""

from dataclasses import replace
from weakref import WeakValueDictionary

import numpy as np
from mitsuba_subdivision import ControlCage, LimitSurface
from mitsuba_subdivision.cage import cage_of
from mitsuba_subdivision.cage.errors import without_warnings
from mitsuba_subdivision.mesh import shared
from mitsuba_subdivision.mesh.cuts import CutMesh
from mitsuba_subdivision.patches import patch_table
from patches.closed_cages import polygons

from reference.refinement import Channel


def sheet(columns, rows, *, triangles=False, **options):
    positions = [[i, j, 0.0] for j in range(rows + 1) for i in range(columns + 1)]
    first = [j * (columns + 1) + i for j in range(rows) for i in range(columns)]
    quads = [[a, a + 1, a + columns + 2, a + columns + 1] for a in first]
    faces = [half for a, b, c, d in quads for half in ([a, b, c], [a, c, d])] if triangles else quads
    return ControlCage(positions, faces, **options)


def half_disc(faces):
    turn = np.linspace(0, np.pi, faces + 1)
    ring = np.stack([np.cos(turn), np.sin(turn), np.zeros_like(turn)], axis=1)
    return ControlCage([[0, 0, 0], *ring], [[0, 1 + i, 2 + i] for i in range(faces)])


def tagged(cage, **options):
    """The same points and faces with other options of a `ControlCage`, and none of its own."""
    return ControlCage.from_arrays(cage.positions, cage.face_sizes, cage.face_vertices, **options)


def changed(cage, **options):
    """A cage with other options, or arrays, of `ControlCage.from_arrays`, and the others of its own."""
    with without_warnings():
        return cage_of(cage.contents, **options)


def upper_half(ball):
    """The faces of a ball that lie nowhere below its middle, in their order: vertex 0 is on top."""
    lowest = np.minimum.reduceat(ball.positions[ball.face_vertices, 2], ball.topology.face_offsets[:-1])
    is_above = lowest > -1e-9
    kept, vertices = np.unique(ball.face_vertices[is_above[ball.topology.face]], return_inverse=True)
    return ControlCage.from_arrays(ball.positions[kept], ball.face_sizes[is_above], vertices.ravel())


def spokes(cage, valence, sharpness):
    """Creases along the edges of vertex 0 of a ball, or half of one, by their sharpness; the last may be left out."""
    ring = cage.face_vertices.reshape(cage.face_count, -1)[:valence, 1].tolist()
    return tagged(cage, creases=[(0, far, s) for far, s in zip(ring, sharpness, strict=False) if s])


def channel_of(cage, values, indices, mode="none"):
    """What the reference has of a cage and values at its corners; of points, these and the faces' vertices."""
    keys = zip(cage.face_vertices.tolist(), indices.tolist(), strict=True)
    return Channel(
        polygons(cage.topology),
        [tuple(rows) for rows in np.split(indices, cage.topology.face_offsets[1:-1])],
        {key: values[key[1]] for key in keys},
        {frozenset((int(a), int(b))): float(s) for a, b, s in cage.tags.creases(cage.topology)},
        {int(vertex): float(s) for vertex, s in cage.tags.corners()},
        cage.boundary == "edge_and_corner",
        mode,
        cage.crease_method,
        cage.triangle_rule == "smooth",
    )


def refined(surface):
    """The surface of the cut mesh refined once; its element at each half-edge is the corner there."""
    cut = surface.cage.cut_mesh
    refinement = surface.scheme.refine(cut.topology)
    t, points = refinement.topology, refinement.apply(surface.cage.positions[cut.vertex])
    cage = ControlCage.from_arrays(points, t.face_sizes, t.face_vertices, boundary="edge_only")
    # Its own rules and edges: what a cage of these faces has not.
    structure = replace(cage.structure, topology=t)
    vars(structure)["cut"] = CutMesh(t, np.arange(t.vertex_count))
    vars(cage).update(topology=t, structure=structure)
    return LimitSurface(cage, surface.scheme)


def refine_first(monkeypatch, many_classes=0):
    """Have patches made of cages refined once, where these have more classes than a number."""
    for name, value in (("MANY_CLASSES", many_classes), ("FEW_PATCHES", 1 << 40), ("FEWER", 0)):
        monkeypatch.setattr(patch_table, name, value)
    # Surfaces would share the patches of others that are there already.
    monkeypatch.setattr(shared, "_values", WeakValueDictionary())
