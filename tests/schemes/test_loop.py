import numpy as np
import pytest
from mitsuba_subdivision.cage.named_cages import tetrahedron
from mitsuba_subdivision.schemes import scheme_named
from reference.exact_samples import mesh_of

pytestmark = pytest.mark.core

# Back to back: every vertex has valence 2, and edges that cut off a corner have the same ends on both sides.
TWO_TRIANGLES = mesh_of(3, [(0, 1, 2), (2, 1, 0)])


@pytest.mark.parametrize("topology", [tetrahedron().topology, TWO_TRIANGLES], ids=["tetrahedron", "two triangles"])
def test_each_edge_has_two_halves_and_each_triangle_three_inside(topology):
    refined = scheme_named("loop").refine(topology).topology
    assert refined.edge_count == 2 * topology.edge_count + topology.half_edge_count
    np.testing.assert_array_equal(np.bincount(refined.edge), 2)
    np.testing.assert_array_equal(refined.twin[refined.twin], np.arange(refined.half_edge_count))
    np.testing.assert_array_equal(refined.face_vertices[refined.twin], refined.face_vertices[refined.next])
