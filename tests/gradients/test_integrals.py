import sys

import numpy as np
import pytest
from gradients import solids
from gradients.surfaces import CLOSED, motions
from mitsuba_subdivision.kernels.array_types import ArrayTypes
from mitsuba_subdivision.llvm import llvm_problem

# Rounding of sums over a surface, relative to its largest integral or derivative.
ROUNDING = 1e-12
# Errors of triangles go with the square of their size: by doubling a rate, a quarter is left.
RATES, QUARTER = (6, 12, 24), (0.2, 0.3)
# Largest relative error at the finest rate.
FINEST = 5e-3
TURN = np.array([0.3, -0.5, 0.7])
AFFINE = {
    "scaling": (np.eye(3), np.zeros(3)),
    "translation": (np.zeros((3, 3)), TURN),
    "rotation": (np.cross(np.eye(3), TURN).T, np.zeros(3)),
    "shear": (np.array([[0, 0.4, 0], [0, 0, -0.3], [0.2, 0, 0]]), TURN),
}


def affine_change(linear, shift, integrals):
    """Derivatives of volume and moments by an affine motion of everything, a field ``linear x + shift``."""
    volume, first, second = np.split(integrals, [1, 4])
    growth, matrix, (i, j) = np.trace(linear), np.empty((3, 3)), np.transpose(solids.PAIRS)
    matrix[i, j] = matrix[j, i] = second
    change = linear @ matrix + np.outer(shift, first)
    change = change + change.T + growth * matrix
    return np.concatenate([growth * volume, linear @ first + shift * volume + growth * first, change[i, j]])


@pytest.mark.skipif(llvm_problem() is not None, reason="no usable LLVM")
@pytest.mark.parametrize("name", CLOSED)
def test_affine_motions_have_closed_forms_and_triangles_converge(name):
    surface, types = CLOSED[name](), ArrayTypes(sys.modules["drjit.llvm.ad"].Float64)
    affine = [surface.cage.positions @ linear.T + shift for linear, shift in AFFINE.values()]
    others = [motions(surface)[name] for name in ("one point", "all")]

    def assert_affine(derivatives, integrals, motions):
        off = derivatives - [affine_change(*motion, integrals) for motion in motions]
        assert np.abs(off).max() <= ROUNDING * np.abs(integrals).max()

    exact = solids.exact_derivatives(surface, [*affine, *others])
    assert_affine(exact[: len(affine), 1:], solids.of_surface(surface), AFFINE.values())
    # Of triangles by scaling, shear and the others: translations and rotations do not change areas.
    errors, exact, directions = [], exact[[0, 3, 4, 5]], [*affine[::3], *others]
    for rate in RATES:
        values, derivatives = solids.derivatives_of(surface, directions, rate, types)
        errors.append(np.linalg.norm(derivatives - exact, axis=0) / np.linalg.norm(exact, axis=0))
        assert_affine(derivatives[:2, 1:], values[1:], [*AFFINE.values()][::3])
    ratios = np.divide(errors[1:], errors[:-1])
    assert max(errors[-1]) <= FINEST
    assert ratios.min() >= QUARTER[0]
    assert ratios.max() <= QUARTER[1]
