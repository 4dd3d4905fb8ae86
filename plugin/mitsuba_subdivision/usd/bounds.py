"""Points of a scene in the world, for lights and cameras to be placed around."""

from __future__ import annotations

import warnings
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..cage import ControlCage
from ..cage.errors import CageError, CageWarning
from ..schemes import SchemeError
from ..studio.placed_points import box_corners, points_at
from ..surface import LimitSurface
from .contents import SceneContents, ShapeContents


def points_of(contents: SceneContents) -> NDArray[np.float64]:
    """Points ``(n, 3)`` that all shapes lie among: of limit surfaces at the cage's vertices, else corners.

    Of groups, there are the corners of their boxes.
    """
    found = [points_at(_points(shape), shape.to_world) for shape in contents.shapes]
    boxes = [
        _corners(_joined([points_at(_points(shape), shape.to_world) for shape in group])) for group in contents.groups
    ]
    found += [points_at(boxes[each.group], each.to_world) for each in contents.instances]
    points = _joined(found)
    return np.asarray(points[np.isfinite(points).all(axis=1)])


def _points(shape: ShapeContents) -> NDArray[Any]:
    if shape.cage.scheme is None:
        return shape.cage.positions
    try:
        with warnings.catch_warnings():
            # Told where the shape itself is made, as errors are.
            warnings.simplefilter("ignore", CageWarning)
            cage = ControlCage.from_arrays(**shape.cage.as_arguments())
        return LimitSurface(cage).tessellate(1).positions
    except (CageError, SchemeError):
        return np.zeros((0, 3))


def _joined(parts: list[NDArray[np.float64]]) -> NDArray[np.float64]:
    return np.concatenate([*parts, np.zeros((0, 3))])


def _corners(points: NDArray[np.float64]) -> NDArray[np.float64]:
    if not len(points):
        return points
    return box_corners(np.stack([points.min(axis=0), points.max(axis=0)]))
