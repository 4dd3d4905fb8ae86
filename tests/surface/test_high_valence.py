"""Vertices and faces of high valence: surfaces around them, and what is refused."""

import numpy as np
import pytest
from mitsuba_subdivision import ControlCage, LimitSurface
from mitsuba_subdivision.evaluation import occupied_pieces
from mitsuba_subdivision.mesh.signature import NEAR_FACES
from mitsuba_subdivision.patches import patch_samples, patch_table
from mitsuba_subdivision.schemes import CatmullClark, Loop
from mitsuba_subdivision.tessellation import memory

SCHEMES = pytest.mark.parametrize("scheme", ["catmull_clark", "loop", "doo_sabin"])
# Of which weights would take tens of gigabytes.
TOO_HIGH = 20_000
HIGH = 300
# Roundings of a circle's points, and of sums over them.
ROUNDED = 1e-12
# Roundings of eigenbases of fans, in points of size one and in unit normals: eigenvalues of fans are close.
ROUNDED_POINT = 1e-13
ROUNDED_NORMAL = 1e-9
# Levels at which the published form, which multiplies by the rules' matrix for each, still has that precision.
FEW_LEVELS = 8


def circle(count):
    angle = 2 * np.pi * np.arange(count) / count
    return np.stack([np.cos(angle), np.sin(angle), 0 * angle], axis=1)


def pyramid(count, *, has_base=False, **tags):
    faces = [[count, i, (i + 1) % count] for i in range(count)]
    base = [[*range(count - 1, -1, -1)]] if has_base else []
    return ControlCage(np.concatenate([circle(count), [[0, 0, 1]]]), faces + base, **tags)


@pytest.mark.core
@pytest.mark.parametrize("scheme", ["catmull_clark", "loop"])
def test_a_vertex_of_too_high_a_valence_is_named(scheme):
    with pytest.raises(MemoryError, match=rf"vertex {TOO_HIGH} has {TOO_HIGH} faces; .* GB .*several vertices"):
        LimitSurface(pyramid(TOO_HIGH), scheme).tessellate(1)


@pytest.mark.parametrize(
    ("count", "sharpness", "where"), [(3000, 10, "at the end of a crease"), (3000, 2.5, "and something semi-sharp")]
)
def test_a_fan_whose_faces_have_weights_of_their_own_is_refused_sooner(count, sharpness, where):
    with pytest.raises(MemoryError, match=rf"vertex {count} has {count} faces {where}; .* GB .*several vertices"):
        LimitSurface(pyramid(count, creases=[[count, 0, sharpness]]), "catmull_clark").tessellate(1)


def test_bases_of_all_faces_at_the_end_of_a_crease_are_refused_sooner():
    surface = LimitSurface(pyramid(700, creases=[[700, 0, 10]]), "catmull_clark")
    assert np.isfinite(surface.evaluate(5, [[0.5, 0.25]]).n).all()
    with pytest.raises(MemoryError, match=r"vertex 700 has 700 faces at the end of a crease; .* GB .*several vertices"):
        surface.bounds()


@pytest.mark.core
@pytest.mark.parametrize("scheme", ["catmull_clark", "doo_sabin"])
def test_a_face_of_too_many_corners_is_named(scheme):
    with pytest.raises(MemoryError, match=rf"face {TOO_HIGH} has {TOO_HIGH} corners; .*smaller faces"):
        LimitSurface(pyramid(TOO_HIGH, has_base=True), scheme).tessellate(1)


def test_pieces_of_a_semi_sharp_fan_that_take_too_much_are_refused():
    """Weights of a tessellation fit into memory, and polynomials of each face over all points do not."""
    surface = LimitSurface(pyramid(HIGH, creases=[[HIGH, 0, 2.5]]), "catmull_clark")
    surface.tessellate(1)
    with pytest.raises(MemoryError, match=rf"vertex {HIGH} has {HIGH} faces, and pieces .* GB .*several vertices"):
        surface.pieces()


