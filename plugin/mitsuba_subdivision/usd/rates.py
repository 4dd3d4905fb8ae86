"""Segments on the edges of limit surfaces: as many as a picture shows."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..cage import ControlCage
from ..cage.errors import CageError
from ..schemes import SchemeError
from ..studio.placed_points import box_corners, points_at
from .contents import SceneContents, ShapeContents
from .surfaces import Surfaces

# Segments on each edge of a cage, if there are not more triangles in all.
MOST_SEGMENTS, MOST_TRIANGLES = 8, 4_000_000
# How far triangles may be from the surface, in pixels. With exact shading only outlines show it; half a pixel is the
# default of adaptive tessellations, too. Normals between vertices need four times as many segments.
ERRORS = {"exact": 0.5, "vertex": 0.5 / 4**2}
# Which part of the vertices the error holds for: borders and creases look more curved than they are.
MOST_VERTICES = 0.99


def with_rate(parameters: dict[str, Any], contents: SceneContents) -> dict[str, Any]:
    """Parameters of every limit surface, with as many segments on each edge as most triangles allow by default."""
    if is_chosen(parameters):
        return parameters
    shapes = [*contents.shapes, *(shape for group in contents.groups for shape in group)]
    corners = sum(int(shape.cage.face_sizes.sum()) for shape in shapes if shape.cage.scheme is not None)
    # A quadrilateral has four corners, and two triangles for each square of the rate.
    most = math.sqrt(2 * MOST_TRIANGLES / max(corners, 1))
    return {**parameters, "tessellation_rate": int(np.clip(most, 1, MOST_SEGMENTS))}


def is_chosen(parameters: dict[str, Any]) -> bool:
    """Whether parameters of limit surfaces say what their triangles are."""
    return bool({"tessellation_rate", "tessellation"} & parameters.keys())


def rates_for(
    contents: SceneContents, surfaces: Surfaces, sensor: dict[str, Any], shading: str, most: int
) -> dict[ShapeContents, int]:
    """Segments on each edge of limit surfaces, as few as a picture cannot tell from more.

    Parameters
    ----------
    contents : SceneContents
    surfaces : Surfaces
        Where limit surfaces come from.
    sensor : dict
        Entry of the scene's sensor.
    shading : str
        "vertex" or "exact".
    most : int
        Segments that there are at most.

    Returns
    -------
    dict of int by shape
        Of shapes in groups, for the instance that needs most. Cages that cannot be used are missing.
    """
    placed: list[tuple[ShapeContents, NDArray[np.float64]]] = [(each, each.to_world) for each in contents.shapes]
    for instance in contents.instances:
        placed += [(each, instance.to_world @ each.to_world) for each in contents.groups[instance.group]]
    limit = ERRORS.get(shading, ERRORS["vertex"])
    rates: dict[ShapeContents, int] = {}
    known: dict[ControlCage, tuple[float, NDArray[np.float64]]] = {}
    for shape, to_world in placed:
        if shape.cage.scheme is None:
            continue
        try:
            cage = surfaces.of(shape.cage).cage
        except (CageError, SchemeError):
            continue
        if cage not in known:
            known[cage] = _deviation(cage), box_corners(np.array([(x.min(), x.max()) for x in cage.positions.T]).T)
        deviation, corners = known[cage]
        error = deviation * float(np.linalg.norm(to_world[:3, :3], 2)) * _pixels(sensor, points_at(corners, to_world))
        # At twice the rate, triangles are four times as near.
        needed = math.ceil(math.sqrt(min(error / limit, float(most**2))))
        rates[shape] = max(rates.get(shape, 1), needed)
    return rates


def _deviation(cage: ControlCage) -> float:
    """How far the faces of a cage are from its surface, in object space, for most vertices.

    Where a surface of curvature ``k`` bends one way, chords of length ``h`` are up to ``k h^2 / 8`` away from it, and
    vertices lie ``k h^2 / 4`` beside the middle of their four neighbours; where it bends both ways, diagonals are twice
    as far away, and so are the vertices.
    """
    t = cage.topology
    used = t.vertex_face_count > 0
    squared = np.zeros(np.count_nonzero(used))
    for x in cage.positions.T:
        at_corners = x[t.face_vertices]
        around = np.bincount(t.face_vertices, (at_corners[t.next] + at_corners[t.prev]) / 2, cage.vertex_count)
        squared += np.square(around[used] / t.vertex_face_count[used] - x[used])
    return math.sqrt(float(np.quantile(squared, MOST_VERTICES))) / 2


def _pixels(sensor: dict[str, Any], corners: NDArray[np.float64]) -> float:
    """Pixels that a unit of the world takes at most, within a box of which the corners ``(8, 3)`` are given."""
    matrix = np.array(sensor["to_world"].matrix, dtype=np.float64).reshape(4, 4)
    width, height = sensor["film"]["width"], sensor["film"]["height"]
    if "fov" not in sensor:
        return float(width / (2 * np.linalg.norm(matrix[:3, 0])))
    nearest = points_at(corners, np.asarray(np.linalg.inv(matrix), np.float64))[:, 2].min()
    side = max(width, height) if sensor["fov_axis"] == "larger" else width
    return float(side / (2 * math.tan(math.radians(sensor["fov"]) / 2) * max(nearest, sensor["near_clip"])))
