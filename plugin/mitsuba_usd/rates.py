"""Chooses the tessellation rates of a stage's limit surfaces for an image."""

from __future__ import annotations

import math
from collections.abc import Mapping
from contextlib import suppress
from typing import Any

import numpy as np
from mitsuba_subdivision.cage import CageError, ControlCage
from mitsuba_subdivision.mesh import IntArray
from mitsuba_subdivision.schemes import SchemeError
from mitsuba_subdivision.studio import MOST_SEGMENTS, MOST_TRIANGLES, highest_rate, segments_for, triangles_for
from mitsuba_subdivision.variants import SceneNode
from numpy.typing import NDArray

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
    segments: Mapping[ShapeContents, IntArray],  # dict of (n,) int array by shape: see `segments_of`
    outline: SceneNode,  # Of the sensor; see `outline_for`
    parameters: dict[str, Any],  # Of every limit surface: the shading, and how many segments there are at most
    *,
    follows_sensor: bool = True,  # Whether the scene is rendered by this sensor only
) -> dict[ShapeContents, dict[str, Any]]:
    """Parameters of limit surfaces with the fewest triangles whose facets do not show in an image.

    With exact shading, those outside groups may be adaptive; displaced ones are not, as they have no known outline.

    Returns dict of dict by shape: cages that cannot be used are missing.
    """
    shading, most = parameters["shading"], parameters["tessellation_rate"]
    needed = {shape: int(segments[shape].max()) for shape in contents.all_shapes if shape in segments}
    found: dict[ShapeContents, dict[str, Any]] = {
        shape: {"tessellation_rate": min(rate, most)} for shape, rate in needed.items()
    }
    if needed and shading == "exact" and follows_sensor and "displacement" not in parameters:
        corners = {shape: int(shape.cage.face_sizes.sum()) for shape in needed}
        highest = highest_rate(np.array([*needed.values()]), np.array([*corners.values()]))
        for shape in contents.shapes:
            if shape in needed:
                found[shape] = triangles_for(needed[shape], corners[shape], most, outline, highest)
    return found


def segments_of(
    contents: SceneContents, surfaces: Surfaces, outline: SceneNode, near_clip: float, shading: str
) -> dict[ShapeContents, IntArray]:
    """Segments on each edge of limit surfaces that a picture needs, at most `FINEST_RATE`; see `segments_for`.

    An array ``(n,)`` for the copies of each shape, in the order of ``contents.placed_shapes``. Cages that cannot be
    used are missing.
    """
    of_shape: dict[ShapeContents, list[NDArray[np.float64]]] = {}
    for shape, to_world in contents.placed_shapes:
        if shape.cage.scheme is not None:
            of_shape.setdefault(shape, []).append(to_world)
    of_cage: dict[ControlCage, list[ShapeContents]] = {}
    for shape in of_shape:
        with suppress(CageError, SchemeError):
            of_cage.setdefault(surfaces.of(shape.cage).cage, []).append(shape)
    found: dict[ShapeContents, IntArray] = {}
    for cage, alike in of_cage.items():
        copies = np.concatenate([of_shape[shape] for shape in alike])
        segments = segments_for(cage, copies, outline, near_clip, shading)
        counts = [len(of_shape[shape]) for shape in alike]
        found |= dict(zip(alike, np.split(segments, np.cumsum(counts)[:-1]), strict=True))
    return found
