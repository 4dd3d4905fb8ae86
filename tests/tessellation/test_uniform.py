import numpy as np
import pytest
from mitsuba_subdivision import ControlCage, LimitSurface
from mitsuba_subdivision.cage import CageWarning, named_cages
from mitsuba_subdivision.evaluation.element import element_stencils
from patches.closed_cages import SURFACES, bumpy, cage_of, mixed_torus, polygons
from reference.brute_force import BruteForce

pytestmark = pytest.mark.core

# Cages have a size of about 3; weights and their sums lose some tens of roundings.
ROUNDING = 1e-13
# Normals of valence 7 and above lose what the eigenbasis is ill-conditioned by.
NORMAL = 1e-12
# Central differences with a step of 1e-5: a step squared times third derivatives, and roundings divided by the step.
DIFFERENCES = 1e-7


@pytest.fixture(params=SURFACES, ids=" ".join)
def surface(request):
    return LimitSurface(bumpy(cage_of(*request.param), size=0.05), request.param[0])


# Odd and even, halves of these odd and even, and a single segment.
@pytest.mark.parametrize("rate", [1, 2, 3, 5, 6, 8])
def test_every_vertex_lies_on_one_polynomial_where_it_says(surface, rate):
    table, vertices = surface.sampling(rate), []
    assert table.triangles.max() == table.vertex_count - 1
    for part in table.polynomials:
        assert (part.patch < part.blocks[part.block, 1]).all()
        assert (np.diff(part.first_run) > 0).all()
        assert (np.diff(part.first_entry) > 0).all()
        assert part.first_run[-1] == len(part.kind) == len(part.first_vertex)
        for kind, first in zip(part.kind.tolist(), part.first_vertex.tolist(), strict=True):
            vertices.append(first + part.offset[part.first_entry[kind] : part.first_entry[kind + 1]])
        # Weights sum to one for constants, and to zero for other coefficients.
        for weights in part.weights:
            assert np.abs(weights.sum(axis=2) - (part.powers == 0).all(axis=1)).max() <= ROUNDING
    np.testing.assert_array_equal(np.sort(np.concatenate(vertices)), np.arange(table.vertex_count))
    corner, uv = table.locations()
    element = surface.patches.elements.face[corner]
    exact = surface.evaluate(element, uv, corner - surface.patches.elements.face_offsets[element])
    positions, normals = table.apply(surface.cage.positions)
    np.testing.assert_allclose(positions, exact.p, rtol=0, atol=ROUNDING)
    np.testing.assert_allclose(normals, exact.n, rtol=0, atol=NORMAL)
    np.testing.assert_allclose(np.linalg.norm(normals, axis=1), 1, rtol=0, atol=ROUNDING)


def test_vertices_of_the_cage_that_no_face_uses_have_none_in_the_tessellation():
    cube = named_cages.cube()
    positions = np.insert(cube.positions, [0, 3], 99.0, axis=0)
    faces = np.array([1, 2, 3, 5, 6, 7, 8, 9])[cube.face_vertices].reshape(-1, 4)
    with pytest.warns(CageWarning, match="2 of 10 vertices are used by no face"):
        surface = LimitSurface(ControlCage(positions, faces))
    found, expected = surface.tessellate(4), LimitSurface(cube).tessellate(4)
    np.testing.assert_array_equal(found.positions, expected.positions)
    np.testing.assert_array_equal(found.normals, expected.normals)
    np.testing.assert_array_equal(found.triangles, expected.triangles)


def test_tangents_are_the_derivatives_up_to_a_positive_factor(surface):
    # One sample in each child, and some nearer to the corner.
    uv = np.array([(0.15, 0.2), (0.6, 0.3), (0.3, 0.6), (0.45, 0.3), (0.05, 0.02)])
    step = 1e-5
    shifts = step * np.array([(1, 0), (-1, 0), (0, 1), (0, -1)])
    for patch_class in surface.patches.classes:
        stencils = element_stencils(surface.scheme, patch_class.signature, np.vstack([uv, *(uv + s for s in shifts)]))
        samples = (stencils @ surface.cage.positions[patch_class.controls[0]]).reshape(3, 5, len(uv), 3)
        tangents = samples[1:, 0]
        east, west, north, south = samples[0, 1:]
        differences = np.stack([east - west, north - south]) / (2 * step)
        factor = np.linalg.norm(differences, axis=2) / np.linalg.norm(tangents, axis=2)
        # Both have the same factor.
        np.testing.assert_allclose(factor[0], factor[1], rtol=DIFFERENCES)
        np.testing.assert_allclose(tangents * factor[..., None], differences, rtol=0, atol=DIFFERENCES)


