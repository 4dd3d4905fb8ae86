"""The order of tiles along Morton's curve."""

import numpy as np
from mitsuba_subdivision.tessellation.tile_choice import _interleaved


def test_bits_with_zeros_between_them_are_binary_digits_read_in_base_four(np_rng):
    values = np.append(np_rng.integers(1 << 26, size=200), [0, 1, (1 << 26) - 1])
    assert _interleaved(values).tolist() == [int(f"{value:b}", 4) for value in values.tolist()]
