"""Points of placed shapes, and corners of their boxes."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray


def points_at(points: NDArray, matrix: NDArray[np.float64]) -> NDArray[np.float64]:
    """Points ``(n, 3)`` transformed by a matrix ``(4, 4)``."""
    return points @ matrix[:3, :3].T + matrix[:3, 3]


def box_corners(box: NDArray[np.float64]) -> NDArray[np.float64]:
    """The eight corners ``(8, 3)`` of a box, given by its least and greatest coordinates ``(2, 3)``."""
    return np.array(np.meshgrid(*box.T)).reshape(3, -1).T
