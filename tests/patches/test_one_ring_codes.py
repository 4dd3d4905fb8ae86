import numpy as np
import pytest
from mitsuba_subdivision.patches.patch_table import FEW_CODES, row_codes


@pytest.mark.parametrize("count", [1, 7, 500])
@pytest.mark.parametrize("widths", [(3,), (1, 1), (2, 5, 3), (1 << 40, 3, 1 << 20), (300, 1, 300, 300)])
def test_codes_are_equal_and_ordered_as_rows_are(np_rng, widths, count):
    # Few distinct values over wide ranges: rows repeat, and ranges multiply beyond any integer.
    columns = [np_rng.choice(np_rng.integers(-width, width, 4), count) for width in widths]
    rows = np.unique(np.stack(columns, axis=1), axis=0, return_inverse=True)[1].ravel()
    codes = row_codes(columns)
    np.testing.assert_array_equal(np.unique(codes, return_inverse=True)[1].ravel(), rows)


def test_many_codes_of_many_rows_are_numbered_anew(np_rng):
    count = 60_000
    columns = [3 * np_rng.integers(0, 300, count), 7 * np_rng.integers(0, 30, count)]
    assert FEW_CODES < 890 * 200 < 4 * count
    rows = np.unique(np.stack(columns, axis=1), axis=0, return_inverse=True)[1].ravel()
    np.testing.assert_array_equal(row_codes(columns), rows)


def test_no_rows_have_no_codes():
    assert row_codes([np.zeros(0, dtype=np.int64)] * 2).shape == (0,)
