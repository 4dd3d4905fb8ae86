"""The regular basis as polynomials is the scheme's own."""

import numpy as np
import pytest
from evaluation.common import EVERY_SCHEME_OBJECT, inside
from mitsuba_subdivision import SchemeError
from mitsuba_subdivision.evaluation.polynomials import polynomial_basis
from mitsuba_subdivision.schemes import CatmullClark

pytestmark = pytest.mark.core

# Sums of products of some tens of powers below one; second derivatives are up to some tens.
ROUNDING = 2e-14
SECOND = 1e-12
# Of the coefficients of the highest powers, which are at most 2^-6 on the domain.
COEFFICIENT = 2e-13


def derived(basis, uv, order_u, order_v):
    """Values of the basis' derivative: each monomial by the power rule."""
    found = np.ones((len(uv), len(basis.powers)))
    for axis, order in enumerate((order_u, order_v)):
        power, x = basis.powers[:, axis], (uv - basis.centre)[:, axis, None]
        factor = np.prod([power - k for k in range(order)], axis=0)
        found *= factor * x ** np.maximum(power - order, 0)
    return found @ basis.matrix


@EVERY_SCHEME_OBJECT
def test_values_and_derivatives_are_the_schemes(scheme, np_rng):
    basis, uv = polynomial_basis(scheme), inside(scheme, np_rng)
    expected = scheme.regular_basis(uv, 2)
    np.testing.assert_allclose(basis.monomials(uv) @ basis.matrix, expected[0], rtol=0, atol=ROUNDING)
    for orders, of_scheme in zip(((0, 0), (1, 0), (0, 1), (2, 0), (1, 1), (0, 2)), expected, strict=True):
        np.testing.assert_allclose(derived(basis, uv, *orders), of_scheme, rtol=0, atol=SECOND)


@EVERY_SCHEME_OBJECT
def test_the_functions_sum_to_one(scheme):
    """So does the constant's row, the first, and all others sum to zero."""
    basis = polynomial_basis(scheme)
    assert basis.powers[0].tolist() == [0, 0]
    np.testing.assert_allclose(basis.matrix.sum(axis=1), np.arange(len(basis.powers)) == 0, rtol=0, atol=COEFFICIENT)


@EVERY_SCHEME_OBJECT
def test_powers_are_those_of_the_splines_and_each_occurs_once(scheme):
    """Of cubic and quadratic tensor products, and at most 4 in all for the quartic box spline."""
    powers = [tuple(power) for power in polynomial_basis(scheme).powers.tolist()]
    highest = {"catmull_clark": 3, "loop": 4, "doo_sabin": 2}[scheme.name]
    assert len(set(powers)) == len(powers)
    if scheme.name == "loop":
        assert max(a + b for a, b in powers) == highest
    else:
        assert set(powers) == {(a, b) for a in range(highest + 1) for b in range(highest + 1)}


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


def test_a_polynomial_of_another_degree_is_found():
    assert polynomial_basis(Bent(5, False)).powers[:, 0].max() == 5
