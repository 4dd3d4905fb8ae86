"""The evaluators against explicit refinement in decimal arithmetic, down to u, v = 2^-45 and at the point itself."""

import json
from pathlib import Path

import numpy as np
import pytest
from evaluation.common import EVERY_SCHEME, assert_exact, curvatures
from mitsuba_subdivision import LimitSurface, SchemeError, limit_stencil
from mitsuba_subdivision.cage.named_cages import extraordinary
from patches.closed_cages import cage_of
from reference import bars
from reference.bars import CURVATURE, DERIVATIVE, NORMAL, POINT, SECOND_DERIVATIVE
from reference.brute_force import BruteForce, Sample
from reference.exact_samples import ORDINARY, angle, bumpy, bumpy_ball, curvature_error, faces_of

pytestmark = pytest.mark.core

# Limit stencils are eigenvectors, by LAPACK, whose libraries differ in what rounding leaves: 1.6e-14 with that of NumPy
# 2.5. Then they are sums of about 2 n products of size one.
STENCIL = 4e-14
SAMPLES = 36


def test_samples_match_explicit_refinement(exact, surface):
    """Points, normals, derivatives and curvatures; and the limits at the extraordinary point."""
    at_point = [[0.0, 0.0]]
    for derivatives in (1, 2):
        assert_exact(surface.evaluate(0, exact.uv, derivatives=derivatives), exact)
        assert_limit(surface.evaluate(0, at_point, derivatives=derivatives), exact)
    if exact.valence != ORDINARY[exact.scheme]:
        assert_limit(surface.evaluate(0, exact.uv, evaluator="limit"), exact)
    # And at any level there are numbers.
    deep = surface.evaluate(0, np.ldexp([[1.0, 0.3]], [[-100], [-500], [-1000], [-1070]]))
    for values in (deep.p, deep.dp_du, deep.dp_dv, deep.n):
        assert np.isfinite(values).all()


def assert_limit(samples, exact):
    assert np.abs(samples.p - exact.limit_p).max() <= POINT * exact.size
    assert angle(samples.n, exact.limit_n).max() <= NORMAL


def test_float32_normals_stay_right_at_every_level(exact, surface):
    uv = np.concatenate([0.9 * np.ldexp([[0.6, 0.45]], -level) for level in range(49)])
    single, precise = (surface.evaluate(0, np.concatenate([exact.uv, uv]), dtype=dtype) for dtype in ("f4", "f8"))
    assert single.n.dtype == np.float32
    bar = bars.NORMAL_FLOAT32_NARROW if exact.valence > bars.NORMAL_FLOAT32_VALENCES else bars.NORMAL_FLOAT32
    assert angle(single.n, precise.n).max() <= bar
    assert np.abs(single.p - precise.p).max() <= bars.POINT_FLOAT32 * exact.size


def test_published_forms_agree_in_points_and_away_from_the_extraordinary_point(exact, surface):
    for evaluator in ("power", "stam") if exact.valence <= 8 else ():
        assert np.abs(surface.evaluate(0, exact.uv, evaluator=evaluator).p - exact.p).max() <= POINT * exact.size
    # Term 1 of (11) is about 2^n times the rounding error, of float64 and at n = 1 nothing.
    far = np.flatnonzero(exact.uv.max(axis=1) > 0.25)
    assert_exact(surface.evaluate(0, exact.uv[far], evaluator="stam", derivatives=2), exact, far)


@pytest.mark.parametrize(("valence", "first_level"), [(3, 17), (5, 28)])
def test_stam_in_float32_loses_the_normal(valence, first_level):
    # plugin/MATHEMATICS.md, section 5: kappa eps |c1| / lambda_2^n, above 5 degrees from a level on with |c1| = 1.
    surface = LimitSurface(extraordinary(valence))
    assert np.linalg.norm(surface.evaluate(0, [[0.0, 0.0]]).p) == pytest.approx(1, abs=0.1)
    uv = np.ldexp([[0.9, 0.6]], -np.arange(first_level, 41)[:, None])
    error = angle(surface.evaluate(0, uv, evaluator="stam", dtype=np.float32).n, surface.evaluate(0, uv).n)
    assert (np.isnan(error) | (error > 5)).all()


@pytest.mark.parametrize("evaluator", ["stam", "power"])
def test_published_forms_have_no_value_at_the_point_itself(evaluator):
    at_point = LimitSurface(extraordinary(5)).evaluate(0, [[0.0, 0.0]], evaluator=evaluator)
    assert np.isnan(at_point.n).all()
    assert at_point.level[0] == -1


