"""Scene entries of shapes, materials, instances and lights, or objects that are kept from frame to frame."""

from __future__ import annotations

import re
import warnings
import zlib
from collections import Counter
from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import cache, partial
from typing import Any

import mitsuba as mi
import numpy as np
from mitsuba_subdivision.cage import (
    Attribute,
    CageContents,
    CageError,
    CageWarning,
    cage_of,
    noting_warnings,
    same,
    same_topology,
    without_warnings,
)
from mitsuba_subdivision.mesh import triangle_corners
from mitsuba_subdivision.messages import counted
from mitsuba_subdivision.mitsuba_mesh import PolygonMesh, box_corners, points_at
from mitsuba_subdivision.schemes import SchemeError
from mitsuba_subdivision.studio import frame_table, set_parameters
from mitsuba_subdivision.surface import LimitSurface
from mitsuba_subdivision.variants import SceneNode
from numpy.typing import NDArray

from .bsdfs import bsdf, interior, radiance, rgb
from .contents import MaterialContents, SceneContents, ShapeContents
from .lights_and_camera import RESERVED, emitter, one_environment
from .stage_warnings import StageWarnings
from .textures import Textures

# Least faces of cages that are framed by their control points: a sphere with 64 around is smaller by 1/600.
DENSE = 2_000
_NO_POINTS: NDArray[np.float64] = np.zeros((0, 3))
_MOVABLE = frozenset({"cage", "to_world"})  # Fields of a shape that may differ between frames that share an object


def scene_entries(
    contents: SceneContents,
    rest: SceneNode,  # Entries of the integrator, the sensor and a studio; empty if nothing is visible
    notes: StageWarnings,
    parameters: dict[str, Any],  # Of every shape `subdivision`; see `with_rate`
    surfaces: Surfaces,
    textures: Textures,
    chosen: Mapping[ShapeContents, dict[str, Any]] | None = None,  # Own parameters of some limit surfaces
    loaded: LoadedShapes | None = None,  # Objects in place of entries of shapes
) -> SceneNode:
    """Scene entries of a stage and the rest, with polygon meshes as `PolygonMesh`."""
    scene: SceneNode = {"type": "scene"}
    shared: dict[MaterialContents, str] = {}  # Keys of BSDFs without primvars, by material

    def add(name: str, entry: Any) -> str:
        key = base = re.sub(r"\W", "_", name.strip("/"))
        number = 1
        while key in scene or key in RESERVED:
            number += 1
            key = f"{base}_{number}"
        scene[key] = entry
        return key

    def made(shape: ShapeContents, area: SceneNode | None) -> SceneNode | mi.Object:
        material, of_shape = shape.material, (chosen or {}).get(shape, parameters)

        def entry(with_bsdf: SceneNode) -> SceneNode:
            if shape.curves is not None:
                return shape.curves.placed(shape.to_world[None]).entry(shape.cage.attributes, with_bsdf)
            if shape.cage.scheme is None:
                if material is not None and "displacement" in material.inputs:
                    notes.add("displacement of meshes that are not subdivided is ignored", shape.name)
                return {**polygon_mesh(shape).entry(with_bsdf, area), **interior(material)}
            return subdivision(shape, surfaces, with_bsdf, area, {**of_shape, **interior(material)}, notes)

        make = partial(bsdf, shape, textures, notes)
        if loaded is not None:
            return loaded.object_of(shape, entry, make)
        if material is None or material.primvars():
            return entry(make())
        if material not in shared:
            shared[material] = add(material.name, make())
        return entry({"type": "ref", "id": shared[material]})

    def area_light(shape: ShapeContents) -> SceneNode | None:
        emitted = None if shape.radiance is None else rgb(np.array(shape.radiance) / _light_area(shape))
        if emitted is None and shape.material is not None:
            emitted = radiance(shape.material, textures, notes)
        if emitted is not None and shape.curves is not None:
            notes.add("emission of curves is ignored; Mitsuba's curves are no lights", shape.name)
        return None if emitted is None else {"type": "area", "radiance": emitted}

    # Not by recursion: a function that refers to itself would keep all textures until the next garbage collection.
    def shown(shape: ShapeContents) -> SceneNode | mi.Object | None:
        """A shape; None, with a warning, if it is unusable."""
        try:
            return made(shape, area_light(shape))
        except SchemeError as error:
            notes.add_message(f"{error}; the mesh is shown as polygons", shape.name)
            polygons = as_polygons(shape)
            return made(polygons, area_light(polygons))
        except CageError as error:
            notes.add_message(f"{error}; the prim is left out", shape.name)
            return None

    textures.read(texture for material in contents.materials for texture in material.textures())
    for shape in counted(contents.shapes, "Shapes"):
        if (entry := shown(shape)) is not None:
            add(shape.name, entry)
    groups: list[str | None] = []
    for number, group in enumerate(contents.groups):
        shapes = {f"shape_{i}": entry for i, shape in enumerate(group) if (entry := shown(shape)) is not None}
        groups.append(add(f"group_{number}", {"type": "shapegroup", **shapes}) if shapes else None)
    for instance in contents.instances:
        if groups[instance.group] is not None:
            place = {"to_world": mi.ScalarTransform4f(instance.to_world.tolist())}
            add(instance.name, {"type": "instance", "group": {"type": "ref", "id": groups[instance.group]}, **place})
    # The integrator volpath, or a dome, finds lights behind clear shapes of other lights.
    has_dome = any(light.kind == "dome" for light in contents.lights)
    are_clear = has_dome or (bool(rest) and rest["integrator"]["type"] == "volpath")
    for light in one_environment(contents.lights, notes):
        entry = emitter(light, textures)
        add(light.name, {**entry, "bsdf": {"type": "null"}} if are_clear and "emitter" in entry else entry)
    return {**scene, **rest}


