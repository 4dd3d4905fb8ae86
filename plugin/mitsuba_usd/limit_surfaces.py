"""Limit surfaces of the cages of a scene, one for all cages that are equal."""

from __future__ import annotations

import warnings
import zlib
from dataclasses import dataclass
from functools import cached_property

import mitsuba as mi
import numpy as np
from mitsuba_subdivision.cage import CageContents, CageError, CageWarning, ControlCage, same, same_topology
from mitsuba_subdivision.progress import counted
from mitsuba_subdivision.schemes import SchemeError
from mitsuba_subdivision.studio import box_corners, frame_table, points_at
from mitsuba_subdivision.surface import LimitSurface
from mitsuba_subdivision.tessellation import VertexTable
from mitsuba_subdivision.variants import SceneNode
from numpy.typing import NDArray

from .contents import SceneContents, ShapeContents
from .stage_warnings import StageWarnings

# From so many faces on, control points stand for the surface, which lies among them and near them: a sphere with 64
# faces around is smaller than its cage by a six-hundredth of its radius.
DENSE = 2_000
_NO_POINTS: NDArray[np.float64] = np.zeros((0, 3))


@dataclass(frozen=True, eq=False)
class _Surface:
    """A limit surface with the warnings about its cage."""

    contents: CageContents
    surface: LimitSurface
    warnings: list[str]

    @cached_property
    def properties(self) -> SceneNode:
        """Properties of the shape ``subdivision`` that describe the cage."""
        return self.surface.cage.as_properties(mi)

    @cached_property
    def points(self) -> NDArray[np.float64]:
        return self.points_of(self.surface.cage.positions)

    def points_of(self, positions: NDArray[np.float64]) -> NDArray[np.float64]:
        """Points on or around the surface of these control points."""
        return positions[self._used] if self._frame_table is None else self._frame_table.apply(positions)[0]

    @cached_property
    def _frame_table(self) -> VertexTable | None:
        return frame_table(self.surface) if self.surface.cage.face_count < DENSE else None

    @cached_property
    def _used(self) -> NDArray[np.bool_]:
        """Mask of the vertices of faces that are not holes."""
        cage = self.surface.cage
        is_shown = np.ones(cage.face_count, dtype=bool)
        is_shown[cage.holes] = False
        used = np.zeros(cage.vertex_count, dtype=bool)
        used[cage.face_vertices[np.repeat(is_shown, cage.face_sizes)]] = True
        return used


class Surfaces:
    """Caches limit surfaces: the left and the right bishop, black or white, share one."""

    def __init__(self) -> None:
        self._known: dict[tuple[int, ...], list[_Surface]] = {}
        # Of shapes whose control points may be others at other times.
        self._of_shape: dict[tuple[str, int | None], _Surface] = {}

    def of(self, contents: CageContents) -> LimitSurface:
        """The surface of a cage, without warnings; see `note_warnings`.

        Raises CageError if the cage is invalid. Raises SchemeError if the scheme cannot subdivide it.
        """
        return self._found(contents).surface

    def note_warnings(self, shape: ShapeContents, notes: StageWarnings) -> None:
        """Record the warnings about the cage of a shape, under the shape's name."""
        known = self._found(shape.cage)
        for message in known.warnings:
            notes.add_message(message.replace(known.contents.source.name, shape.cage.source.name), shape.name)

    def properties(self, contents: CageContents) -> SceneNode:
        """Properties of the shape ``subdivision`` that describe the cage; equal cages share their tensors."""
        return self._found(contents).properties

    def points(self, contents: SceneContents) -> NDArray[np.float64]:
        """Points ``(n, 3)`` in the world, all over limit surfaces or around them, and corners of polygons.

        Of groups, there are the corners of their boxes. Where only control points differ from those of an earlier
        call, weights are made once.
        """
        found = [self._points_of(shape) for shape in counted(contents.shapes, "Limit surfaces")]
        boxes = [_corners(np.concatenate([_NO_POINTS, *map(self._points_of, group)])) for group in contents.groups]
        found += [points_at(boxes[each.group], each.to_world) for each in contents.instances]
        points = np.concatenate([_NO_POINTS, *found])
        return np.asarray(points[np.isfinite(points).all(axis=1)])

    def _points_of(self, shape: ShapeContents) -> NDArray[np.float64]:
        cage, key = shape.cage, (shape.name, shape.material)
        if cage.scheme is None:
            return points_at(cage.positions, shape.to_world)
        known = self._of_shape.get(key)
        if known is None or not same_topology(known.contents, cage):
            try:
                known = self._of_shape[key] = self._found(cage)
            except SchemeError:
                # Shown as polygons.
                return points_at(cage.positions, shape.to_world)
            except CageError:
                # Entries are made of it later, with the error.
                return _NO_POINTS
        is_same = np.array_equal(known.contents.positions, cage.positions)
        points = known.points if is_same else known.points_of(np.asarray(cage.positions, dtype=np.float64))
        return points_at(points, shape.to_world)

    def _found(self, contents: CageContents) -> _Surface:
        key = len(contents.positions), len(contents.face_sizes), zlib.crc32(contents.positions.tobytes())
        alike = self._known.setdefault(key, [])
        for known in alike:
            if same(known.contents, contents):
                return known
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always", CageWarning)
            surface = LimitSurface(ControlCage.from_arrays(**contents.as_arguments()))
        alike.append(_Surface(contents, surface, [str(each.message) for each in caught]))
        return alike[-1]


def _corners(points: NDArray[np.float64]) -> NDArray[np.float64]:
    """Corners of the box around points."""
    return box_corners(np.stack([points.min(axis=0), points.max(axis=0)])) if len(points) else points
