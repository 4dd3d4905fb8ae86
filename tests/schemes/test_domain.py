from fractions import Fraction
from itertools import product

import numpy as np
import pytest
from mitsuba_subdivision.schemes.domain import IDENTITY, SQUARE, TRIANGLE

pytestmark = pytest.mark.core

DOMAINS = pytest.mark.parametrize("domain", [SQUARE, TRIANGLE], ids=lambda d: d.name)
# Parameters next to a corner, down to the smallest number there is, and others whose sums and doubles are exact.
DYADIC = [0.0, 5e-324, 2.0**-1000, 2.0**-60, 2.0**-20, 0.125, 0.3125, 0.5, 0.625, 1.0]


def exact(affine, u, v):
    """Image of (u, v), or None where it or a sum on the way to it is no float64."""
    sums = [Fraction(a) * Fraction(u) + Fraction(b) * Fraction(v) for a, b in affine.matrix.tolist()]
    image = tuple(s + Fraction(o) for s, o in zip(sums, affine.offset.tolist(), strict=True))
    return image if all(Fraction(float(x)) == x for x in (*sums, *image)) else None


def same_map(one, other):
    return np.array_equal(one.matrix, other.matrix) and np.array_equal(one.offset, other.offset)


def rotations(domain):
    return [domain.rotation(corner) for corner in range(domain.corner_count)]


@DOMAINS
def test_maps_are_exact_where_the_result_is_a_number(domain):
    turned = [child @ rotation for child, rotation in product(domain.children, rotations(domain))]
    maps, checked = [*domain.children, *rotations(domain), *turned], 0
    for u, v, affine in product(DYADIC, DYADIC, maps):
        if (expected := exact(affine, u, v)) is not None:
            checked += 1
            assert tuple(map(Fraction, affine(np.array([[u, v]]))[0].tolist())) == expected
    assert checked > 500


@DOMAINS
def test_tiny_parameters_keep_every_bit_in_the_child_at_the_corner(domain):
    tiny = 2.0**-40 * np.random.default_rng(2).random((50, 2))
    for corner in range(domain.corner_count):
        child = next(c for c in domain.children if c.offset.tolist() == (-domain.corners[corner]).tolist())
        there = domain.rotation(corner).inverse() @ child @ domain.rotation(corner)
        np.testing.assert_array_equal(there(tiny), 2 * tiny)


@DOMAINS
def test_inverses_are_exact(domain):
    for affine in (IDENTITY, *domain.children, *rotations(domain)):
        assert same_map(affine @ affine.inverse(), IDENTITY)
        assert same_map(affine.inverse() @ affine, IDENTITY)
