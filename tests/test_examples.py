"""Files that come with the package."""

from pathlib import Path

import pytest
from mitsuba_subdivision import ControlCage, example_file


@pytest.mark.parametrize("name", ["cages/rook.obj", "rook.xml", "export_cage.py"])
def test_examples_are_found_from_any_folder(tmp_path, monkeypatch, name):
    monkeypatch.chdir(tmp_path)
    assert Path(example_file(name)).is_absolute()
    assert Path(example_file(name)).is_file()


def test_an_example_is_a_cage_and_a_missing_one_an_error_that_names_the_folders():
    assert len(ControlCage.from_file(example_file("cages/rook.obj")).positions) > 100
    with pytest.raises(FileNotFoundError, match=r'there is no example "rook\.obj", neither in ".*scenes" nor in "'):
        example_file("rook.obj")
