import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from mitsuba_subdivision.device_arrays import upload
from mitsuba_subdivision.kernels.algebra import unit
from mitsuba_subdivision.kernels.array_types import ArrayTypes

ROW_COUNT = 6
# A few units in the last place of single precision.
ROUNDING = 1e-6


@pytest.mark.core
def test_only_zero_has_no_unit_vector(variant_llvm_ad_rgb, np_rng):  # noqa: ARG001
    directions = np_rng.normal(size=(3, 20))
    directions /= np.linalg.norm(directions, axis=0)
    # Squares vanish at one end, and overflow at the other.
    lengths = 10.0 ** np.linspace(-35, 35, 20)
    units = np.array(unit(upload(mi.Vector3f, (directions * lengths).T)))
    np.testing.assert_allclose(units, directions, atol=ROUNDING)
    np.testing.assert_array_equal(np.array(unit(mi.Vector3f(0, -0.0, 0))).ravel(), 0)
    # The inverse of the smallest numbers is infinite.
    for length in (np.inf, 1e-39, 1e-45):
        np.testing.assert_array_equal(np.array(unit(mi.Vector3f(0, length, 0))).ravel(), 0)


# Sizes that packets divide and that they do not.
@pytest.mark.core
@pytest.mark.parametrize("size", [3, 4, 12, 16, 28, 48])
def test_rows_keep_their_places_and_receive_their_derivatives(size, variants_all_ad_rgb, np_rng):  # noqa: ARG001
    types = ArrayTypes(mi.Float)
    rows = np.arange(ROW_COUNT * size, dtype=np.float64).reshape(ROW_COUNT, size) + 1
    buffer = types.floats(rows)
    index, active = np_rng.integers(0, ROW_COUNT, 20), np_rng.random(20) < 0.7
    row = types.row(buffer, size, types.indices(index), upload(mi.Mask, active))
    np.testing.assert_array_equal(np.array(row).T, rows[index] * active[:, None])
    dr.enable_grad(buffer)
    weights = np_rng.integers(1, 5, (size, 20)).astype(np.float32)
    row = types.row(buffer, size, types.indices(index))
    dr.backward(dr.sum(sum(number * upload(mi.Float, weight) for number, weight in zip(row, weights, strict=True))))
    expected = np.zeros((ROW_COUNT, size))
    np.add.at(expected, index, weights.T)
    np.testing.assert_array_equal(np.array(dr.grad(buffer)).reshape(ROW_COUNT, size), expected)
