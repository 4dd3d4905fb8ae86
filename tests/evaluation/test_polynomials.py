"""The regular basis as polynomials is the scheme's own; and in Bernstein form, whose coefficients bound it."""

import numpy as np
import pytest
from evaluation.common import EVERY_SCHEME_OBJECT, inside
from mitsuba_subdivision import SchemeError
from mitsuba_subdivision.evaluation.polynomials import monomial_values, polynomial_basis
from mitsuba_subdivision.schemes import CatmullClark

pytestmark = pytest.mark.core

# Sums of products of some tens of powers below one; in Bernstein form, of numbers up to some units.
ROUNDING, BERNSTEIN = 2e-14, 5e-14


@EVERY_SCHEME_OBJECT
def test_monomials_are_the_schemes_basis_each_once_and_none_too_many(scheme, np_rng):
    """Of cubic and quadratic tensor products, and at most 4 in all for the quartic box spline."""
    basis, uv = polynomial_basis(scheme), inside(scheme, np_rng)
    values = monomial_values(basis.powers, uv - scheme.domain.centre)[0].T @ basis.matrix
    np.testing.assert_allclose(values, scheme.regular_basis(uv, 0)[0], rtol=0, atol=ROUNDING)
    assert basis.powers[0].tolist() == [0, 0]
    powers = [tuple(power) for power in basis.powers.tolist()]
    highest = {"catmull_clark": 3, "loop": 4, "doo_sabin": 2}[scheme.name]
    assert len(set(powers)) == len(powers)
    if scheme.name == "loop":
        assert max(a + b for a, b in powers) == highest
    else:
        assert set(powers) == {(a, b) for a in range(highest + 1) for b in range(highest + 1)}


@EVERY_SCHEME_OBJECT
def test_bernstein_form_and_its_halves_are_the_same_polynomials_and_bound_them(scheme, np_rng):
    form, uv = polynomial_basis(scheme), inside(scheme, np_rng)
    basis, of_controls = form.bernstein, form.of_controls
    (u, v), values = basis.derivatives, basis.values(uv)
    assert values.min() >= 0
    np.testing.assert_allclose(values.sum(axis=1), 1, rtol=0, atol=BERNSTEIN)
    np.testing.assert_array_equal(basis.values(scheme.domain.corners)[:, basis.corners], np.eye(len(basis.corners)))
    operators = (np.eye(len(u)), u, v, u @ u, v @ u, v @ v)
    for operator, expected in zip(operators, scheme.regular_basis(uv, 2), strict=True):
        np.testing.assert_allclose(values @ operator @ of_controls, expected, rtol=0, atol=BERNSTEIN)
    # B-splines and box splines are means of Bernstein polynomials: the patch's hull contains its coefficients.
    assert of_controls.min() >= 0
    for child, halved in zip(scheme.domain.children, basis.halves, strict=True):
        np.testing.assert_allclose(values @ halved, basis.values(child.inverse()(uv)), rtol=0, atol=BERNSTEIN)


class Bent(CatmullClark):
    """Its basis is two polynomials that meet in the middle, or one of too high a degree."""

    def __init__(self, power, half):
        super().__init__()
        self._power, self._half = power, half

    def regular_basis(self, uv, derivatives):
        values = super().regular_basis(uv, derivatives)
        # Nothing for one function is as much for another, so that they still sum to one.
        u = uv[..., 0]
        bump = np.maximum(u - 0.5, 0) ** 3 if self._half else u**self._power
        values[0, :, 0] += bump
        values[0, :, 1] -= bump
        return values


@pytest.mark.parametrize(("power", "half"), [(3, True), (6, False)], ids=["two pieces", "degree 6"])
def test_a_basis_that_is_no_polynomial_is_an_error(power, half):
    with pytest.raises(SchemeError, match=r"catmull_clark: the regular basis is .* from polynomials of degree 5"):
        polynomial_basis(Bent(power, half))


def test_a_polynomial_of_another_degree_has_its_powers():
    assert polynomial_basis(Bent(5, False)).powers[:, 0].max() == 5