@EVERY_SCHEME
@pytest.mark.parametrize("valence", [3, 4, 5, 6])
def test_tangents_at_the_extraordinary_point_run_along_the_edges(scheme, valence):
    # Directions converge as (lambda_4 / lambda_2)^n, too slowly to see at higher valences.
    surface = LimitSurface(bumpy_ball(scheme, valence), scheme)
    every = surface.evaluate(np.arange(surface.patches.elements.face_count), [[0.0, 0.0]])
    # That of element 0, which may be an ordinary one, and all extraordinary ones.
    elements = np.unique([0, *np.flatnonzero(every.level == -1)])
    assert len(elements) > 1 or valence == 4
    at_point = surface.evaluate(elements, [[0.0, 0.0]])
    for field, direction in (("dp_du", (1, 0)), ("dp_dv", (0, 1))):
        near, deep = (surface.evaluate(elements, [np.ldexp(direction, -level)]) for level in (60, 200))
        tangents = getattr(at_point, field)
        assert np.isfinite(tangents).all()
        assert (np.abs((tangents * at_point.n).sum(axis=1)) <= POINT * np.linalg.norm(tangents, axis=1)).all()
        assert np.abs(deep.p - at_point.p).max() <= POINT
        assert angle(tangents, getattr(near, field)).max() < 1e-3


@pytest.mark.parametrize(
    ("scheme", "name"),
    [
        *(("catmull_clark", name) for name in ("cube", "tetrahedron", "prism", "mixed torus")),
        *(("loop", name) for name in ("tetrahedron", "bipyramid", "mixed torus")),
        *(("doo_sabin", name) for name in ("cube", "tetrahedron", "prism", "mixed torus")),
    ],
)
def test_any_element_and_corner_match_explicit_refinement(scheme, name, np_rng):
    cage = bumpy(cage_of(scheme, name), 5)
    reference = BruteForce(scheme, cage.positions, faces_of(cage))
    surface = LimitSurface(cage, scheme)
    sizes = surface.patches.elements.face_sizes
    # Every element of cages that have not too many.
    element = np.resize(np_rng.permutation(len(sizes)), SAMPLES)
    corner, uv = np_rng.integers(0, sizes[element]), np_rng.random((SAMPLES, 2))
    if scheme == "loop":
        uv[uv.sum(axis=1) > 1] = 1 - uv[uv.sum(axis=1) > 1]
    else:
        uv[:8] = 1 - uv[:8] * 1e-4
    uv[8:] *= 2.0 ** -np_rng.integers(0, 20, (SAMPLES - 8, 1))
    computed = surface.evaluate(element, uv, corner, derivatives=2)
    samples = [reference.evaluate(int(e), int(c), *at) for e, c, at in zip(element, corner, uv, strict=True)]
    exact = {name: np.array([getattr(s, name) for s in samples], dtype=float) for name in Sample._fields}
    assert np.abs(computed.p - exact["p"]).max() <= POINT * np.ptp(cage.positions, axis=0).max()
    assert angle(computed.n, exact["n"]).max() <= NORMAL
    for field in ("dp_du", "dp_dv", "d2p_duu", "d2p_duv", "d2p_dvv"):
        # Of the derivatives' size at the sample, whatever its level is.
        error = np.abs(getattr(computed, field) - exact[field]) / np.abs(exact[field]).max(axis=-1, keepdims=True)
        assert error.max() <= 10 * (SECOND_DERIVATIVE if field.startswith("d2p") else DERIVATIVE)
    assert curvature_error(curvatures(computed), exact["curvature"].T).max() <= CURVATURE


def test_translation_changes_normals_by_rounding_of_the_cage_at_most(exact):
    distance = 1e6
    shift = distance * np.array([0.6, -0.48, 0.64])
    moved = exact.cage.with_positions(exact.cage.positions + shift)
    # What rounding alone does: the moved cage, moved back exactly.
    rounded = exact.cage.with_positions(moved.positions - shift)
    assert np.array_equal(rounded.positions + shift, moved.positions)
    here = LimitSurface(rounded, exact.scheme).evaluate(0, exact.uv)
    there = LimitSurface(moved, exact.scheme).evaluate(0, exact.uv)
    assert angle(here.n, there.n).max() <= NORMAL
    assert np.abs(here.p + shift - there.p).max() <= 4 * np.spacing(distance)


@EVERY_SCHEME
@pytest.mark.parametrize("valence", range(3, 9))
def test_limit_stencils_match_the_published_numbers(scheme, valence):
    published = json.loads((Path(__file__).parents[1] / "data" / "limit_stencils.json").read_text())
    entry, stencil = published[scheme][str(valence)], limit_stencil(scheme, valence)
    names = ("limit_position", "tangent1", "tangent2")
    for name, weights in zip(names, (stencil.position, *stencil.tangents), strict=True):
        # The extraordinary point of Doo-Sabin is a face's, and has no vertex in its centre.
        centre = [] if scheme == "doo_sabin" else [entry[name]["centre"]]
        expected = [*centre, *entry[name]["edge_ring"], *entry[name]["face_ring"]]
        assert np.abs(weights - np.array(expected, dtype=float)).max() <= STENCIL


@EVERY_SCHEME
def test_limit_stencil_of_valence_2_is_an_error(scheme):
    with pytest.raises(SchemeError, match="valence 2: expected 3 or more"):
        limit_stencil(scheme, 2)
