"""A seamless backdrop: a bowl with a flat floor, itself the limit surface of a cage."""

from __future__ import annotations

import numpy as np

from ..cage import ControlCage
from ..cage.source import CageSource

# Corners of every ring of the cage. The limit surface of so many is round.
RING = 16
# Where the wall begins to rise and how high it is, in radii of the floor.
RISE, HEIGHT = 0.6, 1.2


def backdrop(radius: float) -> ControlCage:
    """Cage of a bowl about the z axis, whose floor is z = 0 and whose inside is its front.

    Parameters
    ----------
    radius : float
        Of the flat part of the floor.
    """
    # The surface is flat within the second ring, as all control points are that it depends on there.
    rings = radius * np.array(
        [[0.5, 0], [1, 0], [1 + RISE / 2, 0], [1 + RISE, 0.0], [1 + RISE, RISE], [1 + RISE, HEIGHT]]
    )
    angle = 2 * np.pi * np.arange(RING) / RING
    circle = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    positions = np.concatenate(
        [np.column_stack([distance * circle, np.full(RING, height)]) for distance, height in rings]
    )
    here = np.arange(RING * (len(rings) - 1))
    beside = here - here % RING + (here + 1) % RING
    walls = np.stack([here, here + RING, beside + RING, beside], axis=1)
    return ControlCage(positions, [np.arange(RING).tolist(), *walls.tolist()], source=CageSource("backdrop"))
