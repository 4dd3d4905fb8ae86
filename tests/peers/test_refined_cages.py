"""OpenSubdiv makes the same surface of a refined cage, tags and seams included, as of the cage before."""

import numpy as np
import pytest
from mitsuba_subdivision import LimitSurface

from .fidelity_cages import ISLANDS, SURFACES
from .peers import evaluate
from .test_fidelity import AGAINST_OSD, POINT, box, rounding

pytestmark = AGAINST_OSD

SAMPLES = 100
# Far from corners, where OpenSubdiv's patches are exact.
NEAREST, FARTHEST = 0.1, 0.45
# The rules leave no list of faces that says which half-edges are one edge.
NO_CAGE = "no manifold, Loop, valence 2 inside"
# There are six modes for each kind of islands: of five in a row, each time another one is tried.
NAMES = [name for name in (*SURFACES, *list(ISLANDS)[::5]) if name != NO_CAGE]


@pytest.mark.parametrize("name", NAMES)
def test_opensubdiv_makes_the_same_surface_of_the_refined_cage(name, np_rng):
    before = (SURFACES | ISLANDS)[name]
    refinement = before.refinement()
    element = np_rng.choice(np.flatnonzero(~refinement.cage.is_hole), SAMPLES)
    uv = np_rng.uniform(NEAREST, FARTHEST, (SAMPLES, 2))
    old, corner = refinement.element[element], refinement.corner[element]
    is_middle = corner < 0
    scale = np.where(LimitSurface(before).patches.is_whole[old], 0.5, 1) * np.where(is_middle, -1, 1)
    old_uv = scale[:, None] * uv + np.where(is_middle, 0.5, 0)[:, None]
    here = evaluate(before, old, old_uv, np.maximum(corner, 0))
    there = evaluate(refinement.cage, element, uv, is_middle.astype(int))
    assert np.abs(here.p - there.p).max() <= POINT * rounding(before) * box(before)
    assert np.abs(here.fvar - there.fvar).max(initial=0) <= POINT * rounding(before)
