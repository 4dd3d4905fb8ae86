"""Points of a scene in the world, for lights and cameras to be placed around."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..cage.contents import CageContents
from ..cage.errors import CageError
from ..cage.sameness import same_topology
from ..schemes import SchemeError
from ..studio.model import frame_table
from ..studio.placed_points import box_corners, points_at
from ..surface import LimitSurface
from .contents import SceneContents, ShapeContents
from .surfaces import Surfaces

# From so many faces on, control points stand for the surface, which lies among them and near them: a sphere with 64
# faces around is smaller than its cage by a six-hundredth of its radius.
DENSE = 2_000


class Points:
    """Points of scenes, such as those of one stage at several times: what stays the same is evaluated once.

    Parameters
    ----------
    surfaces : Surfaces
        Where limit surfaces come from.
    """

    def __init__(self, surfaces: Surfaces) -> None:
        self._surfaces = surfaces
        self._known: dict[tuple[str, int | None], _Evaluated] = {}
        self._of_surface: dict[LimitSurface, _Evaluated] = {}

    def of(self, contents: SceneContents) -> NDArray[np.float64]:
        """Points ``(n, 3)`` that all shapes lie among: all over limit surfaces or around them, else corners.

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
            known = self._known[key] = self._evaluated(shape.cage)
        elif not np.array_equal(known.cage.positions, shape.cage.positions):
            positions = np.asarray(shape.cage.positions, dtype=np.float64)
            known = self._known[key] = _Evaluated(shape.cage, known.evaluate, known.evaluate(positions))
        return points_at(known.points, shape.to_world)

    def _evaluated(self, contents: CageContents) -> _Evaluated:
        try:
            # What is to be told, is told where the shape itself is made, as errors are.
            surface = self._surfaces.of(contents)
        except (CageError, SchemeError):
            return _Evaluated(contents, lambda _: _NONE, _NONE)
        if surface not in self._of_surface:
            evaluate = _evaluation(surface)
            self._of_surface[surface] = _Evaluated(contents, evaluate, evaluate(surface.cage.positions))
        return self._of_surface[surface]


_NONE: NDArray[np.float64] = np.zeros((0, 3))


@dataclass(frozen=True, eq=False)
class _Evaluated:
    """A cage, how positions of its vertices become points, and the points; none if it cannot be used."""

    cage: CageContents
    evaluate: Callable[[NDArray[np.float64]], NDArray[np.float64]]
    points: NDArray[np.float64]


def _evaluation(surface: LimitSurface) -> Callable[[NDArray[np.float64]], NDArray[np.float64]]:
    cage = surface.cage
    if cage.face_count < DENSE:
        table = frame_table(surface)
        return lambda positions: table.apply(positions)[0]
    is_shown = np.ones(cage.face_count, dtype=bool)
    is_shown[cage.holes] = False
    is_used = np.zeros(cage.vertex_count, dtype=bool)
    is_used[cage.face_vertices[np.repeat(is_shown, cage.face_sizes)]] = True
    return lambda positions: positions[is_used]


def _joined(parts: list[NDArray[np.float64]]) -> NDArray[np.float64]:
    return np.concatenate([*parts, _NONE])


def _corners(points: NDArray[np.float64]) -> NDArray[np.float64]:
    if not len(points):
        return points
    return box_corners(np.stack([points.min(axis=0), points.max(axis=0)]))
