"""One turn of a model around the axis that points up, in a number of frames."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from .camera import outermost
from .placed_points import points_at
from .view import View, studio_axes, turned


class Turns:
    """Where each frame of a turntable has a model.

    Parameters
    ----------
    points : (n, 3) float64
        Of the model, in the world; it turns around the middle of their bounds.
    up : "y" or "z"
    view : str or (azimuth, elevation)
        From where the camera looks.
    size : (width, height)
    count : int
        Number of frames. Frame 1 is the model as it is; the next ones are turned counter-clockwise from above.

    Attributes
    ----------
    numbers : range
    points : (m, 3) float64
        Those few of all frames that decide what the camera frames.
    """

    def __init__(self, points: NDArray[np.float64], up: str, view: View, size: tuple[int, int], count: int) -> None:
        self.numbers = range(1, count + 1)
        self._count, self._axes = count, studio_axes(up)
        in_studio = points @ self._axes
        self._pivot = self._axes @ ((in_studio.min(axis=0) + in_studio.max(axis=0)) / 2)
        everywhere = [points_at(points, self.matrix(number)) for number in self.numbers]
        self.points = np.concatenate([outermost(each, up, view, size) for each in everywhere])

    def matrix(self, number: float) -> NDArray[np.float64]:
        """Where frame ``number`` has the model: ``(4, 4)``."""
        linear = self._axes @ turned(360 * (number - 1) / self._count) @ self._axes.T
        matrix = np.eye(4)
        matrix[:3, :3], matrix[:3, 3] = linear, self._pivot - linear @ self._pivot
        return matrix
