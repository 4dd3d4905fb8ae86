"""Laws of the brute-force reference. Its limits equal the package's, which are compared with published numbers."""

from decimal import Decimal

import numpy as np
import pytest
from patches.closed_cages import bipyramid, bumpy, polygons, prism, torus, trapezohedron, triangulated

from reference.brute_force import BruteForce, ring
from reference.rules import RULES, precision

# At 80 digits and less than 15 levels no test below loses more than 25 digits.
EXACT = Decimal("1e-55")


@pytest.fixture(autouse=True)
def high_precision():
    with precision(200):
        yield


def without_symmetry(cage):
    """Positions and faces of a cage, moved at random."""
    return bumpy(cage, size=0.15).positions.tolist(), polygons(cage.topology)


CAGES = {
    "catmull_clark 3": ("catmull_clark", *without_symmetry(trapezohedron(3))),
    "catmull_clark 7": ("catmull_clark", *without_symmetry(trapezohedron(7))),
    "catmull_clark polygons": ("catmull_clark", *without_symmetry(prism())),
    "loop 3": ("loop", *without_symmetry(bipyramid(3))),
    "loop 8": ("loop", *without_symmetry(bipyramid(8))),
    "loop regular": ("loop", *without_symmetry(triangulated(torus(4, 4)))),
    "doo_sabin 3": ("doo_sabin", *without_symmetry(trapezohedron(3))),
    "doo_sabin polygons": ("doo_sabin", *without_symmetry(prism())),
}


def some_samples(scheme, points, faces, count=6):
    """Elements, corners and (u, v), many of them close to the corners."""
    rng = np.random.default_rng(2)
    sizes = [sum(v in f for f in faces) for v in range(len(points))] if scheme == "doo_sabin" else [*map(len, faces)]
    for _ in range(count):
        element = int(rng.integers(len(sizes)))
        u, v = rng.uniform(0.05, 0.95, 2) * 0.5 ** rng.integers(0, 8)
        if scheme == "loop" and u + v > 1:
            u, v = 1 - u, 1 - v
        yield element, int(rng.integers(sizes[element])), u, v


@pytest.mark.core
@pytest.mark.parametrize("cage", CAGES.values(), ids=CAGES)
def test_one_more_level_changes_nothing(cage):
    """So that the splines of regular patches are those of the rules, whose weights are tested below."""
    evaluator = BruteForce(*cage)
    for sample in some_samples(*cage):
        coarse = evaluator.evaluate(*sample)
        for more in (1, 3):
            fine = evaluator.evaluate(*sample, min_level=coarse.level + more)
            assert fine.level == coarse.level + more
            assert np.abs(np.stack(coarse[:6]) - np.stack(fine[:6])).max() < EXACT


@pytest.mark.core
def test_rules_have_the_stated_weights():
    """Of one pentagon's new vertex, and of the refined vertex of a valence-5 fan."""
    pentagons = [(0, 1, 2, 3, 4), (0, 4, 5, 6, 7), (0, 7, 8, 9, 1)]
    beta = (5 / 8 - (3 / 8 + np.cos(2 * np.pi / 5) / 4) ** 2) / 5
    for scheme, faces, key, expected in (
        ("doo_sabin", pentagons, (0, 0), [0.5, *(3 + 2 * np.cos(2 * np.pi * np.arange(1, 5) / 5)) / 20, *[0] * 5]),
        ("loop", [(0, i, 1 + i % 5) for i in range(1, 6)], ("vertex", 0), [1 - 5 * beta, *[beta] * 5]),
        (
            "catmull_clark",
            [(0, i, 5 + i, 1 + i % 5) for i in range(1, 6)],
            ("vertex", 0),
            [1 - 7 / 20, *[6 / 100] * 5, *[1 / 100] * 5],
        ),
    ):
        _, point = RULES[scheme](faces, [np.array(row) for row in np.eye(len(expected), dtype=int) + Decimal(0)])
        np.testing.assert_allclose(point(key).astype(float), expected, rtol=0, atol=1e-15)


# Scheme, cage, extraordinary point, and an element with its corner that has (0, 0) there.
LIMITS = [
    ("catmull_clark", without_symmetry(trapezohedron(3)), 0, 0, 0),
    ("catmull_clark", without_symmetry(trapezohedron(5)), 1, 0, 1),
    ("loop", without_symmetry(bipyramid(3)), 0, 0, 0),
    ("loop", without_symmetry(bipyramid(5)), 1, 0, 1),
    ("doo_sabin", without_symmetry(prism(3)), 0, 0, 0),
    ("doo_sabin", without_symmetry(prism(5)), 0, 2, 0),
]


@pytest.mark.parametrize(("scheme", "cage", "at", "element", "corner"), LIMITS)
def test_samples_tend_to_the_limit_and_digits_are_enough(scheme, cage, at, element, corner):
    if scheme == "doo_sabin":
        corner = [sorted(f) for f in ring(element, cage[1])].index(sorted(cage[1][at]))
    reference = BruteForce(scheme, *cage)
    expected, near = reference.limit(at), reference.evaluate(element, corner, 2.0**-200, 2.0**-200)
    # Normals differ by (lambda_4 / lambda_2)^n, which is 2^-n or less for all of these but Catmull-Clark and Loop above
    # valence 4; positions by lambda_2^n.
    assert np.abs(near.p - expected.p).max() < Decimal(2) ** -99
    assert np.abs(near.n - expected.n).max() < Decimal("1e-35")
    place = element, corner, 2.0**-90, 0.7 * 2.0**-90
    usual, finer = (BruteForce(scheme, *cage, digits=digits).evaluate(*place) for digits in (80, 400))
    for a, b in zip(usual[:7], finer[:7], strict=True):
        # Relative to the size of each derivative.
        assert np.abs(a - b).max() < Decimal("1e-30") * np.abs(b).max()
