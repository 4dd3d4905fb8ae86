"""Limit stencils as sparse matrices do to control points what evaluation does."""

import numpy as np
import pytest
from mitsuba_subdivision import Attribute, LimitSurface
from mitsuba_subdivision.tessellation.criterion import Criterion, Measure
from patches.closed_cages import bumpy, cage_of, mixed_torus
from peers.fidelity_cages import SURFACES
from peers.test_fidelity import surface_of
from reference.refined_cages import refine_first, tagged

# Sums of some ten products, of weights below two and coordinates below five.
ROUNDING = 2e-14
# Second derivatives near extraordinary points have weights of a hundred.
SECOND = 1e-11
# Normals of tangents that are not short beside their weights.
NORMAL = 1e-11
PEERS = [
    "cube",
    "piece, rings and rims",
    "sheet without corners",
    "sheet, nothing interpolated",
    "smooth triangles, open and creased",
    "crease, semi-sharp on both sides",
    "dart with a semi-sharp pair",
    "Chaikin, unequal chain",
    "hole",
    "Loop, one triangle",
    "Loop, semi-sharp crease and corner",
    "no manifold, book of three",
    "no manifold, cones that touch, creased",
]
CASES = [
    *((scheme, "mixed torus") for scheme in ("catmull_clark", "doo_sabin", "loop")),
    *(("catmull_clark", "valence 2"), ("doo_sabin", "prism"), ("loop", "bipyramid")),
    *PEERS,
]
pytestmark = pytest.mark.filterwarnings("ignore::mitsuba_subdivision.cage.CageWarning")


def can_be_refined_once(case):
    """Whether its tessellation may be that of the cage refined once: new faces are corners, and all are elements."""
    if isinstance(case, tuple):
        return case[0] == "catmull_clark"
    return not case.startswith("Loop") and case not in ("hole", "sheet, nothing interpolated")


def surface_of_case(case):
    return surface_of(SURFACES[case]) if isinstance(case, str) else LimitSurface(bumpy(cage_of(*case)), case[0])


@pytest.fixture(params=CASES, ids=str)
def surface(request):
    return surface_of_case(request.param)


@pytest.fixture(
    params=[
        *((case, kind) for case in CASES for kind in ("even", "adaptive")),
        *((case, "refined once") for case in filter(can_be_refined_once, CASES)),
    ],
    ids=str,
)
def tessellation(request, monkeypatch):
    """A surface and a table of one of three kinds."""
    case, kind = request.param
    if kind == "refined once":
        refine_first(monkeypatch)
    surface = surface_of_case(case)
    assert (surface.patches.refined is not None) == (kind == "refined once")
    is_adaptive = kind == "adaptive"
    return surface, surface.adaptive_sampling(Criterion(Measure.CHORD, 0.1)) if is_adaptive else surface.sampling(3)


def some_samples(surface, rng, count=300):
    sizes = surface.patches.elements.face_sizes
    element = rng.choice(np.flatnonzero(sizes), count)
    uv = rng.random((count, 2)) * 2.0 ** -rng.integers(0, 8, (count, 1))
    uv[:20] = 0
    if surface.scheme.domain.corner_count == 3:
        uv = np.where(uv.sum(axis=1, keepdims=True) > 1, 1 - uv, uv)
    return element, uv, rng.integers(0, sizes[element])


def assert_rows_sum_as_those_of_points_and_derivatives(points, *derivatives):
    np.testing.assert_allclose(points.sum(axis=1), 1, atol=ROUNDING)
    for matrix in derivatives:
        np.testing.assert_allclose(matrix.sum(axis=1), 0, atol=10 * ROUNDING)


def test_vertices_of_a_tessellation_are_a_matrix_times_control_points(tessellation):
    surface, table = tessellation
    matrices = surface.tessellation_matrix(table)
    points, normals = table.apply(surface.cage.positions)
    found, *tangents = (matrix @ surface.cage.positions for matrix in matrices)
    np.testing.assert_allclose(found, points, atol=ROUNDING * np.abs(points).max())
    has_normal = normals.any(axis=1)
    assert has_normal.any()
    crosses = np.cross(*tangents)[has_normal]
    found = crosses / np.linalg.norm(crosses, axis=1, keepdims=True)
    np.testing.assert_allclose(found, normals[has_normal], atol=NORMAL)
    assert_rows_sum_as_those_of_points_and_derivatives(*matrices)


def test_a_rate_stands_for_its_table(surface):
    found = surface.tessellation_matrix(2).p @ surface.cage.positions
    np.testing.assert_allclose(found, surface.tessellate(2).positions, atol=ROUNDING * 5)


def test_samples_are_a_matrix_times_control_points(surface, np_rng):
    samples = some_samples(surface, np_rng)
    expected = surface.evaluate(*samples, derivatives=2)
    matrices = surface.matrix(*samples, derivatives=2)
    assert_rows_sum_as_those_of_points_and_derivatives(*matrices[:3])
    # Also in which of them are no numbers.
    for name, matrix in matrices._asdict().items():
        rtol, atol = (SECOND, SECOND) if name.startswith("d2p") else (ROUNDING, 10 * ROUNDING)
        found = matrix @ surface.cage.positions
        np.testing.assert_allclose(found, getattr(expected, name), rtol=rtol, atol=atol, err_msg=name)


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


def test_attributes_that_are_subdivided_as_points_are_take_the_same_matrix(np_rng):
    heat = np_rng.random((mixed_torus().vertex_count, 2))
    surface = LimitSurface(tagged(mixed_torus(), attributes={"heat": Attribute(heat)}))
    samples = some_samples(surface, np_rng)
    expected = surface.evaluate_attribute("heat", *samples)
    np.testing.assert_allclose(surface.matrix(*samples).p @ heat, expected, atol=ROUNDING)


def test_both_sides_of_a_crease_have_the_same_rows():
    surface = surface_of(SURFACES["piece, rings and rims"])
    rows, (copies, places) = surface.tessellation_matrix(3).p, surface.sampling(3).copies
    assert len(copies)
    assert (rows[copies] != rows[places]).nnz == 0
