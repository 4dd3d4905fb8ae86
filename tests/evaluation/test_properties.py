import numpy as np
import pytest
from kernels.surfaces import SURFACES, random_locations, surface_named
from mitsuba_subdivision import LimitSurface
from reference.bars import NORMAL, POINT
from reference.exact_samples import angle

SAMPLES = 60
# Derivatives relative to their own size, which near extraordinary points may be anything.
DERIVATIVE = 1e-11


def assert_equal_derivatives(derivatives, expected, rounding=1):
    length = np.linalg.norm(expected, axis=1, keepdims=True)
    assert (np.abs(derivatives - expected) / length).max() <= DERIVATIVE * rounding


@pytest.mark.parametrize("name", SURFACES)
def test_surfaces_commute_with_affine_maps(name, np_rng):
    surface, scale = surface_named(name), 10 ** np_rng.uniform(-3, 3)
    matrix, shift = scale * np_rng.standard_normal((3, 3)), np_rng.standard_normal(3)
    samples = random_locations(surface, np_rng, SAMPLES, deepest=10)
    before = surface.evaluate(*samples)
    moved = surface.cage.with_positions(surface.cage.positions @ matrix.T + shift)
    after = LimitSurface(moved, surface.scheme).evaluate(*samples)
    assert np.abs(before.p @ matrix.T + shift - after.p).max() <= POINT * np.abs(moved.positions).max()
    # The moved cage is rounded to its distance from the origin, which is the larger the smaller it is.
    rounding = (1 + 1 / scale) * np.linalg.cond(matrix)
    assert_equal_derivatives(after.dp_du, before.dp_du @ matrix.T, rounding)
    assert_equal_derivatives(after.dp_dv, before.dp_dv @ matrix.T, rounding)
    normal = np.sign(np.linalg.det(matrix)) * before.n @ np.linalg.inv(matrix)
    assert angle(normal, after.n).max() <= NORMAL * rounding