def test_memory_is_read_for_the_first_surface_of_a_topology_only(monkeypatch):
    """A scene of a thousand equal cages read a dozen of the system's files for each."""
    calls = []
    monkeypatch.setattr(memory, "SMALL", 0)
    monkeypatch.setattr(memory, "available_memory", lambda: calls.append(None))
    cage = pyramid(5)
    first, second = (LimitSurface(cage.with_positions(z * cage.positions), "loop") for z in (1, 2))
    tables = [first.pieces()]
    assert calls
    calls.clear()
    tables.append(second.pieces())
    assert tables[0] is tables[1]
    assert not calls


def test_no_memory_at_all_is_too_little(monkeypatch):
    monkeypatch.setattr(memory, "SMALL", 0)
    monkeypatch.setattr(memory, "available_memory", lambda: 0)
    with pytest.raises(MemoryError, match=r"vertex 0 has 2 faces .* at most 0 GB"):
        LimitSurface(pyramid(5), "loop").tessellate(1)


def test_samples_on_a_fan_are_those_of_its_faces_one_after_the_other(monkeypatch, np_rng):
    cage = pyramid(60, creases=[[60, 0, 2.5], [60, 7, 1.5]])
    element, uv = np.repeat(np.arange(60), 5), np_rng.random((300, 2))
    together = LimitSurface(cage, "catmull_clark").evaluate(element, uv)
    monkeypatch.setattr(patch_samples, "WEIGHTS", 1)
    monkeypatch.setattr(patch_table, "KEPT_BYTES", 0)
    apart = LimitSurface(cage, "catmull_clark").evaluate(element, uv)
    np.testing.assert_allclose(apart.p, together.p, rtol=0, atol=ROUNDED_POINT)
    np.testing.assert_allclose(apart.n, together.n, rtol=0, atol=ROUNDED_NORMAL)


@pytest.mark.parametrize("scheme", ["catmull_clark", "loop"])
@pytest.mark.parametrize("tags", [{}, {"creases": [[60, 0, 2.5]]}, {"creases": [[60, 0, 10]]}, {"corners": [[60, 10]]}])
@pytest.mark.parametrize("derivatives", [1, 2])
def test_weights_found_from_the_piece_upwards_are_those_found_downwards(scheme, tags, derivatives, monkeypatch, np_rng):
    """Parts of many control points have no weights of their own, and large pieces are not copied for each sample."""
    cage = pyramid(60, **tags)
    faces, uv = np.repeat(np.arange(60), 5), np_rng.random((300, 2)) * 0.5 ** np_rng.integers(1, 9, (300, 1))
    monkeypatch.setattr(patch_table, "KEPT_BYTES", -1)
    samples = []
    for many, large, gathered in ((1 << 20, 1 << 40, 1 << 22), (0, 0, 1)):
        monkeypatch.setattr(occupied_pieces, "MANY_CONTROLS", many)
        monkeypatch.setattr(occupied_pieces, "LARGE_PIECE", large)
        monkeypatch.setattr("mitsuba_subdivision.evaluation.element.GATHERED_WEIGHTS", gathered)
        samples.append(LimitSurface(cage, scheme).evaluate(faces, uv, derivatives=derivatives))
    downwards, upwards = samples
    np.testing.assert_array_equal(upwards.level, downwards.level)
    np.testing.assert_allclose(upwards.p, downwards.p, rtol=0, atol=ROUNDED_POINT)
    np.testing.assert_allclose(upwards.n, downwards.n, rtol=0, atol=ROUNDED_NORMAL)
    np.testing.assert_allclose(upwards.dp_du, downwards.dp_du, rtol=ROUNDED, atol=ROUNDED)


