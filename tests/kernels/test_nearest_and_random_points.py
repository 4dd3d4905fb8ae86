import drjit as dr
import numpy as np
import pytest
from kernels.surfaces import KINDS, kernel_named, on_device, surface_named, vectors
from mitsuba_subdivision import ControlCage, LimitSurface
from mitsuba_subdivision.device_arrays import upload
from mitsuba_subdivision.kernels.surface_kernel import SurfaceKernel

pytestmark = pytest.mark.usefixtures("llvm")

DOUBLE, SINGLE = "llvm_ad_rgb_double", "llvm_ad_rgb"

# Errors of distances, in sizes of the surface. Measured: 2e-15 and 2e-7.
BARS = {DOUBLE: 2e-14, SINGLE: 2e-6}
# From a place that is some percent off, nearly all ways down lead to the same minimum.
SAME = 0.95
# Standard errors of a mean that are allowed; seeds are fixed.
ERRORS = 4
COUNT = 20_000
# A parameter is a sum of three products of numbers up to one.
ROUNDED = {DOUBLE: 1e-15, SINGLE: 5e-7}

# The searches ask for points and derivatives only, which test_surface_kernel compares on all surfaces.
SEARCHED = ["valence 50", "smooth triangles", "non-manifold", "corner", "propeller", "loop corner"]
SEARCHED += ["doo_sabin mixed torus"]


def points_near(surface, count, np_rng, away=0.03):
    samples = surface.sample(count, 1)
    size = np.ptp(samples.p, axis=0).max()
    return size, samples.p + away * size * np_rng.normal(size=(count, 1)) * samples.n


def closest(kernel, points, *start):
    nearest = kernel.closest(upload(kernel.types.vector3, points), *on_device(kernel.types, *start))
    dr.eval(nearest)
    return nearest


@pytest.mark.parametrize("name", SEARCHED)
def test_nearest_points_are_minima_from_places_beside_them(name, np_rng):
    surface = surface_named(name)
    size, points = points_near(surface, 120, np_rng)
    expected = surface.closest_point(points)
    uv = np.clip(expected.uv + np_rng.normal(size=(120, 2)) * 0.02, 0, 0.5 if surface.scheme.element == "face" else 1)
    uv = np.where(expected.uv > 0.45, expected.uv, uv)
    # Both against one search, which takes longer than they do.
    for variant, bar in BARS.items():
        nearest = closest(kernel_named(name, variant), points, expected.element, uv, expected.corner)
        distance = np.array(nearest.distance, dtype=np.float64)
        assert (distance >= expected.distance - bar * size).all(), variant
        assert (distance <= expected.distance + bar * size).mean() >= SAME, variant
        away = np.linalg.norm(points - vectors(nearest.p), axis=1)
        np.testing.assert_allclose(distance, away, rtol=0, atol=bar * size, err_msg=variant)


def test_locations_of_results_start_the_next_call(np_rng):
    surface, kernel = surface_named("torus"), kernel_named("torus", DOUBLE)
    _, points = points_near(surface, 40, np_rng)
    near = surface.closest_point(points)
    points, place = upload(kernel.types.vector3, points), on_device(kernel.types, near.element, near.uv, near.corner)
    nearest = kernel.closest(points, *place)
    again = kernel.closest(points, nearest.location)
    there = kernel.evaluate(nearest.location)
    dr.eval(nearest, again, there)
    np.testing.assert_allclose(vectors(again.p), vectors(nearest.p), rtol=0, atol=1e-9)
    np.testing.assert_array_equal(vectors(there.p), vectors(nearest.p))
    for arguments in ((nearest.location, place[1]), (place[0],)):
        with pytest.raises(TypeError, match="expected a location alone, or an element and uv"):
            kernel.evaluate(*arguments)


@pytest.mark.parametrize("name", ["sheet", "half disc of 6", "loop sheet", "holes", "crease"])
def test_minima_on_borders_are_found(name, np_rng):
    surface = surface_named(name)
    size, points = points_near(surface, 150, np_rng, 0.3)
    points += np_rng.normal(size=points.shape) * 0.3 * size
    expected, middle = surface.closest_point(points), np.full((150, 2), 1 / 3)
    nearest = closest(kernel_named(name, DOUBLE), points, expected.element, middle, expected.corner)
    distance = np.array(nearest.distance)
    assert (distance >= expected.distance - BARS[DOUBLE] * size).all()
    # Others are minima of their own: the surfaces bend.
    assert (distance <= expected.distance + 1e-6 * size).mean() > 0.8


@pytest.mark.parametrize("turn", range(3))
def test_nearest_points_on_every_side_of_a_triangle(turn):
    """Whichever parameters run along the border, as a triangle may begin at any of its vertices."""
    positions = np.array([[0, 0, 0], [3, 0, 0.5], [1, 2, 0]])
    surface = LimitSurface(ControlCage(positions, np.roll([[0, 1, 2]], turn, axis=1)), "loop")
    outside = 2 * (0.6 * positions + 0.4 * np.roll(positions, 1, axis=0)) - positions.mean(axis=0)
    start = np.zeros(3, dtype=int), np.full((3, 2), 0.3), np.zeros(3, dtype=int)
    nearest = closest(surface.on_device(DOUBLE), outside, *start)
    np.testing.assert_allclose(np.array(nearest.distance), surface.closest_point(outside).distance, rtol=1e-6)


def drawn_points(kernel, count, np_rng):
    one, *pair = map(kernel.types.floats, np_rng.random((3, count)))
    drawn = kernel.sample(one, kernel.types.vector2(*pair))
    dr.eval(drawn)
    return drawn


@pytest.mark.parametrize("name", KINDS[::2])
def test_random_points_lie_in_their_elements_and_densities_weigh_them(name):
    """Means of weighted points are integrals over the surface, here moved: its area, and its first moments."""
    surface = surface_named(name)
    positions = surface.cage.positions * [1.0, 2.0, 0.5]
    moved = LimitSurface(surface.cage.with_positions(positions), surface.scheme)
    area, others = moved.area(), moved.sample(COUNT, 5).p
    for variant in BARS:
        kernel = surface.on_device(variant)
        drawn_points(kernel, 10, np.random.default_rng(0))
        kernel.set_control_points(positions)
        drawn = drawn_points(kernel, COUNT, np.random.default_rng(0))
        weight = 1 / np.array(drawn.pdf, dtype=np.float64)
        assert abs(weight.mean() - area) <= ERRORS * weight.std() / COUNT**0.5 + 1e-5 * area, variant
        location = drawn.location
        assert surface.scheme.domain.inside(np.array([location.u, location.v]).T).min() >= -ROUNDED[variant], variant
        moments, expected = weight[:, None] * vectors(drawn.p), area * others
        error = np.hypot(moments.std(axis=0), expected.std(axis=0)) / COUNT**0.5
        off = np.abs(moments.mean(axis=0) - expected.mean(axis=0))
        assert (off <= ERRORS * error + 1e-5 * area).all(), variant


@pytest.mark.parametrize("name", ["torus", "sheet"])
def test_densities_are_about_the_same_everywhere(name, np_rng):
    density = np.array(drawn_points(kernel_named(name, DOUBLE), COUNT, np_rng).pdf) * surface_named(name).area()
    assert density.min() > 1 / 1.5
    assert density.max() < 1.5


def test_a_kernel_without_cells_draws_none():
    kernel = SurfaceKernel(surface_named("torus").pieces(), dr.llvm.ad.Float)
    with pytest.raises(ValueError, match="the kernel was made without cells to draw from"):
        kernel.sample(0.5, dr.llvm.ad.Array2f(0.5, 0.5))
