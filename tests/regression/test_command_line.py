"""The commands: what they print, write and return."""

import json

import numpy as np
import pytest
from mitsuba_subdivision.__main__ import main
from mitsuba_subdivision.images.exr import write_exr
from mitsuba_subdivision.images.picture import load_picture
from regression.defects import SCENES

SCENE = str(SCENES / "valence3.xml")
SMALL = ["-D", "resolution=16", "--variant", "scalar_rgb"]


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    path = tmp_path_factory.mktemp("pictures")
    small = [*SMALL, "--batch", "16"]
    assert main(["render", SCENE, "-o", str(path / "reference.exr"), "--reference", "--spp", "512", *small]) == 0
    stam = ["-D", "evaluator=stam", "-D", "sample_offset=1e-6"]
    assert main(["render", SCENE, "-o", str(path / "stam.exr"), "--reference", "--spp", "32", *small, *stam]) == 0
    write_exr(path / "plain.exr", load_picture(path / "reference.exr").pixels)
    write_exr(path / "darker.exr", 0.9 * load_picture(path / "reference.exr").pixels)
    write_exr(path / "small.exr", np.ones((8, 8, 3)))
    (path / "text.exr").write_text("no picture")
    return path


def compare(folder, *words):
    return main(["compare", *(str(folder / word) if word.endswith(".exr") else word for word in words)])


def test_a_scene_against_its_reference(folder, capsys):
    assert compare(folder, "reference.exr", SCENE, "--spp", "64") == 0
    lines = capsys.readouterr().out.splitlines()
    assert lines[0].startswith("PASS")
    assert [line.split()[:2] for line in lines[1:4]] == [["probe", "pass"], ["paired", "pass"], ["tile", "pass"]]


def test_another_picture_fails_and_says_where(folder, capsys, tmp_path):
    assert compare(folder, "reference.exr", "stam.exr", "--html", str(tmp_path / "report")) == 2
    said = capsys.readouterr().out
    assert "worst pixel (probe)" in said
    assert "(u, v) = (" in said
    assert (tmp_path / "report" / "index.html").is_file()


def test_json_on_standard_output_or_in_a_file(folder, capsys, tmp_path):
    assert compare(folder, "reference.exr", "reference.exr", "--json", "-") == 0
    printed = json.loads(capsys.readouterr().out)
    compare(folder, "reference.exr", "reference.exr", "--json", str(tmp_path / "found.json"))
    assert json.loads((tmp_path / "found.json").read_text()) == printed
    assert printed["status"] == "pass"


def test_a_warning_has_a_status_of_its_own(folder, tmp_path, monkeypatch):
    from mitsuba_subdivision.regression import environment

    # The scene has changed, and so has the machine: the tile tier cannot tell, at this tolerance.
    monkeypatch.setattr(environment, "_processor", lambda: "another")
    changed = (SCENES / "valence3.xml").read_text().replace('value="0.72, 0.66', 'value="0.7201, 0.66')
    changed = changed.replace("cages/valence3.obj", str(SCENES / "cages/valence3.obj"))
    (tmp_path / "scene.xml").write_text(changed)
    assert compare(folder, "reference.exr", str(tmp_path / "scene.xml"), "--tiers", "paired", "--spp", "32") == 1


def test_any_two_pictures(folder):
    assert compare(folder, "plain.exr", "reference.exr") == 0
    assert compare(folder, "plain.exr", "darker.exr") == 2
    assert compare(folder, "plain.exr", "darker.exr", "--tolerance", "flip_mean=1", "--tolerance", "flip_p95=1") == 0


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["reference.exr", "missing.exr"], "is not a file"),
        (["reference.exr", "text.exr"], "not a readable OpenEXR file"),
        (["reference.exr", "small.exr"], "expected the same size"),
        (["reference.exr", "plain.exr", "--tiers", "probe"], 'tier "probe" cannot run'),
        (["reference.exr", "plain.exr", "--tiers", "probe,x"], 'unknown tier "x"'),
        (["reference.exr", "plain.exr", "--tolerance", "x=1"], 'unknown tolerance "x"'),
        (["plain.exr", SCENE], "does not say how it was rendered"),
        (["reference.exr", "/missing.xml"], "is not a file"),
    ],
)
def test_unusable_input_is_status_3(folder, capsys, words, message):
    assert compare(folder, *words) == 3
    assert message in capsys.readouterr().err


@pytest.mark.parametrize("words", [["compare"], ["compare", "a", "b", "--tolerance", "x"], ["compare", "a", "b", "-z"]])
def test_unusable_options_are_status_3(words, capsys):
    with pytest.raises(SystemExit) as stop:
        main(words)
    assert stop.value.code == 3
    assert "usage:" in capsys.readouterr().err


def test_passes_and_merge_give_what_one_command_gives(tmp_path):
    common = [SCENE, *SMALL, "--spp", "64", "--batch", "8", "--filter", "box"]
    for i in (2, 1, 3):
        assert main(["render", *common, "-o", str(tmp_path / f"{i}.exr"), "--pass", f"{i}/3"]) == 0
    parts = [str(tmp_path / f"{i}.exr") for i in (3, 1, 2)]
    assert main(["merge", *parts, "-o", str(tmp_path / "merged.exr")]) == 0
    assert main(["render", *common, "-o", str(tmp_path / "whole.exr"), "--passes", "3"]) == 0
    assert (tmp_path / "merged.exr").read_bytes() == (tmp_path / "whole.exr").read_bytes()
    assert main(["merge", parts[0], parts[0], "-o", str(tmp_path / "twice.exr")]) == 3


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["-o", "a.png", "--passes", "2"], "ending in .exr"),
        (["-o", "a.exr", "--passes", "2", "--pass", "1/2"], "only one of them"),
        (["-o", "a.exr", "--reference", "--filter", "tent"], 'filter "box"'),
        (["-o", "a.exr", "--passes", "9", "--spp", "8", "--batch", "4"], "2 batches, fewer than 9 passes"),
        (["-o", "a.exr", "--dask", "nonsense://"], "Dask"),
    ],
)
def test_contradicting_options_are_said(words, message, capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert main(["render", SCENE, *SMALL, *words]) == 1
    assert message in capsys.readouterr().err
    assert list(tmp_path.iterdir()) == []
