"""Unit vectors have a length of one, whatever the lengths of the vectors; there is none along zero."""

import mitsuba as mi
import numpy as np
import pytest
from mitsuba_subdivision.device_arrays import upload
from mitsuba_subdivision.kernels.algebra import unit

# A few units in the last place of single precision.
ROUNDING = 1e-6


@pytest.mark.core
def test_only_zero_has_no_unit_vector(variant_llvm_ad_rgb, np_rng):  # noqa: ARG001
    directions = np_rng.normal(size=(3, 20))
    directions /= np.linalg.norm(directions, axis=0)
    # Squares vanish at one end, and overflow at the other.
    lengths = 10.0 ** np.linspace(-35, 35, 20)
    found = np.array(unit(upload(mi.Vector3f, (directions * lengths).T)))
    np.testing.assert_allclose(found, directions, atol=ROUNDING)
    np.testing.assert_array_equal(np.array(unit(mi.Vector3f(0, -0.0, 0))).ravel(), 0)
    # The inverse of the smallest numbers is infinite.
    for length in (np.inf, 1e-39, 1e-45):
        np.testing.assert_array_equal(np.array(unit(mi.Vector3f(0, length, 0))).ravel(), 0)
