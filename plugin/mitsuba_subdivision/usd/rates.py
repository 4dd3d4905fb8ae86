"""Triangles of a stage's limit surfaces: as many as a picture shows."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..cage import ControlCage
from ..cage.errors import CageError
from ..schemes import SchemeError
from ..studio.picture import MOST_SEGMENTS, MOST_TRIANGLES, Extent, highest_rate, outline_for, triangles_for
from .contents import SceneContents, ShapeContents
from .surfaces import Surfaces


def with_rate(parameters: dict[str, Any], contents: SceneContents) -> dict[str, Any]:
    """Parameters of every limit surface, with as many segments on each edge as most triangles allow by default."""
    if is_chosen(parameters):
        return parameters
    corners = sum(int(shape.cage.face_sizes.sum()) for shape in contents.all_shapes if shape.cage.scheme is not None)
    # A quadrilateral has four corners, and two triangles for each square of the rate.
    most = math.sqrt(2 * MOST_TRIANGLES / max(corners, 1))
    return {**parameters, "tessellation_rate": int(np.clip(most, 1, MOST_SEGMENTS))}


def is_chosen(parameters: dict[str, Any]) -> bool:
    """Whether parameters of limit surfaces say what their triangles are."""
    return bool({"tessellation_rate", "tessellation"} & parameters.keys())


def triangles_for_picture(
    contents: SceneContents,
    surfaces: Surfaces,
    sensor: dict[str, Any],
    parameters: dict[str, Any],
    *,
    follows_sensor: bool = True,
) -> dict[ShapeContents, dict[str, Any]]:
    """Parameters of limit surfaces for as few triangles as a picture cannot tell from more.

    With exact shading, those outside groups may be adaptive; displaced ones are not, as they have no known outline.

    Parameters
    ----------
    contents : SceneContents
    surfaces : Surfaces
        Where limit surfaces come from.
    sensor : dict
        Entry of the scene's sensor.
    parameters : dict
        Of every limit surface: the shading, and how many segments there are at most.
    follows_sensor : bool
        Whether only this sensor is going to see the scene.

    Returns
    -------
    dict of dict by shape
        Cages that cannot be used are missing.
    """
    shading, most = parameters["shading"], parameters["tessellation_rate"]
    segments = segments_of(contents, surfaces, sensor, shading)
    found = {shape: {"tessellation_rate": min(needed, most)} for shape, needed in segments.items()}
    if shading == "exact" and follows_sensor and "displacement" not in parameters:
        corners = {shape: int(shape.cage.face_sizes.sum()) for shape in segments}
        highest = highest_rate(np.array([*segments.values()]), np.array([*corners.values()]))
        outline = outline_for(sensor)
        for shape in contents.shapes:
            if shape in segments:
                found[shape] = triangles_for(segments[shape], corners[shape], most, outline, highest)
    return found


def segments_of(
    contents: SceneContents, surfaces: Surfaces, sensor: dict[str, Any], shading: str
) -> dict[ShapeContents, int]:
    """Segments on each edge of limit surfaces that a picture needs, at most `HIGHEST_RATE`.

    Of shapes in groups, for the instance that needs most. Cages that cannot be used are missing.
    """
    placed: list[tuple[ShapeContents, NDArray[np.float64]]] = [(each, each.to_world) for each in contents.shapes]
    for instance in contents.instances:
        placed += [(each, instance.to_world @ each.to_world) for each in contents.groups[instance.group]]
    found: dict[ShapeContents, int] = {}
    known: dict[ControlCage, Extent] = {}
    for shape, to_world in placed:
        if shape.cage.scheme is None:
            continue
        try:
            cage = surfaces.of(shape.cage).cage
        except (CageError, SchemeError):
            continue
        if cage not in known:
            known[cage] = Extent.of(cage)
        found[shape] = max(found.get(shape, 1), known[cage].segments(to_world, sensor, shading))
    return found