def size_of(contents: SceneContents) -> float:
    """The largest side of a box around all control points; 0 if there are none."""
    boxes = [
        points_at(box_corners(np.stack([points.min(axis=0), points.max(axis=0)])), matrices).reshape(-1, 3)
        for shape, matrices in contents.placements.items()
        if len(points := shape.cage.positions)
    ]
    return float(np.ptp(np.concatenate(boxes), axis=0).max()) if boxes else 0.0


class Surfaces:
    """Cache of limit surfaces, which equal cages share."""

    def __init__(self) -> None:
        self._known: dict[tuple[int, ...], list[tuple[CageContents, LimitSurface]]] = {}
        # By names of shape and material, for frames with other control points.
        self._of_shape: dict[tuple[str, str | None], tuple[CageContents, LimitSurface]] = {}
        self.messages: dict[LimitSurface, list[str]] = {}  # Warnings about the cages of surfaces
        # Properties of the shape `subdivision` for a cage.
        self.properties = cache(lambda surface: surface.cage.as_properties(mi))
        self._sampling = cache(_sampling)

    def of(self, contents: CageContents) -> LimitSurface:
        """The surface of a cage, without warnings. Raises CageError, or SchemeError if the scheme is the reason."""
        key = len(contents.positions), len(contents.face_sizes), zlib.crc32(contents.positions.tobytes())
        alike = self._known.setdefault(key, [])
        for known, surface in alike:
            if same(known, contents):
                return surface
        with noting_warnings() as messages, without_warnings():
            surface = LimitSurface(cage_of(contents))
        alike.append((contents, surface))
        self.messages[surface] = messages
        return surface

    def points(
        self, contents: SceneContents, heights: Mapping[ShapeContents, float] | None = None
    ) -> NDArray[np.float64]:
        """Points ``(n, 3)`` in the world: of shapes, on or around limit surfaces, and of boxes of groups.

        Points of displaced surfaces are those of boxes around them, as large as the heights.
        """

        def points_of(shape: ShapeContents) -> NDArray[np.float64]:
            height = (heights or {}).get(shape, 0.0)
            corners = box_corners(np.array([[-height] * 3, [height] * 3]))[: 8 if height else 1]
            return points_at((self._points_of(shape)[:, None] + corners).reshape(-1, 3), shape.to_world)

        of_shapes = [points_of(shape) for shape in counted(contents.shapes, "Limit surfaces")]
        boxes = []
        for group in contents.groups:
            inside = np.concatenate([_NO_POINTS, *map(points_of, group)])
            boxes.append(box_corners(np.stack([inside.min(axis=0), inside.max(axis=0)])) if len(inside) else inside)
        of_instances = [points_at(boxes[instance.group], instance.to_world) for instance in contents.instances]
        points = np.concatenate([_NO_POINTS, *of_shapes, *of_instances])
        return np.asarray(points[np.isfinite(points).all(axis=1)])

    def _points_of(self, shape: ShapeContents) -> NDArray[np.float64]:
        cage, key = shape.cage, (shape.name, shape.material.name if shape.material else None)
        positions = np.asarray(cage.positions, dtype=np.float64)
        if cage.scheme is None:
            return positions
        if key not in self._of_shape or not same_topology(self._of_shape[key][0], cage):
            try:
                self._of_shape[key] = cage, self.of(cage)
            except SchemeError:
                return positions  # Shown as polygons
            except CageError:
                return _NO_POINTS  # Its entry issues the error
        return self._sampling(self._of_shape[key][1])(positions)


