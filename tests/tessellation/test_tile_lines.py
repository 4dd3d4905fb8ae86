"""Numbers of rows tell apart what differs, however many bits rows have."""

import numpy as np
import pytest
from mitsuba_subdivision.tessellation.tile_lines import ranked


@pytest.mark.parametrize("bits", [(3,), (20, 20), (31, 25, 26, 5), (60, 31, 31), (62, 1, 2)])
def test_rows_of_any_size_are_numbered_in_order(bits, np_rng):
    # Few values of each column, so that there are equal rows, up to the largest.
    few = [np.append(np_rng.integers(0, 1 << size, 5), (1 << size) - 1) for size in bits]
    columns = [np_rng.choice(values, 500) for values in few]
    number, first = ranked(*columns)
    _, expected_first, expected = np.unique(np.stack(columns, axis=1), axis=0, return_index=True, return_inverse=True)
    np.testing.assert_array_equal(number, expected.ravel())
    np.testing.assert_array_equal(first, expected_first)
