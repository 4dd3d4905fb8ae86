"""From triangles of a tessellation back to the surface: their corners are its vertices, and inside nothing jumps."""

import drjit as dr
import numpy as np
import pytest
from kernels.surfaces import kernel_named, surface_named, vectors
from mitsuba_subdivision.kernels.locations import TriangleLocations

pytestmark = [pytest.mark.core, pytest.mark.usefixtures("llvm")]

SURFACES = ["torus", "hexagon", "holes", "loop corner", "doo_sabin mixed torus"]
EVERY_SURFACE = pytest.mark.parametrize("name", SURFACES)
# Of a size of about 3; where parameters are rounded, points move along by some units of that.
POINT = 1e-13
CHANGED = 1e-12


def made(name, rate):
    surface = surface_named(name)
    kernel, table = kernel_named(name, "llvm_ad_rgb_double"), surface.sampling(rate)
    return surface, kernel, table, TriangleLocations(table, kernel.walk, kernel.types)


@EVERY_SURFACE
# Even and odd: at odd rates, triangles reach from one corner of a polygon into the next.
@pytest.mark.parametrize("rate", [1, 2, 3, 4])
def test_corners_of_triangles_are_vertices(name, rate):
    surface, kernel, table, locations = made(name, rate)
    types, expected = kernel.types, table.apply(surface.cage.positions)[0]
    count = len(table.triangles)
    triangle = np.repeat(np.arange(count), 3)
    b1, b2 = (np.tile(weights, count).astype(float) for weights in ((0, 1, 0), (0, 0, 1)))
    found = locations(types.indices(triangle), types.floats(b1), types.floats(b2))
    dr.eval(found)
    elements = surface.patches.elements
    np.testing.assert_array_equal(elements.face[np.array(found.half_edge)], table.element[triangle])
    np.testing.assert_allclose(vectors(kernel.at(found).p), expected[table.triangles.ravel()], rtol=0, atol=POINT)


@EVERY_SURFACE
@pytest.mark.parametrize("rate", [2, 5])
def test_triangles_that_share_an_edge_have_its_points_in_common(name, rate, np_rng):
    """Within an element and across: those on either side of a crease have vertices of their own."""
    surface, kernel, table, locations = made(name, rate)
    types, triangles = kernel.types, table.triangles.astype(np.int64)
    edges = {}
    for triangle, corners in enumerate(triangles.tolist()):
        for k in range(3):
            edges[corners[k], corners[(k + 1) % 3]] = triangle, k
    pairs = [(edges[a, b], edges[b, a]) for a, b in edges if a < b and (b, a) in edges]
    along = np_rng.random(len(pairs))
    sides = []
    for number, share in ((0, along), (1, 1 - along)):
        triangle, k = np.array([pair[number] for pair in pairs]).T
        weights = np.zeros((len(pairs), 3))
        weights[np.arange(len(pairs)), k], weights[np.arange(len(pairs)), (k + 1) % 3] = 1 - share, share
        found = locations(types.indices(triangle), types.floats(weights[:, 1]), types.floats(weights[:, 2]))
        dr.eval(found)
        uv = np.array([found.u, found.v])
        assert surface.scheme.domain.inside(uv.T).min() >= 0
        sides.append(vectors(kernel.at(found).p))
    np.testing.assert_allclose(*sides, rtol=0, atol=CHANGED)