def _sampling(surface: LimitSurface) -> Callable[[NDArray[np.float64]], NDArray[np.float64]]:
    """Function from control points ``(n, 3)`` to points on or around the surface."""
    cage = surface.cage
    if cage.face_count < DENSE:
        table = frame_table(surface)
        return lambda positions: table.apply(positions)[0]
    is_hole = np.isin(np.arange(cage.face_count), cage.holes)
    used = np.isin(np.arange(cage.vertex_count), cage.face_vertices[np.repeat(~is_hole, cage.face_sizes)])
    return lambda positions: positions[used]


def subdivision(
    shape: ShapeContents,
    surfaces: Surfaces,
    material: SceneNode,
    light: SceneNode | None,
    parameters: dict[str, Any],  # Of the shape `subdivision`
    notes: StageWarnings,
) -> SceneNode:
    """A limit surface. Raises CageError for an invalid cage, SchemeError if the scheme cannot subdivide it."""
    surface = surfaces.of(shape.cage)  # Validated here, so that messages name the prim
    for message in surfaces.messages[surface]:
        notes.add_message(message.replace(surface.cage.source.name, shape.cage.source.name), shape.name)
    tensor: Any = mi.TensorXu  # The stubs call it an object
    shown = shape.shown_faces
    return {
        "type": "subdivision",
        **surfaces.properties(surface),
        "cage_name": shape.cage.source.name,
        **({} if shown is None else {"shown_faces": tensor(shown.astype(np.uint32))}),
        **parameters,
        "to_world": mi.ScalarTransform4f(shape.to_world.tolist()),
        "bsdf": material,
        **({} if light is None else {"emitter": light}),
    }


def _light_area(shape: ShapeContents) -> float:
    """Area of a normalized mesh light in the world, with all its faces; 1 for other lights."""
    if (cage := shape.whole_light) is None:
        return 1.0
    cage = replace(cage, positions=points_at(np.asarray(cage.positions, np.float64), shape.to_world))
    if cage.scheme is not None:
        return LimitSurface(cage_of(cage)).area()
    corners, face = triangle_corners(cage.positions, cage.face_sizes, cage.face_vertices)
    p = cage.positions[cage.face_vertices[corners[~np.isin(face, cage.holes)]]]
    return float(np.linalg.norm(np.cross(p[:, 1] - p[:, 0], p[:, 2] - p[:, 0]), axis=1).sum() / 2) or 1.0


