"""Numbers that change from step to step."""

import numpy as np
import pytest
from mitsuba_subdivision.fit import Schedule


def test_one_number_stays():
    schedule = Schedule.of(0.5, "rate")
    assert [schedule(step) for step in (0, 7)] == [0.5, 0.5]


@pytest.mark.core
def test_positive_numbers_lie_on_an_exponential():
    """So that a rate falls by the same factor at every step."""
    schedule = Schedule.of([(10, 1.0), (20, 1e-2)], "rate")
    np.testing.assert_allclose([schedule(step) for step in (0, 10, 15, 20, 30)], [1, 1, 0.1, 1e-2, 1e-2])


def test_numbers_with_zero_lie_on_a_line():
    np.testing.assert_allclose(
        [Schedule.of([(0, 1.0), (4, 0)], "weight")(step) for step in range(5)], [1, 0.75, 0.5, 0.25, 0]
    )


def test_a_function_is_asked():
    assert Schedule.of(lambda step: step**2, "rate")(3) == 9


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ("fast", "rate is 'fast'; expected a number"),
        ([], "expected a number, pairs"),
        ([(0, np.nan)], "expected a number, pairs"),
        ([(5, 1.0), (5, 2.0)], r"rate has the steps \[5.0, 5.0\]; expected increasing ones"),
    ],
)
def test_what_is_no_schedule_is_refused(given, message):
    with pytest.raises(ValueError, match=message):
        Schedule.of(given, "rate")
