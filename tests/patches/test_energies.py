import numpy as np
import pytest
from mitsuba_subdivision import LimitSurface
from mitsuba_subdivision.cage import named_cages
from patches.closed_cages import bumpy, cage_of, mixed_torus, torus
from peers.fidelity_cages import SURFACES
from reference.refined_cages import sheet

# Rounding of sums of entries of about one, and of eigenvalues, relative to the largest entry.
ROUNDING = 1e-12
# A millionth of the energy around extraordinary points is left out, and Gauss's rule of order 8 has about as much.
QUADRATURE = 1e-5
# Bending is known worse, as curvature is not bounded around extraordinary points.
BENDING = 1e-3
# Central differences of areas with this step.
STEP, VARIATION = 1e-4, 2e-6
ORDER = 8
SURFACES_OF_ALL_KINDS = {
    "polygons": lambda: LimitSurface(bumpy(mixed_torus(), size=0.05)),
    "Loop": lambda: LimitSurface(bumpy(cage_of("loop", "bipyramid")), "loop"),
    "Doo-Sabin": lambda: LimitSurface(bumpy(cage_of("doo_sabin", "prism")), "doo_sabin"),
    "creases": lambda: LimitSurface(SURFACES["piece, rings 10.0"]),
    "semi-sharp": lambda: LimitSurface(SURFACES["crease, semi-sharp on both sides"]),
    "hole": lambda: LimitSurface(SURFACES["hole"]),
    "Loop, open": lambda: LimitSurface(SURFACES["Loop, semi-sharp crease and corner"]),
    "no manifold": lambda: LimitSurface(SURFACES["no manifold, book of three"]),
}
pytestmark = pytest.mark.filterwarnings("ignore::mitsuba_subdivision.cage.CageWarning")


@pytest.fixture(params=SURFACES_OF_ALL_KINDS)
def surface(request):
    return SURFACES_OF_ALL_KINDS[request.param]()


def moved(surface, positions):
    return LimitSurface(surface.cage.with_positions(positions), surface.scheme)


def bending_of_shape(surface, *order):
    positions = surface.cage.positions
    return (positions * (surface.bending(*order) @ positions)).sum()


@pytest.mark.parametrize("energy", ["stiffness", "bending"])
def test_energies_are_symmetric_not_negative_and_zero_for_constants(surface, energy):
    matrix = getattr(surface, energy)()
    size = np.abs(matrix).max()
    assert matrix.format == "csr"
    assert (matrix != matrix.T).nnz == 0
    assert np.abs(matrix.sum(axis=1)).max() <= 100 * ROUNDING * size
    assert np.linalg.eigvalsh(matrix.toarray()).min() >= -100 * ROUNDING * size


def test_stiffness_times_control_points_is_the_gradient_of_area(surface, np_rng):
    positions = surface.cage.positions
    direction = np_rng.standard_normal(positions.shape)
    areas = [moved(surface, positions + step * direction).area() for step in (STEP, -STEP)]
    expected = (areas[0] - areas[1]) / (2 * STEP)
    gradient = surface.stiffness(ORDER) @ positions
    largest = np.abs(gradient * direction).sum()
    assert abs((gradient * direction).sum() - expected) <= (QUADRATURE + VARIATION) * largest
    # Area goes with the square of the size.
    assert abs((gradient * positions).sum() / 2 - surface.area()) <= QUADRATURE * surface.area()


def test_energies_of_equal_surfaces_are_equal(surface):
    refinement = surface.cage.refinement(surface.scheme.name)
    finer, m = LimitSurface(refinement.cage), refinement.matrix
    for energy, tolerance in (("stiffness", QUADRATURE), ("bending", BENDING)):
        here, there = getattr(surface, energy)(ORDER), m.T @ getattr(finer, energy)(ORDER) @ m
        assert np.abs(here - there).max() <= tolerance * np.abs(here).max()


def test_bending_is_the_integral_of_both_curvatures_squared():
    surface = LimitSurface(bumpy(torus(7, 6)))
    uv, weights = surface.scheme.domain.quadrature(ORDER)
    count = surface.cage.face_count
    samples = surface.evaluate(np.repeat(np.arange(count), len(uv)), np.tile(uv, (count, 1)), derivatives=2)
    area = np.linalg.norm(np.cross(samples.dp_du, samples.dp_dv), axis=1)
    squares = 4 * samples.mean_curvature**2 - 2 * samples.gaussian_curvature
    expected = (np.tile(weights, count) * area * squares).sum()
    assert abs(bending_of_shape(surface, ORDER) / expected - 1) <= ROUNDING


def test_a_ball_bends_no_less_than_a_sphere():
    # The squares of two curvatures are at least twice their product, whose integral is 4 pi.
    for cage in (named_cages.cube(), named_cages.extraordinary(5)):
        assert 8 * np.pi < bending_of_shape(LimitSurface(cage)) < 1.1 * 8 * np.pi


@pytest.mark.parametrize("scheme", ["catmull_clark", "loop"])
def test_affine_functions_do_not_bend_in_the_plane(scheme, np_rng):
    flat = sheet(4, 4, triangles=scheme == "loop")
    positions = flat.positions + np_rng.uniform(-0.2, 0.2, flat.positions.shape) * [1, 1, 0]
    surface = LimitSurface(flat.with_positions(positions), scheme)
    bending = surface.bending()
    assert np.abs(bending @ positions).max() <= 100 * ROUNDING * np.abs(bending).max()
    assert np.abs(surface.stiffness() @ positions).max() > 0.1


@pytest.mark.parametrize("name", ["sheet without corners", "piece, rings and rims"])
def test_bending_is_finite_where_the_integral_is_infinite(name):
    # Smooth borders with one face at a vertex: curvature grows too fast there to be integrated.
    surface = LimitSurface(SURFACES[name])
    assert np.abs(surface.bending() - surface.bending(ORDER)).max() <= 0.05 * np.abs(surface.bending()).max()
