"""Laws of the brute-force reference itself."""

import json
from decimal import Decimal
from pathlib import Path

import numpy as np
import pytest
from patches.closed_cages import bipyramid, bumpy, polygons, prism, torus, trapezohedron, triangulated

from reference.brute_force import BruteForce, ring
from reference.decimals import precision
from reference.rules import RULES, limit_masks
from reference.splines import box_weights

LIMIT_STENCILS = json.loads((Path(__file__).parents[1] / "data" / "limit_stencils.json").read_text())
# At 80 digits and less than 15 levels no test below loses more than 25 digits.
EXACT = Decimal("1e-55")


@pytest.fixture(autouse=True)
def high_precision():
    with precision(200):
        yield


def decimals(points):
    return {i: tuple(map(Decimal, p)) for i, p in enumerate(points)}


def without_symmetry(cage):
    """Positions and faces of a cage, moved at random."""
    return bumpy(cage, size=0.15).positions.tolist(), polygons(cage.topology)


CAGES = [
    ("catmull_clark", *without_symmetry(trapezohedron(3))),
    ("catmull_clark", *without_symmetry(trapezohedron(7))),
    ("catmull_clark", *without_symmetry(prism())),
    ("loop", *without_symmetry(bipyramid(3))),
    ("loop", *without_symmetry(bipyramid(8))),
    ("doo_sabin", *without_symmetry(trapezohedron(3))),
    ("doo_sabin", *without_symmetry(prism())),
]
IDS = [f"{scheme}-{len(points)}" for scheme, points, _ in CAGES]


def some_samples(scheme, points, faces, count, seed=2):
    """Elements, corners and (u, v), many of them close to the corners."""
    rng = np.random.default_rng(seed)
    sizes = [sum(v in f for f in faces) for v in range(len(points))] if scheme == "doo_sabin" else [*map(len, faces)]
    for _ in range(count):
        element = int(rng.integers(len(sizes)))
        u, v = rng.uniform(0.05, 0.95, 2) * 0.5 ** rng.integers(0, 8)
        if scheme == "loop" and u + v > 1:
            u, v = 1 - u, 1 - v
        yield element, int(rng.integers(sizes[element])), float(u), float(v)


def gap(a, b):
    return max(abs(x - y) for x, y in zip(a, b, strict=True))


def rows(sample):
    return sample.p, sample.dp_du, sample.dp_dv, sample.d2p_duu, sample.d2p_duv, sample.d2p_dvv


BICUBIC = np.array([[1, 4, 1, 0], [-3, 0, 3, 0], [3, -6, 3, 0], [-1, 3, -3, 1]]) / 6
BIQUADRATIC = np.array([[1, 1, 0], [-2, 2, 0], [1, -2, 1]]) / 2


# For Doo-Sabin, the face of least index about the vertex is the one before it in both directions.
@pytest.mark.parametrize(
    ("scheme", "basis", "i", "j"), [("catmull_clark", BICUBIC, 2, 4), ("doo_sabin", BIQUADRATIC, 2, 3)]
)
def test_regular_patches_are_b_splines(scheme, basis, i, j):
    points, faces = without_symmetry(torus(5, 6))
    u, v, k = 0.3, 0.8, np.arange(len(basis))
    bu, bv, dv = u**k @ basis, v**k @ basis, k * v ** (k - 1.0) @ basis
    grid = np.array(points).reshape(5, 6, 3)[np.ix_((i - 1 + k) % 5, (j - 1 + k) % 6)]
    sample = BruteForce(scheme, points, faces).evaluate(i * 6 + j, 0, u, v)
    assert sample.level == 0
    np.testing.assert_allclose(np.array(sample.p, float), np.einsum("i,j,ijk", bu, bv, grid), atol=1e-14)
    np.testing.assert_allclose(np.array(sample.dp_dv, float), np.einsum("i,j,ijk", bu, dv, grid), atol=1e-14)


def test_box_spline_has_the_known_values_and_symmetry():
    # At a vertex: 1/2 and six times 1/12; u^4 + 2 u^3 v over 12 for the control point beyond the first corner.
    weight = box_weights(Decimal(0), Decimal(0))
    assert abs(2 * weight(0, 0)[0] - 1) < EXACT
    for place in ((1, 0), (0, 1), (-1, 1), (-1, 0), (0, -1), (1, -1)):
        assert abs(12 * weight(*place)[0] - 1) < EXACT
    v, w = Decimal("0.2"), Decimal("0.5")
    u = 1 - v - w
    assert abs(12 * box_weights(v, w)(0, -1)[0] - (u**4 + 2 * u**3 * v)) < EXACT
    assert abs(12 * box_weights(v, w)(-1, 0)[0] - (u**4 + 2 * u**3 * w)) < EXACT


@pytest.mark.parametrize(
    "cage", [*CAGES, ("loop", *without_symmetry(triangulated(torus(4, 4))))], ids=[*IDS, "loop-regular"]
)
def test_one_more_level_changes_nothing(cage):
    evaluator = BruteForce(*cage)
    for sample in some_samples(*cage, 6):
        coarse = evaluator.evaluate(*sample, derivatives=2)
        for more in (1, 3):
            fine = evaluator.evaluate(*sample, derivatives=2, min_level=coarse.level + more)
            assert fine.level == coarse.level + more
            assert max(map(gap, rows(coarse), rows(fine))) < EXACT


