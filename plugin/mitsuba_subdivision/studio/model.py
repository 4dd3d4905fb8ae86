"""A cage, its limit surface, and the points by which a camera frames it."""

from __future__ import annotations

from functools import cached_property
from math import isqrt
from pathlib import Path
from typing import Any

import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from ..cage import ControlCage, named_cages
from ..cage.errors import CageSource, shortened, warn
from ..files.formats import FORMATS
from ..surface import LimitSurface
from ..tessellation.vertex_table import VertexTable
from ..variants import SceneNode
from .obj_materials import Material, read_materials
from .picture import MOST_SEGMENTS, highest_rate, outline_for, segments_for, triangles_for

# Quadrilaterals of a tessellation: enough for a picture of usual size. Coarse cages have no more segments per edge than
# the picture shows.
QUADS = 200_000
HIGHEST_DEFAULT_RATE = 24
# Segments per edge between which a camera's frame may be missed, by far less than its margin; of large cages 1.
FRAME_RATE, LARGE = 4, 20_000

# Radius of the rods, in radii of the model, and at most in lengths of the middle edge. Balls are thicker.
ROD, ROD_PER_EDGE, BALL = 0.0045, 0.05, 2.2
# Square tubes and cubes have round limit surfaces, which lie so far within them: of the distance of a corner.
_TUBE_LIMIT, _CUBE_LIMIT = 2 / 3, 1 / 2


def frame_table(surface: LimitSurface) -> VertexTable:
    """Stencils of points all over a limit surface, by which a camera frames it."""
    return surface.sampling(1 if surface.cage.face_count > LARGE else FRAME_RATE)


class Model:
    """A cage and its limit surface, and the file that the cage is from."""

    def __init__(
        self,
        cage: ControlCage,
        path: Path | None = None,  # Its file; None for a cage in memory
        **chosen: Any,  # What of the file: `prim`, `time` and `scheme` as for `ControlCage.from_file`
    ) -> None:
        self.path, self._chosen = path, {name: value for name, value in chosen.items() if value is not None}
        self.surface = LimitSurface(cage, self._chosen.get("scheme"))

    @cached_property
    def materials(self) -> dict[str, Material]:
        """Materials that the libraries of an OBJ file describe, by name."""
        is_obj = self.path is not None and self.path.suffix.lower() == ".obj"
        by_face = self.surface.scheme.element == "face" or len(self.cage.materials) == 1
        if not (self.path and is_obj and self.cage.materials and by_face):
            return {}
        described = read_materials(self.path)
        missing = ", ".join(f'"{name}"' for name in self.cage.materials if name and name not in described)
        if described and missing:
            warn(f'"{self.path}": no material library has {shortened(missing, 200)}; their faces are grey')
        return described

    @property
    def cage(self) -> ControlCage:
        return self.surface.cage

    @cached_property
    def up(self) -> str:
        """Axis that points up, by its file; z for cages that are not from a file."""
        return "z" if self.path is None else up_axis_of(self.path)

    @property
    def default_rate(self) -> int:
        """Segments per edge that are enough for a picture."""
        return max(2, min(HIGHEST_DEFAULT_RATE, isqrt(QUADS // self.cage.face_count)))

    @cached_property
    def _frame_table(self) -> VertexTable:
        return frame_table(self.surface)

    def limit_points(self, control_points: NDArray[np.float64]) -> NDArray[np.float64]:
        """Points ``(n, 3)`` all over the limit surface of these control points."""
        return self._frame_table.apply(control_points)[0]

    @cached_property
    def points(self) -> NDArray[np.float64]:
        """Points ``(n, 3)`` all over the limit surface."""
        return self.limit_points(self.cage.positions)

    @cached_property
    def wire_radius(self) -> float:
        """Radius of the rods of the drawn cage."""
        radius = float(np.linalg.norm(np.ptp(self.points, axis=0)) / 2)
        lengths = np.linalg.norm(np.diff(self.cage.positions[self.cage.edges], axis=1)[:, 0], axis=1)
        return min(ROD * radius, ROD_PER_EDGE * float(np.median(lengths)))

    @property
    def wire_cage(self) -> ControlCage:
        """The cage whose limit surface is rods along the edges and balls around the vertices of the cage."""
        tube = np.array([[0, 1, 5, 4], [1, 2, 6, 5], [2, 3, 7, 6], [3, 0, 4, 7]])
        cube = named_cages.cube().face_vertices.reshape(6, 4)
        count = len(self.cage.edges)
        first = 8 * np.arange(count + len(np.unique(self.cage.edges)))[:, None, None]
        faces = np.concatenate([(first[:count] + tube).reshape(-1, 4), (first[count:] + cube).reshape(-1, 4)])
        return ControlCage(self.wire_points(self.cage.positions), faces, source=CageSource("cage wire"))

    def wire_points(self, control_points: NDArray[np.float64]) -> NDArray[np.float64]:
        """Control points of the rods and balls, from the control points ``(n, 3)`` of the cage."""
        ends, radius = control_points[self.cage.edges], self.wire_radius
        along = _unit(ends[:, 1] - ends[:, 0])
        # The axis that is furthest from the edge.
        axis = np.eye(3)[np.abs(along).argmin(axis=1)]
        side = _unit(np.cross(along, axis))
        across = np.stack([side, np.cross(along, side)], axis=1)
        ring = np.array([[1, 0], [0, 1], [-1, 0], [0, -1]]) @ across * (radius / _TUBE_LIMIT)
        tubes = ends[:, :, None] + ring[:, None]
        corners = named_cages.cube().positions * (BALL * radius / _CUBE_LIMIT / np.sqrt(3))
        balls = control_points[np.unique(self.cage.edges), None] + corners
        return np.concatenate([tubes.reshape(-1, 3), balls.reshape(-1, 3)])

    def as_shape(
        self,
        triangles: SceneNode,  # Parameters of its tessellation
        shading: str,
        *,
        in_memory: bool = False,  # Whether the shape gets the cage itself, rather than its file
    ) -> SceneNode:
        """The shape ``subdivision`` as an entry of a scene, without a material."""
        if in_memory or self.path is None:
            # What `prim` and `time` have chosen is in the cage itself.
            scheme = {name: value for name, value in self._chosen.items() if name == "scheme"}
            cage = self.cage.as_properties(mi) | scheme
        else:
            cage = {"filename": str(self.path.resolve()), **self._chosen}
        shown = {} if shading == "vertex" else {"shading": shading}
        return {"type": "subdivision", **cage, **triangles, **shown}

    def triangles_for(self, sensor: SceneNode) -> SceneNode:
        """Parameters of the coarsest exactly shaded tessellation whose facets this sensor of a scene does not see."""
        outline, corners = outline_for(sensor), int(self.cage.face_sizes.sum())
        segments = segments_for(self.cage, np.eye(4)[None], outline, sensor["near_clip"], "exact")
        highest = highest_rate(segments, np.array([corners]))
        return triangles_for(int(segments[0]), corners, min(MOST_SEGMENTS, highest), outline, highest)


def up_axis_of(path: Path) -> str:
    """Axis of a model's file that points up: "y" or "z". Raises CageError if a USD file cannot be opened."""
    form = FORMATS.get(path.suffix.lower())
    if form is not None and form.up is not None:
        return form.up
    from ..files.usd_stage import stage_up_axis

    return stage_up_axis(path)


def _unit(vectors: NDArray[np.float64]) -> NDArray[np.float64]:
    lengths = np.linalg.norm(vectors, axis=1, keepdims=True)
    return vectors / np.where(lengths > 0, lengths, 1)
