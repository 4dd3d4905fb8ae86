"""Shapes of a stage as shapes of Mitsuba: limit surfaces as the shape ``subdivision``, polygons as meshes.

Entries of a scene, or objects that are kept from frame to frame.
"""

from __future__ import annotations

import warnings
from collections import Counter
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import mitsuba as mi
import numpy as np
from mitsuba_subdivision.cage import Attribute, CageContents, CageError, CageWarning, same, same_topology
from mitsuba_subdivision.mesh import IntArray, ragged
from mitsuba_subdivision.studio import PolygonMesh, points_at, set_parameters
from mitsuba_subdivision.variants import SceneNode
from numpy.typing import NDArray

from .bsdfs import interior
from .contents import MaterialContents, ShapeContents
from .limit_surfaces import Surfaces
from .stage_warnings import StageWarnings

# Fields of a shape that may differ between frames that share an object: a shape can move, and materials are compared
# themselves.
_MOVABLE = frozenset({"cage", "to_world", "material"})
Loaded = tuple[ShapeContents, MaterialContents | None, mi.Object]


def subdivision(
    shape: ShapeContents,
    surfaces: Surfaces,
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


class LoadedShapes:
    """Builds Mitsuba shapes for successive frames.

    A limit surface that only moves reuses the object of the frame before, with new control points: its patches and
    weights stay. A polygon mesh that moves is rebuilt.
    """

    def __init__(self, parameters: dict[str, Any]) -> None:
        self._parameters = parameters  # Of every shape `subdivision`
        self._before: dict[tuple[str, int], Loaded] = {}
        self._now: dict[tuple[str, int], Loaded] = {}
        self._counts: Counter[str] = Counter()
        self._bsdfs: list[tuple[MaterialContents, mi.BSDF]] = []
        self.surfaces = Surfaces()

    def begin_frame(self) -> None:
        """Begin the next frame, and free objects that the last one did not use."""
        self._before, self._now, self._counts, self.surfaces = self._now, {}, Counter(), Surfaces()
        materials = [material for _, material, _ in self._before.values()]
        self._bsdfs = [pair for pair in self._bsdfs if any(pair[0] is each for each in materials)]

    def object_of(
        self,
        shape: ShapeContents,
        material: MaterialContents | None,
        bsdf: Callable[[], SceneNode],  # Makes the entry of its BSDF
        area: SceneNode | None,  # Entry of its emitter
        notes: StageWarnings,
    ) -> mi.Object:
        """The object of a shape.

        Raises CageError if the cage is invalid, or its points are not finite. Raises SchemeError if the scheme cannot
        subdivide it.
        """
        # Several shapes have one name if a mesh has several materials, or if groups have equal shapes.
        self._counts[shape.name] += 1
        key = shape.name, self._counts[shape.name]
        known = self._before.get(key)
        is_alike = known is not None and _differs_by_position(known, shape, material)
        if known is None or not is_alike or (shape.cage.scheme is None and _has_moved(known[0], shape)):
            emitter = None if area is None else mi.load_dict(area)
            if shape.cage.scheme is None:
                media = [mi.load_dict(each) for each in interior(material).values()]
                made = polygon_mesh(shape).loaded(self._bsdf(material, bsdf), emitter, *media)
            else:
                # Validated before its BSDF is made, so that warnings about the cage name the prim.
                parameters = {**self._parameters, **interior(material)}
                entry = subdivision(shape, self.surfaces, None, emitter, parameters, notes)
                with warnings.catch_warnings():
                    warnings.simplefilter("ignore", CageWarning)
                    made = mi.load_dict({**entry, "bsdf": self._bsdf(material, bsdf)})
            known = shape, material, made
        elif _has_moved(known[0], shape):
            _move(known[2], shape)
            known = shape, known[1], known[2]
        self._now[key] = known
        return known[2]

    def _bsdf(self, material: MaterialContents | None, entry: Callable[[], SceneNode]) -> mi.BSDF:
        """The BSDF of a material, shared by all its shapes unless it reads their attributes."""
        if material is None or material.primvars():
            return mi.load_dict(entry())
        for known, loaded in self._bsdfs:
            if same(known, material):
                return loaded
        self._bsdfs.append((material, mi.load_dict(entry())))
        return self._bsdfs[-1][1]


def _differs_by_position(known: Loaded, shape: ShapeContents, material: MaterialContents | None) -> bool:
    """Whether two shapes are equal except for transforms and control points."""
    return same(known[0], shape, _MOVABLE) and same(known[1], material) and same_topology(known[0].cage, shape.cage)


def _has_moved(before: ShapeContents, shape: ShapeContents) -> bool:
    return not (
        np.array_equal(before.cage.positions, shape.cage.positions) and np.array_equal(before.to_world, shape.to_world)
    )


def _move(loaded: mi.Object, shape: ShapeContents) -> None:
    positions = np.asarray(shape.cage.positions, dtype=np.float64)
    if not np.isfinite(positions).all():
        raise CageError(f"{shape.cage.source.name}: points are not finite; expected finite numbers")
    to_world = mi.ScalarTransform4f(shape.to_world.tolist())
    set_parameters(loaded, {"control_points": positions, "to_world": to_world})
