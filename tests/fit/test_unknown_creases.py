import numpy as np
import pytest
from mitsuba_subdivision import CageError, LimitSurface
from mitsuba_subdivision.cage import named_cages
from mitsuba_subdivision.fit.unknown_creases import UnknownCreases
from patches.closed_cages import bumpy, mixed_torus, triangulated
from reference.refined_cages import tagged

HIGHEST = 3
# Rounding of points of size one.
ROUNDING = 1e-12
# Central differences: step and error. Derivatives are one-sided differences of 1e-6; Chaikin's polynomials are curved.
STEP, DIFFERENCE = 1e-4, 1e-6

CAGES = {
    "cube": (named_cages.cube, None),
    "torus": (lambda: bumpy(mixed_torus()), None),
    "triangles": (lambda: bumpy(triangulated(mixed_torus())), "loop"),
}
EVERY_CAGE = pytest.mark.parametrize("name", CAGES)


def creases(name, method="uniform", count=6):
    """Some edges of a cage as half as many creases, beside a crease whose sharpness is known."""
    make, scheme = CAGES[name]
    cage = make()
    known, *edges = cage.edges[:: max(1, len(cage.edges) // count)][: count + 1]
    cage = tagged(cage, creases=[(*known, 1.5)], crease_method=method)
    return UnknownCreases(cage, edges, np.arange(len(edges)) // 2, HIGHEST, scheme), scheme


@pytest.mark.core
@EVERY_CAGE
@pytest.mark.parametrize("method", ["uniform", "chaikin"])
def test_points_equal_the_refined_tagged_cage(name, method, np_rng):
    unknown, scheme = creases(name, method)
    for sharpness in (np_rng.uniform(0, HIGHEST, len(unknown.initial)), np.arange(len(unknown.initial)) % 4):
        cage = unknown.with_sharpness(sharpness)
        positions = unknown.matrix(sharpness) @ cage.positions
        samples = LimitSurface(unknown.refined.with_positions(positions), scheme).tessellate(2).positions
        for _ in range(HIGHEST):
            cage = cage.refined(scheme)
        np.testing.assert_allclose(positions, cage.positions, rtol=0, atol=ROUNDING)
        np.testing.assert_array_equal(unknown.refined.face_vertices, cage.face_vertices)
        np.testing.assert_allclose(samples, LimitSurface(cage, scheme).tessellate(2).positions, rtol=0, atol=ROUNDING)


@pytest.mark.core
def test_creases_start_at_the_mean_sharpness_of_their_edges_below_the_highest():
    cage = named_cages.cube()
    cage = tagged(cage, creases=[(*edge, s) for edge, s in zip(cage.edges, (0.5, 1, 2.5, 10, 0, 2), strict=False)])
    unknown = UnknownCreases(cage, cage.edges[:6], np.arange(6) // 2, HIGHEST, None)
    np.testing.assert_array_equal(unknown.initial, [0.75, 2.75, 1])


@EVERY_CAGE
@pytest.mark.parametrize("method", ["uniform", "chaikin"])
def test_derivatives_are_differences(name, method, np_rng):
    """Between integers; at integers those of the interval above, at the highest of the one below."""
    unknown, _ = creases(name, method)
    positions = unknown.with_sharpness(unknown.initial).positions
    count = len(unknown.initial)
    inside = np_rng.integers(0, HIGHEST, count) + np_rng.uniform(0.2, 0.8, count)
    at_ends = np.array([0, 1, HIGHEST])[:count]
    for sharpness, at in ((inside, inside), (at_ends, at_ends + np.where(at_ends < HIGHEST, 2, -2) * STEP)):
        for k, derivative in enumerate(unknown.derivatives(sharpness.astype(float), positions)):
            ahead, behind = (unknown.matrix(at + side * STEP * np.eye(count)[k]) @ positions for side in (1, -1))
            expected = (ahead - behind) / (2 * STEP)
            bar = DIFFERENCE if at is sharpness else 10 * STEP * max(1, np.abs(expected).max())
            np.testing.assert_allclose(derivative, expected, rtol=0, atol=bar)


@pytest.mark.parametrize("name", ["cube", "triangles"])
def test_remaining_sharpness_gives_the_same_points(name):
    unknown, scheme = creases(name)
    sharpness = np.linspace(1, HIGHEST, len(unknown.initial))
    cage = unknown.with_sharpness(sharpness)
    left = unknown.after(cage.refinement(scheme))
    np.testing.assert_allclose(left.initial, sharpness - 1, atol=ROUNDING)
    expected = unknown.matrix(sharpness) @ cage.positions
    np.testing.assert_allclose(left.matrix(sharpness - 1) @ cage.refined(scheme).positions, expected, atol=ROUNDING)


def test_invalid_unknown_creases_are_errors():
    cube, one = named_cages.cube(), np.zeros(1, dtype=np.int64)
    with pytest.raises(CageError, match="is no edge of a face"):
        UnknownCreases(cube, [(0, 7)], one, HIGHEST, None)
    with pytest.raises(CageError, match="highest_sharpness is 7; expected 1 to 6"):
        UnknownCreases(cube, [(0, 1)], one, 7, None)
