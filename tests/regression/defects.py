"""Deliberate defects of a scene, mostly too small to see."""

from dataclasses import dataclass
from pathlib import Path

import mitsuba as mi
import numpy as np
from mitsuba_subdivision.device_arrays import upload
from mitsuba_subdivision.regression.scene import load_scene
from mitsuba_subdivision.schemes import CatmullClark, StencilTable, register_scheme

SCENES = Path(__file__).parents[2] / "scenes"
RESOLUTION = 64


def scene_of(valence, **parameters):
    return load_scene(SCENES / f"valence{valence}.xml", {"resolution": RESOLUTION, **parameters}, "box").scene


def changed(valence, name, change):
    """A scene in which a parameter of the surface is another one: what a function makes of it."""
    scene = scene_of(valence)
    shape = next(p for p in map(mi.traverse, scene.shapes()) if "control_points" in p)
    shape[name] = change(shape)
    shape.update()
    return scene


def brighter(valence):
    return changed(valence, "bsdf.reflectance.value", lambda shape: 1.01 * shape["bsdf.reflectance.value"])


def turned_normals(valence):

    def turned(shape):
        normals = np.array(shape["vertex_normals"], dtype=np.float64).reshape(-1, 3)
        vertices = np.unique(np.array(shape["faces"]).reshape(-1, 3)[np.array(shape["face_element"]) == 0])
        c, s = np.cos(np.radians(0.1)), np.sin(np.radians(0.1))
        normals[vertices] = normals[vertices] @ [[1, 0, 0], [0, c, s], [0, -s, c]]
        return upload(mi.Float, normals)

    return changed(valence, "vertex_normals", turned)


def moved_vertex(valence):

    def moved(shape):
        points = np.array(shape["control_points"])
        points[2] += 1e-3
        return upload(mi.Float, points)

    return changed(valence, "control_points", moved)


def stam(valence):
    return scene_of(valence, evaluator="stam", sample_offset={3: "1e-6", 5: "1e-8"}[valence])


@dataclass(frozen=True)
class OtherVertexRule(CatmullClark):
    """Catmull-Clark with an extraordinary vertex keeping 1e-3 more of itself, and as much less of all others."""

    def refine(self, topology):
        refinement = super().refine(topology)
        matrix = refinement.stencils.matrix.tolil()
        for vertex in np.flatnonzero(~topology.is_border_vertex & (topology.vertex_face_count != 4)):
            others = [column for column in matrix.rows[vertex] if column != vertex]
            matrix[vertex, vertex] += 1e-3
            for column in others:
                matrix[vertex, column] -= 1e-3 / len(others)
        return refinement._replace(stencils=StencilTable.from_matrix(matrix))


def wrong_rule(valence):
    register_scheme(OtherVertexRule())
    try:
        return scene_of(valence)
    finally:
        register_scheme(CatmullClark())


DEFECTS = {
    "albedo + 1 %": brighter,
    "normals of a patch turned by 0.1 degrees": turned_normals,
    "one vertex moved by 1e-3": moved_vertex,
    "Stam's form": stam,
    "a weight wrong by 1e-3": wrong_rule,
}
