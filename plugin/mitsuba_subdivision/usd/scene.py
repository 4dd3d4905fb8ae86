"""A whole USD file as a scene of Mitsuba."""

from __future__ import annotations

import math
import re
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..cage.errors import CageError, warn
from ..files.usd_process import call_in_process, seconds_in_process
from ..schemes import SchemeError
from ..studio import studio
from .bounds import points_of
from .bsdfs import Bsdfs, rgb
from .contents import TYPES, CameraContents, SceneContents, ShapeContents
from .emitters import emitter, one_environment
from .notes import Notes
from .sensors import sensor
from .shapes import polygon_mesh, subdivision
from .stage_walk import read_stage
from .textures import Textures

DEFAULT_SPP = 64
WIDTH, DEFAULT_SIZE = 640, (640, 480)
# Segments on each edge of a cage, if there are not more triangles in all.
MOST_SEGMENTS, MOST_TRIANGLES = 8, 4_000_000
# Half the least size of what the studio is set up around, as a part of its place: a single point has no size.
_LEAST_SIZE = 1e-6


def usd_scene(
    path: str | Path,
    mi: Any,
    *,
    time: float | None = None,
    camera: str | None = None,
    size: tuple[int, int] | None = None,
    spp: int = DEFAULT_SPP,
    view: Any = "three-quarter",
    **parameters: Any,
) -> dict[str, Any]:
    """A whole USD file as a dictionary for ``mi.load_dict``.

    Meshes become limit surfaces, or polygons where they are not to be subdivided; with their transforms, instances,
    materials, lights and the camera. Where the stage has no lights or no camera, it gets those of the studio.

    Parameters
    ----------
    path : str or Path
        A ``.usd``, ``.usda``, ``.usdc`` or ``.usdz`` file.
    mi : module
        ``mitsuba`` with a variant set. The scene is for this variant.
    time : float, optional
        Time code. By default, the first one at which there is a value.
    camera : str, optional
        Path of the camera, such as "/World/camera". By default that of the stage's render settings, or its first one.
    size : (width, height), optional
        Of the film, in pixels. By default what the stage's render settings say, or 640 pixels wide and as high as the
        camera's aperture asks for.
    spp : int
        Samples per pixel.
    view : str or (azimuth, elevation)
        From where the studio's camera looks, where the stage has no camera.
    **parameters
        Of every shape ``subdivision``, such as ``tessellation_rate=4`` or ``shading="exact"``. By default there are 8
        segments on each edge, or as many as 4 million triangles allow.

    Returns
    -------
    dict
        Entries have the names of their prims: "/World/car" is "World_car".

    Raises
    ------
    CageError
        If the package usd-core is missing; if the file is malformed; if there is no such camera, or nothing to be seen.
        If ``MITSUBA_SUBDIVISION_USD_PROCESS`` is set, also if reading crashes or takes longer.
    ValueError
        If the time, the size or the samples are none.
    OSError
        If the file cannot be read.

    Warns
    -----
    CageWarning
        About what is not taken, once for each kind, and about each mesh that cannot be used.

    Examples
    --------
    >>> import mitsuba_subdivision as msub
    >>> import mitsuba as mi
    >>> mi.set_variant("llvm_ad_rgb")
    >>> scene = mi.load_dict(msub.usd_scene("kitchen.usda", mi))  # doctest: +SKIP
    >>> mi.util.write_bitmap("kitchen.png", mi.render(scene))  # doctest: +SKIP
    """
    contents = _read(path, time, camera)
    notes = Notes()
    made = _Scene(contents, mi, notes, parameters)
    scene = made.entries()
    _stage(scene, contents, made.is_lit, _film_size(contents, size), spp, view, mi, notes)
    notes.tell(f'"{path}"')
    return scene


def _read(path: str | Path, time: float | None, camera: str | None) -> SceneContents:
    if time is not None and not math.isfinite(time):
        raise ValueError(f'"{path}": time {time}; expected a finite number, a time code')
    with Path(path).open("rb"):
        pass  # So that a missing file is an OSError, as for other formats.
    seconds = seconds_in_process()
    arguments: dict[str, Any] = {"time": None if time is None else float(time), "camera": camera}
    contents: SceneContents
    if seconds is None:
        contents = read_stage(path, **arguments)
    else:
        contents = call_in_process(read_stage, path, arguments, seconds, TYPES)
    if not contents.shapes and not contents.instances:
        raise CageError(f'"{path}": there is nothing to be seen; expected visible meshes')
    return contents


