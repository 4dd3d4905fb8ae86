from functools import partial

import drjit as dr
import numpy as np
import pytest
from kernels.surfaces import derivatives_both_ways
from mitsuba_subdivision.device_arrays import upload
from mitsuba_subdivision.kernels.array_types import ArrayTypes
from mitsuba_subdivision.kernels.linear_maps import ControlValues, SparseMatrix
from scipy import sparse

ROWS, COLUMNS = 40, 12


@pytest.fixture
def weights(np_rng):
    dense = np_rng.random((ROWS, COLUMNS)) * (np_rng.random((ROWS, COLUMNS)) < 0.3)
    dense[:, 0] += 0.1
    return sparse.csr_array(dense / dense.sum(axis=1, keepdims=True))


@pytest.mark.core
@pytest.mark.parametrize("size", [1, 2, 3, 4])
def test_weighted_values_and_derivatives_are_products(float_type, rounding, weights, size, np_rng):
    matrix, (values, change) = SparseMatrix(weights, float_type), np_rng.random((2, COLUMNS, size))
    products = np.array(matrix(upload(float_type, values), size))
    np.testing.assert_allclose(products, (weights @ values).ravel(), rtol=0, atol=rounding)
    inputs, changes = ([upload(float_type, numbers)] for numbers in (values, change))
    (derivative,) = derivatives_both_ways(lambda flat: [matrix(flat, size)], inputs, changes, np_rng, 10 * rounding)
    np.testing.assert_allclose(derivative, (weights @ change).ravel(), rtol=0, atol=rounding)


def made(table, float_type):
    return SparseMatrix(table(), float_type)


def test_looked_up_values_follow_in_place(float_type, rounding, weights, np_rng):
    types = ArrayTypes(float_type)
    first, second = np_rng.random((2, COLUMNS, 3))
    values = ControlValues(types, 3, made, partial(weights.copy)).load(first)
    flat, given = values.flat, upload(float_type, second)
    dr.enable_grad(given)
    assert not dr.grad_enabled(flat)
    values.set(given)
    assert dr.grad_enabled(flat)
    assert values.flat is flat
    row = dr.gather(types.vector3, values.flat, types.index(5))
    np.testing.assert_allclose(np.array(dr.detach(row)).ravel(), (weights @ second)[5], rtol=0, atol=rounding)
    dr.backward(row.x)
    gradient = np.array(dr.grad(given)).reshape(-1, 3)
    np.testing.assert_allclose(gradient, weights.toarray()[5][:, None] * [1, 0, 0], rtol=0, atol=rounding)


def test_equal_values_share_arrays_until_they_are_set(float_type, rounding, weights, np_rng):
    types, values, table = ArrayTypes(float_type), np_rng.random((COLUMNS, 3)), partial(weights.copy)
    first, second = (ControlValues(types, 3, made, table).load(values.copy()) for _ in range(2))
    other = ControlValues(types, 3, made, table).load(values + 1)
    apart = ControlValues(types, 3, made, partial(weights.copy)).load(values)
    kept = np.array(second.flat)
    assert first.flat is not second.flat
    assert first.flat.index == second.flat.index
    assert len({known.flat.index for known in (first, other, apart)}) == 3
    first.set(upload(float_type, 2 * values))
    np.testing.assert_array_equal(second.flat, kept)
    np.testing.assert_allclose(np.array(first.flat), 2 * kept, rtol=0, atol=2 * rounding)
