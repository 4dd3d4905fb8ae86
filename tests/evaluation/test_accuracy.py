"""The evaluators against explicit refinement in decimal arithmetic, down to u, v = 2^-45 and at the point itself."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from mitsuba_subdivision import ControlCage, LimitSurface, SchemeError, limit_stencil
from mitsuba_subdivision.cage.named_cages import extraordinary, torus
from patches.closed_cages import cage_of
from reference.bars import (
    CURVATURE,
    CURVATURE_LEVELS,
    DERIVATIVE,
    NORMAL,
    NORMAL_FLOAT32,
    NORMAL_FLOAT32_NARROW,
    NORMAL_FLOAT32_VALENCES,
    POINT,
    POINT_FLOAT32,
    SECOND_DERIVATIVE,
)
from reference.brute_force import BruteForce
from reference.decimals import precision
from reference.exact_samples import (
    DIGITS,
    SCHEMES,
    angle,
    bumpy,
    bumpy_ball,
    curvature_error,
    exact_curvature,
    faces_of,
    samples_at,
)

pytestmark = pytest.mark.core

# Limit stencils are eigenvectors, by LAPACK, whose libraries differ in what rounding leaves: 1.6e-14 with that of NumPy
# 2.5. Then they are sums of about 2 n products of size one.
STENCIL = 4e-14
EVERY_SCHEME = pytest.mark.parametrize("scheme", SCHEMES)
# Valences on both sides of the ordinary one.
SOME_POINTS = pytest.mark.parametrize(("scheme", "valence"), [(s, n) for s in SCHEMES for n in (3, 5, 8)])


def curvatures(found):
    return np.stack([found.gaussian_curvature, found.mean_curvature])


def seconds(found):
    return np.stack([found.d2p_duu, found.d2p_duv, found.d2p_dvv])


def test_points_match_explicit_refinement(exact, surface):
    found = surface.evaluate(0, exact.uv)
    assert np.abs(found.p - exact.p).max() <= POINT * exact.size


def test_derivatives_match_explicit_refinement(exact, surface):
    found = surface.evaluate(0, exact.uv)
    scale = exact.derivative_scale(found.level)[:, None] * exact.size
    assert np.abs((found.dp_du - exact.dp_du) / scale).max() <= DERIVATIVE
    assert np.abs((found.dp_dv - exact.dp_dv) / scale).max() <= DERIVATIVE


def test_second_derivatives_match_explicit_refinement(exact, surface):
    found = surface.evaluate(0, exact.uv, derivatives=2)
    scale = exact.derivative_scale(found.level, 2)[:, None] * exact.size
    assert np.abs((seconds(found) - exact.second) / scale).max() <= SECOND_DERIVATIVE


def test_curvatures_match_explicit_refinement(exact, surface):
    found = surface.evaluate(0, exact.uv, derivatives=2)
    near = found.level <= CURVATURE_LEVELS
    assert curvature_error(curvatures(found)[:, near], exact.curvature[:, near]).max() <= CURVATURE


def test_normals_match_explicit_refinement(exact, surface):
    assert angle(surface.evaluate(0, exact.uv).n, exact.n).max() <= NORMAL


def test_point_and_normal_at_the_extraordinary_point_are_the_limits(exact, surface):
    found = surface.evaluate(0, [[0.0, 0.0]])
    assert np.abs(found.p - exact.limit_p).max() <= POINT * exact.size
    assert angle(found.n[0], exact.limit_n) <= NORMAL


def test_float32_normals_stay_right_at_every_level(exact, surface):
    uv = np.concatenate([0.9 * np.ldexp([[0.6, 0.45]], -level) for level in range(49)])
    found = surface.evaluate(0, np.concatenate([exact.uv, uv]), dtype=np.float32)
    precise = surface.evaluate(0, np.concatenate([exact.uv, uv]))
    assert found.n.dtype == np.float32
    bar = NORMAL_FLOAT32 if exact.valence <= NORMAL_FLOAT32_VALENCES else NORMAL_FLOAT32_NARROW
    assert angle(found.n, precise.n).max() <= bar
    assert np.abs(found.p - precise.p).max() <= POINT_FLOAT32 * exact.size


@SOME_POINTS
def test_powers_of_the_matrix_give_the_same_points(scheme, valence):
    exact = samples_at(scheme, valence)
    found = LimitSurface(exact.cage, scheme).evaluate(0, exact.uv, evaluator="power")
    assert np.abs(found.p - exact.p).max() <= POINT * exact.size


def test_stam_agrees_far_from_the_extraordinary_vertex(exact, surface):
    # Term 1 of (11) is about 2^n times the rounding error, of float64 and at n = 1 nothing.
    far = np.flatnonzero(exact.uv.max(axis=1) > 0.25)
    found = surface.evaluate(0, exact.uv[far], evaluator="stam", derivatives=2)
    scale = exact.derivative_scale(found.level, 2)[:, None] * exact.size
    assert np.abs((seconds(found) - exact.second[:, far]) / scale).max() <= SECOND_DERIVATIVE
    assert curvature_error(curvatures(found), exact.curvature[:, far]).max() <= CURVATURE
    assert angle(found.n, exact.n[far]).max() <= NORMAL
    assert np.abs(found.p - exact.p[far]).max() <= POINT * exact.size


def test_stam_in_float32_loses_the_normal_at_valence_3():
    # plugin/MATHEMATICS.md, section 5: kappa eps |c1| / lambda_2^n, above 5 degrees from n = 17 on with |c1| = 1.
    surface = LimitSurface(extraordinary(3))
    assert np.linalg.norm(surface.evaluate(0, [[0.0, 0.0]]).p) == pytest.approx(1, abs=0.1)
    uv = np.ldexp([[0.9, 0.6]], -np.arange(17, 41)[:, None])
    error = angle(surface.evaluate(0, uv, evaluator="stam", dtype=np.float32).n, surface.evaluate(0, uv).n)
    assert (np.isnan(error) | (error > 5)).all()


def test_stam_in_float32_loses_the_normal_at_valence_5():
    surface = LimitSurface(extraordinary(5))
    uv = np.ldexp([[0.9, 0.6]], -np.arange(28, 41)[:, None])
    error = angle(surface.evaluate(0, uv, evaluator="stam", dtype=np.float32).n, surface.evaluate(0, uv).n)
    assert (np.isnan(error) | (error > 5)).all()


@pytest.mark.parametrize("evaluator", ["stam", "power"])
def test_published_forms_have_no_value_at_the_point_itself(evaluator):
    found = LimitSurface(extraordinary(5)).evaluate(0, [[0.0, 0.0]], evaluator=evaluator)
    assert np.isnan(found.n).all()
    assert found.level[0] == -1


@EVERY_SCHEME
@pytest.mark.parametrize("valence", [3, 5, 12, 50])
def test_limit_evaluator_gives_the_extraordinary_point_for_every_sample(scheme, valence):
    exact = samples_at(scheme, valence)
    found = LimitSurface(exact.cage, scheme).evaluate(0, exact.uv, evaluator="limit")
    assert np.abs(found.p - exact.limit_p).max() <= POINT * exact.size
    assert angle(found.n, exact.limit_n).max() <= NORMAL


@EVERY_SCHEME
@pytest.mark.parametrize("valence", [3, 4, 5, 6])
def test_tangents_at_the_extraordinary_point_run_along_the_edges(scheme, valence):
    # Directions converge as (lambda_4 / lambda_2)^n, too slowly to see at higher valences.
    surface = LimitSurface(samples_at(scheme, valence).cage, scheme)
    at_point = surface.evaluate(0, [[0.0, 0.0]])
    deep = surface.evaluate(0, [[2.0**-200, 0.0], [0.0, 2.0**-200]])
    for tangent, end in ((at_point.dp_du[0], deep.p[0]), (at_point.dp_dv[0], deep.p[1])):
        assert np.isfinite(tangent).all()
        assert abs(tangent @ at_point.n[0]) <= POINT * np.linalg.norm(tangent)
        assert np.abs(end - at_point.p[0]).max() <= POINT
    near = surface.evaluate(0, [[2.0**-60, 0.0], [0.0, 2.0**-60]])
    assert angle(at_point.dp_du[0], near.dp_du[0]) < 1e-3
    assert angle(at_point.dp_dv[0], near.dp_dv[1]) < 1e-3


def test_normals_stay_finite_at_any_level(surface):
    uv = np.ldexp([[1.0, 0.3]], [[-100], [-500], [-1000], [-1070]])
    found = surface.evaluate(0, uv)
    for values in (found.p, found.dp_du, found.dp_dv, found.n):
        assert np.isfinite(values).all()


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
    element = np_rng.integers(0, len(sizes), 30)
    corner = np_rng.integers(0, sizes[element])
    uv = np_rng.random((30, 2))
    if scheme == "loop":
        uv[uv.sum(axis=1) > 1] = 1 - uv[uv.sum(axis=1) > 1]
    uv *= 2.0 ** -np_rng.integers(0, 20, (30, 1))
    found = surface.evaluate(element, uv, corner, derivatives=2)
    exact = [
        reference.evaluate(int(e), int(c), u, v, derivatives=2)
        for e, c, (u, v) in zip(element, corner, uv, strict=True)
    ]
    size = np.ptp(cage.positions, axis=0).max()
    with precision(DIGITS):
        points, du, dv, normals, duu, duv, dvv = (
            np.array([getattr(s, field) for s in exact], dtype=float)
            for field in ("p", "dp_du", "dp_dv", "n", "d2p_duu", "d2p_duv", "d2p_dvv")
        )
        curvature = np.array([exact_curvature(s) for s in exact], dtype=float).T
    assert np.abs(found.p - points).max() <= POINT * size
    assert angle(found.n, normals).max() <= NORMAL
    for values, bar in (
        ((found.dp_du, du), DERIVATIVE),
        ((found.dp_dv, dv), DERIVATIVE),
        ((seconds(found), [duu, duv, dvv]), SECOND_DERIVATIVE),
    ):
        # Of the derivatives' size at the sample, whatever its level is.
        a, b = (np.asarray(value) for value in values)
        assert (np.abs(a - b) / np.abs(b).max(axis=-1, keepdims=True)).max() <= 10 * bar
    assert curvature_error(curvatures(found), curvature).max() <= CURVATURE


def test_faces_of_all_sizes_and_valences_match_explicit_refinement(np_rng):
    # A pentagonal prism with one lid cut into triangles about a centre: faces of 3, 4, 5 corners, valences 3, 4, 5.
    turn = 2 * np.pi * np.arange(5) / 5
    ring = np.stack([np.cos(turn), np.sin(turn)], axis=1)
    positions = np.concatenate([np.c_[ring, np.zeros(5)], np.c_[ring, np.ones(5)], [[0.1, 0, 1.3]]])
    faces = [[4, 3, 2, 1, 0]] + [[i, (i + 1) % 5, 5 + (i + 1) % 5, 5 + i] for i in range(5)]
    faces += [[5 + i, 5 + (i + 1) % 5, 10] for i in range(5)]
    reference = BruteForce("catmull_clark", positions, faces)
    surface = LimitSurface(ControlCage(positions, faces))
    for element, face in enumerate(faces):
        corner = np_rng.integers(0, len(face), 4)
        uv = np_rng.random((4, 2))
        uv[0] = 1 - uv[0] * 1e-4
        found = surface.evaluate(element, uv, corner)
        exact = [reference.evaluate(element, int(c), u, v) for c, (u, v) in zip(corner, uv, strict=True)]
        with precision(120):
            assert np.abs(found.p - np.array([s.p for s in exact], dtype=float)).max() <= POINT * 2
            assert angle(found.n, np.array([s.n for s in exact], dtype=float)).max() <= NORMAL


def test_a_torus_grid_is_a_bicubic_spline(np_rng):
    cage = torus(9, 7)
    surface = LimitSurface(cage)
    uv = np_rng.random((50, 2))
    column, row = np_rng.integers(0, 9, 50), np_rng.integers(0, 7, 50)
    found = surface.evaluate(column * 7 + row, uv)
    expected = np.zeros((50, 3))
    for i in range(-1, 3):
        for j in range(-1, 3):
            weight = _cubic_hat(uv[:, 0] - i) * _cubic_hat(uv[:, 1] - j)
            expected += weight[:, None] * cage.positions[(column + i) % 9 * 7 + (row + j) % 7]
    assert np.abs(found.p - expected).max() <= POINT * 6
    assert (found.level == 0).all()


def _cubic_hat(t):
    """Cardinal cubic B-spline centred at 0, from truncated powers."""
    return sum(c * np.maximum(t + 2 - k, 0) ** 3 for k, c in enumerate((1, -4, 6, -4, 1))) / 6


def test_evaluation_commutes_with_affine_maps(exact, np_rng):
    matrix, shift = np_rng.standard_normal((3, 3)), np_rng.standard_normal(3)
    before = LimitSurface(exact.cage, exact.scheme).evaluate(0, exact.uv)
    moved = exact.cage.with_positions(exact.cage.positions @ matrix.T + shift)
    after = LimitSurface(moved, exact.scheme).evaluate(0, exact.uv)
    assert np.abs(before.p @ matrix.T + shift - after.p).max() <= POINT * 10
    normal = np.sign(np.linalg.det(matrix)) * before.n @ np.linalg.inv(matrix)
    assert angle(normal, after.n).max() <= NORMAL


@pytest.mark.parametrize("distance", [1e3, 1e6])
def test_translation_changes_normals_by_no_more_than_rounding_the_cage_does(exact, distance):
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
    entry = published[scheme][str(valence)]
    found = limit_stencil(scheme, valence)
    for name, weights in (
        ("limit_position", found.position),
        ("tangent1", found.tangents[0]),
        ("tangent2", found.tangents[1]),
    ):
        # The extraordinary point of Doo-Sabin is a face's, and has no vertex in its centre.
        centre = [] if scheme == "doo_sabin" else [entry[name]["centre"]]
        expected = [*centre, *entry[name]["edge_ring"], *entry[name]["face_ring"]]
        assert np.abs(weights - np.array(expected, dtype=float)).max() <= STENCIL


@EVERY_SCHEME
@pytest.mark.parametrize("valence", [3, 4, 5, 12, 50])
def test_limit_stencil_of_a_position_sums_to_one_and_of_tangents_to_zero(scheme, valence):
    found = limit_stencil(scheme, valence)
    assert found.position.sum() == pytest.approx(1, abs=STENCIL)
    assert np.abs(found.tangents.sum(axis=1)).max() <= STENCIL * valence


@EVERY_SCHEME
@pytest.mark.parametrize("valence", [3, 5, 12])
def test_limit_stencil_agrees_with_evaluation(scheme, valence):
    cage = bumpy_ball(scheme, valence)
    faces = faces_of(cage)
    ring = np.array(faces[:valence]) if scheme != "doo_sabin" else None
    slots = {
        "catmull_clark": lambda: [0, *ring[:, 1], *ring[:, 2]],
        "loop": lambda: [0, *ring[:, 1]],
        "doo_sabin": lambda: faces[0],
    }[scheme]()
    found = limit_stencil(scheme, valence)
    points = cage.positions[slots]
    sample = LimitSurface(cage, scheme).evaluate(0, [[0.0, 0.0]])
    assert np.abs(found.position @ points - sample.p[0]).max() <= POINT
    assert angle(np.cross(*(found.tangents @ points)), sample.n[0]) <= NORMAL


@EVERY_SCHEME
def test_limit_stencil_of_valence_2_is_an_error(scheme):
    with pytest.raises(SchemeError, match="valence 2: expected 3 or more"):
        limit_stencil(scheme, 2)