class _Scene:
    """Shapes, materials and instances as entries of a scene."""

    def __init__(self, contents: SceneContents, mi: Any, notes: Notes, parameters: dict[str, Any]) -> None:
        self._contents = contents
        self._mi = mi
        self._notes = notes
        self._textures = Textures(mi, notes)
        self._bsdfs = Bsdfs(self._textures, notes)
        self._parameters = parameters
        if not {"tessellation_rate", "tessellation"} & parameters.keys():
            self._parameters = {**parameters, "tessellation_rate": _tessellation_rate(contents)}
        self._entries: dict[str, Any] = {"type": "scene"}
        self.is_lit = bool(contents.lights)
        # BSDFs that are the same for all shapes, as entries and as objects, by material.
        self._shared: dict[int, str] = {}
        self._objects: dict[int, Any] = {}

    def entries(self) -> dict[str, Any]:
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
        return self._entries

    def _add(self, name: str, entry: Any) -> str:
        """Add an entry with the name of a prim, and return its key."""
        key = base = re.sub(r"\W", "_", name.strip("/"))
        number = 1
        while key in self._entries or key in _STUDIO:
            number += 1
            key = f"{base}_{number}"
        self._entries[key] = entry
        return key

    def _instance(self, group: str, to_world: Any) -> dict[str, Any]:
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
        # Materials that glow are not what a scene is lit by.
        self.is_lit |= shape.radiance is not None
        try:
            if shape.cage.scheme is not None:
                return subdivision(shape, self._mi, self._bsdf(shape), area, self._parameters)
            loaded = None if area is None else self._mi.load_dict(area)
            return polygon_mesh(shape, self._mi, self._bsdf_object(shape), loaded)
        except (CageError, SchemeError) as error:
            warn(f"{error}; the prim is left out")
            return None

    def _bsdf(self, shape: ShapeContents) -> dict[str, Any]:
        number = shape.material
        if number is None:
            return self._bsdfs.display(shape)
        material = self._contents.materials[number]
        if material.primvars():
            return self._bsdfs.preview(material, shape)
        if number not in self._shared:
            self._shared[number] = self._add(material.name, self._bsdfs.preview(material, shape))
        return {"type": "ref", "id": self._shared[number]}

    def _bsdf_object(self, shape: ShapeContents) -> Any:
        """BSDF of a mesh that is made here, and not from the dictionary."""
        number = shape.material
        if number is None:
            return self._mi.load_dict(self._bsdfs.display(shape))
        material = self._contents.materials[number]
        if number not in self._objects or material.primvars():
            self._objects[number] = self._mi.load_dict(self._bsdfs.preview(material, shape))
        return self._objects[number]


_STUDIO_LIGHTS = ("key_light", "fill_light", "rim_light", "ambient_light")
_STUDIO = ("integrator", "sensor", *_STUDIO_LIGHTS, "ground")


def _tessellation_rate(contents: SceneContents) -> int:
    shapes = [*contents.shapes, *(shape for group in contents.groups for shape in group)]
    corners = sum(int(shape.cage.face_sizes.sum()) for shape in shapes if shape.cage.scheme is not None)
    # A quadrilateral has four corners, and two triangles for each square of the rate.
    most = math.sqrt(2 * MOST_TRIANGLES / max(corners, 1))
    return int(np.clip(most, 1, MOST_SEGMENTS))


def _film_size(contents: SceneContents, size: tuple[int, int] | None) -> tuple[int, int]:
    if size is not None:
        return size
    if contents.resolution is not None:
        width, height = contents.resolution
        return width, height
    if contents.camera is None:
        return DEFAULT_SIZE
    wide, high = contents.camera.aperture
    return WIDTH, max(1, round(WIDTH * high / wide))


def _stage(
    scene: dict[str, Any],
    contents: SceneContents,
    is_lit: bool,
    size: tuple[int, int],
    spp: int,
    view: Any,
    mi: Any,
    notes: Notes,
) -> None:
    """Add an integrator, the camera, and what of a studio the stage lacks."""
    camera = contents.camera
    points = points_of(contents)
    bounds = np.stack([points.min(axis=0), points.max(axis=0)])
    if (bounds[0] == bounds[1]).all():
        bounds += np.array([[-1], [1]]) * _LEAST_SIZE * (1 + np.abs(bounds).max())
    direction = view if camera is None else _direction(camera, contents.up)
    entries = studio(bounds, up=contents.up, view=direction, size=size, spp=spp, points=points)
    scene["integrator"] = entries["integrator"]
    scene["sensor"] = entries["sensor"] if camera is None else sensor(camera, size, spp, mi, notes)
    if is_lit:
        return
    for name in (*_STUDIO_LIGHTS, "ground"):
        if name not in entries or (name == "ground" and camera is not None):
            continue
        # The stage's own camera may be so far away that lights of a studio would be in its picture.
        is_near = camera is not None and entries[name]["type"] == "rectangle"
        scene[name] = _far_away(entries[name], bounds.mean(axis=0)) if is_near else entries[name]


def _far_away(light: dict[str, Any], target: NDArray[np.float64]) -> dict[str, Any]:
    """A distant light that lights a target as a rectangle does that faces it."""
    matrix = np.array(light["to_world"].matrix, dtype=np.float64)
    towards = target - matrix[:3, 3]
    distance = np.linalg.norm(towards)
    area = 4 * np.linalg.norm(np.cross(matrix[:3, 0], matrix[:3, 1]))
    irradiance = np.array(light["emitter"]["radiance"]["value"]) * area / distance**2
    return {"type": "directional", "direction": (towards / distance).tolist(), "irradiance": rgb(irradiance)}


def _direction(camera: CameraContents, up: str) -> tuple[float, float]:
    """Azimuth and elevation of a camera for the studio, whose lights turn with it."""
    back = camera.to_world[:3, 2]
    right, behind, above = back if up == "z" else (back[0], -back[2], back[1])
    azimuth = math.degrees(math.atan2(right, -behind))
    return azimuth, math.degrees(math.asin(np.clip(above, -1, 1)))
