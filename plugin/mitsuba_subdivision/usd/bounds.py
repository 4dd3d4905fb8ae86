"""Points of a scene in the world, for lights and cameras to be placed around."""

from __future__ import annotations

import warnings
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..cage import ControlCage
from ..cage.contents import CageContents
from ..cage.errors import CageError, CageWarning
from ..cage.sameness import same_topology
from ..schemes import SchemeError
from ..studio.model import frame_table
from ..studio.placed_points import box_corners, points_at
from ..surface import LimitSurface
from .contents import SceneContents, ShapeContents


class Points:
    """Points of scenes, such as those of one stage at several times: what stays the same is evaluated once."""

    def __init__(self) -> None:
        self._known: dict[tuple[str, int | None], _Evaluated] = {}

    def of(self, contents: SceneContents) -> NDArray[np.float64]:
        """Points ``(n, 3)`` that all shapes lie among: all over limit surfaces, else corners.

        Of groups, there are the corners of their boxes.
        """
        found = [self._placed(shape) for shape in contents.shapes]
        boxes = [_corners(_joined([self._placed(shape) for shape in group])) for group in contents.groups]
        found += [points_at(boxes[each.group], each.to_world) for each in contents.instances]
        points = _joined(found)
        return np.asarray(points[np.isfinite(points).all(axis=1)])

    def _placed(self, shape: ShapeContents) -> NDArray[np.float64]:
        if shape.cage.scheme is None:
            return points_at(shape.cage.positions, shape.to_world)
        key = shape.name, shape.material
        known = self._known.get(key)
        if known is None or not same_topology(known.cage, shape.cage):
            known = self._known[key] = _evaluated(shape.cage)
        elif not np.array_equal(known.cage.positions, shape.cage.positions):
            positions = np.asarray(shape.cage.positions, dtype=np.float64)
            points = known.points if known.table is None else known.table.apply(positions)[0]
            known = self._known[key] = _Evaluated(shape.cage, known.table, points)
        return points_at(known.points, shape.to_world)


@dataclass(frozen=True, eq=False)
class _Evaluated:
    """A cage, the weights of points of its surface, and the points; None and no points if it cannot be used.

    The weights are what `frame_table` returns.
    """

    cage: CageContents
    table: Any
    points: NDArray[np.float64]


def _evaluated(contents: CageContents) -> _Evaluated:
    try:
        with warnings.catch_warnings():
            # Told where the shape itself is made, as errors are.
            warnings.simplefilter("ignore", CageWarning)
            cage = ControlCage.from_arrays(**contents.as_arguments())
        table = frame_table(LimitSurface(cage))
        return _Evaluated(contents, table, table.apply(cage.positions)[0])
    except (CageError, SchemeError):
        return _Evaluated(contents, None, np.zeros((0, 3)))


def _joined(parts: list[NDArray[np.float64]]) -> NDArray[np.float64]:
    return np.concatenate([*parts, np.zeros((0, 3))])


def _corners(points: NDArray[np.float64]) -> NDArray[np.float64]:
    if not len(points):
        return points
    return box_corners(np.stack([points.min(axis=0), points.max(axis=0)]))
