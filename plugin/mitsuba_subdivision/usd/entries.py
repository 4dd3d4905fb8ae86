"""Shapes, materials, instances and lights of a stage as entries of a scene."""

from __future__ import annotations

import re
from collections.abc import Mapping
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from ..cage.errors import CageError, warn
from ..schemes import SchemeError
from ..studio.picture import MOST_SEGMENTS, MOST_TRIANGLES, shading_for
from ..variants import variant_name
from .bsdfs import Bsdfs, rgb
from .contents import MaterialContents, SceneContents, ShapeContents
from .copies import with_copies
from .emitters import emitter, one_environment
from .notes import Notes
from .rates import with_rate
from .shapes import polygon_mesh, subdivision
from .staging import RESERVED
from .surfaces import Surfaces
from .textures import Textures


class ShapeMaker(Protocol):
    """Makes the objects of shapes; see `entries`."""

    def make(self, shape: ShapeContents, material: MaterialContents | None, bsdf: Any, area: Any) -> Any:
        """An object of Mitsuba for a shape, with the entries of its BSDF, from a function, and of its emitter."""


class Entries:
    """Entries of a scene of a stage: all but what a studio has.

    Limit surfaces are entries of the shape ``subdivision``. Polygon meshes have the type "ply", and in place of a file
    name ``mesh``, a `PolygonMesh`.

    Parameters
    ----------
    contents : SceneContents
    mi : module
        ``mitsuba`` with a variant set.
    notes : Notes
    parameters : dict
        Of every shape ``subdivision``; see `with_rate`.
    surfaces : Surfaces
        Where limit surfaces come from.
    triangles : dict of dict by shape, optional
        Parameters of the tessellations of some limit surfaces, instead of the rate of all.
    maker : ShapeMaker, optional
        If it is given, shapes are the objects that it makes.

    Attributes
    ----------
    scene : dict
    """

    def __init__(
        self,
        contents: SceneContents,
        mi: Any,
        notes: Notes,
        parameters: dict[str, Any],
        surfaces: Surfaces,
        triangles: Mapping[ShapeContents, dict[str, Any]] | None = None,
        maker: ShapeMaker | None = None,
    ) -> None:
        self._contents = contents
        self._mi = mi
        self._notes = notes
        self._textures = Textures(mi, notes)
        self._bsdfs = Bsdfs(self._textures, notes)
        self._parameters = parameters
        self._surfaces = surfaces
        self._triangles = triangles or {}
        self._maker = maker
        # Entries of BSDFs that are the same for all shapes, by material.
        self._shared: dict[int, str] = {}
        self.scene: dict[str, Any] = {"type": "scene"}
        self._add_all()

    def _add_all(self) -> None:
        contents = self._contents
        for shape in contents.shapes:
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
                self._add(each.name, self._instance(group, each.to_world))
        for light in one_environment(contents.lights, self._notes):
            self._add(light.name, emitter(light, contents.up, self._mi, self._textures))

    def _add(self, name: str, entry: Any) -> str:
        """Add an entry with the name of a prim, and return its key."""
        key = base = re.sub(r"\W", "_", name.strip("/"))
        number = 1
        while key in self.scene or key in RESERVED:
            number += 1
            key = f"{base}_{number}"
        self.scene[key] = entry
        return key

    def _instance(self, group: str, to_world: NDArray[np.float64]) -> dict[str, Any]:
        return {
            "type": "instance",
            "group": {"type": "ref", "id": group},
            "to_world": self._mi.ScalarTransform4f(to_world.tolist()),
        }

    def _shape(self, shape: ShapeContents) -> Any | None:
        """A shape; None if it cannot be used, which is told."""
        material = None if shape.material is None else self._contents.materials[shape.material]
        radiance = None if shape.radiance is None else rgb(shape.radiance)
        if radiance is None and material is not None:
            radiance = self._bsdfs.radiance(material)
        area = None if radiance is None else {"type": "area", "radiance": radiance}
        try:
            if self._maker is not None:
                return self._maker.make(shape, material, lambda: self._bsdf(shape, is_shared=False), area)
            bsdf = self._bsdf(shape)
            if shape.cage.scheme is not None:
                return subdivision(shape, self._surfaces, self._mi, bsdf, area, self._parameters_of(shape))
            mesh = polygon_mesh(shape)
            # Otherwise Mitsuba would make normals.
            facets = {} if mesh.has_normals else {"face_normals": True}
            return {"type": "ply", "mesh": mesh, **facets, "bsdf": bsdf, **({} if area is None else {"emitter": area})}
        except (CageError, SchemeError) as error:
            warn(f"{error}; the prim is left out")
            return None

    def _parameters_of(self, shape: ShapeContents) -> dict[str, Any]:
        if shape not in self._triangles:
            return self._parameters
        others = {name: value for name, value in self._parameters.items() if name != "tessellation_rate"}
        return {**others, **self._triangles[shape]}

    def _bsdf(self, shape: ShapeContents, is_shared: bool = True) -> dict[str, Any]:
        number = shape.material
        if number is None:
            return self._bsdfs.display(shape)
        material = self._contents.materials[number]
        if material.primvars() or not is_shared:
            return self._bsdfs.surface(material, shape)
        if number not in self._shared:
            self._shared[number] = self._add(material.name, self._bsdfs.surface(material, shape))
        return {"type": "ref", "id": self._shared[number]}


