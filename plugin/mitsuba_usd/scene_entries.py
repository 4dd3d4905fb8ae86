"""Shapes, materials, instances and lights of a stage as entries of a scene."""

from __future__ import annotations

import re
from collections.abc import Mapping
from functools import partial
from typing import Any

import mitsuba as mi
from mitsuba_subdivision.cage import CageError
from mitsuba_subdivision.messages import counted
from mitsuba_subdivision.schemes import SchemeError
from mitsuba_subdivision.variants import SceneNode

from .bsdfs import bsdf, interior, radiance, rgb
from .contents import MaterialContents, SceneContents, ShapeContents
from .emitters import emitter, one_environment
from .sensors import RESERVED
from .shapes import LoadedShapes, Surfaces, as_polygons, polygon_mesh, subdivision
from .stage_warnings import StageWarnings
from .textures import Textures


def scene_entries(
    contents: SceneContents,
    notes: StageWarnings,
    parameters: dict[str, Any],  # Of every shape `subdivision`; see `with_rate`
    surfaces: Surfaces,  # Provides the limit surfaces
    textures: Textures,
    # Parameters of some limit surfaces, in place of those of all
    chosen: Mapping[ShapeContents, dict[str, Any]] | None = None,
    *,
    loaded: LoadedShapes | None = None,  # If given, its objects are used as shapes
    # Whether shapes of lights let light through, which takes the integrator `volpath`
    has_clear_lamps: bool = False,
) -> SceneNode:
    """Scene entries of a stage, without those of a studio.

    Limit surfaces are entries of the shape ``subdivision``, polygon meshes those of `PolygonMesh`.
    """
    scene: SceneNode = {"type": "scene"}
    # Keys of BSDFs that are the same for all shapes, by material.
    shared: dict[int, str] = {}

    def add(name: str, entry: Any) -> str:
        """Add an entry with the name of a prim, and return its key."""
        key = base = re.sub(r"\W", "_", name.strip("/"))
        number = 1
        while key in scene or key in RESERVED:
            number += 1
            key = f"{base}_{number}"
        scene[key] = entry
        return key

    def made(shape: ShapeContents, material: MaterialContents | None, area: SceneNode | None) -> SceneNode | mi.Object:
        of_shape = (chosen or {}).get(shape, parameters)

        def entry(with_bsdf: SceneNode) -> SceneNode:
            if shape.cage.scheme is None:
                return {**polygon_mesh(shape).entry(with_bsdf, area), **interior(material)}
            return subdivision(shape, surfaces, with_bsdf, area, {**of_shape, **interior(material)}, notes)

        make = partial(bsdf, material, shape, textures, notes)
        if loaded is not None:
            return loaded.object_of(shape, material, entry, make)
        number = shape.material
        if material is None or number is None or material.primvars():
            return entry(make())
        if number not in shared:
            shared[number] = add(material.name, make())
        return entry({"type": "ref", "id": shared[number]})

    def shown(shape: ShapeContents) -> SceneNode | mi.Object | None:
        """A shape; None if it cannot be used, with a warning."""
        material = None if shape.material is None else contents.materials[shape.material]
        shining = None if shape.radiance is None else rgb(shape.radiance)
        if shining is None and material is not None:
            shining = radiance(material, textures, notes)
        area = None if shining is None else {"type": "area", "radiance": shining}
        try:
            return made(shape, material, area)
        except SchemeError as error:
            notes.add_message(f"{error}; the mesh is shown as polygons", shape.name)
            return made(as_polygons(shape), material, area)
        except CageError as error:
            notes.add_message(f"{error}; the prim is left out", shape.name)
            return None

    used = dict.fromkeys(shape.material for shape in contents.all_shapes if shape.material is not None)
    textures.read(texture for number in used for texture in contents.materials[number].textures())
    for shape in counted(contents.shapes, "Shapes"):
        if (entry := shown(shape)) is not None:
            add(shape.name, entry)
    groups: list[str | None] = []
    for number, group in enumerate(contents.groups):
        shapes = {f"shape_{i}": entry for i, shape in enumerate(group) if (entry := shown(shape)) is not None}
        groups.append(add(f"group_{number}", {"type": "shapegroup", **shapes}) if shapes else None)
    for instance in contents.instances:
        if groups[instance.group] is not None:
            place = mi.ScalarTransform4f(instance.to_world.tolist())
            group_of = {"type": "ref", "id": groups[instance.group]}
            add(instance.name, {"type": "instance", "group": group_of, "to_world": place})
    for light in one_environment(contents.lights, notes):
        entry = emitter(light, textures)
        is_clear = has_clear_lamps and "emitter" in entry
        add(light.name, {**entry, "bsdf": {"type": "null"}} if is_clear else entry)
    return scene