@SCHEMES
def test_a_regular_pyramid_has_its_symmetry_at_a_high_valence(scheme):
    """The surface turned by one sector is the same surface, and its normal at the top points up."""
    surface, sectors = LimitSurface(pyramid(HIGH), scheme), np.arange(HIGH)
    # Under Doo-Sabin the top is one element, and its corners are the sectors.
    element, corner = (HIGH, sectors) if scheme == "doo_sabin" else (sectors, 0)
    samples = surface.evaluate(element, np.tile([0.2, 0.1], (HIGH, 1)), corner)
    angle = 2 * np.pi / HIGH
    turn = np.array([[np.cos(angle), -np.sin(angle), 0], [np.sin(angle), np.cos(angle), 0], [0, 0, 1]])
    np.testing.assert_allclose(samples.p[:-1] @ turn.T, samples.p[1:], rtol=0, atol=ROUNDED)
    np.testing.assert_allclose(samples.n[:-1] @ turn.T, samples.n[1:], rtol=0, atol=ROUNDED)
    top = surface.evaluate(element, [[1, 1]] if scheme == "doo_sabin" else [[0, 0]], corner)
    np.testing.assert_allclose(top.n, np.tile([0, 0, 1], (HIGH, 1)), rtol=0, atol=ROUNDED)


def open_fan(count, triangles_only, rng):
    """Faces around a vertex on the border, along half an uneven ellipse; each third one may be a quadrilateral."""
    rim = circle(2 * count)[: count + 1] * [1, 1.5, 1] + 0.02 * rng.standard_normal((count + 1, 3))
    quads = [] if triangles_only else range(0, count, 3)
    beyond = {i: [count + 2 + number] for number, i in enumerate(quads)}
    faces = [[count + 1, i, *beyond.get(i, []), i + 1] for i in range(count)]
    return np.concatenate([rim, [[0, 0, 0.4]], 1.3 * rim[list(quads)]]), faces


class WholeCatmullClark(CatmullClark):
    has_local_borders = False


class WholeLoop(Loop):
    has_local_borders = False


@pytest.mark.core
@pytest.mark.parametrize(
    ("scheme", "whole", "corner"),
    [(CatmullClark(), WholeCatmullClark(), 0), (Loop(), WholeLoop(), 0), (Loop(), WholeLoop(), 10)],
    ids=["catmull_clark", "loop", "loop corner"],
)
def test_far_faces_of_a_fan_do_not_matter(scheme, whole, corner, np_rng):
    """The surface by the near faces is that by all faces of a fan, and that by the rules, level by level."""
    count = NEAR_FACES + 5
    points, faces = open_fan(count, scheme.name == "loop", np_rng)
    cage = ControlCage(points, faces, corners=[[count + 1, corner]] if corner else [])
    # Quadrilaterals and triangles, at both borders and between.
    element = np.array([0, NEAR_FACES // 2, count - 3])
    for level in (1, FEW_LEVELS, 45):
        uv = np.tile([0.6, 0.31], (len(element), 1)) * 2.0**-level
        found, expected = (LimitSurface(cage, each).evaluate(element, uv) for each in (scheme, whole))
        np.testing.assert_allclose(found.p, expected.p, rtol=0, atol=ROUNDED_POINT)
        np.testing.assert_allclose(found.n, expected.n, rtol=0, atol=ROUNDED_NORMAL)
        if level <= FEW_LEVELS:
            by_rules = LimitSurface(cage, whole).evaluate(element, uv, evaluator="power")
            np.testing.assert_allclose(found.p, by_rules.p, rtol=0, atol=ROUNDED_POINT)
            np.testing.assert_allclose(found.n, by_rules.n, rtol=0, atol=ROUNDED_NORMAL)
    # The limit at the vertex depends on no other faces than those on the border.
    found, expected = (LimitSurface(cage, each).evaluate(element, [[0, 0]]) for each in (scheme, whole))
    np.testing.assert_allclose(found.p, expected.p, rtol=0, atol=ROUNDED_POINT)
    assert (found.n[:, 2] > 0).all()
