"""OpenSubdiv makes the same surface of a refined cage, tags and seams included, as of the cage before."""

from dataclasses import replace

import numpy as np
import pytest
from patches.closed_cages import polygons

from .fidelity_cages import ISLANDS, SURFACES
from .peers import evaluate
from .test_fidelity import AGAINST_OSD, POINT, box, rounding, surface_of

pytestmark = AGAINST_OSD

SAMPLES = 100
# Far from corners, where OpenSubdiv's patches are exact.
NEAREST, FARTHEST = 0.1, 0.45
# The rules leave no list of faces that says which half-edges are one edge.
NO_CAGE = "no manifold, Loop, valence 2 inside"
# There are six modes for each kind of islands: of five in a row, each time another one is tried.
NAMES = [name for name in (*SURFACES, *list(ISLANDS)[::5]) if name != NO_CAGE]


def peer_of(cage, before):
    """A refined cage for OpenSubdiv, with the options of the one before."""
    t, values = cage.topology, cage.texcoords
    return replace(
        before,
        positions=cage.positions,
        faces=[list(face) for face in polygons(t)],
        creases=[(int(a), int(b), s) for a, b, s in cage.tags.creases(t).tolist()],
        corners=[(int(vertex), s) for vertex, s in cage.tags.corners().tolist()],
        holes=cage.holes.tolist(),
        fvar=None if values is None else (values.values, values.indices),
        fvar_linear=before.fvar_linear if values is None else cage.face_varying,
    )


@pytest.mark.parametrize("name", NAMES)
def test_opensubdiv_makes_the_same_surface_of_the_refined_cage(name, np_rng):
    before = (SURFACES | ISLANDS)[name]
    surface = surface_of(before)
    refinement = surface.cage.refinement(surface.scheme.name)
    element = np_rng.choice(np.flatnonzero(~refinement.cage.is_hole), SAMPLES)
    uv = np_rng.uniform(NEAREST, FARTHEST, (SAMPLES, 2))
    old, corner = refinement.element[element], refinement.corner[element]
    is_middle = corner < 0
    scale = np.where(surface.patches.is_whole[old], 0.5, 1) * np.where(is_middle, -1, 1)
    old_uv = scale[:, None] * uv + np.where(is_middle, 0.5, 0)[:, None]
    here = evaluate(before, old, old_uv, np.maximum(corner, 0))
    there = evaluate(peer_of(refinement.cage, before), element, uv, is_middle.astype(int))
    assert np.abs(here.p - there.p).max() <= POINT * rounding(before) * box(before)
    assert np.abs(here.fvar - there.fvar).max(initial=0) <= POINT * rounding(before)
