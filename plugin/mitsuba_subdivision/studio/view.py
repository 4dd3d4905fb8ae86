"""View direction of the camera, and the studio's axes in the world."""

from __future__ import annotations

import numbers
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from ..cage.errors import in_digits

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


def angles_of(view: View) -> tuple[float, float]:
    """Azimuth and elevation of a view, in degrees.

    Parameters
    ----------
    view : str or (azimuth, elevation)
        A name in `VIEWS`, or two angles.

    Raises
    ------
    ValueError
        If there is no such view, or the elevation is not between -90 and 90.
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

    Raises
    ------
    ValueError
        If the axis is neither y nor z.
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
