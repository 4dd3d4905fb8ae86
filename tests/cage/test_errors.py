"""Warnings of cages."""

import _thread
import time
import warnings

import pytest
from mitsuba_subdivision.cage.errors import CageWarning, warn
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