@pytest.mark.core
@pytest.mark.parametrize("scheme", RULES)
@pytest.mark.parametrize("valence", range(3, 9))
def test_limit_masks_equal_the_stored_ones(scheme, valence):
    stored = LIMIT_STENCILS[scheme][str(valence)]
    for mask, name in zip(limit_masks(scheme, valence), ("limit_position", "tangent1", "tangent2"), strict=True):
        centre = [] if scheme == "doo_sabin" else [stored[name]["centre"]]
        expected = [*centre, *stored[name]["edge_ring"], *stored[name]["face_ring"]]
        assert gap(mask, map(Decimal, expected)) < Decimal("1e-24")


@pytest.mark.core
def test_rules_have_the_stated_weights():
    # One pentagon's new vertex, and the refined vertex of a valence-5 fan, as weights of unit points.
    pentagons = [(0, 1, 2, 3, 4), (0, 4, 5, 6, 7), (0, 7, 8, 9, 1)]
    _, point = RULES["doo_sabin"](pentagons, decimals(np.eye(10)))
    weights = np.array(point((0, 0)), float)
    cosines = np.cos(2 * np.pi * np.arange(1, 5) / 5)
    np.testing.assert_allclose(weights[:5], [0.5, *(3 + 2 * cosines) / 20], atol=1e-15)

    _, point = RULES["loop"]([(0, i, 1 + i % 5) for i in range(1, 6)], decimals(np.eye(6)))
    beta = (5 / 8 - (3 / 8 + np.cos(2 * np.pi / 5) / 4) ** 2) / 5
    np.testing.assert_allclose(np.array(point(("vertex", 0)), float), [1 - 5 * beta, *[beta] * 5], atol=1e-15)

    _, point = RULES["catmull_clark"]([(0, i, 5 + i, 1 + i % 5) for i in range(1, 6)], decimals(np.eye(11)))
    expected = [1 - 7 / 20, *[6 / 100] * 5, *[1 / 100] * 5]
    np.testing.assert_allclose(np.array(point(("vertex", 0)), float), expected, atol=1e-15)


# Scheme, cage, extraordinary point, and an element with its corner that has (0, 0) there.
LIMITS = [
    ("catmull_clark", without_symmetry(trapezohedron(3)), {"vertex": 0}, 0, 0),
    ("catmull_clark", without_symmetry(trapezohedron(5)), {"vertex": 1}, 0, 1),
    ("loop", without_symmetry(bipyramid(3)), {"vertex": 0}, 0, 0),
    ("loop", without_symmetry(bipyramid(5)), {"vertex": 1}, 0, 1),
    ("doo_sabin", without_symmetry(prism(3)), {"face": 0}, 0, 0),
    ("doo_sabin", without_symmetry(prism(5)), {"face": 0}, 2, 0),
]


@pytest.mark.parametrize(("scheme", "cage", "at", "element", "corner"), LIMITS)
def test_samples_tend_to_the_limit(scheme, cage, at, element, corner):
    if scheme == "doo_sabin":
        corner = [sorted(f) for f in ring(element, cage[1])].index(sorted(cage[1][at["face"]]))
    expected = BruteForce(scheme, *cage).limit(**at)
    near = BruteForce(scheme, *cage).evaluate(element, corner, 2.0**-200, 2.0**-200)
    # Normals differ by (lambda_4 / lambda_2)^n, which is 2^-n or less for all of these but Catmull-Clark and Loop above
    # valence 4; positions by lambda_2^n.
    assert gap(near.p, expected.p) < Decimal(2) ** -99
    assert gap(near.n, expected.n) < Decimal("1e-35")


@pytest.mark.parametrize(("scheme", "cage", "element", "corner"), [(*case[:2], *case[3:]) for case in LIMITS])
def test_digits_are_enough(scheme, cage, element, corner):
    place = element, corner, 2.0**-90, 0.7 * 2.0**-90
    usual, finer = (BruteForce(scheme, *cage, digits=d).evaluate(*place, derivatives=2) for d in (80, 400))
    for a, b in zip(rows(usual), rows(finer), strict=True):
        # Relative to the size of each derivative.
        assert gap(a, b) < Decimal("1e-30") * max(map(abs, b))
    assert gap(usual.n, finer.n) < Decimal("1e-30")


def test_refuses_what_it_cannot_evaluate():
    points, faces = without_symmetry(trapezohedron(5))
    for scheme, cage, uv, message in (
        ("catmull_clark", (points, faces), (0, 0), "extraordinary"),
        ("catmull_clark", (points, faces), (1.5, 0), "outside the domain"),
        ("catmull_clark", (points, faces[1:]), (0.5, 0.5), "boundary"),
        ("loop", without_symmetry(bipyramid(3)), (0.75, 0.5), "outside the domain"),
    ):
        with pytest.raises(ValueError, match=message):
            BruteForce(scheme, *cage).evaluate(0, 0, *uv)
