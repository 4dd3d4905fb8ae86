"""Views of a model, and a camera that frames all points as closely as possible."""

from __future__ import annotations

import numbers
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..cage.errors import in_digits

# Field of view of the picture's longer side, in degrees: that of long lenses for products and portraits.
FIELD_OF_VIEW = 28.0
# Part of the picture that stays empty on each side.
MARGIN = 0.08
# Least distance of the nearest point, in depths of the model: the furthest point then looks a fifth as large.
NEAREST = 0.25

# Azimuth and elevation in degrees. Azimuth 0 is the model's front, 90 its own left, which is +x.
VIEWS = {
    "front": (0.0, 0.0),
    "side": (90.0, 0.0),
    "back": (180.0, 0.0),
    "top": (0.0, 90.0),
    "three-quarter": (35.0, 18.0),
}
DEFAULT_VIEW = "three-quarter"
UP_AXES = ("y", "z")
View = str | Sequence[float]


@dataclass(frozen=True)
class Camera:
    """A perspective camera in the studio's axes."""

    axes: NDArray[np.float64]  # (3, 3) float64: columns right, up and forward
    origin: NDArray[np.float64]  # (3,) float64
    distance: float  # From the camera to the middle of the points, along the view


def framed(
    points: NDArray[np.float64],  # (n, 3) float64: in the studio's axes
    # Where the camera is, seen from the points, in degrees
    azimuth: float,
    elevation: float,
    size: tuple[int, int],  # (width, height)
) -> Camera:
    """Place a camera so that points just fit into its image, centred, but for `MARGIN`.

    Points that are deeper than they are wide are smaller than that, as the camera keeps away from them.
    """
    axes = camera_axes(azimuth, elevation)
    slopes = _slopes(size)
    in_camera = points @ axes
    z = in_camera[:, 2]
    nearest, middle = [], []
    for along, slope in zip(in_camera.T[:2], slopes, strict=True):
        above, below = (along - slope * z).max(), (-along - slope * z).max()
        nearest.append(-(above + below) / (2 * slope))
        middle.append((above - below) / 2)
    # A nearer camera would distort models that are long along the view, and could lie inside a thin tip.
    depth = min(*nearest, z.min() - NEAREST * (z.max() - z.min()))
    return Camera(axes, axes @ np.array([*middle, depth]), float((z.min() + z.max()) / 2 - depth))


def outermost(
    points: NDArray[np.float64],  # (n, 3) float64
    up: str,  # The axis that points up in the world
    view: View,  # str or (azimuth, elevation): from where the camera looks
    size: tuple[int, int],  # (width, height)
) -> NDArray[np.float64]:
    """The few points that determine the camera of `framed`, and the bounds of all points."""
    x, y = _slopes(size)
    # Away from each side of what the camera sees, then along its view and along the axes.
    towards = np.array([[1, 0, -x], [-1, 0, -x], [0, 1, -y], [0, -1, -y], [0, 0, 1], [0, 0, -1]])
    directions = np.concatenate([towards @ camera_axes(*angles_of(view)).T, np.eye(3), -np.eye(3)])
    return points[np.unique((points @ studio_axes(up) @ directions.T).argmax(axis=0))]


def _slopes(size: tuple[int, int]) -> NDArray[np.float64]:
    """Half extents of what points may fill per unit of depth, horizontally and vertically."""
    return np.tan(np.radians(FIELD_OF_VIEW / 2)) * np.array(size) / max(size) * (1 - 2 * MARGIN)


def camera_axes(azimuth: float, elevation: float) -> NDArray[np.float64]:
    """Columns right, up and forward ``(3, 3)``, in the studio's axes."""
    a, e = np.radians([azimuth, elevation])
    right = np.array([np.cos(a), np.sin(a), 0.0])
    forward = np.array([-np.sin(a) * np.cos(e), np.cos(a) * np.cos(e), -np.sin(e)])
    return np.stack([right, np.cross(right, forward), forward], axis=1)


def angles_of(
    view: View,  # str or (azimuth, elevation): A name in `VIEWS`, or two angles
) -> tuple[float, float]:
    """Azimuth and elevation of a view, in degrees.

    Raises ValueError if there is no such view, or the elevation is not between -90 and 90.
    """
    if isinstance(view, str):
        if view not in VIEWS:
            raise ValueError(f'view "{view}"; expected one of {", ".join(VIEWS)}, or azimuth and elevation')
        return VIEWS[view]
    if len(view) != 2 or not all(isinstance(angle, numbers.Real) and np.isfinite(angle) for angle in view):
        raise ValueError(f"view {view!r}; expected one of {', '.join(VIEWS)}, or azimuth and elevation in degrees")
    azimuth, elevation = map(float, view)
    if not -90 <= elevation <= 90:
        raise ValueError(f"elevation {in_digits(elevation)}; expected -90 to 90 degrees")
    return azimuth, elevation


def studio_axes(up: str) -> NDArray[np.float64]:
    """Directions of the studio in the world: columns right, back and up ``(3, 3)``, of a viewer before the front.

    A model's front is that of modelling programs: -y where z is up, +z where y is up.
    Raises ValueError if the axis is neither y nor z.
    """
    if up not in UP_AXES:
        raise ValueError(f'up axis "{up}"; expected {" or ".join(UP_AXES)}')
    if up == "z":
        return np.eye(3)
    return np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])


def turned(azimuth: float) -> NDArray[np.float64]:
    """Rotation ``(3, 3)`` about the studio's up axis, by degrees, counter-clockwise seen from above."""
    c, s = np.cos(np.radians(azimuth)), np.sin(np.radians(azimuth))
    return np.array([[c, -s, 0], [s, c, 0], [0, 0, 1.0]])
