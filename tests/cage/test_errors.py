"""Warnings of cages."""

import _thread
import time
import warnings

import pytest
from mitsuba_subdivision.cage.errors import CageWarning, warn
from mitsuba_subdivision.files.left_out import warn_of_left_out


def test_warnings_name_the_file_of_the_caller():
    with pytest.warns(CageWarning, match="all of it") as told:
        warn_of_left_out("cage.obj", {"all of it": True})
    assert told[0].filename == __file__


def test_a_thread_without_a_caller_can_warn(monkeypatch):
    # Mitsuba loads the shapes of a scene in such threads.
    told = []
    with warnings.catch_warnings():
        warnings.simplefilter("always")
        monkeypatch.setattr(warnings, "showwarning", lambda message, *_place: told.append(str(message)))
        _thread.start_new_thread(warn, ("odd",))
        end = time.monotonic() + 10
        while not told and time.monotonic() < end:
            time.sleep(0.01)
    assert told == ["odd"]
