"""Warnings and messages of cages."""

import _thread
import re
import time
import warnings

import numpy as np
import pytest
from mitsuba_subdivision import ControlCage, LimitSurface
from mitsuba_subdivision.cage.errors import CageError, CageWarning, in_digits, warn
from mitsuba_subdivision.cage.named_cages import cube
from mitsuba_subdivision.files.losses import warn_of_losses


def test_warnings_name_the_file_of_the_caller():
    with pytest.warns(CageWarning, match="all of it") as record:
        warn_of_losses("cage.obj", {"all of it": True})
    assert record[0].filename == __file__


def test_a_thread_without_a_caller_can_warn(monkeypatch):
    # Mitsuba loads the shapes of a scene in such threads.
    shown = []
    with warnings.catch_warnings():
        warnings.simplefilter("always")
        monkeypatch.setattr(warnings, "showwarning", lambda message, *_place: shown.append(str(message)))
        _thread.start_new_thread(warn, ("odd",))
        end = time.monotonic() + 10
        while not shown and time.monotonic() < end:
            time.sleep(0.01)
    assert shown == ["odd"]


@pytest.mark.parametrize(
    ("numbers", "expected"),
    [
        (5.0, "5"),
        (3, "3"),
        (1.000000001, "1.000000001"),
        (np.float32(0.1), "0.1"),
        (np.nan, "nan"),
        (1e300, "1e+300"),
        ([1.000000001, 0.5], "(1.000000001, 0.5)"),
        (np.array([1, 2]), "(1, 2)"),
    ],
)
def test_numbers_have_all_their_digits(numbers, expected):
    assert in_digits(numbers) == expected


def test_numbers_just_outside_a_range_do_not_look_as_if_within():
    surface = LimitSurface(cube())
    with pytest.raises(ValueError, match=re.escape("uv of sample 0 is (1.000000001, 0.5); expected parameters in")):
        surface.evaluate([0], [[1.000000001, 0.5]])
    with pytest.raises(CageError, match="has sharpness -1e-09; expected 0"):
        ControlCage(cube().positions, cube().face_vertices.reshape(-1, 4), creases=[(0, 1, -1e-9)])
