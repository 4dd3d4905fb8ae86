"""Laws of curvature; its values are compared with explicit refinement in `test_accuracy`."""

import numpy as np
import pytest
from evaluation.common import EVERY_SCHEME, curvatures, seconds
from mitsuba_subdivision import LimitSurface
from mitsuba_subdivision.cage.named_cages import extraordinary, extraordinary_face, extraordinary_triangles, torus
from mitsuba_subdivision.evaluation.element import curvature
from patches.closed_cages import triangulated
from reference.bars import CURVATURE, CURVATURE_LEVELS
from reference.exact_samples import ORDINARY, curvature_error, samples_at, subdominant

BALLS = [("catmull_clark", extraordinary), ("loop", extraordinary_triangles), ("doo_sabin", extraordinary_face)]
# (|lambda_4| / lambda_2^2) is approached as the next eigenvalues fade, within 100 levels and more.
GROWTH = 1e-3


def curvatures_at(surface, uv):
    return curvatures(surface.evaluate(0, uv, derivatives=2))


def size(curvature):
    """The larger principal curvature, up to a factor of two."""
    return np.sqrt(4 * curvature[1] ** 2 - 2 * curvature[0])


def growth(scheme, valence):
    """``|lambda_4| / lambda_2^2`` where lambda_4 belongs to the second Fourier mode, in closed form."""
    return subdominant(scheme, valence / 2) / subdominant(scheme, valence) ** 2


@pytest.mark.parametrize("radius", [0.5, 3.0])
def test_curvature_of_a_sphere_by_its_derivatives(radius):
    a, b = np.random.default_rng(0).uniform(0.3, 1.2, (2, 10))
    ca, sa, cb, sb, zero = np.cos(a), np.sin(a), np.cos(b), np.sin(b), 0 * a
    # (u, v) = (longitude a, latitude b): du x dv points outward.
    first = radius * np.array([[-sa * cb, ca * cb, zero], [-ca * sb, -sa * sb, cb]])
    second = radius * np.array([[-ca * cb, -sa * cb, zero], [sa * sb, -ca * sb, zero], [-ca * cb, -sa * cb, -sb]])
    gaussian, mean = curvature(first.swapaxes(1, 2), second.swapaxes(1, 2))
    np.testing.assert_allclose(gaussian, 1 / radius**2, rtol=1e-12)
    np.testing.assert_allclose(mean, -1 / radius, rtol=1e-12)


@EVERY_SCHEME
def test_curvature_tends_to_that_of_the_torus_a_cage_is_taken_from(scheme, np_rng):
    errors = []
    for columns, rows in ((24, 16), (48, 32)):
        cage = torus(columns, rows)
        surface = LimitSurface(triangulated(cage) if scheme == "loop" else cage, scheme)
        elements = surface.patches.elements.face_count
        uv = np_rng.random((300, 2)) / 2
        found = surface.evaluate(np_rng.integers(0, elements, 300), uv, derivatives=2)
        out = np.hypot(found.p[:, 0], found.p[:, 1]) - 2
        cosine = out / np.hypot(out, found.p[:, 2])
        gaussian, mean = cosine / (2 + cosine), -(1 + cosine) / (2 + cosine)
        errors.append(np.abs(curvatures(found) - [gaussian, mean]).max(axis=1))
    # Second derivatives of quadratic splines converge once, those of smoother ones twice.
    rate = 1.7 if scheme == "doo_sabin" else 3
    assert (errors[0] > rate * errors[1]).all()
    assert np.max(errors[1]) < 0.15


@pytest.mark.parametrize(("scheme", "make"), BALLS)
@pytest.mark.parametrize("valence", [3, 4, 5, 6])
def test_mean_curvature_of_a_ball_is_negative_by_its_outward_normal(scheme, make, valence, np_rng):
    surface = LimitSurface(make(valence), scheme)
    uv = np_rng.random((200, 2)) / 2
    found = surface.evaluate(np_rng.integers(0, surface.patches.elements.face_count, 200), uv, derivatives=2)
    assert ((found.p * found.n).sum(axis=1) > 0).all()
    assert (found.mean_curvature < 0).all()
    assert np.median(found.gaussian_curvature) == pytest.approx(1, abs=0.3)


# Maps of a cage, and what they multiply Gaussian and mean curvature by. A mirror image keeps the faces' order, so that
# normals turn inward.
TURN = np.linalg.qr(np.random.default_rng(0).standard_normal((3, 3)))[0]
TURN *= np.linalg.det(TURN)
MAPS = {
    "turned and moved": (TURN, [1.0, -2.0, 3.0], (1, 1)),
    "small": (1e-3 * np.eye(3), 0, (1e6, 1e3)),
    "large": (8 * np.eye(3), 0, (1 / 64, 1 / 8)),
    "mirrored": (np.diag([1, 1, -1]), 0, (1, -1)),
}


