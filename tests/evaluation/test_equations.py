"""The equations, each summed here term by term as it is printed, against the rows of `equations`."""

import numpy as np
import pytest
from mitsuba_subdivision.evaluation.equations import (
    characteristic_jacobian,
    child_rows,
    limit_rows,
    locate,
    power_rows,
    stabilized_rows,
    stam_rows,
)
from mitsuba_subdivision.evaluation.patch_tree import irregular_patch, isolated_signature
from mitsuba_subdivision.schemes import scheme_named

# Sums of some twenty terms whose size is about one; derivatives and points are divided by their own factors.
ROUNDING = 1e-13
LEVELS = (0, 1, 4, 9)
# A diagonal T: no valence that has a Jordan block.
CASES = [("catmull_clark", 3), ("catmull_clark", 5), ("catmull_clark", 8), ("loop", 5), ("loop", 7), ("doo_sabin", 3)]
EVERY_CASE = pytest.mark.parametrize(("scheme", "valence"), CASES)


def patch_of(name, valence):
    scheme = scheme_named(name)
    return irregular_patch(scheme, isolated_signature(scheme, valence))


def samples_of(scheme):
    """(n, k, (u', v'), (u, v)) of some samples in all three regular children of some levels."""
    inside = scheme.domain.corners.mean(axis=0) + np.array([0.03, -0.05])
    for n in LEVELS:
        for k in (1, 2, 3):
            yield n, k, inside, scheme.domain.children[k].inverse()(inside[None])[0] * 2.0**-n


def rows_of(patch, tables):
    uv = np.array([uv for *_, uv in samples_of(patch.scheme)])
    return child_rows(patch.scheme, uv, tables, 2)


def at_samples(patch, derivative):
    """Of each sample, its level and ``b^T P_k``."""
    for n, k, local, _ in samples_of(patch.scheme):
        b = patch.scheme.regular_basis(local[None], 2)[derivative, 0]
        yield n, b @ patch.children[k - 1]


def sums(patch, first_term, base, derivative):
    """Of each sample, the sum over i of ``(b^T P_k Abar v_i) (lambda_i / base)^n c_i``; c_i are the unit vectors."""
    found, eigenvalues = [], patch.basis.eigenvalues
    for n, row in at_samples(patch, derivative):
        terms = row @ patch.basis.vectors * (eigenvalues / base) ** n
        found.append(np.where(np.arange(len(terms)) < first_term - 1, 0, terms))
    return np.array(found)


def factors(patch, order):
    """``s_k 2^(n + 1)`` for first derivatives, ``4^(n + 1)`` for second ones, one for points."""
    is_turned = patch.scheme.domain.corner_count == 3
    found = [(-1 if is_turned and k == 3 else 1) * 2.0 ** (n + 1) for n, k, *_ in samples_of(patch.scheme)]
    return np.array(found) ** order


ORDERS = [0, 1, 1, 2, 2, 2]


@EVERY_CASE
def test_samples_are_found_in_their_child(scheme, valence):
    domain = patch_of(scheme, valence).scheme.domain
    for n, k, local, uv in samples_of(scheme_named(scheme)):
        level, child, found = locate(domain, uv[None])
        assert (level[0], child[0] + 1) == (n, k)
        np.testing.assert_allclose(found[0], local, rtol=0, atol=ROUNDING)


@EVERY_CASE
def test_equation_4(scheme, valence):
    patch = patch_of(scheme, valence)
    level, rows = rows_of(patch, patch.children)
    found = power_rows(rows, level, patch.matrix)
    for derivative, order in enumerate(ORDERS):
        samples = at_samples(patch, derivative)
        expected = [row @ np.linalg.matrix_power(patch.matrix, n) for n, row in samples]
        scale = factors(patch, order)[:, None]
        np.testing.assert_allclose(found[derivative] / scale, expected, rtol=0, atol=ROUNDING)


@EVERY_CASE
def test_equations_9_and_11(scheme, valence):
    patch = patch_of(scheme, valence)
    level, rows = rows_of(patch, patch.eigen_children)
    found = stam_rows(rows, level, patch.basis)
    for derivative, order in enumerate(ORDERS):
        scale = factors(patch, order)[:, None]
        np.testing.assert_allclose(found[derivative] / scale, sums(patch, 1, 1, derivative), rtol=0, atol=ROUNDING)


@EVERY_CASE
def test_equations_10_and_12(scheme, valence):
    patch = patch_of(scheme, valence)
    level, rows = rows_of(patch, patch.eigen_children)
    found, derivative_scale = stabilized_rows(rows, level, patch.basis)
    lambda_2 = patch.basis.subdominant
    point = lambda_2 ** level[:, None] * sums(patch, 2, lambda_2, 0)
    point[:, 0] = 1
    np.testing.assert_allclose(found[0], point, rtol=0, atol=ROUNDING)
    for derivative, order in list(enumerate(ORDERS))[1:]:
        np.testing.assert_allclose(derivative_scale[order - 1], (2.0**order * lambda_2) ** level, rtol=ROUNDING)
        # What is left of s_k 2^(n + 1) or 4^(n + 1) is s_k 2 or 4.
        scale = (factors(patch, order) / 2.0 ** (order * level))[:, None]
        expected = scale * sums(patch, 2, lambda_2, derivative)
        np.testing.assert_allclose(found[derivative], expected, rtol=0, atol=10 * ROUNDING)


@EVERY_CASE
def test_equation_13(scheme, valence):
    """Point and normal of (10) and (12) tend to it."""
    patch = patch_of(scheme, valence)
    control_points = np.random.default_rng(valence).standard_normal((len(patch.basis.eigenvalues), 3))
    coordinates = patch.basis.inverse @ control_points
    point, first, second = limit_rows(len(coordinates)) @ coordinates
    normal = np.cross(first, second)
    assert characteristic_jacobian(patch.scheme, patch.children, patch.basis.vectors) > 0
    near = patch.rows(np.array([(2.0**-300, 2.0**-300)]), "stabilized", np.float64).rows[:, 0] @ coordinates
    np.testing.assert_allclose(near[0], point, rtol=0, atol=ROUNDING)
    found, expected = (each / np.linalg.norm(each) for each in (np.cross(near[1], near[2]), normal))
    np.testing.assert_allclose(found, expected, rtol=0, atol=100 * ROUNDING)
