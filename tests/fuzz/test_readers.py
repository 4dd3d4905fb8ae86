"""Some thousand damaged files, each read as any user's file is; `python tests/fuzz` reads more."""

import os
import time

import pytest
from fuzz import campaign
from fuzz.campaign import run
from fuzz.seed_files import seed_files
from mitsuba_subdivision.cage import CageError, ControlCage, without_warnings

# About two seconds each.
COUNTS = {"obj": 2000, "ply": 2000, "usd": 300}
PACKAGES = {"ply": "plyfile", "usd": "pxr"}


@pytest.fixture(params=COUNTS)
def reader(request):
    if request.param in PACKAGES:
        pytest.importorskip(PACKAGES[request.param])
    return request.param


def test_damaged_files_are_cages_or_errors_that_name_them(reader, tmp_path):
    assert run(reader, 0, COUNTS[reader], 0, 1, tmp_path) == {}


def test_valid_files_and_some_damaged_ones_are_cages(reader, tmp_path):
    def is_cage(name, suffix, content):
        path = tmp_path / f"{name}{suffix}"
        path.write_bytes(content)
        with without_warnings():
            try:
                return bool(ControlCage.from_file(path, **campaign.OPTIONS[reader]))
            except CageError:
                return False

    assert all(is_cage(f"seed{number}", *seed) for number, seed in enumerate(seed_files(reader)))
    damaged = [campaign.damaged_file(reader, 0, number) for number in range(100)]
    assert 0.05 < sum(is_cage(number, *file) for number, file in enumerate(damaged)) / len(damaged) < 0.95


def test_hangs_and_crashes_are_found_and_the_rest_is_read(tmp_path, monkeypatch):
    monkeypatch.setattr(campaign, "PATIENCE_ON_CLOCK", 20.0)
    problems = run("obj", 0, 6, 0, 1, tmp_path, _hang_and_crash)
    assert problems == {"hang of more than .. s": 1, "crash, exit code ..": 1, "odd": 1}
    assert len(list(tmp_path.glob("obj_0_[124].obj"))) == 3


def _hang_and_crash(_folder, _reader, _seed, index):
    if index == 1:
        time.sleep(60)
    if index == 2:
        os._exit(3)
    return "odd" if index == 4 else None
