from itertools import pairwise

import numpy as np
import pytest
from mitsuba_subdivision.mesh import ragged


@pytest.mark.parametrize("lengths", [[3, 0, 2], [0, 0], [], [1], [0, 5, 0, 0, 1, 7]], ids=str)
def test_ragged_arrays_are_the_rows_one_after_the_other(lengths):
    rows = [[10 * row + place for place in range(length)] for row, length in enumerate(lengths)]
    flat = [entry for row in rows for entry in row]
    counts = np.array(lengths, dtype=np.int32)
    offsets = ragged.offsets(counts)
    assert [flat[begin:end] for begin, end in pairwise(offsets)] == rows
    np.testing.assert_array_equal(ragged.starts(counts), offsets[:-1])
    np.testing.assert_array_equal(ragged.index_in_row(counts), [place for row in rows for place in range(len(row))])
    np.testing.assert_array_equal(ragged.ranges(10 * np.arange(len(rows)), counts), flat)


def test_offsets_have_the_requested_type():
    assert ragged.offsets([1, 2]).dtype == np.int64
    assert ragged.offsets(np.array([1, 2]), np.int32).dtype == np.int32
    # One number with stride 0, as the sizes of faces that are all alike.
    np.testing.assert_array_equal(ragged.offsets(np.broadcast_to(np.int64(4), 3), np.int32), [0, 4, 8, 12])


@pytest.mark.parametrize("lengths", [[], [5], [1] * 10, [3, 0, 9, 2, 2, 0, 0, 4]])
def test_runs_cover_all_rows_in_order_within_the_limit_or_one_row(lengths):
    runs = ragged.runs_of(lengths, 4)
    assert [index for run in runs for index in range(*run.indices(len(lengths)))] == list(range(len(lengths)))
    for run in runs:
        assert lengths[run]
        assert sum(lengths[run]) - lengths[run][0] < 4
