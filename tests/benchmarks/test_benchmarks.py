import json
import re
import shutil
import sys
from pathlib import Path

import pytest
from benchmarks.processes import ran
from mitsuba_subdivision.llvm import llvm_problem

HERE = Path(__file__).parent
STAGE = HERE.parent / "data" / "quads.usda"
# They measure with the module resource.
pytestmark = pytest.mark.posix
needs_llvm = pytest.mark.skipif(llvm_problem() is not None, reason=str(llvm_problem()))


def said(*words):
    done = ran([sys.executable, *words])
    assert done.returncode == 0, done.stderr
    return done.stdout


@needs_llvm
def test_benchmarks_run_on_the_smallest_cage(tmp_path):
    written = tmp_path / "found.json"
    words = [HERE, "--cages", "cube", "--rates", "4", "--repeats", "1", "--no-peers", "--variants", "scalar_rgb"]
    assert "cube, rate 4" in said(*words, "--cache", tmp_path, "--json", written)
    (result,) = json.loads(written.read_text())["results"]
    assert [len(laps) for laps in result["compiled"]["laps"].values()] == [2, 2]
    assert {wall > 0 for laps in result["stages"]["laps"].values() for wall, _, _ in laps} == {True}


@pytest.mark.parametrize(
    ("words", "expected"),
    [
        ("first_picture.py --repeats 1 --variants scalar_rgb --rate 2", "star, scalar_rgb"),
        ("samples.py --samples 100 --rate 2 --repeats 2", "times a vertex of the tessellation"),
        pytest.param("steps.py --counts 1 --repeats 1", "1, exact", marks=needs_llvm),
        pytest.param("scenes.py growth --growth 1,2,2 --repeats 1", "compiled: next", marks=needs_llvm),
    ],
)
def test_other_benchmarks_run(words, expected):
    program, *options = words.split()
    printed = said(HERE / program, *options)
    assert expected in printed
    assert "failed" not in printed


@needs_llvm
def test_a_whole_stage_is_measured_without_cycles(tmp_path):
    pytest.importorskip("pxr")
    stage = tmp_path / "quads.usda"
    words = [HERE / "whole_stage.py", stage, "--size", "16", "12", "--spp", "1", "--repeats", "1"]
    done = ran([sys.executable, *words])
    assert done.returncode == 1
    assert "there is no such file; expected a USD stage" in done.stderr
    shutil.copy(STAGE, stage)
    printed = said(*words, "--cycles", sys.executable)
    assert "Cycles: left out" in printed
    (ratios,) = re.findall("exact / vertex: (.*)", printed)
    stages = [re.sub(r" [0-9.]+ \(CPU [0-9.]+\)$", "", ratio) for ratio in ratios.split(", ")]
    assert stages == ["program to picture", "file to picture", "next picture"]
