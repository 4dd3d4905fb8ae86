"""Parameters that some limit surfaces have of their own: displacements at rates that show them, and rates."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import mitsuba as mi
import numpy as np
from mitsuba_subdivision import studio
from mitsuba_subdivision.variants import SceneNode
from numpy.typing import NDArray

from .bsdfs import heights
from .contents import SceneContents, ShapeContents
from .picture_detail import pixels_of, rate_of_heights
from .stage_warnings import StageWarnings
from .textures import Textures

_CONSTANT = "vertex_constant_displacement"


def with_own_parameters(
    contents: SceneContents,
    chosen: Mapping[ShapeContents, dict[str, Any]],  # Parameters of some limit surfaces
    parameters: dict[str, Any],  # Of the others; a displacement replaces those of materials
    sensors: Sequence[SceneNode] | None,  # See the heights; none if any may, None for rates that stay as they are
    textures: Textures,
    notes: StageWarnings,
) -> dict[ShapeContents, dict[str, Any]]:
    """Parameters of limit surfaces, with the displacements of their materials and the rates of the stage."""
    shapes = [shape for shape in contents.all_shapes if shape.is_displaced and "displacement" not in parameters]
    copies: dict[ShapeContents, list[NDArray[np.float64]]] = {shape: [] for shape in shapes}
    for shape, to_world in contents.placed_shapes if shapes else ():
        copies.get(shape, []).append(to_world)
    corners = sum(len(shape.cage.face_vertices) for shape in shapes)
    highest = min(math.isqrt(2 * studio.MOST_TRIANGLES // max(corners, 1)), studio.HIGHEST_RATE)
    seen = [(studio.outline_for(sensor), sensor["near_clip"]) for sensor in sensors or () if shapes]
    displaced = {**chosen}
    textures.read(texture for shape in shapes if shape.material for texture in shape.material.textures())
    for shape, placed in copies.items():
        displaced[shape] = {**chosen.get(shape, parameters), **_displacement(shape, textures, notes)}
        texture = displaced[shape].get("displacement")
        if sensors is not None and placed and texture is not None:
            rate = displaced[shape]["tessellation_rate"]
            if isinstance(texture, str):
                rate = rate if texture == _CONSTANT else max(rate, studio.MOST_SEGMENTS)
            elif "bitmap" not in texture:
                rate = 8 * studio.MOST_SEGMENTS
            else:
                pixels = pixels_of(shape.cage, np.stack(placed), seen) if seen else np.inf
                error = studio.ERRORS[parameters["shading"]] / pixels
                rate = max(rate, rate_of_heights(shape.cage, texture, error))
            displaced[shape]["tessellation_rate"] = max(1, min(rate, highest))
    for shape in contents.all_shapes if sensors is not None else ():
        if shape.rate is not None and shape.cage.scheme is not None:
            own = {name: displaced[shape][name] for name in displaced.get(shape, ()) if "displacement" in name}
            displaced[shape] = {**parameters, **own, "tessellation_rate": shape.rate}
    return displaced


def _displacement(shape: ShapeContents, textures: Textures, notes: StageWarnings) -> dict[str, Any]:
    """Parameters of the shape ``subdivision``: a texture or an attribute, which a constant is as well."""
    given, scale = heights(shape, textures, notes)
    if isinstance(given, float):
        values = np.full((len(shape.cage.positions), 1), given * scale)
        return {_CONSTANT: mi.TensorXf(values), "displacement": _CONSTANT} if given * scale else {}
    if given["type"] != "mesh_attribute":
        return {"displacement": given}
    name = given["name"].removeprefix("vertex_")
    if shape.cage.attributes[name].values.shape[1] != 1:
        notes.add(f'displacement by the primvar "{name}" is ignored; expected one number per value', shape.name)
        return {}
    return {"displacement": given["name"], "displacement_scale": scale}
