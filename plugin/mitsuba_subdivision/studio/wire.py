"""A control cage drawn over its surface: rods along its edges and balls at its vertices."""

from __future__ import annotations

from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from ..cage import ControlCage, named_cages
from ..cage.source import CageSource

# Radius of the rods, in radii of the model, and at most in lengths of the middle edge. Balls are thicker.
ROD, ROD_PER_EDGE, BALL = 0.0045, 0.05, 2.2
# Square tubes and cubes have round limit surfaces, which lie so far within them: of the distance of a corner.
_TUBE_LIMIT, _CUBE_LIMIT = 2 / 3, 1 / 2


class CageWire:
    """Rods and balls that follow the control points of a cage.

    Parameters
    ----------
    cage : ControlCage
    model_radius : float
    """

    def __init__(self, cage: ControlCage, model_radius: float) -> None:
        self._edges, self._vertices = cage.edges, np.unique(cage.edges)
        lengths = np.linalg.norm(np.diff(cage.positions[cage.edges], axis=1)[:, 0], axis=1)
        self.radius = min(ROD * model_radius, ROD_PER_EDGE * float(np.median(lengths)))
        self._positions = cage.positions

    @cached_property
    def cage(self) -> ControlCage:
        """The cage whose limit surface is the rods and balls."""
        count = len(self._edges)
        first, corner = 8 * np.arange(count)[:, None, None], np.arange(4)
        beside = (corner + 1) % 4
        tubes = first + np.stack([corner, beside, beside + 4, corner + 4], axis=1)
        cube = named_cages.cube().face_vertices.reshape(1, 6, 4)
        balls = 8 * (count + np.arange(len(self._vertices))[:, None, None]) + cube
        faces = np.concatenate([tubes.reshape(-1, 4), balls.reshape(-1, 4)])
        return ControlCage(self.positions(self._positions), faces, source=CageSource("cage wire"))

    def positions(self, control_points: NDArray[np.float64]) -> NDArray[np.float64]:
        """Control points of the rods and balls, from the control points ``(n, 3)`` of the cage."""
        start, end = control_points[self._edges[:, 0]], control_points[self._edges[:, 1]]
        along = _unit(end - start)
        # The axis that is furthest from the edge.
        axis = np.eye(3)[np.abs(along).argmin(axis=1)]
        side = _unit(np.cross(along, axis))
        across = np.stack([side, np.cross(along, side)], axis=1)
        ring = np.array([[1, 0], [0, 1], [-1, 0], [0, -1]]) @ across * (self.radius / _TUBE_LIMIT)
        tubes = np.stack([start, end], axis=1)[:, :, None] + ring[:, None]
        corners = named_cages.cube().positions * (BALL * self.radius / _CUBE_LIMIT / np.sqrt(3))
        balls = control_points[self._vertices, None] + corners
        return np.concatenate([tubes.reshape(-1, 3), balls.reshape(-1, 3)])


def _unit(vectors: NDArray[np.float64]) -> NDArray[np.float64]:
    lengths = np.linalg.norm(vectors, axis=1, keepdims=True)
    return vectors / np.where(lengths > 0, lengths, 1)
