"""Numbers that change from step to step."""

import numpy as np
import pytest
from mitsuba_subdivision.fit import Schedule


@pytest.mark.core
@pytest.mark.parametrize(
    ("given", "numbers"),
    [
        (0.5, {0: 0.5, 7: 0.5}),
        # A rate falls by the same factor at every step.
        ([(10, 1.0), (20, 1e-2)], {0: 1, 10: 1, 15: 0.1, 20: 1e-2, 30: 1e-2}),
        # With zero, on a line.
        ([(0, 1.0), (4, 0)], {0: 1, 1: 0.75, 2: 0.5, 3: 0.25, 4: 0}),
        (lambda step: step**2, {3: 9}),
    ],
)
def test_a_schedule_has_these_numbers(given, numbers):
    found = [Schedule.of(given, "rate")(step) for step in numbers]
    np.testing.assert_allclose(found, list(numbers.values()), rtol=1e-15)


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
