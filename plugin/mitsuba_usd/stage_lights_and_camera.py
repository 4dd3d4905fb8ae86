"""Lights of UsdLux, and cameras, as plain data."""

from __future__ import annotations

from typing import Any

import numpy as np
from mitsuba_subdivision.files import value_at
from numpy.typing import NDArray
from pxr import Usd, UsdGeom, UsdLux

from .contents import CameraContents, LightContents
from .stage_curves import EVEN
from .stage_settings import namespaced
from .stage_warnings import StageWarnings

# Kind of each type of light, and attributes of its size.
_KINDS: dict[str, tuple[str, ...]] = {
    "DistantLight": ("distant", "inputs:angle"), "RectLight": ("rect", "inputs:width", "inputs:height"),
    "DiskLight": ("disk", "inputs:radius"), "SphereLight": ("sphere", "inputs:radius"),
    "CylinderLight": ("cylinder", "inputs:length", "inputs:radius"), "DomeLight": ("dome",), "DomeLight_1": ("dome",),
}  # fmt: skip
_POINTLIKE = 1.0  # Largest angle in degrees of distant lights without a warning: twice the Sun's
_CONE = "inputs:shaping:cone:angle"
# Ignored attributes of lights, their values without effect, and the reason.
_EVERYWHERE = "Mitsuba's area lights shine in all directions"
_NEUTRAL_OF_LIGHTS = {
    "inputs:diffuse": (1, "lights illuminate all materials"),
    "inputs:specular": (1, "lights illuminate all materials"),
    _CONE: (90, _EVERYWHERE),
    "inputs:shaping:focus": (0, _EVERYWHERE),
    "inputs:shaping:ies:file": (None, "Mitsuba has no lights with IES profiles"),
    "inputs:shadow:enable": (True, "all shapes cast shadows"),
    "inputs:shadow:color": ((0, 0, 0), "shadows are where light is missing"),
    "inputs:shadow:distance": (-1, "shadows have no end"),
    "inputs:shadow:falloff": (-1, "shadows have no end"),
}
_NEUTRAL_EXPOSURE = {"exposure": 0.0, "exposure:iso": 100.0}
_NEUTRAL_EXPOSURE |= dict.fromkeys(("exposure:time", "exposure:fStop", "exposure:responsivity"), 1.0)
_TENTHS = 0.1  # Apertures and focal lengths are in tenths of the world's unit


def read_light(
    prim: Usd.Prim, to_world: NDArray[np.float64], time: Usd.TimeCode, notes: StageWarnings
) -> LightContents | None:
    """Read a light with a transform ``(4, 4)`` for column vectors; return None for unsupported or dark ones."""
    path, given = prim.GetPath(), str(prim.GetTypeName())
    if given not in _KINDS:
        notes.add(f"lights of type {given} are ignored; expected one of {', '.join(_KINDS)}", path)
        return None
    note_ignored(prim, time, notes)
    if own := [attribute.GetName() for attribute in prim.GetAuthoredPropertiesInNamespace("mitsuba")]:
        notes.add("attributes of Mitsuba are ignored at lights", f"{', '.join(own)} of {path}")
    kind, *sizes = _KINDS[given]
    size = [float(value_at(prim.GetAttribute(name), time)) for name in sizes]
    if kind == "distant" and size[0] > _POINTLIKE:
        notes.add("distant lights have an angle of 0, and sharp shadows; expected an angle of 1 degree or less", path)
    is_normalized = bool(_value(prim, "inputs:normalize", time, False))
    is_point = bool(kind == "sphere" and (size[0] == 0 or _value(prim, "treatAsPoint", time, False)))
    angle = float(_value(prim, _CONE, time, 90.0))
    if kind == "sphere" and (angle == 0 or (size[0] == 0 and not is_normalized)):
        notes.add("sphere lights without power are left out: of radius 0 and not normalized, or with a cone of 0", path)
        return None
    if kind == "sphere" and 0 < angle < 90:
        size += [angle, float(_value(prim, "inputs:shaping:cone:softness", time, 0.0))]
        if not is_point:
            notes.add("sphere lights with a cone have a radius of 0, and sharp shadows", path)
        kind = "spot"
    elif is_point:
        kind = "point"
    pole = _value(prim, "poleAxis", time, "scene") if given == "DomeLight_1" else "Y"
    if pole == "scene":
        pole = UsdGeom.GetStageUpAxis(prim.GetStage())
    emission = read_emission(prim, time).tolist()
    numbers, is_area = [*emission, *size, *to_world.ravel()], kind not in ("distant", "dome", "point", "spot")
    if not np.isfinite(numbers).all() or np.linalg.det(to_world[:3, :3]) == 0 or (is_area and min(size) <= 0):
        raise ValueError("the light is not usable; expected finite numbers, a size above 0 and an invertible transform")
    if kind in ("sphere", "cylinder") and np.linalg.cond(to_world[:3, kind == "cylinder" : 3]) > EVEN:
        notes.add("sphere and cylinder lights stay round where transforms stretch them", path)
    texture = _texture(prim, time, notes) if kind in ("rect", "dome") else None
    return LightContents(str(path), kind, to_world, emission, is_normalized, size, texture, str(pole).lower())


