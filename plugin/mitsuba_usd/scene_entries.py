"""Shapes, materials, instances and lights of a stage as entries of a scene."""

from __future__ import annotations

import re
from collections.abc import Mapping
from typing import Any

import mitsuba as mi
from mitsuba_subdivision.cage import CageError
from mitsuba_subdivision.progress import counted
from mitsuba_subdivision.schemes import SchemeError
from mitsuba_subdivision.variants import SceneNode

from .bsdfs import Bsdfs, interior, rgb
from .contents import MaterialContents, SceneContents, ShapeContents
from .emitters import emitter, one_environment
from .limit_surfaces import Surfaces
from .shapes import LoadedShapes, as_polygons, polygon_mesh, subdivision
from .stage_warnings import StageWarnings
from .studio_defaults import RESERVED
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
        self._bsdfs = Bsdfs(self._textures, notes)
        self._parameters, self._surfaces, self._triangles = parameters, surfaces, triangles or {}
        self._loaded, self._has_clear_lamps = loaded, has_clear_lamps
        # Entries of BSDFs that are the same for all shapes, by material.
        self._shared: dict[int, str] = {}
        self.scene: SceneNode = {"type": "scene"}
        self._add_all()

    def _add_all(self) -> None:
        contents = self._contents
        materials = dict.fromkeys(each.material for each in contents.all_shapes if each.material is not None)
        self._textures.read(each for number in materials for each in contents.materials[number].textures())
        for shape in counted(contents.shapes, "Shapes"):
            entry = self._shape(shape)
            if entry is not None:
                self._add(shape.name, entry)
        groups: list[str | None] = []
        for number, shapes_of_group in enumerate(contents.groups):
            shapes = {
                f"shape_{i}": made for i, each in enumerate(shapes_of_group) if (made := self._shape(each)) is not None
            }
            groups.append(self._add(f"group_{number}", {"type": "shapegroup", **shapes}) if shapes else None)
        for each in contents.instances:
            group = groups[each.group]
            if group is not None:
                to_world = mi.ScalarTransform4f(each.to_world.tolist())
                self._add(each.name, {"type": "instance", "group": {"type": "ref", "id": group}, "to_world": to_world})
        for light in one_environment(contents.lights, self._notes):
            entry = emitter(light, contents.up, self._textures)
            is_clear = self._has_clear_lamps and "emitter" in entry
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
        radiance = None if shape.radiance is None else rgb(shape.radiance)
        if radiance is None and material is not None:
            radiance = self._bsdfs.radiance(material)
        area = None if radiance is None else {"type": "area", "radiance": radiance}
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
        if self._loaded is not None:
            return self._loaded.object_of(
                shape, material, lambda: self._bsdf(shape, is_shared=False), area, self._notes
            )
        if shape.cage.scheme is None:
            return {**polygon_mesh(shape).entry(self._bsdf(shape), area), **interior(material)}
        parameters = {**self._parameters_of(shape), **interior(material)}
        return subdivision(shape, self._surfaces, self._bsdf(shape), area, parameters, self._notes)

    def _parameters_of(self, shape: ShapeContents) -> SceneNode:
        if shape not in self._triangles:
            return self._parameters
        others = {name: value for name, value in self._parameters.items() if name != "tessellation_rate"}
        return {**others, **self._triangles[shape]}

    def _bsdf(self, shape: ShapeContents, is_shared: bool = True) -> SceneNode:
        number = shape.material
        if number is None:
            return self._bsdfs.display(shape)
        material = self._contents.materials[number]
        if material.primvars() or not is_shared:
            return self._bsdfs.surface(material, shape)
        if number not in self._shared:
            self._shared[number] = self._add(material.name, self._bsdfs.surface(material, shape))
        return {"type": "ref", "id": self._shared[number]}
