"""Random points of a surface: the same for the same seed, and uniform by area, by tests of chi-square.

Seeds are fixed, so the tests always give the same. At a significance of one in a thousand, each would fail by chance
for one seed in a thousand.
"""

import numpy as np
import pytest
from kernels.surfaces import surface_named
from mitsuba_subdivision.patches.area_samples import uniform_locations
from scipy.special import chdtrc

NAMES = ["mixed torus", "half disc of 6", "crease", "loop mixed torus", "loop corner", "doo_sabin mixed torus"]
SIGNIFICANCE, COUNT = 1e-3, 10_000
# Cells on each side of an element, and parts of a cell that are evaluated to measure it.
CELLS, PARTS = 4, 2


def cell_areas(surface, element, corner):
    """``(n, cells)`` areas of the cells of ``n`` elements, by sums over the middles of their parts."""
    domain, count = surface.scheme.domain, CELLS * PARTS
    j, i = (np.indices((count, count)).reshape(2, -1) + 0.5) / count
    # Of parts on the diagonal of a triangle, half are inside.
    share = np.clip((1 - i - j) * count + 0.5, 0, 1) if domain.corner_count == 3 else np.ones(len(i))
    uv, share = np.stack([i, j], axis=1)[share > 0], share[share > 0]
    where = np.repeat(element, len(uv)), np.tile(uv, (len(element), 1)), np.repeat(corner, len(uv))
    samples = surface.evaluate(*where)
    sizes = share * np.linalg.norm(np.cross(samples.dp_du, samples.dp_dv), axis=1).reshape(-1, len(uv))
    return np.array([np.bincount(cell_of(uv), size, CELLS * CELLS) for size in sizes]) / count**2


def cell_of(uv):
    i, j = np.minimum((uv * CELLS).astype(int), CELLS - 1).T
    return CELLS * j + i


def assert_fits(counts, expected):
    chosen = expected > 0
    assert counts[~chosen].sum() == 0
    expected = expected[chosen] * counts.sum() / expected[chosen].sum()
    assert chdtrc(len(expected) - 1, ((counts[chosen] - expected) ** 2 / expected).sum()) > SIGNIFICANCE


@pytest.mark.parametrize("name", NAMES)
def test_elements_have_points_by_their_areas(name):
    surface = surface_named(name)
    samples = surface.sample(COUNT, seed=1)
    elements = surface.patches.elements
    corner = np.arange(len(elements.face)) - elements.face_offsets[elements.face]
    chosen = (corner == 0) | ~surface.patches.is_whole[elements.face]
    areas = cell_areas(surface, elements.face[chosen], corner[chosen]).sum(axis=1)
    areas = np.bincount(elements.face[chosen], areas, elements.face_count)
    assert_fits(np.bincount(samples.element, minlength=elements.face_count), areas)


@pytest.mark.parametrize("name", NAMES)
def test_points_are_uniform_inside_elements(name):
    surface = surface_named(name)
    bounds = surface.bounds()
    element = int(bounds.element[np.linalg.norm(bounds.upper - bounds.lower, axis=1).argmax()])
    # What `sample` evaluates, of which there have to be many for enough of them to lie in one element.
    start, uv = uniform_locations(surface._surface_pieces, surface._areas[0], 8 * COUNT, np.random.default_rng(2))
    elements, corners = surface._element_and_corner(start)
    own = elements == element
    if surface.patches.is_whole[element]:
        # Seen from the first corner.
        domain, uv = surface.scheme.domain, uv[own]
        for corner in range(1, domain.corner_count):
            turned = corners[own] == corner
            uv[turned] = domain.rotation(corner)(uv[turned])
    else:
        own &= corners == 0
        uv = uv[own]
    assert own.sum() > 500
    assert_fits(np.bincount(cell_of(uv), minlength=CELLS * CELLS), cell_areas(surface, [element], [0])[0])


@pytest.mark.core
def test_seeds_determine_points():
    surface = surface_named("hexagon")
    first, again, other = surface.sample(100, 7), surface.sample(100, 7), surface.sample(100, 8)
    np.testing.assert_array_equal(first.p, again.p)
    assert (first.p != other.p).any(axis=1).all()
    rng = np.random.default_rng(7)
    np.testing.assert_array_equal(surface.sample(100, rng).p, first.p)
    assert (surface.sample(100, rng).p != first.p).any(axis=1).all()


def test_points_equal_the_surface_at_their_parameters():
    surface = surface_named("rook")
    samples = surface.sample(1000)
    expected = surface.evaluate(samples.element, samples.uv, samples.corner)
    for column in ("p", "n", "dp_du", "dp_dv"):
        np.testing.assert_array_equal(getattr(samples, column), getattr(expected, column))
