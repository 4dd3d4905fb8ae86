import numpy as np
import pytest
from kernels.surfaces import KINDS, SURFACES, grid_locations, surface_named
from mitsuba_subdivision import ControlCage, LimitSurface
from patches.closed_cages import bumpy, cage_of
from reference.refined_cages import sheet

SAMPLES = 5000
MANY_SAMPLES = ("mixed torus", "loop mixed torus", "doo_sabin mixed torus")
# Diagonals of boxes, in those of the tight ones.
LONGER = 1.05
# Samples on a grid leave out some of the tight box: a part of the bend between two of them.
GRID, BETWEEN = 16, 1.005


def assert_contained(surface, np_rng, count=SAMPLES):
    bounds = surface.bounds()
    lower, upper = (np.full((len(surface.patches.elements.face_sizes), 3), np.nan) for _ in range(2))
    lower[bounds.element], upper[bounds.element] = bounds.lower, bounds.upper
    elements, domain = surface.patches.elements, surface.scheme.domain
    element = np_rng.choice(bounds.element, count)
    corner = np_rng.integers(0, elements.face_sizes[element])
    uv = np_rng.dirichlet(np.ones(domain.corner_count), count) @ domain.corners
    uv[: count // 2] *= 2.0 ** -np_rng.integers(0, 30, (count // 2, 1))
    # Extremes often lie on edges.
    uv[: count // 4, 0] = 0
    for dtype in (np.float64, np.float32):
        points = surface.evaluate(element, uv, corner, dtype=dtype).p.astype(np.float64)
        assert (points >= lower[element]).all()
        assert (points <= upper[element]).all()


@pytest.mark.parametrize("name", SURFACES)
def test_boxes_contain_the_surface_in_both_precisions(name, np_rng):
    assert_contained(surface_named(name), np_rng, 30_000 if name in MANY_SAMPLES else SAMPLES)


@pytest.mark.parametrize("name", ["cube", "loop valence 3", "doo_sabin mixed torus"])
def test_boxes_contain_the_surface_far_from_the_origin(name, np_rng):
    surface = surface_named(name)
    cage = surface.cage.with_positions(surface.cage.positions + np.array([1e3, -1e5, 0]))
    assert_contained(LimitSurface(cage, surface.scheme), np_rng)


def test_bounds_of_an_inner_minimum_are_tight_to_a_256th():
    """Over z = (x - 1/16)^2, the minimum is in the middle of the first of eight parts, whose coefficients are
    ab = -1/256 at least, for a part from a to b.
    """
    x, y = np.indices((6, 6)) - 2.0
    # Points of a uniform cubic spline are a third below the parabola's.
    points = np.stack([x, y, (x - 1 / 16) ** 2 - 1 / 3], axis=-1).reshape(-1, 3)
    first = np.add.outer(6 * np.arange(5), np.arange(5)).ravel()
    bounds = LimitSurface(ControlCage(points, first[:, None] + [0, 6, 7, 1])).bounds()
    (middle,) = np.flatnonzero((bounds.lower[:, :2].round(2) == 0).all(axis=1))
    assert -1 / 256 - 1e-5 <= bounds.lower[middle, 2] <= 0


def bent(scheme):
    return LimitSurface(bumpy(cage_of(scheme, "mixed torus"), size=1), scheme)


@pytest.mark.parametrize(
    ("make", "name"),
    [(surface_named, name) for name in KINDS] + [(bent, name) for name in ("catmull_clark", "loop", "doo_sabin")],
)
def test_boxes_are_tight(make, name):
    surface = make(name)
    bounds = surface.bounds()
    start, uv = grid_locations(surface, GRID)
    points = surface._sampler.evaluate(start, uv).p
    lower, upper = np.full((2, len(surface.patches.elements.face_sizes), 3), np.inf)
    element = surface.patches.elements.face[start]
    np.minimum.at(lower, element, points)
    np.minimum.at(upper, element, -points)
    tight = np.linalg.norm(upper + lower, axis=1)[bounds.element]
    assert (np.linalg.norm(bounds.upper - bounds.lower, axis=1) <= LONGER * BETWEEN * tight).all()


def test_boxes_of_flat_elements_are_the_elements():
    inner = LimitSurface(sheet(4, 3)).bounds([5])
    np.testing.assert_allclose([inner.lower, inner.upper], [[[1, 1, 0]], [[2, 2, 0]]], rtol=0, atol=1e-5)


def test_elements_are_chosen_by_number():
    surface = LimitSurface(bumpy(cage_of("catmull_clark", "mixed torus")))
    every, some, chosen = surface.bounds(), surface.bounds([4, 1, 4]), [4, 1, 4]
    assert some.element.tolist() == chosen
    np.testing.assert_array_equal([some.lower, some.upper], [every.lower[chosen], every.upper[chosen]])
