from pathlib import Path

import pytest
from mitsuba_subdivision import example_file


def test_examples_are_found_from_any_folder_or_errors_name_the_folders(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for name in ("cages/rook.obj", "rook.xml", "export_cage.py"):
        assert Path(example_file(name)).is_absolute()
        assert Path(example_file(name)).is_file()
    with pytest.raises(FileNotFoundError, match=r'there is no example "rook\.obj", neither in ".*scenes" nor in "'):
        example_file("rook.obj")
