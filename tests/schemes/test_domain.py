from fractions import Fraction
from itertools import product

import numpy as np
import pytest
from mitsuba_subdivision.schemes.domain import IDENTITY, SQUARE, TRIANGLE

pytestmark = pytest.mark.core

DOMAINS = pytest.mark.parametrize("domain", [SQUARE, TRIANGLE], ids=lambda d: d.name)
# Parameters next to a corner, down to the smallest number there is, and others whose sums and doubles are exact.
DYADIC = [0.0, 5e-324, 2.0**-1000, 2.0**-60, 2.0**-20, 0.125, 0.3125, 0.5, 0.625, 1.0]


def inner_points(domain, count=2000):
    """Random parameters strictly inside."""
    weights = np.random.default_rng(1).dirichlet(np.ones(domain.corner_count), count)
    return weights @ domain.corners


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


@DOMAINS
def test_corners_are_counter_clockwise_from_the_origin(domain):
    assert domain.corner_count == len(domain.corners)
    assert domain.corners[0].tolist() == [0, 0]
    assert domain.corners[1].tolist() == [1, 0]
    edges = np.roll(domain.corners, -1, axis=0) - domain.corners
    turns = edges[:, 0] * np.roll(edges, -1, axis=0)[:, 1] - edges[:, 1] * np.roll(edges, -1, axis=0)[:, 0]
    assert (turns > 0).all()


@DOMAINS
def test_rotation_moves_corners_on(domain):
    for corner, rotation in enumerate(rotations(domain)):
        np.testing.assert_array_equal(rotation(domain.corners), np.roll(domain.corners, -corner, axis=0))
        assert np.linalg.det(rotation.matrix) == pytest.approx(1)
        assert same_map(rotation @ domain.rotation(1), domain.rotation((corner + 1) % domain.corner_count))


@DOMAINS
def test_children_have_half_the_size_and_cover_the_domain_once(domain):
    uv = inner_points(domain)
    inside = np.array([domain.inside(child(uv)) for child in domain.children])
    assert ((inside > 0).sum(axis=0) == 1).all()
    assert (inside > 0).any(axis=1).all()
    for child in domain.children:
        assert np.abs(child.matrix).tolist() == [[2, 0], [0, 2]]
        assert (domain.inside(child.inverse()(uv)) > 0).all()


@DOMAINS
def test_inside_is_positive_inside_zero_on_the_border_negative_outside(domain):
    assert (domain.inside(inner_points(domain)) > 0).all()
    t = np.linspace(0, 1, 9)[:, None]
    for one, other in zip(domain.corners, np.roll(domain.corners, -1, axis=0), strict=True):
        border = one * (1 - t) + other * t
        np.testing.assert_array_equal(domain.inside(border), 0)
        outward = np.array([(other - one)[1], (one - other)[0]])
        assert (domain.inside(border + 1e-9 * outward) < 0).all()
        assert (domain.inside(border + outward) < 0).all()


@DOMAINS
@pytest.mark.parametrize("size", [1.0, 0.5, 2.0**-30])
def test_extent_is_the_size_of_the_copy_that_reaches_the_parameters(domain, size):
    path = domain.corners[1:]
    far = np.vstack([path, (path[1:] + path[:-1]) / 2])
    np.testing.assert_array_equal(domain.extent(size * far), size)
    uv = inner_points(domain)
    extent = domain.extent(uv)
    # On the far border of its own copy: inside a copy a little larger, outside one a little smaller.
    assert (domain.inside(uv / (extent * (1 + 1e-12))[:, None]) > 0).all()
    assert (domain.inside(uv / (extent * (1 - 1e-12))[:, None]) < 0).all()
    assert domain.extent([0.0, 0.0]) == 0
