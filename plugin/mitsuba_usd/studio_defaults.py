"""Camera, lights and backdrop of a studio for a stage that lacks them."""

from __future__ import annotations

import math

import numpy as np
from mitsuba_subdivision.studio import DEFAULT_SIZE, LIGHTS, Look, View, studio
from mitsuba_subdivision.variants import SceneNode
from numpy.typing import NDArray

from .bsdfs import integrator, rgb
from .contents import SceneContents
from .emitters import are_lamps_in_the_way
from .sensors import sensor
from .stage_warnings import StageWarnings

# Of pictures by a stage's camera.
WIDTH = 640
_LIGHTS = (*LIGHTS, "ambient_light")
RESERVED = ("integrator", "sensor", *_LIGHTS, "ground")
# Half the least size of what the studio is set up around, as a part of its place: a single point has no size.
_LEAST_SIZE = 1e-6


def size_for(contents: SceneContents, look: Look) -> tuple[int, int]:
    """Size of the film for a stage: 640 pixels wide and as high as the camera's aperture asks for, if none is given."""
    if look.size is not None:
        return look.size
    if contents.resolution is not None:
        width, height = contents.resolution
        return width, height
    if contents.camera is None:
        return DEFAULT_SIZE
    wide, high = contents.camera.aperture
    return WIDTH, max(1, round(WIDTH * high / wide))


def angles_for(contents: SceneContents, look: Look) -> View:
    """View direction of a stage's camera, for the studio, whose lights turn with the camera."""
    if contents.camera is None:
        return look.view
    back = contents.camera.to_world[:3, 2]
    right, behind, above = back if contents.up == "z" else (back[0], -back[2], back[1])
    azimuth = math.degrees(math.atan2(right, -behind))
    return azimuth, math.degrees(math.asin(np.clip(above, -1, 1)))


def with_studio_defaults(
    contents: SceneContents,
    points: NDArray[np.float64],  # (n, 3) float64: in the world, that the studio is set up around
    is_lit: bool,  # Whether the stage has lights
    look: Look,
    notes: StageWarnings,
    name: str,  # Of the stage, with which messages begin
) -> SceneNode:
    """An integrator, the camera, and what of a studio the stage lacks, as entries of a scene."""
    camera, size = contents.camera, size_for(contents, look)
    bounds = np.stack([points.min(axis=0), points.max(axis=0)])
    if (bounds[0] == bounds[1]).all():
        bounds += np.array([[-1], [1]]) * _LEAST_SIZE * (1 + np.abs(bounds).max())
    view = angles_for(contents, look)
    entries = studio(bounds, up=contents.up, view=view, size=size, spp=look.spp, points=points, name=name)
    has_clear_lamps = are_lamps_in_the_way(contents.lights, points)
    found = {"integrator": integrator(contents.materials, entries["integrator"], has_clear_lamps=has_clear_lamps)}
    found["sensor"] = entries["sensor"] if camera is None else sensor(camera, size, look.spp, notes)
    if is_lit:
        return found
    for name in (*_LIGHTS, "ground"):
        if name not in entries or (name == "ground" and camera is not None):
            continue
        # The stage's own camera may be so far away that lights of a studio would be in its picture.
        is_near = camera is not None and entries[name]["type"] == "rectangle"
        found[name] = _distant_light(entries[name], bounds.mean(axis=0)) if is_near else entries[name]
    return found


def _distant_light(light: SceneNode, target: NDArray[np.float64]) -> SceneNode:
    """A distant light with the irradiance of a rectangle light that faces the target."""
    matrix = np.array(light["to_world"].matrix, dtype=np.float64)
    towards = target - matrix[:3, 3]
    distance = np.linalg.norm(towards)
    area = 4 * np.linalg.norm(np.cross(matrix[:3, 0], matrix[:3, 1]))
    irradiance = np.array(light["emitter"]["radiance"]["value"]) * area / distance**2
    return {"type": "directional", "direction": (towards / distance).tolist(), "irradiance": rgb(irradiance)}
