import numpy as np
import pytest
from kernels.surfaces import SURFACES, random_locations, surface_named
from mitsuba_subdivision import Attribute, LimitSurface
from mitsuba_subdivision.tessellation.criterion import Criterion
from patches.closed_cages import mixed_torus
from reference.refined_cages import refine_first, tagged

pytestmark = pytest.mark.core

EVERY_SURFACE = pytest.mark.parametrize("name", SURFACES)
# Rounding of sums of some tens of terms; around vertices of valence 50 of ill-conditioned eigenvectors.
ROUNDED, NORMAL = 1e-13, 1e-10
# Rounding of derivatives, in sums of the absolute values of their terms where these are above one.
DERIVATIVE = 1e-12


def locations(surface, rng, count=300):
    """All over the surface, near corners down to 1e-12 of an element and below, and at them."""
    element, uv, corner = random_locations(surface, rng, count)
    third = count // 3
    uv[:third] *= 10.0 ** rng.uniform(-12, 0, (third, 1))
    uv[:20], uv[20:30] = 0, uv[20:30] * 1e-200
    uv[30:50, 0], uv[50:70] = 0, (1, 0)
    return element, uv, corner


def close(computed, expected, size, atol=ROUNDED):
    np.testing.assert_allclose(computed, expected, rtol=0, atol=atol * size)


def assert_applied(matrix, points, expected, rounded=ROUNDED):
    """Rows of weights times points are these values, also in which of them are no numbers."""
    terms = abs(matrix) @ np.abs(points)
    np.testing.assert_array_equal(np.isnan(terms), np.isnan(expected))
    known = np.isfinite(terms)
    assert (np.abs(matrix @ points - expected)[known] <= rounded * np.maximum(terms, 1)[known]).all()


@EVERY_SURFACE
def test_samples_are_limit_stencils_applied_and_first_levels_as_eigencoordinates_have_them(name, np_rng):
    surface = surface_named(name)
    where, points = locations(surface, np_rng), surface.cage.positions
    samples, weights = surface.evaluate(*where), surface.matrix(*where, derivatives=2)
    # With second derivatives, no level is a piece.
    expected = surface.evaluate(*where, derivatives=2)
    close(weights.p.sum(axis=1), 1, 1)
    for column, matrix in weights._asdict().items():
        assert_applied(matrix, points, getattr(expected, column), ROUNDED if column == "p" else DERIVATIVE)
        if column != "p":
            assert_applied(matrix, np.ones(len(points)), 0 * matrix.sum(axis=1), DERIVATIVE)
    for column in ("dp_du", "dp_dv"):
        assert_applied(getattr(weights, column), points, getattr(samples, column), DERIVATIVE)
    np.testing.assert_array_equal(samples.level, expected.level)
    close(samples.p, expected.p, np.abs(points).max())
    close(samples.n, expected.n, 1, NORMAL)
    np.testing.assert_array_equal((samples.n == 0).all(axis=1), (expected.n == 0).all(axis=1))


