"""Defects put into a scene on purpose, small enough that nobody would see most of them."""

from dataclasses import dataclass
from pathlib import Path

import mitsuba as mi
import numpy as np
from mitsuba_subdivision.device_arrays import upload
from mitsuba_subdivision.regression.scene import load_scene
from mitsuba_subdivision.schemes import CatmullClark, StencilTable, register_scheme

SCENES = Path(__file__).parents[2] / "scenes"
RESOLUTION = 64
ELEMENT = "face_element"


def scene_of(valence, **parameters):
    path = SCENES / f"valence{valence}.xml"
    return load_scene(path, {"resolution": RESOLUTION, **parameters}, "box").scene


def subdivision(scene):
    return next(p for p in map(mi.traverse, scene.shapes()) if "control_points" in p)


def brighter(valence):
    """The albedo of the surface, one per cent higher."""
    scene = scene_of(valence)
    parameters = mi.traverse(scene)
    shape = next(key for key in parameters.keys() if key.endswith("control_points")).rpartition(".")[0]  # noqa: SIM118
    parameters[f"{shape}.bsdf.reflectance.value"] *= 1.01
    parameters.update()
    return scene


def turned_normals(valence):
    """The normals of one patch, turned by 0.1 degrees."""
    scene = scene_of(valence)
    mesh = subdivision(scene)
    normals = np.array(mesh["vertex_normals"], dtype=np.float64).reshape(-1, 3)
    faces = np.array(mesh["faces"]).reshape(-1, 3)
    vertices = np.unique(faces[np.array(mesh[ELEMENT]) == 0])
    angle = np.radians(0.1)
    turn = np.array([[1, 0, 0], [0, np.cos(angle), -np.sin(angle)], [0, np.sin(angle), np.cos(angle)]])
    normals[vertices] = normals[vertices] @ turn.T
    mesh["vertex_normals"] = upload(mi.Float, normals)
    mesh.update()
    return scene


def moved_vertex(valence):
    """One vertex of the cage, moved by 1e-3 along z."""
    scene = scene_of(valence)
    mesh = subdivision(scene)
    points = np.array(mesh["control_points"])
    points[2] += 1e-3
    mesh["control_points"] = upload(mi.Float, points)
    mesh.update()
    return scene


def stam(valence):
    """Stam's form in single precision instead of the stabilised one."""
    return scene_of(valence, evaluator="stam", sample_offset={3: "1e-6", 5: "1e-8"}[valence])


@dataclass(frozen=True)
class OtherVertexRule(CatmullClark):
    """Catmull-Clark with an extraordinary vertex keeping 1e-3 more of itself, and as much less of all others."""

    def refine(self, topology):
        refinement = super().refine(topology)
        matrix = refinement.stencils.matrix.tolil()
        for vertex in np.flatnonzero(~topology.is_border_vertex & (topology.vertex_face_count != 4)):
            if vertex >= topology.vertex_count:
                continue
            others = [column for column in matrix.rows[vertex] if column != vertex]
            matrix[vertex, vertex] += 1e-3
            for column in others:
                matrix[vertex, column] -= 1e-3 / len(others)
        return refinement._replace(stencils=StencilTable.from_matrix(matrix))


def wrong_rule(valence):
    """One weight of a refinement rule wrong by 1e-3."""
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
