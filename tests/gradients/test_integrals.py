"""Derivatives of area, volume and moments: closed forms, Hadamard's formula, and triangles that converge to both."""

import sys

import drjit as dr
import numpy as np
import pytest
from gradients import solids
from gradients.surfaces import CLOSED, motions, moved
from mitsuba_subdivision import LimitSurface
from mitsuba_subdivision.kernels.array_types import ArrayTypes
from mitsuba_subdivision.kernels.vertex_kernel import VertexKernel
from mitsuba_subdivision.llvm import llvm_problem
from reference.refined_cages import sheet, tagged

# Of sums over a surface, beside its largest integral or derivative.
ROUNDING = 1e-12
# Volume and moments are polynomials of the step, of degree 5 at most: these differences are exact but for rounding.
STEPS = (1e-2, 2e-2, 3e-2)
WEIGHTS = np.array([45, -9, 1]) / 60
POLYNOMIAL = 1e-11
# Areas are no polynomials; `stiffness` leaves out a millionth around extraordinary points.
AREA = 1e-5
# Errors of triangles go with the square of their size: by doubling a rate, a quarter is left.
RATES, QUARTER = (6, 12, 24), (0.2, 0.3)
# Of the finest ones.
FINEST = 5e-3
TURN = np.array([0.3, -0.5, 0.7])


@pytest.fixture(scope="module", params=CLOSED)
def surface(request):
    return CLOSED[request.param]()


@pytest.fixture
def types():
    if problem := llvm_problem():
        pytest.skip(problem)
    return ArrayTypes(sys.modules["drjit.llvm.ad"].Float64)


def expected_of(linear, shift, volume, first, second):
    """Derivatives of volume and moments by an affine motion of everything, a field ``linear x + shift``."""
    growth, matrix, (i, j) = np.trace(linear), np.empty((3, 3)), np.transpose(solids.PAIRS)
    matrix[i, j] = matrix[j, i] = second
    change = linear @ matrix + np.outer(shift, first)
    change = change + change.T + growth * matrix
    return np.concatenate([growth * volume, linear @ first + shift * volume + growth * first, change[i, j]])


AFFINE = {
    "scaling": (np.eye(3), np.zeros(3)),
    "translation": (np.zeros((3, 3)), TURN),
    "rotation": (np.cross(np.eye(3), TURN).T, np.zeros(3)),
    "shear": (np.array([[0, 0.4, 0], [0, 0, -0.3], [0.2, 0, 0]]), TURN),
}


# Of the exact surface


def test_affine_motions_change_volume_and_moments_as_they_must(surface):
    integrals = solids.of_surface(surface)
    derivatives = solids.derivatives_of_surface(surface, [surface.cage.positions @ a.T + b for a, b in AFFINE.values()])
    expected = [expected_of(linear, shift, *integrals.values()) for linear, shift in AFFINE.values()]
    assert np.abs(derivatives - expected).max() <= ROUNDING * np.abs(solids.joined(integrals)).max()


def test_scaling_turning_and_shifting_change_the_area_as_they_must(surface):
    positions, area = surface.cage.positions, surface.area()
    gradient = surface.stiffness(solids.STIFFNESS_ORDER) @ positions
    assert abs((gradient * positions).sum() - 2 * area) <= AREA * area
    assert np.abs(gradient.sum(axis=0)).max() <= ROUNDING * area
    assert np.abs(np.cross(positions, gradient).sum(axis=0)).max() <= ROUNDING * area


def test_hadamards_formula_is_the_derivative_of_volume_and_moments(surface):
    positions, direction = surface.cage.positions, motions(surface)["all"]
    (derivatives,) = solids.derivatives_of_surface(surface, [direction])

    def integrals(step):
        return solids.joined(solids.of_surface(moved(surface, positions + step * direction)))

    expected = WEIGHTS @ [integrals(step) - integrals(-step) for step in STEPS] / STEPS[0]
    assert np.abs(derivatives - expected).max() <= POLYNOMIAL * np.abs(expected).max()


# Of triangles


def test_gradients_of_triangles_converge_to_those_of_the_surface(surface, types):
    linear, shift = AFFINE["shear"]
    directions = [*motions(surface).values(), surface.cage.positions @ linear.T + shift]
    area = surface.stiffness(solids.STIFFNESS_ORDER) @ surface.cage.positions
    areas = [(area * direction).sum() for direction in directions]
    exact = np.column_stack([areas, solids.derivatives_of_surface(surface, directions)])
    errors = []
    for rate in RATES:
        values, derivatives = solids.derivatives_of(surface, directions, rate, types)
        errors.append(np.linalg.norm(derivatives - exact, axis=0) / np.linalg.norm(exact, axis=0))
        # The triangles' own volume and moments obey the closed forms exactly.
        forms = expected_of(linear, shift, values[1:2], values[2:5], values[5:])
        assert np.abs(derivatives[-1, 1:] - forms).max() <= ROUNDING * np.abs(values[1:]).max()
    ratios = np.divide(errors[1:], errors[:-1])
    assert max(errors[-1]) <= FINEST
    assert ratios.min() >= QUARTER[0]
    assert ratios.max() <= QUARTER[1]


@pytest.mark.parametrize("triangles", [False, True])
def test_area_of_a_flat_sheet_changes_at_its_border_only(triangles, types, np_rng):
    """Where its corners stay, the sheet is a rectangle, at any rate."""
    cage = tagged(sheet(4, 3, triangles=triangles), corners=[(vertex, 10.0) for vertex in (0, 4, 15, 19)])
    surface = LimitSurface(cage, "loop" if triangles else "catmull_clark")
    positions = cage.positions
    is_inner = ((positions > 0) & (positions < positions.max(axis=0)))[:, :2].all(axis=1)
    inner = is_inner[:, None] * np_rng.normal(size=positions.shape)
    upwards = np_rng.normal(size=(len(positions), 1)) * [0, 0, 1]
    # Stretched along x, sheared, and its right side moved outwards.
    stretch, shear = positions * [1, 0, 0], positions[:, [1, 0, 2]] * [1, 0, 0]
    right = (positions[:, :1] == 4) * np.array([1.0, 0, 0])
    fields = ((inner, 0), (upwards, 0), (stretch, 12), (shear, 0), (right, 3))
    exact = surface.stiffness(solids.STIFFNESS_ORDER) @ positions
    table, points = surface.sampling(3), types.floats(positions.ravel())
    dr.enable_grad(points)
    vertices, _ = VertexKernel(table, types.float)(points)
    dr.backward(solids.of_triangles(types, vertices, table.triangles)["area"][0])
    of_triangles = np.array(dr.grad(points)).reshape(-1, 3)
    for gradient, tolerance in ((exact, AREA), (of_triangles, ROUNDING)):
        for field, expected in fields:
            assert abs((gradient * field).sum() - expected) <= 12 * tolerance
