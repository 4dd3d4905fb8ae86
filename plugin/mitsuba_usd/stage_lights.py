"""UsdLux lights as plain data."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from mitsuba_subdivision.files import value_at
from numpy.typing import NDArray

from .contents import LightContents
from .stage_warnings import StageWarnings

if TYPE_CHECKING:
    from pxr import Usd

# Kind of each type, and attributes for its sizes. The schemas of lights say what they are without a value.
_KINDS: dict[str, tuple[str, ...]] = {
    "DistantLight": ("distant", "inputs:angle"),
    "RectLight": ("rect", "inputs:width", "inputs:height"),
    "DiskLight": ("disk", "inputs:radius"),
    "SphereLight": ("sphere", "inputs:radius"),
    "CylinderLight": ("cylinder", "inputs:length", "inputs:radius"),
    "DomeLight": ("dome",),
    "DomeLight_1": ("dome",),
}
# Angle in degrees, of the Sun and some more, up to which a distant light becomes a point without a warning.
_POINTLIKE = 1.0
CONE = "inputs:shaping:cone:angle"
# Attributes of lights that are ignored, and the values that have no effect.
_NEUTRAL = {
    "inputs:diffuse": 1,
    "inputs:specular": 1,
    CONE: 90,
    "inputs:shaping:focus": 0,
    "inputs:shaping:ies:file": None,
    "inputs:shadow:enable": True,
}


def read_light(
    prim: Usd.Prim, to_world: NDArray[np.float64], time: Usd.TimeCode, notes: StageWarnings
) -> LightContents | None:
    """Read a light with a transform ``(4, 4)`` for column vectors; None if its kind is not supported."""
    path, given = prim.GetPath(), str(prim.GetTypeName())
    if given not in _KINDS:
        notes.add(f"lights of type {given} are ignored; expected one of {', '.join(_KINDS)}", path)
        return None
    _note_ignored(prim, time, notes)
    kind, *sizes = _KINDS[given]
    size = [float(value_at(prim.GetAttribute(name), time)) for name in sizes]
    if kind == "distant" and size[0] > _POINTLIKE:
        notes.add("distant lights have an angle of 0, and sharp shadows; expected an angle of 1 degree or less", path)
    is_point = bool(kind == "sphere" and _value(prim, "treatAsPoint", time, False))
    angle = float(_value(prim, CONE, time, 90.0))
    if kind == "sphere" and 0 <= angle < 90:
        size += [angle, float(_value(prim, "inputs:shaping:cone:softness", time, 0.0))]
        if not is_point and size[0] > 0:
            notes.add("sphere lights with a cone have a radius of 0, and sharp shadows", path)
        kind = "spot"
    elif is_point:
        kind = "point"
    return LightContents(
        str(path),
        kind,
        to_world,
        read_emission(prim, time).tolist(),
        bool(_value(prim, "inputs:normalize", time, False)),
        size,
        _texture(prim, time, notes) if kind in ("rect", "dome") else None,
        str(_value(prim, "poleAxis", time, "scene")).lower() if given == "DomeLight_1" else "y",
    )


def read_emission(prim: Usd.Prim, time: Usd.TimeCode) -> NDArray[np.float64]:
    """``color * intensity * 2**exposure`` of a light, ``(3,)``, with its colour temperature."""
    from pxr import UsdLux

    light = UsdLux.LightAPI(prim)
    color = np.array(value_at(light.GetColorAttr(), time), dtype=np.float64)
    if value_at(light.GetEnableColorTemperatureAttr(), time):
        color *= np.array(UsdLux.BlackbodyTemperatureAsRgb(value_at(light.GetColorTemperatureAttr(), time)))
    return color * (value_at(light.GetIntensityAttr(), time) * 2.0 ** value_at(light.GetExposureAttr(), time))


def _value(prim: Usd.Prim, name: str, time: Usd.TimeCode, usual: Any) -> Any:
    value = value_at(prim.GetAttribute(name), time)
    return usual if value is None else value


def _note_ignored(prim: Usd.Prim, time: Usd.TimeCode, notes: StageWarnings) -> None:
    for name, neutral in _NEUTRAL.items():
        value = _value(prim, name, time, neutral)
        is_cone_kept = name == CONE and (value >= neutral or prim.GetTypeName() == "SphereLight")
        if value != neutral and not is_cone_kept:
            notes.add(
                f"{name} of lights is ignored; lights illuminate all materials, in all directions", prim.GetPath()
            )
    for name, what in (("light:filters", "light filters"), ("portals", "portals")):
        relationship = prim.GetRelationship(name)
        if relationship and relationship.GetTargets():
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
