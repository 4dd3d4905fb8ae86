"""The benchmarks run; what they measure is for people to read, not for tests."""

import json
import re
import subprocess
import sys
from pathlib import Path

import pytest
from benchmarks.peers import time_peer
from benchmarks.whole_stage import without_materials
from mitsuba_subdivision.llvm import llvm_problem

HERE = Path(__file__).parent
# They measure with the module resource.
pytestmark = pytest.mark.posix


def test_benchmarks_of_the_smallest_cage_run(tmp_path):
    if problem := llvm_problem():
        pytest.skip(problem)
    written = tmp_path / "found.json"
    words = [sys.executable, HERE, "--cages", "cube", "--rates", "4", "--repeats", "1", "--no-peers", "--variants"]
    words += ["scalar_rgb", "--cache", tmp_path, "--json", written]
    done = subprocess.run([str(word) for word in words], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert "cube, rate 4" in done.stdout
    (result,) = json.loads(written.read_text())["results"]
    assert result["total"]["warm"]["total"] > 0
    assert set(result["stages"]["warm"]) == set(result["stages"]["cold"])


def test_the_first_picture_is_measured():
    words = [sys.executable, HERE / "first_picture.py", "--repeats", "1", "--variants", "scalar_rgb", "--rate", "2"]
    done = subprocess.run([str(word) for word in words], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert "star, scalar_rgb" in done.stdout


def test_samples_are_measured():
    words = [sys.executable, HERE / "samples.py", "--samples", "100", "--rate", "2", "--repeats", "2"]
    done = subprocess.run([str(word) for word in words], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert "times a vertex of the tessellation" in done.stdout


def test_scenes_are_measured_in_both_shadings():
    if problem := llvm_problem():
        pytest.skip(problem)
    words = [sys.executable, HERE / "scenes.py", "growth", "--growth", "1,2,2", "--repeats", "1"]
    done = subprocess.run([str(word) for word in words], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert "failed" not in done.stdout
    assert "compiled: next" in done.stdout


STAGE = """#usda 1.0
def Mesh "quads" {
    int[] faceVertexCounts = [4, 4]
    int[] faceVertexIndices = [0, 1, 4, 3, 1, 2, 5, 4]
    point3f[] points = [(0, 0, 0), (1, 0, 0), (2, 0, 1), (0, 1, 0), (1, 1, 0), (2, 1, 1)]
}
"""


def test_a_stage_without_materials_has_all_else(tmp_path):
    usd = pytest.importorskip("pxr.Usd")
    path = tmp_path / "quads.usda"
    binding = '(prepend apiSchemas = ["MaterialBindingAPI"]) {\n    rel material:binding = </red>'
    text = STAGE.replace("#usda 1.0", '#usda 1.0\n(\n    upAxis = "Z"\n)\ndef Material "red" {\n}')
    path.write_text(text.replace('"quads" {', f'"quads" {binding}'))
    given = usd.Stage.Open(str(path))
    found = usd.Stage.Open(str(without_materials(path, tmp_path / "grey.usda")))
    assert [each.GetName() for each in given.Traverse()] == ["red", "quads"]
    assert [each.GetName() for each in found.Traverse()] == ["quads"]
    bindings = [
        each.GetPrimAtPath("/quads").GetRelationship("material:binding").GetTargets() for each in (given, found)
    ]
    assert [len(each) for each in bindings] == [1, 0]
    assert found.GetMetadata("upAxis") == given.GetMetadata("upAxis") == "Z"
    points = [each.GetPrimAtPath("/quads").GetAttribute("points").Get() for each in (given, found)]
    assert points[0] == points[1]


def test_a_whole_stage_is_measured_without_cycles(tmp_path):
    if problem := llvm_problem():
        pytest.skip(problem)
    pytest.importorskip("pxr")
    stage = tmp_path / "quads.usda"
    words = [sys.executable, HERE / "whole_stage.py", stage, "--size", "16", "12", "--spp", "1", "--repeats", "1"]
    command = [str(word) for word in words]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 1
    assert "there is no such file; expected a USD stage" in done.stderr
    stage.write_text(STAGE)
    done = subprocess.run([*command, "--cycles", sys.executable], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert "Cycles: left out" in done.stdout
    (ratios,) = re.findall("exact / vertex: (.*)", done.stdout)
    stages = [re.sub(r" [0-9.]+ \(CPU [0-9.]+\)$", "", each) for each in ratios.split(", ")]
    assert stages == ["program to picture", "file to picture", "next picture"]


@pytest.mark.parametrize(
    ("program", "reason"),
    [("kill -9 $$", "ended by SIGKILL"), ("echo no cage >&2; exit 3", "no cage"), ("exit 3", "exit status 3")],
)
def test_a_peer_that_fails_says_why(program, reason):
    assert time_peer(["sh", "-c", program], "cage.bin", 8, 1, "shared") == {"failed": reason}
