import os

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from mitsuba_subdivision import ControlCage, LimitSurface
from mitsuba_subdivision.cage.named_cages import cube
from mitsuba_subdivision.device_arrays import upload
from mitsuba_subdivision.fit import LargeSteps, regularizer
from mitsuba_subdivision.fit.smoothness import LEAST_COSINE, folds, quadratic_form
from patches.closed_cages import torus

# Rounding of sums of float32 numbers.
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
@pytest.mark.parametrize("pages", [((0, 1, 2, 3), (1, 0, 4)), ((0, 1, 2), (1, 0, 4)), ((3, 0, 1, 2), (5, 1, 0, 4))])
def test_folds_are_of_the_angle_between_faces(pages):
    for angle in np.radians([0, 60, 100, 120, 150, 180]):
        expected = max(0, LEAST_COSINE - np.cos(angle)) ** 2
        assert value(book(angle, pages)) == pytest.approx(expected, abs=ROUNDING)


def test_folds_have_no_size_and_cages_without_them_or_edges_have_none():
    for size in (1e-4, 1e4):
        assert value(book(2.5), size * book(2.5).positions) == pytest.approx(value(book(2.5)), rel=ROUNDING)
    assert value(cube().refined()) == 0
    assert value(ControlCage([(0, 0, 0), (1, 0, 0), (1, 1, 0)], [[0, 1, 2]])) == 0


def test_gradients_of_folds_are_differences(np_rng):
    cage = book(2.4)
    points = cage.positions + 0.1 * np_rng.standard_normal(cage.positions.shape)
    flat = upload(mi.Float, points)
    dr.enable_grad(flat)
    dr.backward(folds(cage)(flat))
    gradient = np.array(dr.grad(flat))
    flat, moved = points.ravel(), STEP * np.eye(points.size)
    expected = [(value(cage, flat + move) - value(cage, flat - move)) / (2 * STEP) for move in moved]
    assert np.abs(gradient).max() > 0.1
    np.testing.assert_allclose(gradient, expected, atol=DIFFERENCE)


# Sums of some hundred terms in single precision.
SINGLE = 2e-5


@pytest.fixture
def surface():
    mi.set_variant("llvm_ad_rgb")
    return LimitSurface(torus(6, 5))


def test_large_steps_equal_mitsubas(surface, np_rng):
    """For a cage of triangles, whose edges are those of Mitsuba's mesh; its coordinates have another order."""
    pytest.importorskip("cholespy")
    if os.environ.get("GUARDED_ARRAYS"):
        pytest.skip("Mitsuba's own class converts NumPy's arrays without a copy")
    cage = ControlCage(surface.cage.positions, surface.cage.triangles)
    points, gradient = upload(mi.Float, cage.positions), np_rng.normal(size=cage.positions.shape)
    theirs = mi.ad.LargeSteps(points, upload(mi.UInt32, cage.triangles), 3.0)
    their_step = upload(mi.Float, gradient[np.array(theirs.index)])
    expected = theirs.from_differential(theirs.to_differential(points) + their_step)
    steps = LargeSteps(cage.laplacian(), 3.0)
    moved = steps.from_differential(steps.to_differential(points) + upload(mi.Float, gradient))
    np.testing.assert_allclose(np.array(moved), np.array(expected), atol=SINGLE)


@pytest.mark.core
def test_coordinates_and_points_are_inverse_and_derivatives_solve_the_same_system(surface, np_rng):
    points, steps = surface.cage.positions, LargeSteps(surface.cage.laplacian(), 3.0)
    again = steps.from_differential(steps.to_differential(points))
    np.testing.assert_allclose(np.array(again).reshape(-1, 3), points, atol=SINGLE)
    steps = LargeSteps(surface.stiffness(), 2.0)
    dense = np.eye(surface.cage.vertex_count) + 2.0 * surface.stiffness().toarray()
    given = np_rng.normal(size=surface.cage.positions.shape)
    expected = np.linalg.solve(dense, given)
    u, v = upload(mi.Float, given), upload(mi.Float, given)
    dr.enable_grad(u, v)
    dr.backward(dr.dot(steps.from_differential(u), upload(mi.Float, given)))
    dr.set_grad(v, upload(mi.Float, given))
    for solution in (u.grad, dr.forward_to(steps.from_differential(v))):
        np.testing.assert_allclose(np.array(solution).reshape(-1, 3), expected, atol=SINGLE)


@pytest.mark.core
@pytest.mark.parametrize("name", ["laplacian", "bending", "anchor"])
def test_regularizers_are_quadratic_forms_of_these_matrices(surface, np_rng, name):
    cage = surface.cage
    points = cage.positions + np_rng.normal(scale=0.1, size=cage.positions.shape)
    away = points - cage.positions if name == "anchor" else points
    laplacian, count = cage.laplacian(), cage.vertex_count
    mean_square = laplacian.T @ laplacian / count
    matrix = {"laplacian": mean_square, "bending": surface.bending(), "anchor": np.eye(count) / count}[name]
    product, flat = matrix @ away, upload(mi.Float, points)
    dr.enable_grad(flat)
    value = regularizer(name, surface)(flat)
    dr.backward(value)
    assert float(np.array(value)[0]) == pytest.approx((away * product).sum() / 2, rel=SINGLE)
    np.testing.assert_allclose(np.array(flat.grad).reshape(-1, 3), product, atol=SINGLE * np.abs(product).max())


def test_an_unknown_regularizer_and_a_lambda_of_zero_are_refused(surface):
    with pytest.raises(ValueError, match='regularizer "tension"; expected one of laplacian, bending, anchor'):
        quadratic_form("tension", surface)
    with pytest.raises(ValueError, match="lambda_ is 0; expected a positive number"):
        LargeSteps(surface.cage.laplacian(), 0)
