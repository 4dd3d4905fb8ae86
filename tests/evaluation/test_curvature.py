"""Laws of curvature; its values are compared with explicit refinement in `test_accuracy`."""

import numpy as np
import pytest
from evaluation.common import EVERY_SCHEME, curvatures, seconds
from mitsuba_subdivision import LimitSurface
from mitsuba_subdivision.cage.named_cages import extraordinary
from mitsuba_subdivision.evaluation.element import curvature
from reference.bars import CURVATURE
from reference.exact_samples import ORDINARY, bumpy_ball, curvature_error, samples_at, subdominant

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


@EVERY_SCHEME
def test_the_sign_is_right_where_the_surface_turns_away_from_the_limit_normal(scheme, np_rng):
    """Crumpled, the surface is no graph over its limit plane, and in places it stands upright on that."""
    cage = bumpy_ball(scheme, 7)
    surface = LimitSurface(cage.with_positions(np_rng.standard_normal(cage.positions.shape)), scheme)
    # The elements around the point.
    samples = surface.evaluate(np_rng.integers(0, 7, 400), np_rng.random((400, 2)) / 2, derivatives=2)
    turned = samples.n @ surface.evaluate(0, [[0.0, 0.0]]).n[0] < 0
    assert 10 < turned.sum() < 390
    by_forms = curvature(np.stack([samples.dp_du, samples.dp_dv]), seconds(samples))
    # Far from the point the fundamental forms lose little.
    assert curvature_error(curvatures(samples), by_forms).max() <= CURVATURE


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
    surface = LimitSurface(bumpy_ball(scheme, valence), scheme)
    uv = np.array([[0.55, 0.3], [0.2, 0.7], [0.4, 0.4]])
    shallow, deep = (size(curvatures_at(surface, uv * 2.0**-level)) for level in (150, 250))
    np.testing.assert_allclose((deep / shallow) ** (1 / 100), expected, rtol=GROWTH)


@pytest.mark.parametrize("valence", [5, 6, 8])
def test_curvature_of_defective_doo_sabin_grows_linearly_with_the_level(valence):
    surface = LimitSurface(bumpy_ball("doo_sabin", valence), "doo_sabin")
    first, second = np.diff(size(curvatures_at(surface, np.ldexp([[0.55, 0.3]], [[-100], [-200], [-300]]))))
    assert 0 < first == pytest.approx(second, rel=1e-2)


def test_curvature_vanishes_at_a_catmull_clark_vertex_of_valence_3():
    surface = LimitSurface(bumpy_ball("catmull_clark", 3))
    np.testing.assert_array_equal(curvatures_at(surface, [[0.0, 0.0]]), 0)
    assert np.abs(curvatures_at(surface, [[0.0, 2.0**-900]])).max() < 1e-2


UNBOUNDED = {"catmull_clark": (5, 6, 12), "loop": (3, 4, 5, 7, 12), "doo_sabin": (3, 5, 6, 8)}


@pytest.mark.parametrize(("scheme", "valence"), [(s, n) for s, valences in UNBOUNDED.items() for n in valences])
def test_there_are_no_second_derivatives_and_no_curvature_at_other_extraordinary_points(scheme, valence):
    surface = LimitSurface(bumpy_ball(scheme, valence), scheme)
    at_point = surface.evaluate(0, [[0.0, 0.0]], derivatives=2)
    assert np.isnan(curvatures(at_point)).all()
    assert np.isnan(seconds(at_point)).all()
    assert np.isfinite(curvatures_at(surface, [[0.0, 2.0**-100]])).all()


@EVERY_SCHEME
def test_there_is_curvature_at_an_ordinary_point(scheme):
    surface = LimitSurface(bumpy_ball(scheme, ORDINARY[scheme]), scheme)
    at_point, beside = (curvatures_at(surface, [[t, 0.0]]) for t in (0.0, 2.0**-40))
    assert curvature_error(at_point, beside).max() < 1e-6


@EVERY_SCHEME
def test_float32_curvature_is_that_of_float64_within_its_precision(scheme):
    exact = samples_at(scheme, 5)
    samples = LimitSurface(exact.cage, scheme).evaluate(0, exact.uv, derivatives=2, dtype=np.float32)
    assert samples.gaussian_curvature.dtype == samples.d2p_duu.dtype == np.float32
    # Some 20 roundings of 6e-8, over second derivatives of a tenth of the cage.
    assert curvature_error(curvatures(samples), exact.curvature).max() < 1e-4


def test_first_derivatives_come_without_second_ones_and_curvature():
    samples = LimitSurface(extraordinary(5)).evaluate(0, [[0.5, 0.5]])
    assert samples.d2p_duu is None
    assert samples.gaussian_curvature is None
