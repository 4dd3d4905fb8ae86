"""A camera from which all points are in the picture, as large as fits."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

# Of the picture's longer side, in degrees: as long lenses have that products and faces are photographed with.
FIELD_OF_VIEW = 28.0
# Part of the picture that stays empty on each side.
MARGIN = 0.08


@dataclass(frozen=True)
class Camera:
    """A perspective camera in the studio's axes.

    Attributes
    ----------
    axes : (3, 3) float64
        Columns right, up and forward.
    origin : (3,) float64
    distance : float
        From the camera to the middle of the points, along the view.
    """

    axes: NDArray[np.float64]
    origin: NDArray[np.float64]
    distance: float


def framed(
    points: NDArray[np.float64], azimuth: float, elevation: float, size: tuple[int, int], margin: float = MARGIN
) -> Camera:
    """Place a camera so that points just fit into its picture, and lie in the middle of it.

    Parameters
    ----------
    points : (n, 3) float64
        In the studio's axes.
    azimuth, elevation : float
        Where the camera is, seen from the points, in degrees.
    size : (width, height)
    margin : float
        Part of the picture's width and height that stays empty on each side.
    """
    axes = camera_axes(azimuth, elevation)
    x, y, z = (points @ axes).T
    # Along the view, a point may lie no further out than its depth times these.
    slopes = np.tan(np.radians(FIELD_OF_VIEW / 2)) * np.array(size) / max(size) * (1 - 2 * margin)
    nearest, middle = [], []
    for along, slope in ((x, slopes[0]), (y, slopes[1])):
        above, below = (along - slope * z).max(), (-along - slope * z).max()
        nearest.append(-(above + below) / (2 * slope))
        middle.append((above - below) / 2)
    depth = min(nearest)
    centre = (z.min() + z.max()) / 2
    return Camera(axes, axes @ np.array([*middle, depth]), float(centre - depth))


def camera_axes(azimuth: float, elevation: float) -> NDArray[np.float64]:
    """Columns right, up and forward ``(3, 3)``, in the studio's axes."""
    a, e = np.radians([azimuth, elevation])
    right = np.array([np.cos(a), np.sin(a), 0.0])
    forward = np.array([-np.sin(a) * np.cos(e), np.cos(a) * np.cos(e), -np.sin(e)])
    return np.stack([right, np.cross(right, forward), forward], axis=1)
