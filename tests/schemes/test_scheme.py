import numpy as np
import pytest
from mitsuba_subdivision.schemes import SchemeError, scheme_named
from mitsuba_subdivision.schemes.scheme import with_rules
from patches.closed_cages import tetrahedron
from reference.exact_samples import mesh_of

pytestmark = pytest.mark.core


def test_a_scheme_with_other_rules_is_a_copy():
    usual = scheme_named("catmull_clark")
    assert with_rules(usual, "uniform", "catmull_clark") is usual
    other = with_rules(usual, "chaikin", "smooth")
    assert (other.crease_method, other.triangle_rule) == ("chaikin", "smooth")
    assert with_rules(other, "chaikin", "smooth") is other


@pytest.mark.parametrize(
    ("scheme", "crease_method", "triangle_rule", "missing"),
    [
        ("doo_sabin", "chaikin", "catmull_clark", 'crease_method "chaikin"'),
        ("doo_sabin", "uniform", "smooth", 'triangle_rule "smooth"'),
        ("loop", "chaikin", "smooth", 'triangle_rule "smooth"'),
    ],
)
def test_unknown_rules_of_a_scheme_are_refused(scheme, crease_method, triangle_rule, missing):
    with pytest.raises(SchemeError, match=f"the scheme {scheme} has no {missing}"):
        with_rules(scheme_named(scheme), crease_method, triangle_rule)


# Back to back: every vertex has valence 2, and edges that cut off a corner have the same ends on both sides.
TWO_TRIANGLES = mesh_of(3, [(0, 1, 2), (2, 1, 0)])


@pytest.mark.parametrize("topology", [tetrahedron().topology, TWO_TRIANGLES], ids=["tetrahedron", "two triangles"])
def test_each_edge_has_two_halves_and_each_triangle_three_inside(topology):
    refined = scheme_named("loop").refine(topology).topology
    assert refined.edge_count == 2 * topology.edge_count + topology.half_edge_count
    np.testing.assert_array_equal(np.bincount(refined.edge), 2)
    np.testing.assert_array_equal(refined.twin[refined.twin], np.arange(refined.half_edge_count))
    np.testing.assert_array_equal(refined.face_vertices[refined.twin], refined.face_vertices[refined.next])
