"""Schemes have the rules of a cage, if they know them."""

import pytest
from mitsuba_subdivision.schemes import SchemeError, scheme_named
from mitsuba_subdivision.schemes.scheme_table import with_rules

pytestmark = pytest.mark.core


def test_a_scheme_with_other_rules_is_a_copy():
    usual = scheme_named("catmull_clark")
    assert with_rules(usual, "uniform", "catmull_clark") is usual
    other = with_rules(usual, "chaikin", "smooth")
    assert (other.crease_method, other.triangle_rule) == ("chaikin", "smooth")
    assert with_rules(other, "chaikin", "smooth") is other
    assert with_rules(usual, "uniform", "catmull_clark") is usual


@pytest.mark.parametrize(
    ("scheme", "crease_method", "triangle_rule", "missing"),
    [
        ("doo_sabin", "chaikin", "catmull_clark", 'crease_method "chaikin"'),
        ("doo_sabin", "uniform", "smooth", 'triangle_rule "smooth"'),
        ("loop", "chaikin", "smooth", 'triangle_rule "smooth"'),
    ],
)
def test_rules_that_a_scheme_does_not_know_are_refused(scheme, crease_method, triangle_rule, missing):
    with pytest.raises(SchemeError, match=f"the scheme {scheme} has no {missing}"):
        with_rules(scheme_named(scheme), crease_method, triangle_rule)
