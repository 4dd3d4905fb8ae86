"""Warnings and messages of cages, and how these name faces and vertices."""

import _thread
import re
import time
import warnings

import numpy as np
import pytest
from mitsuba_subdivision import LimitSurface
from mitsuba_subdivision.cage.errors import CageError, CageSource, CageWarning, in_digits, warn
from mitsuba_subdivision.cage.named_cages import cube
from mitsuba_subdivision.files.formats import warn_of_losses
from reference.refined_cages import tagged


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


def test_numbers_have_all_their_digits():
    """Those just outside a range do not look as if they were within."""
    numbers = [5.0, 3, 1.000000001, np.float32(0.1), np.nan, 1e300, [1.000000001, 0.5], np.array([1, 2])]
    expected = ["5", "3", "1.000000001", "0.1", "nan", "1e+300", "(1.000000001, 0.5)", "(1, 2)"]
    assert [in_digits(number) for number in numbers] == expected
    with pytest.raises(ValueError, match=re.escape("uv of sample 0 is (1.000000001, 0.5); expected parameters in")):
        LimitSurface(cube()).evaluate([0], [[1.000000001, 0.5]])
    with pytest.raises(CageError, match="has sharpness -1e-09; expected 0"):
        tagged(cube(), creases=[(0, 1, -1e-9)])


def test_arrays_are_numbered_from_zero_and_files_name_the_line_and_their_own_numbers():
    array, file = CageSource(), CageSource('"cube.obj"', 1, np.array([2, 3]), np.array([5, 17]))
    assert (array.at_face(4), array.at_vertex(0)) == ("control cage: face 4", "control cage: vertex 0")
    assert (file.at_face(1), file.at_vertex(0)) == ('"cube.obj", line 17: face 2', '"cube.obj", line 2: vertex 1')
    assert (array.edge(3, 7), file.edge(0, 1)) == ("edge (3, 7)", "edge (1, 2)")
    assert (array.faces(np.array([2])), array.faces(np.arange(10))) == ("face 2", "faces 0, 1, 2, 3, 4, 5 and 4 more")
    assert file.faces(np.array([0, 1])) == "faces 1 (line 5), 2 (line 17)"
