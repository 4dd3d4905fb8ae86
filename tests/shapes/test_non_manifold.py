"""Cages that are no manifold, as shapes."""

import drjit as dr
import mitsuba as mi
import mitsuba_subdivision as msub
import numpy as np
import pytest
from mitsuba_subdivision.device_arrays import upload
from peers.fidelity_cages import book, cube, fan, joined, pole
from shapes.cages import load
from shapes.scenes import buffer
from shapes.updates import differentiated
from shapes.variants import every_ad_variant, every_variant

pytestmark = pytest.mark.filterwarnings("ignore::mitsuba_subdivision.cage.CageWarning")

RATE = 3
CASES = {
    "book": book(3),
    "cones": joined(fan(4), fan(5), {0: 0}),
    "cubes": joined(cube(), cube(), {0: 7, 1: 6}),
    "pole": pole(5),
}
# Of sums of some hundred positions of about one in single precision.
SINGLE = 2e-4


def cage_of(name):
    return msub.ControlCage(CASES[name].positions, CASES[name].faces)


@pytest.fixture(params=CASES)
def cage(request):
    return cage_of(request.param)


@every_variant
def test_the_shape_has_the_surface(cage):
    shape, expected = load(cage, tessellation_rate=RATE), msub.LimitSurface(cage).tessellate(RATE)
    corners = buffer(shape, "vertex_positions")[buffer(shape, "faces")]
    np.testing.assert_allclose(corners, expected.positions[expected.triangles], atol=1e-6)


@every_variant
def test_strict_is_an_error():
    with pytest.raises(Exception, match="expected a manifold surface"):
        load(cage_of("book"), strict=True)


@every_ad_variant
def test_gradients_of_points_are_differences(cage):
    """Positions are linear in the control points, so that a difference over any step is the derivative."""
    weights = np.random.default_rng(1).uniform(-1, 1, (msub.LimitSurface(cage).tessellate(RATE).positions.size,))

    def total(positions):
        found = msub.LimitSurface(cage.with_positions(positions)).tessellate(RATE).positions
        return float(found.ravel() @ weights)

    parameters = mi.traverse(load(cage, tessellation_rate=RATE))
    points = differentiated(parameters, "control_points")
    assert dr.width(parameters["vertex_positions"]) == weights.size
    dr.backward(dr.sum(parameters["vertex_positions"] * upload(mi.Float, weights)))
    gradient = np.array(dr.grad(points)).reshape(-1, 3)
    direction = np.random.default_rng(2).uniform(-1, 1, cage.positions.shape)
    expected = total(cage.positions + direction) - total(cage.positions)
    assert (gradient * direction).sum() == pytest.approx(expected, abs=SINGLE)