@pytest.mark.parametrize("scheme", ["catmull_clark", "doo_sabin"])
def test_an_offset_moves_samples_at_extraordinary_points_into_their_elements(scheme):
    """From corners of elements, and from centres of polygons, which have the parameter 1."""
    surface = LimitSurface(mixed_torus(), scheme)
    plain, moved = (surface.tessellate(2, sample_offset=offset).positions for offset in (0, 0.25))
    moved = moved[np.linalg.norm(moved - plain, axis=1) > 1e-3]
    elements = surface.patches.elements
    face = np.tile(elements.face.astype(int), 2)
    corner = np.tile(np.arange(len(face) // 2), 2) - elements.face_offsets[face]
    at = surface.evaluate(face, np.repeat([[0.25] * 2, [0.75] * 2], len(face) // 2, axis=0), corner).p
    assert len(moved) > 3
    assert np.linalg.norm(moved[:, None] - at, axis=2).min(axis=1).max() < ROUNDED


@EVERY_SURFACE
def test_samples_do_not_depend_on_others(name, np_rng):
    surface = surface_named(name)
    where = locations(surface, np_rng, 90)
    expected, size = surface.evaluate(*where), np.abs(surface.cage.positions).max()

    def check(chosen):
        samples = surface.evaluate(*(values[chosen] for values in where))
        close(samples.p, expected.p[chosen], size)
        close(samples.n, expected.n[chosen], 1, NORMAL)
        np.testing.assert_array_equal(samples.level, expected.level[chosen])

    for chosen in (slice(None, None, -1), slice(0, 1), slice(5, 6), slice(40, 43)):
        check(chosen)


def assert_vertices_are_samples(surface, table):
    """And a matrix times the control points; both sides of a crease have the same points, bit by bit."""
    control_points = surface.cage.positions
    (points, normals), size = table.apply(control_points), np.abs(control_points).max()
    expected, weights = surface._sampler.evaluate(*table.locations()), surface.tessellation_matrix(table)
    close(points, expected.p, size)
    close(normals, expected.n, 1, NORMAL)
    has_normal = normals.any(axis=1)
    close(np.linalg.norm(normals[has_normal], axis=1), 1, 1)
    np.testing.assert_array_equal(has_normal, expected.n.any(axis=1))
    np.testing.assert_array_equal(points, points[table.weld_target])
    np.testing.assert_array_equal(np.unique(table.triangles), np.arange(table.vertex_count))
    close(weights.p @ control_points, points, size)
    close(weights.p.sum(axis=1), 1, 1)
    assert (weights.p[table.copies[0]] != weights.p[table.copies[1]]).nnz == 0
    crosses = np.cross(*((tangent @ control_points)[has_normal] for tangent in weights[1:]))
    close(crosses / np.linalg.norm(crosses, axis=1, keepdims=True), normals[has_normal], 1, NORMAL)


@EVERY_SURFACE
def test_vertices_are_samples_at_their_parameters(name, monkeypatch):
    surface = surface_named(name)
    # Odd and even, and halves of these odd and even.
    assert_vertices_are_samples(surface, surface.sampling(1 + list(SURFACES).index(name) % 6))
    chord = 0.03 * np.ptp(surface.cage.positions, axis=0).max()
    assert_vertices_are_samples(surface, surface.adaptive_sampling(Criterion("chord", chord)))
    refine_first(monkeypatch)
    refined = LimitSurface(surface.cage, surface.scheme)
    if refined.patches.refined is not None:
        assert_vertices_are_samples(refined, refined.sampling(3))


def test_a_rate_gives_the_same_as_its_table():
    surface = LimitSurface(mixed_torus())
    points = surface.tessellation_matrix(2).p @ surface.cage.positions
    np.testing.assert_allclose(points, surface.tessellate(2).positions, atol=ROUNDED)


def test_matrices_are_in_canonical_form_and_sparse():
    surface = LimitSurface(mixed_torus())
    for matrix in (*surface.tessellation_matrix(4), *surface.matrix([0, 1], [[0.5, 0.5]], derivatives=2)):
        assert (matrix.format, matrix.dtype, matrix.shape[1]) == ("csr", np.float64, surface.cage.vertex_count)
        assert matrix.has_canonical_format
        assert (matrix.data != 0).all()
        assert np.diff(matrix.indptr).max() < 40
    # Second derivatives are there when asked for.
    assert surface.matrix(0, [[0.5, 0.5]]).d2p_duu is None
    with pytest.raises(ValueError, match="derivatives 3; expected 1 or 2"):
        surface.matrix(0, [[0.5, 0.5]], derivatives=3)


def test_attributes_subdivided_as_points_share_the_matrix(np_rng):
    heat = np_rng.random((mixed_torus().vertex_count, 2))
    surface = LimitSurface(tagged(mixed_torus(), attributes={"heat": Attribute(heat)}))
    samples = surface.sample(300)
    where = samples.element, samples.uv, samples.corner
    expected = surface.evaluate_attribute("heat", *where)
    np.testing.assert_allclose(surface.matrix(*where).p @ heat, expected, atol=ROUNDED)
