import sys

import numpy as np
import pytest
from gradients.surfaces import ALL
from kernels.surfaces import derivatives_both_ways
from mitsuba_subdivision.kernels.vertex_kernel import VertexKernel, placed
from mitsuba_subdivision.llvm import llvm_problem
from mitsuba_subdivision.tessellation.criterion import Criterion

pytestmark = pytest.mark.skipif(llvm_problem() is not None, reason="no usable LLVM")

# Central differences of two steps, extrapolated: what is left goes with the fourth power of the step, and rounding
# with one over it. Beside the largest derivative.
STEP, DIFFERENCES = 2e-4, 1e-9
# Sums of products in another order, beside the sum of their absolute values.
ROUNDING = 1e-13
# Chord error of adaptive tessellations, in sizes of the surface: rates differ from tile to tile.
CHORD = 0.01
MATRIX = np.array([[1.1, 0.2, -0.3, 4], [0.1, 0.9, 0.25, -5], [-0.2, 0.3, 1.2, 6], [0, 0, 0, 1]])


def table_of(surface, tessellation):
    if tessellation == "uniform":
        return surface.sampling(3)
    chord = CHORD * np.ptp(surface.cage.positions, axis=0).max()
    return surface.adaptive_sampling(Criterion("chord", chord), 16)


def on_host(table, positions, matrix):
    """Positions and normals in NumPy, and placed by a matrix: normals stay outside."""
    p, n = table.apply(positions)
    linear = matrix[:3, :3]
    n = n @ np.linalg.inv(linear)
    return p @ linear.T + matrix[:3, 3], n / np.linalg.norm(n, axis=1, keepdims=True)


def extrapolated(function):
    def central(step):
        return [(a - b) / (2 * step) for a, b in zip(function(step), function(-step), strict=True)]

    return [(4 * b - a) / 3 for a, b in zip(central(2 * STEP), central(STEP), strict=True)]


@pytest.mark.parametrize("mirror", [1, -1])
@pytest.mark.parametrize("tessellation", ["uniform", "adaptive"])
@pytest.mark.parametrize("name", ALL)
def test_forward_reverse_and_differences_agree(name, tessellation, mirror, np_rng):
    arrays = sys.modules["drjit.llvm.ad"]
    surface, start = ALL[name](), MATRIX @ np.diag([mirror, 1, 1, 1])
    table, positions = table_of(surface, tessellation), surface.cage.positions

    def vertices(points, matrix):
        return placed(*VertexKernel(table, arrays.Float64)(points), matrix, arrays.Array3f64)

    # In lengths of edges, which say how soon differences bend.
    edge = np.linalg.norm(np.diff(positions[surface.cage.edges], axis=1), axis=2).min()
    move, turn = edge * np_rng.normal(size=positions.shape), np.vstack([np_rng.normal(size=(3, 4)), np.zeros(4)])
    expected = extrapolated(lambda step: on_host(table, positions + step * move, start + step * turn))
    inputs = arrays.Float64(positions.ravel()), arrays.Matrix4f64(start)
    changes = arrays.Float64(move.ravel()), arrays.Matrix4f64(turn)
    derivatives = derivatives_both_ways(vertices, inputs, changes, np_rng, ROUNDING)
    for derivative, difference in zip(derivatives, expected, strict=True):
        assert np.abs(derivative.reshape(-1, 3) - difference).max() <= DIFFERENCES * np.abs(difference).max()
