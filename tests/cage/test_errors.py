"""Warnings and messages of cages, and how these name faces and vertices."""

import _thread
import re
import time
import warnings

import numpy as np
import pytest
from mitsuba_subdivision import ControlCage, LimitSurface
from mitsuba_subdivision.cage.errors import CageError, CageSource, CageWarning, in_digits, warn
from mitsuba_subdivision.cage.named_cages import cube
from mitsuba_subdivision.files.formats import warn_of_losses


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
    numbers = [5.0, 3, 1.000000001, np.float32(0.1), np.nan, 1e300, [1.000000001, 0.5], np.array([1, 2])]
    expected = ["5", "3", "1.000000001", "0.1", "nan", "1e+300", "(1.000000001, 0.5)", "(1, 2)"]
    assert [in_digits(number) for number in numbers] == expected


def test_numbers_just_outside_a_range_do_not_look_as_if_within():
    surface = LimitSurface(cube())
    with pytest.raises(ValueError, match=re.escape("uv of sample 0 is (1.000000001, 0.5); expected parameters in")):
        surface.evaluate([0], [[1.000000001, 0.5]])
    with pytest.raises(CageError, match="has sharpness -1e-09; expected 0"):
        ControlCage(cube().positions, cube().face_vertices.reshape(-1, 4), creases=[(0, 1, -1e-9)])


def test_arrays_are_numbered_from_zero_and_long_lists_of_faces_are_cut():
    source = CageSource()
    assert source.at_face(4) == "control cage: face 4"
    assert source.at_vertex(0) == "control cage: vertex 0"
    assert source.edge(3, 7) == "edge (3, 7)"
    assert source.faces(np.array([2])) == "face 2"
    assert source.faces(np.arange(10)) == "faces 0, 1, 2, 3, 4, 5 and 4 more"


def test_files_name_the_line_and_their_own_numbers():
    source = CageSource('"cube.obj"', 1, np.array([2, 3]), np.array([5, 17]))
    assert source.at_face(1) == '"cube.obj", line 17: face 2'
    assert source.at_vertex(0) == '"cube.obj", line 2: vertex 1'
    assert source.edge(0, 1) == "edge (1, 2)"
    assert source.faces(np.array([0, 1])) == "faces 1 (line 5), 2 (line 17)"
