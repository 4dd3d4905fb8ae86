import numpy as np
import pytest
from kernels.surfaces import random_locations, surface_named
from mitsuba_subdivision import LimitSurface
from mitsuba_subdivision.cage.named_cages import cube
from mitsuba_subdivision.tessellation.criterion import Criterion
from patches.closed_cages import bumpy, mixed_torus
from reference.refined_cages import refine_first, tagged

# Around extraordinary points, quadrature leaves out other parts of a refined cage, and boxes bound others.
QUADRATURE, BOXES = 1e-5, 0.03


def test_holes_have_no_surface():
    whole, holed = LimitSurface(cube()), LimitSurface(tagged(cube(), holes=[1, 2]))
    np.testing.assert_allclose(holed.area(), whole.area() * 4 / 6, rtol=1e-10)
    assert not np.isin([1, 2], holed.sample(1000).element).any()
    assert not np.isin([1, 2], holed.closest_point(np.random.default_rng(0).normal(size=(100, 3)) * 3).element).any()
    assert holed.bounds().element.tolist() == [0, 3, 4, 5]
    for use in (lambda: holed.bounds([2]), lambda: holed.evaluate(2, [[0.5, 0.5]])):
        with pytest.raises(ValueError, match="element of sample 0 is 2; expected one that has a surface: no hole"):
            use()


def test_a_collapsed_surface_is_a_point():
    surface = LimitSurface(cube().with_positions(np.ones((8, 3))))
    nearest, bounds = surface.closest_point([[1.0, 1.0, 4.0]]), surface.bounds()
    np.testing.assert_allclose(nearest.p, [[1, 1, 1]], rtol=0, atol=1e-14)
    np.testing.assert_array_equal(nearest.n, [[0, 0, 0]])
    np.testing.assert_allclose([bounds.lower, bounds.upper], 1, rtol=0, atol=1e-6)
    at_origin = LimitSurface(cube().with_positions(np.zeros((8, 3))))
    np.testing.assert_array_equal([at_origin.bounds().lower, at_origin.bounds().upper], 0)
    assert at_origin.area() == at_origin.stiffness().count_nonzero() == at_origin.bending().count_nonzero() == 0


def test_results_do_not_depend_on_the_unit_of_length(np_rng):
    """Powers of two scale all products exactly."""
    cage, points = bumpy(mixed_torus()), np_rng.normal(size=(50, 3)) * 3
    here = LimitSurface(cage)
    for unit in (2.0**-30, 2.0**30, 2.0**-10):
        there = LimitSurface(cage.with_positions(unit * cage.positions))
        assert there.area() == unit**2 * here.area()
        np.testing.assert_array_equal(there.sample(100, 3).uv, here.sample(100, 3).uv)
    np.testing.assert_array_equal(there.closest_point(unit * points).uv, here.closest_point(points).uv)
    np.testing.assert_allclose(there.stiffness().data, here.stiffness().data, rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(unit**2 * there.bending().data, here.bending().data, rtol=1e-9, atol=1e-12)


def test_cages_refined_first_have_the_same_surface(np_rng, monkeypatch):
    cage, points = bumpy(mixed_torus(), size=0.05), np_rng.normal(size=(200, 3)) * 3
    plain = LimitSurface(cage)
    assert plain.patches.refined is None
    refine_first(monkeypatch)
    refined = LimitSurface(cage)
    assert refined.patches.refined is not None
    nearest, expected = refined.closest_point(points), plain.closest_point(points)
    np.testing.assert_allclose(nearest.distance, expected.distance, rtol=0, atol=1e-13)
    np.testing.assert_allclose(nearest.p, expected.p, rtol=0, atol=1e-7)
    np.testing.assert_allclose(refined.area(), plain.area(), rtol=1e-10)
    energy = plain.stiffness(8)
    assert np.abs(refined.stiffness(8) - energy).max() <= QUADRATURE * np.abs(energy).max()
    boxes, others = ([bounds.lower, bounds.upper] for bounds in (refined.bounds(), plain.bounds()))
    size = np.linalg.norm(others[1] - others[0], axis=1).max()
    np.testing.assert_allclose(boxes, others, rtol=0, atol=BOXES * size)
    samples, (lower, upper) = refined.sample(2000), boxes
    assert ((lower[samples.element] <= samples.p) & (samples.p <= upper[samples.element])).all()


BLOCKS = {
    "mesh.ragged.CHUNK_LENGTH": 5,
    "patches.patch_samples.WEIGHTS": 70,
    "evaluation.equations.MOST_MULTIPLICATIONS": 1,
    "tessellation.vertex_table.WEIGHTS_AT_ONCE": 1,
    "tessellation.vertex_table.COEFFICIENTS_AT_ONCE": 1,
    "tessellation.adaptive.TILES_AT_ONCE": 7,
    # Levels that are computed when they are needed.
    "patches.closest_points.MOST_KEPT": 0,
    "patches.closest_points.MOST_HALVED": 0,
}


@pytest.mark.parametrize("name", ["mixed torus", "loop corner"])
def test_results_do_not_depend_on_blocks(name, np_rng, monkeypatch):
    named = surface_named(name)
    where, points = random_locations(named, np_rng, 200), np_rng.uniform(-1.5, 3, (50, 3))
    criterion = Criterion("chord", 1e-2 * np.linalg.norm(np.ptp(named.cage.positions, axis=0)))

    def results():
        # Tables of its own: a surface keeps what it has made.
        surface = LimitSurface(named.cage, named.scheme)
        for table in (surface.sampling(3), surface.adaptive_sampling(criterion)):
            yield from (table.triangles, table.element, *table.locations(), *table.apply(named.cage.positions))
        for dtype in (np.float64, np.float32):
            yield from surface.evaluate(*where, dtype=dtype)[:4]
        yield surface.closest_point(points).distance

    expected = list(results())
    for constant, value in BLOCKS.items():
        monkeypatch.setattr(f"mitsuba_subdivision.{constant}", value)
    for values, whole in zip(results(), expected, strict=True):
        np.testing.assert_allclose(values, whole, rtol=0, atol=1e-13 if whole.dtype == np.float64 else 1e-6)
