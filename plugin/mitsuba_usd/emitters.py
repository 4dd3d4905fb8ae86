"""UsdLux lights as Mitsuba's emitters."""

from __future__ import annotations

import math

import mitsuba as mi
import numpy as np
from mitsuba_subdivision.variants import SceneNode
from numpy.typing import NDArray

from .bsdfs import rgb
from .contents import LightContents
from .stage_warnings import StageWarnings
from .textures import Textures

# From Mitsuba's environments, whose pole is y, to domes with the pole z.
_POLE_TO_Z = np.array([[1.0, 0, 0, 0], [0, 0, -1, 0], [0, 1, 0, 0], [0, 0, 0, 1]])
_TURNED = np.diag([-1.0, 1, -1, 1])  # From Mitsuba's lights, which emit along z, to USD's, which emit along -z
_LEAST_SOFTNESS = 1e-3  # Least softness of a cone, as Mitsuba divides by it


def emitter(light: LightContents, textures: Textures) -> SceneNode:
    """An emitter, or a shape with an emitter."""
    textured = _TEXTURED.get(light.kind)
    return _UNTEXTURED[light.kind](light) if textured is None else textured(light, textures)


def _distant(light: LightContents) -> SceneNode:
    angle = math.radians(min(light.size[0], 180.0))
    irradiance = np.array(light.emission)
    if angle > 0 and not light.is_normalized:
        irradiance = irradiance * math.pi * math.sin(angle / 2) ** 2  # Radiance times the projected solid angle
    direction = -light.to_world[:3, 2]
    direction /= np.linalg.norm(direction)
    return {"type": "directional", "direction": direction.tolist(), "irradiance": rgb(irradiance)}


def _flat(light: LightContents, textures: Textures) -> SceneNode:
    is_rect = light.kind == "rect"
    u, v = np.array(light.size) / 2 if is_rect else np.repeat(light.size, 2)
    area = _area(light, (4 if is_rect else math.pi) * u * v * _stretch(light.to_world, 0, 1))
    bitmap = None if light.texture is None else textures.radiance(light.texture, area["radiance"]["value"])
    if bitmap is not None:
        # The image is upright as seen from the front of the light.
        upright = mi.ScalarAffineTransform3f([[1, 0, 0], [0, -1, 1], [0, 0, 1]])
        area["radiance"] = {"type": "bitmap", "bitmap": bitmap, "to_uv": upright, "wrap_mode": "clamp"}
    to_world = mi.ScalarTransform4f((light.to_world @ _TURNED @ np.diag([u, v, 1, 1])).tolist())
    return {"type": "rectangle" if is_rect else "disk", "to_world": to_world, "emitter": area}


def _sphere(light: LightContents) -> SceneNode:
    radius, center = _world_radius(light), light.to_world[:3, 3].tolist()
    return {"type": "sphere", "center": center, "radius": radius, "emitter": _area(light, 4 * math.pi * radius**2)}


def _point(light: LightContents) -> SceneNode:
    # Intensity of a sphere from afar; independent of the radius of a normalized one.
    intensity = np.array(light.emission) * (0.25 if light.is_normalized else math.pi * _world_radius(light) ** 2)
    return {"type": "point", "position": light.to_world[:3, 3].tolist(), "intensity": rgb(intensity)}


def _spot(light: LightContents) -> SceneNode:
    _, angle, softness = light.size
    place, forward = light.to_world[:3, 3], -light.to_world[:3, 2]
    return {
        "type": "spot",
        "to_world": mi.ScalarTransform4f().look_at(place, place + forward, light.to_world[:3, 1]),
        "intensity": _point(light)["intensity"],
        "cutoff_angle": angle,
        "beam_width": angle * (1 - np.clip(softness, _LEAST_SOFTNESS, 1)),
    }


