"""Chooses the tessellation rates of a stage's limit surfaces for an image."""

from __future__ import annotations

import math
from contextlib import suppress
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..cage import ControlCage
from ..cage.errors import CageError
from ..schemes import SchemeError
from ..studio.picture import MOST_SEGMENTS, MOST_TRIANGLES, highest_rate, segments_for, triangles_for
from ..variants import SceneNode
from .contents import SceneContents, ShapeContents
from .limit_surfaces import Surfaces


def with_rate(parameters: dict[str, Any], contents: SceneContents) -> dict[str, Any]:
    """Parameters of every limit surface, with as many segments on each edge as most triangles allow by default."""
    if is_chosen(parameters):
        return parameters
    corners = sum(int(shape.cage.face_sizes.sum()) for shape in contents.all_shapes if shape.cage.scheme is not None)
    # A quadrilateral has four corners, and two triangles for each square of the rate.
    most = math.sqrt(2 * MOST_TRIANGLES / max(corners, 1))
    return {**parameters, "tessellation_rate": int(np.clip(most, 1, MOST_SEGMENTS))}


def is_chosen(parameters: dict[str, Any]) -> bool:
    """Whether the parameters of limit surfaces determine their tessellation."""
    return bool({"tessellation_rate", "tessellation"} & parameters.keys())


def triangles_for_picture(
    contents: SceneContents,
    surfaces: Surfaces,
    outline: SceneNode,
    near_clip: float,
    parameters: dict[str, Any],
    *,
    follows_sensor: bool = True,
) -> dict[ShapeContents, dict[str, Any]]:
    """Parameters of limit surfaces with the fewest triangles whose facets do not show in an image.

    With exact shading, those outside groups may be adaptive; displaced ones are not, as they have no known outline.

    Parameters
    ----------
    contents : SceneContents
    surfaces : Surfaces
        Provides the limit surfaces.
    outline : dict
        Of the sensor; see `outline_for`.
    near_clip : float
        Of the sensor.
    parameters : dict
        Of every limit surface: the shading, and how many segments there are at most.
    follows_sensor : bool
        Whether the scene is rendered by this sensor only.

    Returns
    -------
    dict of dict by shape
        Cages that cannot be used are missing.
    """
    shading, most = parameters["shading"], parameters["tessellation_rate"]
    segments = segments_of(contents, surfaces, outline, near_clip, shading)
    found = {shape: {"tessellation_rate": min(needed, most)} for shape, needed in segments.items()}
    if shading == "exact" and follows_sensor and "displacement" not in parameters:
        corners = {shape: int(shape.cage.face_sizes.sum()) for shape in segments}
        highest = highest_rate(np.array([*segments.values()]), np.array([*corners.values()]))
        for shape in contents.shapes:
            if shape in segments:
                found[shape] = triangles_for(segments[shape], corners[shape], most, outline, highest)
    return found


def segments_of(
    contents: SceneContents, surfaces: Surfaces, outline: SceneNode, near_clip: float, shading: str
) -> dict[ShapeContents, int]:
    """Segments on each edge of limit surfaces that a picture needs, at most `HIGHEST_RATE`; see `segments_for`.

    Of shapes in groups, for the instance that needs most. Cages that cannot be used are missing.
    """
    of_cage: dict[ControlCage, list[tuple[ShapeContents, NDArray[np.float64]]]] = {}
    for shape, to_world in contents.placed_shapes:
        if shape.cage.scheme is not None:
            with suppress(CageError, SchemeError):
                of_cage.setdefault(surfaces.of(shape.cage).cage, []).append((shape, to_world))
    found: dict[ShapeContents, int] = {}
    for cage, copies in of_cage.items():
        segments = segments_for(cage, np.stack([to_world for _, to_world in copies]), outline, near_clip, shading)
        for (shape, _), needed in zip(copies, segments.tolist(), strict=True):
            found[shape] = max(found.get(shape, 1), needed)
    return found