def as_polygons(shape: ShapeContents) -> ShapeContents:
    """A limit surface as its control cage."""
    cage, shown = shape.cage, shape.shown_faces
    if shown is not None:
        cage = replace(cage, holes=np.union1d(cage.holes, np.setdiff1d(np.arange(len(cage.face_sizes)), shown)))
    return replace(shape, cage=replace(cage, scheme=None), shown_faces=None)


def polygon_mesh(shape: ShapeContents) -> PolygonMesh:
    """Triangles of a polygon mesh."""
    cage, normals = shape.cage, shape.normals
    corners, face = triangle_corners(cage.positions, cage.face_sizes, cage.face_vertices)
    corners = corners[~np.isin(face, cage.holes)]
    data: dict[str, Attribute] = dict(cage.attributes)
    if cage.texcoords is not None:
        data["texcoords"] = cage.texcoords
    if normals is not None or any(attribute.interpolation == "face_varying" for attribute in data.values()):
        vertex, triangles = cage.face_vertices, corners  # Every corner of a face is a vertex of its own
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


class LoadedShapes:
    """Objects of shapes in successive frames. Limit surfaces that only move keep theirs; other objects are rebuilt."""

    def __init__(self) -> None:
        self._before: dict[tuple[str, int], tuple[ShapeContents, mi.Object]] = {}
        self._now: dict[tuple[str, int], tuple[ShapeContents, mi.Object]] = {}
        self._counts: Counter[str] = Counter()
        self._bsdfs: list[tuple[MaterialContents, mi.BSDF]] = []

    def begin_frame(self) -> None:
        """Begin the next frame, and free the objects that the last one did not use."""
        self._before, self._now, self._counts = self._now, {}, Counter()
        materials = {shape.material for shape, _ in self._before.values()}
        self._bsdfs = [pair for pair in self._bsdfs if pair[0] in materials]

    def object_of(
        self, shape: ShapeContents, entry: Callable[[SceneNode], SceneNode], bsdf: Callable[[], SceneNode]
    ) -> mi.Object:
        """The object of a shape; ``entry`` makes its scene entry with a BSDF, and ``bsdf`` the entry of the BSDF.

        Raises CageError, SchemeError as `subdivision` does.
        """
        # Parts of a mesh with several materials, and equal shapes of groups, share a name.
        self._counts[shape.name] += 1
        key = shape.name, self._counts[shape.name]
        known = self._before.get(key)
        stays = (
            known is not None
            and np.array_equal(known[0].to_world, shape.to_world)
            and np.array_equal(known[0].cage.positions, shape.cage.positions)
        )
        if (
            known is None
            or not same(known[0], shape, _MOVABLE)
            or not same_topology(known[0].cage, shape.cage)
            or (shape.cage.scheme is None and not stays)
        ):
            # The cage is validated before the BSDF is made, so that warnings name the prim.
            known = shape, self._loaded(shape.material, entry({}), bsdf)
        elif not stays:
            positions = np.asarray(shape.cage.positions, dtype=np.float64)
            if not np.isfinite(positions).all():
                raise CageError(f"{shape.cage.source.name}: points are not finite; expected finite numbers")
            to_world = mi.ScalarTransform4f(shape.to_world.tolist())
            set_parameters(known[1], {"control_points": positions, "to_world": to_world})
            known = replace(shape, material=known[0].material), known[1]
        self._now[key] = known
        return known[1]

    def _loaded(self, material: MaterialContents | None, made: SceneNode, bsdf: Callable[[], SceneNode]) -> mi.Object:
        # Shapes of a material without primvars share its BSDF.
        shared = None if material is None or material.primvars() else material
        loaded = next((loaded for known, loaded in self._bsdfs if same(known, shared)), None)
        if loaded is None:
            loaded = mi.load_dict(bsdf())
            self._bsdfs += [] if shared is None else [(shared, loaded)]
        if "mesh" in made:
            parts = (mi.load_dict(made[name]) if name in made else None for name in ("emitter", "interior"))
            return made["mesh"].loaded(loaded, *parts)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", CageWarning)
            return mi.load_dict({**made, "bsdf": loaded})