def _cylinder(light: LightContents) -> SceneNode:
    length = light.size[0]
    radius = light.size[1] * math.sqrt(_stretch(light.to_world, 1, 2))
    start, end = ((light.to_world @ [x, 0, 0, 1])[:3] for x in (-length / 2, length / 2))
    area = _area(light, 2 * math.pi * radius * float(np.linalg.norm(end - start)))
    return {"type": "cylinder", "p0": start.tolist(), "p1": end.tolist(), "radius": radius, "emitter": area}


def _dome(light: LightContents, textures: Textures) -> SceneNode:
    radiance = np.array(light.emission)
    bitmap = None if light.texture is None else textures.radiance(light.texture, radiance)
    if bitmap is None:
        return {"type": "constant", "radiance": rgb(radiance)}
    turned = light.to_world @ (_POLE_TO_Z if light.pole == "z" else np.eye(4))
    turned[:3, 3] = 0
    return {"type": "envmap", "bitmap": bitmap, "to_world": mi.ScalarTransform4f(turned.tolist())}


_TEXTURED = {"rect": _flat, "disk": _flat, "dome": _dome}
_UNTEXTURED = {"distant": _distant, "sphere": _sphere, "point": _point, "spot": _spot, "cylinder": _cylinder}


def one_environment(lights: list[LightContents], notes: StageWarnings) -> list[LightContents]:
    """The lights with at most one dome, the first with a texture, as Mitsuba's scenes have one environment."""
    domes = [light for light in lights if light.kind == "dome"]
    kept = next((light for light in domes if light.texture), domes[0] if domes else None)
    left = [light for light in domes if light is not kept]
    for light in left:
        notes.add("further dome lights are ignored; a scene of Mitsuba has one environment", light.name)
    return [light for light in lights if light not in left]


def are_lamps_in_the_way(lights: list[LightContents], points: NDArray[np.float64]) -> bool:
    """Whether bounding spheres of lights come between points ``(n, 3)`` and other lights.

    A dome without a texture does not count: paths that a BSDF samples find it behind clear shapes.
    """
    middle = (points.min(axis=0) + points.max(axis=0)) / 2
    radius = np.linalg.norm(points - middle, axis=1).max()
    sources = [light for light in lights if light.kind != "dome" or light.texture is not None]
    for lamp in (light for light in lights if light.kind in ("rect", "disk", "sphere", "cylinder")):
        place = lamp.to_world[:3, 3]
        for other in (source for source in sources if source is not lamp):
            if other.kind == "dome":
                return True
            start, start_radius = other.to_world[:3, 3], _bounding_radius(other)
            if other.kind == "distant":
                towards = other.to_world[:3, 2] / np.linalg.norm(other.to_world[:3, 2])
                start, start_radius = middle + towards * (radius + np.linalg.norm(place - middle)), radius
            # The cone around the other light and the points, at the nearest place of its axis to the lamp.
            axis = middle - start
            along = np.clip((place - start) @ axis / max(axis @ axis, 1e-30), 0, 1)
            cone_radius = start_radius + along * (radius - start_radius)
            if np.linalg.norm(place - start - along * axis) < cone_radius + _bounding_radius(lamp):
                return True
    return False


def _bounding_radius(light: LightContents) -> float:
    return float(np.linalg.norm(light.to_world[:3, :3], 2) * np.linalg.norm(light.size))


def _area(light: LightContents, area: float) -> SceneNode:
    radiance = np.array(light.emission) / (area if light.is_normalized and area > 0 else 1)
    return {"type": "area", "radiance": rgb(radiance)}


def _world_radius(light: LightContents) -> float:
    return light.size[0] * abs(float(np.linalg.det(light.to_world[:3, :3]))) ** (1 / 3)


def _stretch(to_world: NDArray[np.float64], first: int, second: int) -> float:
    """Factor by which a transform scales areas spanned by two axes."""
    return float(np.linalg.norm(np.cross(to_world[:3, first], to_world[:3, second])))
