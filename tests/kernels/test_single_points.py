"""Laws of searches and of points, one by one, in double precision."""

from types import SimpleNamespace

import drjit as dr
import numpy as np
import pytest
from kernels.surfaces import kernel_named, surface_named
from mitsuba_subdivision import ControlCage, LimitSurface
from mitsuba_subdivision.cage.named_cages import cube, extraordinary_triangles
from mitsuba_subdivision.kernels import line_intersection
from mitsuba_subdivision.kernels.algebra import AffineMap
from mitsuba_subdivision.kernels.line_intersection import ON_LINE
from mitsuba_subdivision.kernels.locations import TriangleLocations
from mitsuba_subdivision.kernels.vertex_kernel import UnitNormal
from reference.refined_cages import tagged

pytestmark = pytest.mark.core

DOUBLE = "llvm_ad_rgb_double"
# Rounding of sums of some ten numbers of about one.
ROUNDING = 1e-13
# The last of Newton's steps is below 3e-4, and what is left is about its square.
NEWTON = 1e-6
# Central differences: truncation of about the step squared, rounding over the step.
STEP, DIFFERENCES = 1e-5, 1e-8


def vector(values):
    return dr.llvm.ad.Array3f64(*map(float, values))


def place(element, uv, corner):
    return int(element), dr.llvm.ad.Array2f64(*map(float, uv)), int(corner)


def numbers(array):
    return np.array(array).ravel()


def test_rays_from_far_away_hit_as_exactly_as_from_nearby():
    """Their origins and directions are exact, and so is the point of the ray that is nearest to the start."""
    surface, kernel = surface_named("mixed torus"), kernel_named("mixed torus", DOUBLE)
    uv = np.array([0.25, 0.375])
    target = np.round(surface.evaluate([5], uv[None]).p[0] * 1024) / 1024
    d = np.array([1.0, -1.0, 1.0])
    rays = (SimpleNamespace(o=vector(target - t * d), d=vector(d)) for t in (1.0, 2.0**33))
    near, far = (kernel.intersect(ray, *place(5, uv + 0.03, 0)) for ray in rays)
    assert np.isfinite(numbers(near.t)).all()
    np.testing.assert_allclose(numbers(far.p), numbers(near.p), rtol=0, atol=1e-9)


@pytest.mark.parametrize("rounds", [1, 2, 3])
def test_locations_are_where_the_points_lie_however_few_rounds_there_are(monkeypatch, np_rng, rounds):
    """Also where a search ends in the last round that it has."""
    surface, kernel = surface_named("mixed torus"), kernel_named("mixed torus", DOUBLE)
    monkeypatch.setattr(line_intersection, "ROUNDS", rounds)
    hits = 0
    samples = surface.sample(12, 2)
    for k in range(12):
        start = np.clip(samples.uv[k] + np_rng.uniform(-0.1, 0.1, 2), 0.01, 0.49)
        location = kernel.walk.at(int(samples.element[k]), *start.tolist(), int(samples.corner[k]))
        met = kernel.line_hits(vector(samples.p[k]), vector(samples.n[k]), location)
        if numbers(met.kind)[0] == ON_LINE:
            hits += 1
            again = kernel.at(met.location)
            np.testing.assert_allclose(numbers(again.p), numbers(met.values.value), rtol=0, atol=NEWTON)
    assert hits


@pytest.mark.parametrize("turn", range(3))
def test_nearest_points_on_every_side_of_a_triangle(turn):
    """Whichever parameters run along the border, as a triangle may begin at any of its vertices."""
    positions = np.array([[0, 0, 0], [3, 0, 0.5], [1, 2, 0]])
    surface = LimitSurface(ControlCage(positions, np.roll([[0, 1, 2]], turn, axis=1)), "loop")
    kernel = surface.on_device(DOUBLE)
    centre = positions.mean(axis=0)
    for side in range(3):
        outside = 2 * (positions[side] + 0.4 * (positions[side - 1] - positions[side])) - centre
        expected = surface.closest_point(outside[None])
        found = kernel.closest(vector(outside), *place(0, (0.3, 0.3), 0))
        np.testing.assert_allclose(numbers(found.distance)[0], expected.distance[0], rtol=NEWTON)


@pytest.mark.parametrize(("scheme", "cage"), [("catmull_clark", cube()), ("loop", extraordinary_triangles(5))])
def test_locations_are_found_beside_holes(scheme, cage):
    """Faces are whole or holes here: none has corners of its own, and nothing is divided by their number."""
    surface = LimitSurface(tagged(cage, holes=[1]), scheme)
    kernel, table = surface.on_device(DOUBLE), surface.sampling(2)
    locations = TriangleLocations(table, kernel.walk, kernel.types)
    expected = table.apply(surface.cage.positions)[0]
    for triangle in range(0, len(table.triangles), 5):
        found = kernel.at(locations(kernel.types.index(triangle), kernel.types.float(0), kernel.types.float(0)))
        np.testing.assert_allclose(numbers(found.p), expected[table.triangles[triangle, 0]], rtol=0, atol=ROUNDING)


def test_placed_normals_turn_as_the_placed_surface_does(np_rng):
    kernel = kernel_named("mixed torus", DOUBLE)
    matrix = np.eye(4)
    matrix[:3] = np_rng.normal(size=(3, 4))
    to_world = AffineMap.of(dr.llvm.ad.Matrix4f64(matrix.tolist()))
    there_and_back = numbers(to_world.inverse_point(to_world.point(vector((1, 2, 3)))))
    np.testing.assert_allclose(there_and_back, (1, 2, 3), rtol=0, atol=10 * ROUNDING)

    def at(u, v):
        return kernel.evaluate(*place(3, (u, v), 0), derivatives=2).placed(to_world)

    found = at(0.3, 0.2)
    for turn, du, dv in ((found.dn_du, STEP, 0), (found.dn_dv, 0, STEP)):
        ahead, behind = (numbers(at(0.3 + side * du, 0.2 + side * dv).n) for side in (1, -1))
        difference = (ahead - behind) / (2 * STEP)
        np.testing.assert_allclose(numbers(turn), difference, rtol=0, atol=DIFFERENCES * np.abs(difference).max())


@pytest.mark.parametrize("longer", [-2, 0])
def test_parallel_tangents_have_no_normal_and_no_derivatives(longer):
    du = vector((1, 2, 4))
    normal = UnitNormal(du, longer * du, 0, du)
    for found in (normal.value, normal.forward(vector((1, 0, 0)), vector((0, 1, 0))), *normal.backward(du)):
        np.testing.assert_array_equal(np.array(found), 0)