@EVERY_SCHEME
@pytest.mark.parametrize("valence", [3, 5, 8])
@pytest.mark.parametrize(("linear", "shift", "factors"), MAPS.values(), ids=MAPS)
def test_curvature_follows_maps_of_the_cage(scheme, valence, linear, shift, factors):
    exact = samples_at(scheme, valence)
    near = exact.uv.max(axis=1) > 2.0**-CURVATURE_LEVELS
    mapped = LimitSurface(exact.cage.with_positions(exact.cage.positions @ linear.T + shift), scheme)
    found = curvatures_at(mapped, exact.uv[near]) / np.reshape(factors, (2, 1))
    assert curvature_error(found, exact.curvature[:, near]).max() <= CURVATURE


@EVERY_SCHEME
def test_the_sign_is_right_where_the_surface_turns_away_from_the_limit_normal(scheme, np_rng):
    """Crumpled, the surface is no graph over its limit plane, and in places it stands upright on that."""
    cage = samples_at(scheme, 7).cage
    surface = LimitSurface(cage.with_positions(np_rng.standard_normal(cage.positions.shape)), scheme)
    # The elements around the point.
    found = surface.evaluate(np_rng.integers(0, 7, 400), np_rng.random((400, 2)) / 2, derivatives=2)
    turned = found.n @ surface.evaluate(0, [[0.0, 0.0]]).n[0] < 0
    assert 10 < turned.sum() < 390
    by_forms = curvature(np.stack([found.dp_du, found.dp_dv]), seconds(found))
    # Far from the point the fundamental forms lose little.
    assert curvature_error(curvatures(found), by_forms).max() <= CURVATURE


@pytest.mark.parametrize(
    ("scheme", "valence", "expected"),
    [
        *(("catmull_clark", n, growth("catmull_clark", n)) for n in (5, 6, 8, 12)),
        *(("loop", n, growth("loop", n)) for n in (7, 8, 12)),
        # Not of the second mode, but the first's square (bounded curvature) and the outer ring's 1/8.
        ("catmull_clark", 3, 0.9911),
        ("loop", 5, 1.0),
        ("loop", 3, 2.0),
        ("doo_sabin", 3, 1.0),
    ],
)
def test_curvature_grows_with_the_level_by_its_eigenvalues(scheme, valence, expected):
    # plugin/MATHEMATICS.md, section 9: (|lambda_4| / lambda_2^2)^n.
    surface = LimitSurface(samples_at(scheme, valence).cage, scheme)
    uv = np.array([[0.55, 0.3], [0.2, 0.7], [0.4, 0.4]])
    shallow, deep = (size(curvatures_at(surface, uv * 2.0**-level)) for level in (150, 250))
    np.testing.assert_allclose((deep / shallow) ** (1 / 100), expected, rtol=GROWTH)


@pytest.mark.parametrize("valence", [5, 6, 8])
def test_curvature_of_defective_doo_sabin_grows_linearly_with_the_level(valence):
    surface = LimitSurface(samples_at("doo_sabin", valence).cage, "doo_sabin")
    levels = np.array([100, 200, 300])
    first, second = np.diff(size(curvatures_at(surface, np.ldexp([[0.55, 0.3]], -levels[:, None]))))
    assert 0 < first == pytest.approx(second, rel=1e-2)


def test_curvature_vanishes_at_a_catmull_clark_vertex_of_valence_3():
    surface = LimitSurface(samples_at("catmull_clark", 3).cage)
    np.testing.assert_array_equal(curvatures_at(surface, [[0.0, 0.0]]), 0)
    assert np.abs(curvatures_at(surface, [[0.0, 2.0**-900]])).max() < 1e-2


@pytest.mark.parametrize(
    ("scheme", "valence"),
    [
        *(("catmull_clark", n) for n in (5, 6, 12)),
        *(("loop", n) for n in (3, 4, 5, 7, 12)),
        *(("doo_sabin", n) for n in (3, 5, 6, 8)),
    ],
)
def test_there_are_no_second_derivatives_and_no_curvature_at_other_extraordinary_points(scheme, valence):
    surface = LimitSurface(samples_at(scheme, valence).cage, scheme)
    found = surface.evaluate(0, [[0.0, 0.0]], derivatives=2)
    assert np.isnan(curvatures(found)).all()
    assert np.isnan(seconds(found)).all()
    assert np.isfinite(curvatures_at(surface, [[0.0, 2.0**-100]])).all()


@EVERY_SCHEME
def test_there_is_curvature_at_an_ordinary_point(scheme):
    surface = LimitSurface(samples_at(scheme, ORDINARY[scheme]).cage, scheme)
    at_point, beside = (curvatures_at(surface, [[t, 0.0]]) for t in (0.0, 2.0**-40))
    assert curvature_error(at_point, beside).max() < 1e-6


@EVERY_SCHEME
def test_float32_curvature_is_that_of_float64_within_its_precision(scheme):
    exact = samples_at(scheme, 5)
    found = LimitSurface(exact.cage, scheme).evaluate(0, exact.uv, derivatives=2, dtype=np.float32)
    assert found.gaussian_curvature.dtype == found.d2p_duu.dtype == np.float32
    # Some 20 roundings of 6e-8, over second derivatives of a tenth of the cage.
    assert curvature_error(curvatures(found), exact.curvature).max() < 1e-4


def test_one_derivative_leaves_second_derivatives_and_curvature_out():
    found = LimitSurface(extraordinary(5)).evaluate(0, [[0.5, 0.5]])
    assert found.d2p_duu is None
    assert found.gaussian_curvature is None
