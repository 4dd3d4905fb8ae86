"""The term that keeps fitted cages from folding over."""

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from mitsuba_subdivision import ControlCage
from mitsuba_subdivision.cage.named_cages import cube
from mitsuba_subdivision.device_arrays import upload
from mitsuba_subdivision.fit.smoothness import LEAST_COSINE, folds

# Of sums of float32 numbers.
ROUNDING = 1e-6
# Central differences of values near one, in float32.
STEP, DIFFERENCE = 1e-3, 2e-3
pytestmark = [
    # Some vertices have no page.
    pytest.mark.filterwarnings("ignore::mitsuba_subdivision.cage.CageWarning"),
    pytest.mark.usefixtures("variant_llvm_ad_rgb"),
]


def book(angle, pages=((0, 1, 2, 3), (1, 0, 4, 5))):
    """Two faces with an edge in common, along x: one flat, one that has turned from its plane by an angle."""
    end = (-np.cos(angle), np.sin(angle))
    points = [(0, 0, 0), (1, 0, 0), (1, 1, 0), (0, 1, 0), (0, *end), (1, *end)]
    return ControlCage(points, [list(page) for page in pages], boundary="edge_and_corner")


def value(cage, points=None):
    given = upload(mi.Float, cage.positions if points is None else points)
    return float(np.array(folds(cage)(given)).ravel()[0])


@pytest.mark.core
@pytest.mark.parametrize(
    "pages",
    [((0, 1, 2, 3), (1, 0, 4, 5)), ((0, 1, 2), (1, 0, 4)), ((0, 1, 2, 3), (1, 0, 4)), ((3, 0, 1, 2), (5, 1, 0, 4))],
)
def test_it_is_of_the_angle_between_faces(pages):
    for angle in np.radians([0, 60, 100, 120, 150, 180]):
        expected = max(0, LEAST_COSINE - np.cos(angle)) ** 2
        assert value(book(angle, pages)) == pytest.approx(expected, abs=ROUNDING)


def test_size_and_cages_without_folds_and_edges_do_not_count():
    for size in (1e-4, 1e4):
        assert value(book(2.5), size * book(2.5).positions) == pytest.approx(value(book(2.5)), rel=ROUNDING)
    assert value(cube().refined()) == 0
    assert value(ControlCage([(0, 0, 0), (1, 0, 0), (1, 1, 0)], [[0, 1, 2]])) == 0


def test_gradients_are_those_of_differences(np_rng):
    cage = book(2.4)
    points = cage.positions + 0.1 * np_rng.standard_normal(cage.positions.shape)
    flat = upload(mi.Float, points)
    dr.enable_grad(flat)
    dr.backward(folds(cage)(flat))
    found = np.array(dr.grad(flat))
    flat = points.ravel()
    moved = STEP * np.eye(points.size)
    expected = [(value(cage, flat + each) - value(cage, flat - each)) / (2 * STEP) for each in moved]
    assert np.abs(found).max() > 0.1
    np.testing.assert_allclose(found, expected, atol=DIFFERENCE)


def test_a_folded_cage_opens():
    """Where nothing else holds it."""
    cage = book(2.9)
    points = upload(mi.Float, cage.positions)
    optimizer = mi.ad.Adam(lr=0.05, params={"points": points})
    energy = folds(cage)
    for _ in range(40):
        dr.backward(energy(optimizer["points"]))
        optimizer.step()
    assert value(cage, np.array(optimizer["points"])) == 0
