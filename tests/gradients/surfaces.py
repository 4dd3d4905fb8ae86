"""Surfaces whose gradients are tested: three schemes, sharp, semi-sharp and open ones, one that is refined first."""

import numpy as np
import pytest
from mitsuba_subdivision import LimitSurface
from mitsuba_subdivision.cage import named_cages
from patches.closed_cages import bumpy, cage_of, cube_with_hexagon
from reference.refined_cages import refine_first
from shapes.cages import ISLANDS, RING, cube


def ring_of(sharpness):
    """A cube with a ring of creases around a face, and a seam of texture coordinates along each edge."""
    return LimitSurface(bumpy(cube(creases=[(a, b, sharpness) for a, b, _ in RING], texcoords=ISLANDS)))


def refined_first():
    with pytest.MonkeyPatch.context() as patched:
        refine_first(patched)
        surface = LimitSurface(bumpy(cube_with_hexagon()))
        assert surface.patches.refined is not None
    return surface


CLOSED = {
    "catmull_clark": lambda: LimitSurface(bumpy(cage_of("catmull_clark", "prism"))),
    "loop": lambda: LimitSurface(bumpy(cage_of("loop", "bipyramid")), "loop"),
    "doo_sabin": lambda: LimitSurface(bumpy(cage_of("doo_sabin", "prism")), "doo_sabin"),
    "creased": lambda: ring_of(10.0),
    "semi-sharp": lambda: ring_of(2.5),
    "refined first": refined_first,
}
ALL = {**CLOSED, "open": lambda: LimitSurface(bumpy(named_cages.extraordinary(5, closed=False), size=0.02))}


def motions(surface):
    """Scaling, bending, one point, and all points at random: directions in which control points move."""
    positions, rng = surface.cage.positions, np.random.default_rng(3)
    one = np.zeros_like(positions)
    one[positions[:, 2].argmax()] = rng.normal(size=3)
    bend = np.stack([positions[:, 2] ** 2, np.zeros(len(positions)), -positions[:, 0] * positions[:, 2]], axis=1)
    return {"scaling": positions, "bending": bend, "one point": one, "all": rng.normal(size=positions.shape)}
