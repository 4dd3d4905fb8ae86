"""Cages that are no manifold, as shapes."""

import drjit as dr
import mitsuba as mi
import mitsuba_subdivision as msub
import numpy as np
import pytest
from mitsuba_subdivision.device_arrays import upload
from peers.fidelity_cages import book, cube, fan, joined, pole

pytestmark = pytest.mark.filterwarnings("ignore::mitsuba_subdivision.cage.CageWarning")

RATE = 3
CASES = {
    "book": book(3),
    "cones": joined(fan(4), fan(5), {0: 0}),
    "cubes": joined(cube(), cube(), {0: 7, 1: 6}),
    "pole": pole(5),
}
EVERY_CASE = pytest.mark.parametrize("name", CASES)
# Of sums of some hundred positions of about one in single precision.
SINGLE = 2e-4


def cage_of(name):
    return msub.ControlCage(CASES[name].positions, CASES[name].faces)


def shape_of(cage, **parameters):
    return mi.load_dict({"type": "subdivision", "tessellation_rate": RATE, **cage.as_properties(mi), **parameters})


@EVERY_CASE
@pytest.mark.usefixtures("variants_all_rgb")
def test_the_shape_has_the_surface(name):
    cage = cage_of(name)
    shape, expected = shape_of(cage), msub.LimitSurface(cage).tessellate(RATE)
    triangles = np.array(mi.traverse(shape)["faces"]).reshape(-1, 3)
    positions = np.array(mi.traverse(shape)["vertex_positions"]).reshape(-1, 3)
    np.testing.assert_allclose(positions[triangles], expected.positions[expected.triangles], atol=1e-6)


@pytest.mark.usefixtures("variants_all_rgb")
def test_strict_is_an_error():
    with pytest.raises(Exception, match="expected a manifold surface"):
        shape_of(cage_of("book"), strict=True)
    with pytest.raises(Exception, match='"strict" is 1; expected true or false'):
        shape_of(cage_of("book"), strict=1)


@EVERY_CASE
@pytest.mark.usefixtures("variants_all_ad_rgb")
def test_gradients_of_points_are_differences(name):
    """Positions are linear in the control points, so that a difference over any step is the derivative."""
    cage = cage_of(name)
    weights = np.random.default_rng(1).uniform(-1, 1, (msub.LimitSurface(cage).tessellate(RATE).positions.size,))

    def total(positions):
        found = msub.LimitSurface(cage.with_positions(positions)).tessellate(RATE).positions
        return float(found.ravel() @ weights)

    shape = shape_of(cage)
    params = mi.traverse(shape)
    points = mi.Float(params["control_points"])
    dr.enable_grad(points)
    params["control_points"] = points
    params.update()
    assert dr.width(params["vertex_positions"]) == weights.size
    dr.backward(dr.sum(params["vertex_positions"] * upload(mi.Float, weights)))
    gradient = np.array(dr.grad(points)).reshape(-1, 3)
    direction = np.random.default_rng(2).uniform(-1, 1, cage.positions.shape)
    expected = total(cage.positions + direction) - total(cage.positions)
    assert (gradient * direction).sum() == pytest.approx(expected, abs=SINGLE)