@pytest.mark.parametrize("rate", [4, 5])
def test_elements_hold_the_points_of_the_brute_force_reference(surface, rate):
    cage, t = surface.cage, surface.patches.elements
    tessellation = surface.tessellate(rate)
    reference = BruteForce(surface.scheme.name, cage.positions, polygons(cage.topology), digits=40)
    rng = np.random.default_rng(9)
    for element in rng.choice(t.face_count, 3, replace=False).tolist():
        corner = int(rng.integers(t.face_sizes[element]))
        own = np.unique(tessellation.triangles[tessellation.element == element])
        # A sample of the lattice that is inside both a triangle and a square, and in a polygon's corner too.
        u, v = (1 / rate, 2 / rate) if surface.patches.is_whole[element] else (2 / rate, 2 / rate)
        expected = reference.evaluate(element, corner, u, v)
        p, n = np.array(expected.p, float), np.array(expected.n, float)
        nearest = own[np.argmin(np.linalg.norm(tessellation.positions[own] - p, axis=1))]
        np.testing.assert_allclose(tessellation.positions[nearest], p, rtol=0, atol=ROUNDING)
        np.testing.assert_allclose(tessellation.normals[nearest], n, rtol=0, atol=NORMAL)


@pytest.mark.parametrize(("scheme", "name"), SURFACES)
def test_triangles_face_outward(scheme, name):
    surface = LimitSurface(cage_of(scheme, name), scheme)
    for rate in (5, 6):
        t = surface.tessellate(rate)
        a, b, c = t.positions[t.triangles].swapaxes(0, 1)
        towards = np.einsum("ij,ij->i", np.cross(b - a, c - a), t.normals[t.triangles].sum(axis=1))
        # A triangle without area faces nowhere; folds of a cage that is not convex stay thin.
        assert (towards > 0).mean() > 0.99
        assert np.einsum("ij,ij->", a, np.cross(b, c)) > 0


def test_moved_control_points_give_the_tessellation_of_the_moved_cage(surface):
    table, moved = surface.sampling(3), bumpy(surface.cage, seed=11)
    table.apply(surface.cage.positions)
    fresh = LimitSurface(moved, surface.scheme).tessellate(3)
    for again, other in zip(table.apply(moved.positions), (fresh.positions, fresh.normals), strict=True):
        np.testing.assert_array_equal(again, other)
    np.testing.assert_array_equal(table.triangles, fresh.triangles)
    np.testing.assert_array_equal(table.element, fresh.element)


def test_translation_moves_points_and_keeps_normals(surface):
    table = surface.sampling(4)
    # On this grid a translation by a power of two is exact, so nothing is lost before the weights.
    grid = np.round(surface.cage.positions * 2**30) / 2**30
    offset = np.array([2.0**20, -(2.0**19), 2.0**18])
    positions, normals = table.apply(grid)
    moved_positions, moved_normals = table.apply(grid + offset)
    # Half a unit in the last place of the moved points.
    np.testing.assert_allclose(moved_positions - offset, positions, rtol=0, atol=2.0**-32)
    np.testing.assert_array_equal(moved_normals, normals)


def test_normals_are_numbers_where_sums_overflow(surface):
    with np.errstate(all="ignore"):
        normals = surface.sampling(3).apply(surface.cage.positions * 3e307)[1]
    lengths = np.linalg.norm(normals, axis=1)
    np.testing.assert_allclose(lengths[lengths > 0], 1, rtol=0, atol=1e-6)


@pytest.mark.parametrize("coefficients", [1, 1000])
@pytest.mark.parametrize("weights", [1, 5000])
def test_runs_do_not_show(weights, coefficients, monkeypatch):
    surface = LimitSurface(bumpy(mixed_torus(), size=0.05))
    table = surface.sampling(3)
    expected = table.apply(surface.cage.positions)
    for name, value in (("WEIGHTS_AT_ONCE", weights), ("COEFFICIENTS_AT_ONCE", coefficients)):
        monkeypatch.setattr(f"mitsuba_subdivision.tessellation.vertex_table.{name}", value)
    for found, one in zip(table.apply(surface.cage.positions), expected, strict=True):
        np.testing.assert_allclose(found, one, rtol=0, atol=ROUNDING)


def test_more_vertices_than_buffers_hold_are_refused(surface):
    message = r"tessellation rate 100000 makes \d{11,} vertices; expected at most 715827882"
    with pytest.raises(ValueError, match=message):
        surface.tessellate(100_000)
