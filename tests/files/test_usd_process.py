"""USD files read in a process of their own."""

from pathlib import Path

import numpy as np
import pytest
from fuzz.seed_files import seed_files
from mitsuba_subdivision.cage import CageError, CageWarning, ControlCage
from mitsuba_subdivision.cage.named_cages import cube
from mitsuba_subdivision.files import usd_process
from mitsuba_subdivision.files.usd_process import ENVIRONMENT_VARIABLE
from mitsuba_subdivision.files.usd_reader import read_usd

pytest.importorskip("pxr")
# Seconds, more than a process takes to start on a busy machine.
PATIENT = "100"


@pytest.fixture
def file(tmp_path):
    cube().save(tmp_path / "cube.usda")
    return tmp_path / "cube.usda"


@pytest.fixture
def library(tmp_path, monkeypatch):
    """Put some lines in place of the USD library, for new processes."""

    def put(lines):
        (tmp_path / "pxr").mkdir()
        (tmp_path / "pxr" / "__init__.py").write_text(lines)
        monkeypatch.syspath_prepend(tmp_path)
        monkeypatch.setenv(ENVIRONMENT_VARIABLE, PATIENT)

    return put


def test_contents_and_warnings_are_the_same(tmp_path, monkeypatch):
    path = tmp_path / "cage.usda"
    path.write_bytes(seed_files("usd")[0][1] + b'def Mesh "empty" {}\n')
    results = []
    for seconds in ("", PATIENT):
        monkeypatch.setenv(ENVIRONMENT_VARIABLE, seconds)
        with pytest.warns(CageWarning) as record:
            found = vars(read_usd(path, "/World", None, {"boundary": "none"})).copy()
        found["source"] = found["source"].name
        attributes = {"texcoords": found.pop("texcoords"), **found.pop("attributes")}
        results.append((found, attributes, [str(each.message) for each in record]))
    (expected, expected_attributes, expected_warnings), (found, attributes, warnings) = results
    assert warnings == expected_warnings
    assert found.keys() == expected.keys()
    assert found["rules"] == {"triangle_rule": "catmull_clark", "face_varying": "all"}
    assert found["scheme"] == "catmull_clark"
    for name, value in expected.items():
        np.testing.assert_array_equal(found[name], value)
    assert list(attributes) == list(expected_attributes) == ["texcoords", "displayColor", "pair"]
    for name, value in expected_attributes.items():
        assert attributes[name].interpolation == value.interpolation
        np.testing.assert_array_equal(attributes[name].values, value.values)
        np.testing.assert_array_equal(attributes[name].indices, value.indices)


def test_errors_are_the_same(tmp_path, monkeypatch):
    monkeypatch.setenv(ENVIRONMENT_VARIABLE, PATIENT)
    (tmp_path / "bad.usda").write_text("#usda 1.0\ndef Mesh {\n")
    with pytest.raises(CageError, match=r'^".*bad.usda", line 2: .*; expected a USD file'):
        ControlCage.from_file(tmp_path / "bad.usda")
    with pytest.raises(FileNotFoundError, match=r"missing\.usda"):
        ControlCage.from_file(tmp_path / "missing.usda")


def test_nothing_is_imported_from_the_working_folder(file, monkeypatch):
    for module in ("json", "numpy", "pxr"):
        (file.parent / f"{module}.py").write_text("import os\nos._exit(7)\n")
    monkeypatch.chdir(file.parent)
    monkeypatch.setenv(ENVIRONMENT_VARIABLE, PATIENT)
    assert ControlCage.from_file("cube.usda", time=np.float32(1)).face_count == 6


def test_a_crash_is_an_error(file, library):
    library("import os\nos.abort()\n")
    with pytest.raises(CageError, match=r'cube.usda": the process that read the file crashed \(SIGABRT\); expected'):
        ControlCage.from_file(file)


def test_a_process_without_an_answer_is_an_error(file, library):
    library("import os\nos.write(1, b'PK nonsense')\nos._exit(0)\n")
    with pytest.raises(CageError, match=r'cube.usda": the process that read the file gave no answer'):
        ControlCage.from_file(file)


def test_an_answer_cannot_run_anything(file, library, tmp_path):
    """A damaged file may take over the process that reads it, and answer with an object that acts when it is loaded."""
    library(
        "import io, os, numpy\n"
        "class Trap:\n"
        "    def __reduce__(self):\n"
        f"        return os.mkdir, ({str(tmp_path / 'trapped')!r},)\n"
        "content = io.BytesIO()\n"
        "numpy.savez(content, text=numpy.array([Trap()], dtype=object))\n"
        # One of these is the answer's.
        "for file in range(3, 20):\n"
        "    try:\n"
        "        os.write(file, content.getvalue())\n"
        "    except OSError:\n"
        "        pass\n"
        "os._exit(0)\n"
    )
    with pytest.raises(CageError, match=r'cube.usda": the process that read the file gave no answer'):
        ControlCage.from_file(file)
    assert not (tmp_path / "trapped").exists()


def test_reading_for_too_long_is_an_error(file, library, monkeypatch):
    library("import time\ntime.sleep(1000)\n")
    monkeypatch.setenv(ENVIRONMENT_VARIABLE, "0.5")
    with pytest.raises(
        CageError, match=f'cube.usda": reading takes longer than 0.5 s, the limit that {ENVIRONMENT_VARIABLE}'
    ):
        ControlCage.from_file(file)


def test_memory_is_limited(file, library, tmp_path):
    pytest.importorskip("resource")
    library(
        "import resource\n"
        f"with open({str(tmp_path / 'limit')!r}, 'w') as file:\n"
        "    file.write(str(resource.getrlimit(resource.RLIMIT_DATA)[0]))\n"
        "bytearray(1 << 40)\n"
    )
    with pytest.raises(CageError, match=r'cube.usda": .*the process that read the file ended with the exit code 1'):
        ControlCage.from_file(file)
    limit = int((tmp_path / "limit").read_text())
    assert 1 << 30 < limit < 1 << 36
    if Path("/proc/self/statm").exists():
        # Beyond what the process has already.
        assert limit > usd_process._LEAST_MEMORY + usd_process._MEMORY_PER_BYTE * file.stat().st_size


@pytest.mark.parametrize("seconds", ["yes", "0", "-1", "nan", "inf"])
def test_other_values_of_the_variable_are_errors(file, monkeypatch, seconds):
    monkeypatch.setenv(ENVIRONMENT_VARIABLE, seconds)
    with pytest.raises(CageError, match=f'variable {ENVIRONMENT_VARIABLE} is "{seconds}"; expected a positive number'):
        ControlCage.from_file(file)
