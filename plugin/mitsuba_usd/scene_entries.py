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


class SceneEntries:
    """Scene entries of a stage, without those of a studio.

    Limit surfaces are entries of the shape ``subdivision``, polygon meshes those of `PolygonMesh`.
    """

    def __init__(
        self,
        contents: SceneContents,
        notes: StageWarnings,
        parameters: dict[str, Any],  # Of every shape `subdivision`; see `with_rate`
        surfaces: Surfaces,  # Provides the limit surfaces
        # Parameters of the tessellations of some limit surfaces, instead of the rate of all
        triangles: Mapping[ShapeContents, dict[str, Any]] | None = None,
        needed: Mapping[str, float] | None = None,  # Pixels along the sides of textures; see `texels_for_pictures`
        texture_size: int | None = None,  # Pixels along the sides of textures of materials at most
        loaded: LoadedShapes | None = None,  # If given, its objects are used as shapes
        # Whether shapes of lights let light through, which takes the integrator `volpath`
        has_clear_lamps: bool = False,
    ) -> None:
        self._contents, self._notes = contents, notes
        self._textures = Textures(notes, needed, texture_size)
        self._parameters, self._surfaces, self._triangles = parameters, surfaces, triangles or {}
        self._loaded = loaded
        # Entries of BSDFs that are the same for all shapes, by material.
        self._shared: dict[int, str] = {}
        self.scene: SceneNode = {"type": "scene"}
        used = dict.fromkeys(shape.material for shape in contents.all_shapes if shape.material is not None)
        self._textures.read(texture for number in used for texture in contents.materials[number].textures())
        for shape in counted(contents.shapes, "Shapes"):
            entry = self._shape(shape)
            if entry is not None:
                self._add(shape.name, entry)
        groups: list[str | None] = []
        for number, group in enumerate(contents.groups):
            shapes = {f"shape_{i}": made for i, shape in enumerate(group) if (made := self._shape(shape)) is not None}
            groups.append(self._add(f"group_{number}", {"type": "shapegroup", **shapes}) if shapes else None)
        for instance in contents.instances:
            if groups[instance.group] is not None:
                entry = {"type": "instance", "group": {"type": "ref", "id": groups[instance.group]}}
                entry["to_world"] = mi.ScalarTransform4f(instance.to_world.tolist())
                self._add(instance.name, entry)
        for light in one_environment(contents.lights, notes):
            entry = emitter(light, contents.up, self._textures)
            is_clear = has_clear_lamps and "emitter" in entry
            self._add(light.name, {**entry, "bsdf": {"type": "null"}} if is_clear else entry)

    def _add(self, name: str, entry: Any) -> str:
        """Add an entry with the name of a prim, and return its key."""
        key = base = re.sub(r"\W", "_", name.strip("/"))
        number = 1
        while key in self.scene or key in RESERVED:
            number += 1
            key = f"{base}_{number}"
        self.scene[key] = entry
        return key

    def _shape(self, shape: ShapeContents) -> SceneNode | mi.Object | None:
        """A shape; None if it cannot be used, with a warning."""
        material = None if shape.material is None else self._contents.materials[shape.material]
        shining = None if shape.radiance is None else rgb(shape.radiance)
        if shining is None and material is not None:
            shining = radiance(material, self._textures, self._notes)
        area = None if shining is None else {"type": "area", "radiance": shining}
        try:
            return self._made(shape, material, area)
        except SchemeError as error:
            self._notes.add_message(f"{error}; the mesh is shown as polygons", shape.name)
            return self._made(as_polygons(shape), material, area)
        except CageError as error:
            self._notes.add_message(f"{error}; the prim is left out", shape.name)
            return None

    def _made(
        self, shape: ShapeContents, material: MaterialContents | None, area: SceneNode | None
    ) -> SceneNode | mi.Object:
        make = partial(bsdf, material, shape, self._textures, self._notes)
        if self._loaded is not None:
            return self._loaded.object_of(shape, material, make, area, self._notes)
        number = shape.material
        if material is None or number is None or material.primvars():
            entry = make()
        else:
            if number not in self._shared:
                self._shared[number] = self._add(material.name, make())
            entry = {"type": "ref", "id": self._shared[number]}
        if shape.cage.scheme is None:
            return {**polygon_mesh(shape).entry(entry, area), **interior(material)}
        parameters = self._parameters
        if shape in self._triangles:
            others = {name: value for name, value in parameters.items() if name != "tessellation_rate"}
            parameters = {**others, **self._triangles[shape]}
        parameters = {**parameters, **interior(material)}
        return subdivision(shape, self._surfaces, entry, area, parameters, self._notes)
