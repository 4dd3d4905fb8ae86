"""Numbers of pairs tell apart what differs, however many bits pairs have, and each occurs somewhere first."""

import numpy as np
import pytest
from mitsuba_subdivision.tessellation.spans import first_of_each, joined, ranked


@pytest.mark.parametrize(("high_bits", "bits"), [(3, 1), (20, 20), (59, 31), (36, 51), (61, 53)])
def test_pairs_of_any_size_are_numbered_in_order(high_bits, bits, np_rng):
    # Few values of each, so that there are equal pairs, up to the largest.
    few = [np.append(np_rng.integers(0, 1 << size, 5), (1 << size) - 1) for size in (high_bits, bits)]
    pairs = [np_rng.choice(values, 500) for values in few]
    number, first = ranked(joined(*pairs, bits))
    _, expected_first, expected = np.unique(np.stack(pairs, axis=1), axis=0, return_index=True, return_inverse=True)
    np.testing.assert_array_equal(number, expected.ravel())
    np.testing.assert_array_equal(first, expected_first)


@pytest.mark.parametrize("count", [0, 1, 2, 100])
def test_numbers_occur_first_where_numpy_finds_them(count, np_rng):
    number = np_rng.permutation(np.repeat(np.arange(count), 3))
    np.testing.assert_array_equal(first_of_each(number), np.unique(number, return_index=True)[1])
