import numpy as np
import pytest
from mitsuba_subdivision.mesh.connectivity import Topology
from mitsuba_subdivision.patches.patch_table import PatchTable
from mitsuba_subdivision.schemes import scheme_named
from mitsuba_subdivision.schemes.domain import SQUARE, TRIANGLE
from mitsuba_subdivision.tessellation.uniform_grid import UniformGrid
from patches.closed_cages import SURFACES, cage_of

# Odd and even, each more than once: from here on they differ in numbers only.
RATES = range(1, 5)
EVERY_SURFACE = pytest.mark.parametrize(("scheme", "name"), SURFACES)
ROUNDING = 1e-13


@EVERY_SURFACE
def test_sizes_have_their_formulas_and_every_vertex_is_used(scheme, name):
    """From these it follows that the Euler characteristic is that of the cage."""
    patches = PatchTable(cage_of(scheme, name).topology, scheme_named(scheme))
    for rate in RATES:
        grid = UniformGrid(patches.scheme.domain, patches.elements, rate)
        t, half = grid.topology, rate // 2
        inner, triangles = [], []
        for size in t.face_sizes.tolist():
            if scheme == "loop":
                counts = (rate - 1) * (rate - 2) // 2, rate**2
            elif size == 4:
                counts = (rate - 1) ** 2, 2 * rate**2
            elif rate % 2 == 0:
                counts = size * half * (half - 1) + 1, size * 2 * half**2
            else:
                counts = size * half**2 + 1, size * (2 * half**2 + 2 * half + 1)
            inner.append(counts[0])
            triangles.append(counts[1])
        assert grid.vertex_count == t.vertex_count + (rate - 1) * t.edge_count + sum(inner)
        np.testing.assert_array_equal(np.unique(grid.triangles()), np.arange(grid.vertex_count))
        np.testing.assert_array_equal(grid.element(), np.repeat(np.arange(t.face_count), triangles))
        assert len(grid.triangles()) == sum(triangles)
        assert grid.triangles().dtype == grid.element().dtype == np.uint32


@pytest.mark.parametrize("domain", [SQUARE, TRIANGLE], ids=lambda domain: domain.name)
def test_triangles_cover_the_domain_once(domain):
    """Their areas are positive, and add up to that of the domain, as those of a polygon's corner do."""
    for rate in range(1, 7):
        both = UniformGrid(domain, Topology(0, np.empty(0, int), np.empty(0, int)), rate).triangle_parameters()
        # Those of whole elements are cells of the lattice.
        assert np.ptp(both[0], axis=1).max() <= 1 / rate + ROUNDING
        for parameters in filter(len, both):
            areas = np.linalg.det(parameters[:, 1:] - parameters[:, :1]) / 2
            assert (areas > 0).all()
            assert areas.sum() == pytest.approx(domain.area, abs=ROUNDING)