def is_lit(contents: SceneContents) -> bool:
    """Whether a stage has lights; materials that glow are not what a scene is lit by."""
    shapes = [*contents.shapes, *(shape for group in contents.groups for shape in group)]
    return bool(contents.lights) or any(shape.radiance is not None for shape in shapes)


def has_surfaces(contents: SceneContents) -> bool:
    """Whether a stage has meshes that are to be subdivided."""
    shapes = [*contents.shapes, *(shape for group in contents.groups for shape in group)]
    return any(shape.cage.scheme is not None for shape in shapes)


def prepared(contents: SceneContents, mi: Any, parameters: dict[str, Any]) -> tuple[SceneContents, dict[str, Any]]:
    """What a scene is made of, for a variant: with copies in place of many instances, with a shading and a rate.

    Parameters
    ----------
    contents : SceneContents
    mi : module
    parameters : dict
        Of every limit surface.
    """
    parameters = with_rate(parameters, contents)
    if has_surfaces(contents):
        parameters = {**parameters, "shading": shading_for(variant_name(mi), parameters)}
    # Scalar variants have numbers of Python, and no programs for instances.
    if mi.Float is not float:
        rate = parameters.get("tessellation_rate", MOST_SEGMENTS)
        contents = with_copies(contents, rate, MOST_TRIANGLES)
    return contents, parameters


def with_meshes(scene: dict[str, Any], mi: Any) -> dict[str, Any]:
    """A scene of `Entries` for ``mi.load_dict``: polygon meshes are objects of Mitsuba, with BSDFs of their own."""
    bsdfs: dict[str, Any] = {}
    used = set()

    def loaded(entry: Any) -> Any:
        if not isinstance(entry, dict):
            return entry
        given = entry.get("bsdf", {})
        shared = given["id"] if given.get("type") == "ref" else None
        if "mesh" not in entry:
            used.add(shared)
            return {name: loaded(each) if entry["type"] == "shapegroup" else each for name, each in entry.items()}
        if shared is None:
            bsdf = mi.load_dict(given)
        else:
            bsdf = bsdfs[shared] = bsdfs.get(shared) or mi.load_dict(scene[shared])
        return entry["mesh"].loaded(mi, bsdf, mi.load_dict(entry["emitter"]) if "emitter" in entry else None)

    found = {name: loaded(entry) for name, entry in scene.items()}
    return {name: entry for name, entry in found.items() if name not in bsdfs or name in used}