def read_emission(prim: Usd.Prim, time: Usd.TimeCode) -> NDArray[np.float64]:
    """``color * intensity * 2**exposure`` of a light, ``(3,)``, with its colour temperature."""
    light = UsdLux.LightAPI(prim)
    color = np.array(value_at(light.GetColorAttr(), time), dtype=np.float64)
    if value_at(light.GetEnableColorTemperatureAttr(), time):
        color *= np.array(UsdLux.BlackbodyTemperatureAsRgb(value_at(light.GetColorTemperatureAttr(), time)))
    return color * (value_at(light.GetIntensityAttr(), time) * 2.0 ** value_at(light.GetExposureAttr(), time))


def _value(prim: Usd.Prim, name: str, time: Usd.TimeCode, usual: Any) -> Any:
    value = value_at(prim.GetAttribute(name), time)
    return usual if value is None else value


def note_ignored(prim: Usd.Prim, time: Usd.TimeCode, notes: StageWarnings) -> None:
    """Warn of attributes and relationships of a light, or of a mesh that is one, which have no effect."""
    for name, (neutral, reason) in _NEUTRAL_OF_LIGHTS.items():
        value = _value(prim, name, time, neutral)
        is_cone_kept = name == _CONE and (value >= neutral or prim.GetTypeName() == "SphereLight")
        if value != neutral and not is_cone_kept:
            notes.add(f"{name} of lights is ignored; {reason}", prim.GetPath())
    for name, what in (("light:filters", "light filters"), ("portals", "portals")):
        if (relationship := prim.GetRelationship(name)) and relationship.GetTargets():
            notes.add(f"{what} are ignored", prim.GetPath())
    for link in ("lightLink", "shadowLink"):
        root = prim.GetAttribute(f"collection:{link}:includeRoot")
        excludes = prim.GetRelationship(f"collection:{link}:excludes")
        if (root and root.Get() is False) or (excludes and excludes.GetTargets()):
            notes.add("light and shadow links are ignored; lights illuminate all shapes", prim.GetPath())


def _texture(prim: Usd.Prim, time: Usd.TimeCode, notes: StageWarnings) -> str | None:
    asset = _value(prim, "inputs:texture:file", time, None)
    if asset is None or not asset.path:
        return None
    layout = _value(prim, "inputs:texture:format", time, "automatic")
    if layout not in ("automatic", "latlong"):
        notes.add(f'dome textures of format "{layout}" are ignored; expected latlong', prim.GetPath())
        return None
    return str(asset.resolvedPath or asset.path)


def read_camera(
    camera: UsdGeom.Camera, to_world: NDArray[np.float64], time: Usd.TimeCode, notes: StageWarnings
) -> CameraContents:
    """Read a camera with a transform ``(4, 4)`` for column vectors. Raises ValueError if it is unusable."""
    # Frustums of USD have no scale.
    prim, path = camera.GetPrim(), camera.GetPath()
    x, y, z = to_world[:3, :3].T
    forward = -z / np.linalg.norm(z)
    up = y - forward * (forward @ y)
    up /= np.linalg.norm(up)
    right = np.cross(forward, up)
    if right @ x < 0:
        notes.add("reflections in the transforms of cameras are ignored", path)
    rigid = np.eye(4)
    rigid[:3, :3], rigid[:3, 3] = np.stack([right, up, -forward], axis=1), to_world[:3, 3]

    def number(name: str) -> float:
        return float(value_at(prim.GetAttribute(name), time))

    projection = str(value_at(camera.GetProjectionAttr(), time))
    if projection not in ("perspective", "orthographic"):
        notes.add(f'the projection "{projection}" of cameras is ignored, and perspective is used', path)
    is_perspective = projection != "orthographic"
    unit = 1.0 if is_perspective else _TENTHS
    sides = ("horizontalAperture", "verticalAperture")
    film = [unit * number(side) for side in sides], [unit * number(f"{side}Offset") for side in sides]
    shutter = [number("shutter:open"), number("shutter:close")]
    near, far = value_at(camera.GetClippingRangeAttr(), time)
    if not near <= far:
        notes.add("clippingRange of cameras is ignored; expected a number and a larger one", path)
        near, far = 1.0, 1e6  # Defaults of the schema
    focal_length, f_stop, focus = number("focalLength"), number("fStop"), number("focusDistance")
    has_lens = is_perspective and f_stop > 0 and focus > 0
    if is_perspective and f_stop > 0 >= focus:
        notes.add("fStop of cameras without a focusDistance above 0 is ignored", path)
    for name, neutral in _NEUTRAL_EXPOSURE.items():
        if value_at(prim.GetAttribute(name), time) not in (None, neutral):
            notes.add(f"{name} of cameras is ignored; pictures have the radiance of the scene", path)
    if value_at(camera.GetClippingPlanesAttr(), time):
        notes.add("clippingPlanes of cameras are ignored", path)
    lens = (_TENTHS * focal_length / (2 * f_stop), focus) if has_lens else (0.0, 0.0)
    numbers = focal_length, float(near), float(far), *lens
    is_finite = np.isfinite([*to_world.ravel(), *film[0], *film[1], *numbers, *shutter]).all()
    if not is_finite or min(*film[0], focal_length) <= 0:
        raise ValueError("the camera has no image")
    stated = namespaced(prim, "mitsuba:sensor", time)
    return CameraContents(str(path), rigid, is_perspective, *film, *numbers, shutter, mitsuba=stated)
