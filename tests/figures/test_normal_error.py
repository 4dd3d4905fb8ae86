"""The curves of normal error against level."""

from functools import cache

import numpy as np
import pytest
from mitsuba_subdivision.cage.named_cages import extraordinary
from mitsuba_subdivision.figures.normal_error import LEVELS, exact_normals, normal_errors, offset_cage

# First level with an error above 5 degrees, MATH of float32 and float64: theta ~ kappa eps |c1| / lambda_2^n. Another
# cage and direction move it by a level or two.
FIRST_WRONG = {
    (3, np.float32): {1: 16, 100: 11},
    (3, np.float64): {1: 38, 100: 33},
    (5, np.float32): {1: 23, 100: 15},
    (5, np.float64): {1: 55, 100: 47},
}
MOVED = 2


@cache
def cage_and_normals(valence, offset):
    cage = offset_cage(extraordinary(valence), offset)
    return cage, exact_normals(cage)


@pytest.mark.parametrize(("valence", "dtype"), FIRST_WRONG)
def test_stam_fails_at_the_predicted_level(valence, dtype):
    for offset, level in FIRST_WRONG[valence, dtype].items():
        error = normal_errors(*cage_and_normals(valence, offset), "stam", dtype)
        assert abs(int(np.argmax(error > 5)) - level) <= MOVED, offset


@pytest.mark.parametrize("valence", [3, 5])
@pytest.mark.parametrize("offset", [0, 1, 100])
def test_the_stabilised_form_is_right_at_every_level(valence, offset):
    cage, exact = cage_and_normals(valence, offset)
    assert normal_errors(cage, exact, "stabilized", np.float32).max() < 1e-4
    assert normal_errors(cage, exact, "stabilized", np.float64).max() < 1e-9


def test_the_limit_normal_is_reached_as_the_eigenvalues_say():
    error = normal_errors(*cage_and_normals(3, 0), "limit", np.float64)
    slope = np.diff(np.log(error[10:30])).mean()
    # lambda_4 / lambda_2 at valence 3.
    assert slope == pytest.approx(np.log(1 / 6 / 0.4100970508), abs=0.02)
    assert len(error) == len(LEVELS)
