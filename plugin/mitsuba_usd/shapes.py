"""Shapes of a stage as shapes of Mitsuba: limit surfaces as the shape ``subdivision``, polygons as meshes."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import mitsuba as mi
import numpy as np
from mitsuba_subdivision.cage import Attribute, CageContents
from mitsuba_subdivision.mesh import IntArray, ragged
from mitsuba_subdivision.studio import PolygonMesh, points_at
from mitsuba_subdivision.variants import SceneNode
from numpy.typing import NDArray

from .contents import ShapeContents
from .limit_surfaces import Surfaces
from .stage_warnings import StageWarnings


def subdivision(
    shape: ShapeContents,
    surfaces: Surfaces,  # Where its cage is validated
    bsdf: SceneNode | None,
    emitter: SceneNode | mi.Object | None,
    parameters: dict[str, Any],  # Of the shape `subdivision`
    notes: StageWarnings,
) -> SceneNode:
    """A limit surface. Raises CageError for an invalid cage, SchemeError if the scheme cannot subdivide it."""
    # Validated here, so that messages name the prim.
    surfaces.note_warnings(shape, notes)
    # Any, as the stubs call it an object.
    tensor: Any = mi.TensorXu
    shown = shape.shown_faces
    return {
        "type": "subdivision",
        **surfaces.properties(shape.cage),
        "cage_name": shape.cage.source.name,
        **({} if shown is None else {"shown_faces": tensor(shown.astype(np.uint32))}),
        **parameters,
        "to_world": mi.ScalarTransform4f(shape.to_world.tolist()),
        "bsdf": bsdf,
        **({} if emitter is None else {"emitter": emitter}),
    }


def as_polygons(shape: ShapeContents) -> ShapeContents:
    """A limit surface as its control cage."""
    cage, shown = shape.cage, shape.shown_faces
    if shown is not None:
        cage = replace(cage, holes=np.union1d(cage.holes, np.setdiff1d(np.arange(len(cage.face_sizes)), shown)))
    return replace(shape, cage=replace(cage, scheme=None), shown_faces=None)


def polygon_mesh(shape: ShapeContents) -> PolygonMesh:
    """Triangles of a shape that is not to be subdivided."""
    cage, normals = shape.cage, shape.normals
    corners = _triangles(cage)
    data: dict[str, Attribute] = dict(cage.attributes)
    if cage.texcoords is not None:
        data["texcoords"] = cage.texcoords
    if normals is not None or any(each.interpolation == "face_varying" for each in data.values()):
        # Every corner of a face is a vertex of its own.
        vertex, triangles = cage.face_vertices, corners
    else:
        vertex, triangles = np.arange(len(cage.positions)), cage.face_vertices[corners]
    matrix = shape.to_world
    if np.linalg.det(matrix[:3, :3]) < 0:
        triangles = triangles[:, ::-1]
    vertices: dict[str, NDArray] = {"vertex_positions": points_at(cage.positions[vertex], matrix)}
    if normals is not None:
        turned = normals @ np.linalg.inv(matrix[:3, :3])
        lengths = np.linalg.norm(turned, axis=1, keepdims=True)
        vertices["vertex_normals"] = turned / np.where(lengths > 0, lengths, 1)
    for name, attribute in data.items():
        vertices[f"vertex_{name}"] = attribute.values[vertex if attribute.indices is None else attribute.indices]
    return PolygonMesh(shape.name, triangles, vertices)


def _triangles(cage: CageContents) -> IntArray:
    """Face corners of triangles that fan out from the first corners of the faces, ``(n, 3)``."""
    sizes = cage.face_sizes.copy()
    first = np.cumsum(sizes) - sizes
    sizes[cage.holes] = 0
    counts = np.maximum(sizes - 2, 0)
    index = ragged.index_in_row(counts)
    start = np.repeat(first, counts)
    return np.stack([start, start + index + 1, start + index + 2], axis=1)
