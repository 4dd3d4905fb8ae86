"""Bernstein form: the same polynomials, with coefficients that bound them."""

import numpy as np
import pytest
from evaluation.common import EVERY_SCHEME_OBJECT, inside
from mitsuba_subdivision.evaluation.polynomials import polynomial_basis, times

pytestmark = pytest.mark.core

# Sums of some tens of products of numbers up to some units.
ROUNDING = 5e-14


@EVERY_SCHEME_OBJECT
def test_functions_are_non_negative_and_sum_to_one(scheme, np_rng):
    values = polynomial_basis(scheme).bernstein.values(inside(scheme, np_rng))
    assert values.min() >= 0
    np.testing.assert_allclose(values.sum(axis=1), 1, rtol=0, atol=ROUNDING)


@EVERY_SCHEME_OBJECT
def test_patches_are_the_schemes_and_weights_of_coefficients_non_negative(scheme, np_rng):
    form, uv = polynomial_basis(scheme), inside(scheme, np_rng)
    expected = scheme.regular_basis(uv, 2)
    own, (u, v) = form.of_controls, form.bernstein.derivatives
    for product, wanted in zip((own, u @ own, v @ own, u @ u @ own, v @ u @ own, v @ v @ own), expected, strict=True):
        np.testing.assert_allclose(form.bernstein.values(uv) @ product, wanted, rtol=0, atol=ROUNDING)
    # B-splines and box splines are means of Bernstein polynomials: the patch's hull contains its coefficients.
    assert own.min() >= 0


@EVERY_SCHEME_OBJECT
def test_halves_are_the_same_polynomials_over_copies_of_the_domain(scheme, np_rng):
    basis = polynomial_basis(scheme).bernstein
    coefficients = np_rng.normal(size=(len(basis.indices), 3))
    uv = inside(scheme, np_rng)
    for child, halved in zip(scheme.domain.children, basis.halves, strict=True):
        found = basis.values(uv) @ (halved @ coefficients)
        np.testing.assert_allclose(found, basis.values(child.inverse()(uv)) @ coefficients, rtol=0, atol=ROUNDING)


@EVERY_SCHEME_OBJECT
def test_coefficients_at_corners_are_values(scheme):
    basis = polynomial_basis(scheme).bernstein
    np.testing.assert_array_equal(basis.values(scheme.domain.corners)[:, basis.corners], np.eye(len(basis.corners)))


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
@pytest.mark.parametrize("count", [0, 1, 7, 100])
def test_products_do_not_depend_on_the_blocks_they_are_made_in(dtype, count, np_rng, monkeypatch):
    rows, points = np_rng.normal(size=(5, 9)).astype(dtype), np_rng.normal(size=(9, 3, count)).astype(dtype)
    expected = np.einsum("rb,bxn->rxn", rows, points)
    for most in (1, rows.size * 10, 1 << 18):
        monkeypatch.setattr("mitsuba_subdivision.evaluation.equations.MOST_MULTIPLICATIONS", most)
        found = times(rows, points)
        assert found.dtype == dtype
        # Sums of nine products.
        np.testing.assert_allclose(found, expected, rtol=0, atol=100 * np.finfo(dtype).eps)
