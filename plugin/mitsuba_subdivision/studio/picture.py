"""Shading and triangles of limit surfaces: what a picture tells from better ones."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from ..cage import ControlCage
from ..messages import tell_aside
from ..shapes.automatic_shading import exact_shading_problem
from ..shapes.parameter_table import SHADINGS
from .placed_points import box_corners, points_at

# How far triangles may be from the surface, in pixels. With exact shading only outlines show it. Normals between
# vertices need more: a 32nd of a pixel is half of one at a quarter of the segments.
ERRORS = {"exact": 0.1, "vertex": 0.5 / 4**2}
# Which part of the vertices an estimate of the error holds for: borders and creases look more curved than they are, and
# few vertices are at outlines.
MOST_VERTICES = {"exact": 0.95, "vertex": 0.99}
# Segments on each edge of a cage: of uniform tessellations that a picture decides on, and of adaptive ones.
MOST_SEGMENTS, HIGHEST_RATE = 8, 64
# Triangles of all surfaces of a scene.
MOST_TRIANGLES = 4_000_000
# As many uniform ones as take as long as the choice of adaptive ones.
FEW_TRIANGLES = 20_000


def shading_for(variant: str, parameters: dict[str, Any]) -> str:
    """How limit surfaces of a scene are shaded, "exact" or "vertex".

    If it is "vertex" because exact shading does not work, or takes long, a line on standard error says so: a warning
    would make an error of every scene in a scalar variant where warnings are errors.

    Parameters
    ----------
    variant : str
        That the scene is for.
    parameters : dict
        Of the shape ``subdivision``; by default its shading is ``auto``.

    Raises
    ------
    ValueError
        If there is no such shading.
    """
    shading = parameters.get("shading", "auto")
    if shading not in SHADINGS:
        raise ValueError(f'shading "{shading}"; expected one of {", ".join(SHADINGS)}')
    if shading != "auto":
        return str(shading)
    if parameters.get("face_normals"):
        return "vertex"
    problem = exact_shading_problem(getattr(mi, variant))
    if problem is None:
        return "exact"
    tell_aside(f"normals are interpolated between vertices: {problem}")
    return "vertex"


@dataclass(frozen=True, eq=False)
class Extent:
    """How far a cage reaches, and how curved its surface is.

    Attributes
    ----------
    corners : (8, 3) float64
        Of its box.
    deviations : dict of float
        How far its faces are from its surface, for most vertices, by shading.
    """

    corners: NDArray[np.float64]
    deviations: dict[str, float]

    @classmethod
    def of(cls, cage: ControlCage) -> Extent:
        """Those of a cage."""
        return cls(box_corners(np.array([(x.min(), x.max()) for x in cage.positions.T]).T), _deviations(cage))

    def segments(self, to_world: NDArray[np.float64], sensor: dict[str, Any], shading: str) -> int:
        """Segments on each edge of the cage by which a picture shows no triangles; an estimate, up to `HIGHEST_RATE`.

        Parameters
        ----------
        to_world : (4, 4) float64
        sensor : dict
            Entry of the scene's sensor.
        shading : "vertex" or "exact"
        """
        stretch = float(np.linalg.norm(to_world[:3, :3], 2))
        error = self.deviations[shading] * stretch * _pixels(sensor, points_at(self.corners, to_world))
        # At twice the rate, triangles are four times as near.
        return max(1, math.ceil(math.sqrt(min(error / ERRORS[shading], HIGHEST_RATE**2))))


def highest_rate(segments: NDArray[np.integer], corners: NDArray[np.integer]) -> int:
    """Most segments on each edge, up to `HIGHEST_RATE`, with which cages have no more than `MOST_TRIANGLES`.

    Parameters
    ----------
    segments : (n,) int
        That each cage needs.
    corners : (n,) int
        Of its faces; a quadrilateral has four, and two triangles for each square of the rate.
    """
    rates = np.arange(2, HIGHEST_RATE + 1)
    triangles = (np.minimum(segments, rates[:, None]) ** 2 * corners).sum(axis=1) // 2
    return 1 + int(np.searchsorted(triangles, MOST_TRIANGLES, side="right"))


def outline_for(sensor: dict[str, Any]) -> dict[str, Any]:
    """Parameters of exactly shaded shapes that have the outlines that a sensor sees; see `pixel_error_for`.

    Parameters
    ----------
    sensor : dict
        Entry of the scene's sensor.
    """
    return {
        "tessellation": "adaptive",
        "pixel_error": ERRORS["exact"],
        "outline": "sensor",
        "sensor_to_world": sensor["to_world"],
        "sensor_fov": math.degrees(2 * math.atan(_half_width(sensor))) if "fov" in sensor else 0.0,
        "film_width": sensor["film"]["width"],
        "film_height": sensor["film"]["height"],
    }


def triangles_for(segments: int, corners: int, most: int, outline: dict[str, Any], highest: int) -> dict[str, Any]:
    """Parameters of an exactly shaded shape in a still picture.

    Adaptive triangles are chosen where that pays: not where uniform ones are few, or as many as the cage has.

    Parameters
    ----------
    segments : int
        That it needs on each edge.
    corners : int
        Of the faces of its cage.
    most : int
        Segments of a uniform tessellation at most.
    outline : dict
        See `outline_for`.
    highest : int
        Segments on each edge of an adaptive one at most.
    """
    is_enough = segments <= most and segments**2 * corners <= 2 * FEW_TRIANGLES
    if is_enough or min(segments, highest) == 1:
        return {"tessellation_rate": min(segments, most)}
    return {**outline, "max_rate": highest}


def _deviations(cage: ControlCage) -> dict[str, float]:
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
    most = np.sqrt(np.quantile(squared, [*MOST_VERTICES.values()])) / 2
    return dict(zip(MOST_VERTICES, most.tolist(), strict=True))


def _pixels(sensor: dict[str, Any], corners: NDArray[np.float64]) -> float:
    """Pixels that a unit of the world takes at most, within a box of which the corners ``(8, 3)`` are given."""
    matrix = np.array(sensor["to_world"].matrix, dtype=np.float64).reshape(4, 4)
    width = sensor["film"]["width"]
    if "fov" not in sensor:
        return float(width / (2 * np.linalg.norm(matrix[:3, 0])))
    nearest = points_at(corners, np.asarray(np.linalg.inv(matrix), np.float64))[:, 2].min()
    return float(width / (2 * _half_width(sensor) * max(nearest, sensor["near_clip"])))


def _half_width(sensor: dict[str, Any]) -> float:
    """Half the width of what a perspective sensor sees, at a depth of one."""
    width, height = sensor["film"]["width"], sensor["film"]["height"]
    side = max(width, height) if sensor["fov_axis"] == "larger" else width
    return math.tan(math.radians(sensor["fov"]) / 2) * width / side
