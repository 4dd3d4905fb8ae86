import numpy as np
import pytest
from mitsuba_subdivision import CageError, ControlCage, LimitSurface
from mitsuba_subdivision.mesh.signature import NEAR_FACES
from mitsuba_subdivision.schemes import CatmullClark, Loop
from mitsuba_subdivision.surface import arguments
from patches.closed_cages import circle

SCHEMES = pytest.mark.parametrize("scheme", ["catmull_clark", "loop", "doo_sabin"])
HIGH = 200
# Roundings of a circle's points, and of sums over them.
ROUNDED = 1e-12
# Roundings of eigenbases of fans, in points of size one and in unit normals: eigenvalues of fans are close.
ROUNDED_POINT = 1e-13
ROUNDED_NORMAL = 1e-9
# Levels at which the published form, which multiplies by the rules' matrix for each, still has that precision.
FEW_LEVELS = 8


def pyramid(count, **tags):
    faces = [[count, i, (i + 1) % count] for i in range(count)]
    return ControlCage(np.concatenate([circle(count), [[0, 0, 1]]]), faces, **tags)


def prism(count):
    i, points = np.arange(count), circle(count)
    sides = np.stack([i, (i + 1) % count, (i + 1) % count + count, i + count], axis=1).tolist()
    return ControlCage(np.concatenate([points, np.add(points, [0, 0, 1])]), [*sides, [*range(count, 2 * count)]])


@pytest.mark.core
@pytest.mark.parametrize(
    ("scheme", "cage", "message"),
    [
        ("catmull_clark", pyramid(512), "vertex 512 has 512 faces; expected at most 511"),
        ("loop", pyramid(2_000), "vertex 2000 has 2000 faces; expected at most 511"),
        ("catmull_clark", pyramid(65, creases=[[65, 0, 10]]), "vertex 65 has 65 faces; .* 64 .* end of a crease"),
        ("loop", pyramid(65, creases=[[65, 0, 2.5]]), "vertex 65 has 65 faces; .* 64 .* semi-sharp"),
        ("catmull_clark", prism(512), "face 512 has 512 corners; expected at most 511"),
        ("doo_sabin", prism(512), "face 512 has 512 corners; expected at most 511"),
    ],
)
def test_a_valence_above_the_limit_is_refused_at_once(scheme, cage, message):
    with pytest.raises(CageError, match=message):
        LimitSurface(cage, scheme).tessellate(1)


SMOOTH = pytest.param({}, marks=pytest.mark.long)


@pytest.mark.parametrize("tags", [SMOOTH, {"creases": [[64, 0, 10]]}, {"creases": [[64, 0, 2.5]]}])
@pytest.mark.parametrize("scheme", ["catmull_clark", "loop"])
def test_valences_at_the_limit_are_evaluated(scheme, tags):
    count = 64 if tags else 511
    samples = LimitSurface(pyramid(count, **tags), scheme).evaluate([3, 3, 3], [[0, 0], [1e-9, 2e-9], [0.2, 0.3]])
    assert np.isfinite(samples.n).all()
    np.testing.assert_allclose(np.linalg.norm(samples.n, axis=1), 1, rtol=0, atol=ROUNDED)


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


@pytest.mark.parametrize(("rules_of", "corner"), [(CatmullClark, 0), (Loop, 0), (Loop, 10)])
def test_far_faces_of_a_fan_have_no_effect(rules_of, corner, np_rng, monkeypatch):
    """The surface by the near faces is that by all faces of a fan, and that by the rules, level by level."""
    count, scheme, whole = NEAR_FACES + 5, rules_of(), type("Whole", (rules_of,), {"has_local_borders": False})()
    monkeypatch.setattr(arguments, "MOST_DIFFERENT_FACES", count)
    points, faces = open_fan(count, scheme.name == "loop", np_rng)
    cage = ControlCage(points, faces, corners=[[count + 1, corner]] if corner else [])
    # Quadrilaterals and triangles, at both borders and between.
    element = np.array([0, NEAR_FACES // 2, count - 3])
    for level in (1, FEW_LEVELS, 45):
        uv = np.tile([0.6, 0.31], (len(element), 1)) * 2.0**-level
        near, expected = (LimitSurface(cage, rules).evaluate(element, uv) for rules in (scheme, whole))
        np.testing.assert_allclose(near.p, expected.p, rtol=0, atol=ROUNDED_POINT)
        np.testing.assert_allclose(near.n, expected.n, rtol=0, atol=ROUNDED_NORMAL)
        if level <= FEW_LEVELS:
            by_rules = LimitSurface(cage, whole).evaluate(element, uv, evaluator="power")
            np.testing.assert_allclose(near.p, by_rules.p, rtol=0, atol=ROUNDED_POINT)
            np.testing.assert_allclose(near.n, by_rules.n, rtol=0, atol=ROUNDED_NORMAL)
    # The limit at the vertex depends on no other faces than those on the border.
    near, expected = (LimitSurface(cage, rules).evaluate(element, [[0, 0]]) for rules in (scheme, whole))
    np.testing.assert_allclose(near.p, expected.p, rtol=0, atol=ROUNDED_POINT)
    assert (near.n[:, 2] > 0).all()
