"""A seamless backdrop: a floor that bends up into a wall, itself the limit surface of a cage."""

from __future__ import annotations

import numpy as np

from ..cage import ControlCage
from ..cage.source import CageSource


def backdrop(front: float, bend: float, wall: float, height: float, half_width: float) -> ControlCage:
    """Cage of a sweep across the x axis: the floor is z = 0, and the wall rises towards +y.

    Parameters
    ----------
    front : float
        How far the floor reaches towards -y; more than ``wall - 2 * bend``.
    bend, wall : float
        Where, towards +y, the floor begins to bend, and where the wall stands upright, at the height ``wall - bend``.
    height : float
        Of the wall; more than ``2 * (wall - bend)``.
    half_width : float
    """
    # A cubic spline is straight where four control points in a row are.
    step = wall - bend
    floor = [[-front, 0], [bend - step, 0], [bend, 0]]
    profile = np.array([*floor, [wall, 0], [wall, step], [wall, 2 * step], [wall, height]])
    positions = np.concatenate([np.insert(profile, 0, x, axis=1) for x in (-half_width, half_width)])
    left = np.arange(len(profile) - 1)
    right = left + len(profile)
    return ControlCage(positions, np.stack([left, right, right + 1, left + 1], axis=1), source=CageSource("backdrop"))
