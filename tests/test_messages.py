"""What the command line tells of wrong input: one line, without tracebacks."""

from __future__ import annotations

import pytest
from mitsuba_subdivision.__main__ import main
from mitsuba_subdivision.cage.named_cages import cube

SCENE = """<scene version="3.0.0"><integrator type="direct"/>
    <sensor type="perspective"><film type="hdrfilm"><integer name="width" value="4"/>
        <integer name="height" value="4"/></film></sensor>
    <shape type="subdivision"><string name="filename" value="cube.obj"/>{}</shape>
</scene>"""


@pytest.fixture
def folder(tmp_path, monkeypatch):
    cube().save(tmp_path / "cube.obj")
    monkeypatch.chdir(tmp_path)
    return tmp_path


def test_errors_of_a_shape_in_a_scene_have_no_traceback(folder, capsys):
    (folder / "scene.xml").write_text(SCENE.format('<string name="scheme" value="loop"/>'))
    assert main(["render", "scene.xml", "-o", "picture.exr", "--variant", "scalar_rgb"]) == 1
    told = capsys.readouterr().err
    assert told.startswith("mitsuba-subdivision: error:")
    assert told.endswith("numbers count from 1)\n")
    assert "line 10: face 1 has 4 corners; the scheme loop expects triangles only" in told
    assert told.count("\n") == 1
    assert not (folder / "picture.exr").exists()


def test_a_scene_without_an_integrator_is_told(folder, capsys):
    (folder / "scene.xml").write_text(SCENE.format("").replace('<integrator type="direct"/>', ""))
    assert main(["render", "scene.xml", "-o", "picture.exr", "--variant", "scalar_rgb"]) == 1
    assert capsys.readouterr().err.endswith('error: scene "scene.xml" has no integrator; expected one\n')


def test_warnings_name_no_place_in_the_code(folder, capsys):
    with (folder / "cube.obj").open("a") as file:
        file.write("t unheard 0/0/0\n")
    (folder / "scene.xml").write_text(SCENE.format(""))
    expected = 'mitsuba-subdivision: warning: "{}cube.obj", line 16: tag "unheard 0/0/0" is not supported'
    assert main(["info", "cube.obj"]) == 0
    assert capsys.readouterr().err.startswith(expected.format(""))
    assert main(["render", "scene.xml", "-o", "picture.exr", "--variant", "scalar_rgb", "--spp", "1"]) == 0
    assert 'cube.obj", line 16: tag "unheard 0/0/0" is not supported' in capsys.readouterr().err


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--rate", "fine"], '"fine"; expected an integer'),
        (["--rate", "0"], "0; expected 1 or more"),
        (["--rate", "100000000000"], "expected 1024 or less"),
    ],
)
@pytest.mark.usefixtures("folder")
def test_wrong_rates_are_told(capsys, words, message):
    with pytest.raises(SystemExit):
        main(["info", "cube.obj", *words])
    assert message in capsys.readouterr().err


@pytest.mark.parametrize("suffix", ["ply", "usda"])
@pytest.mark.usefixtures("folder")
def test_saving_into_a_missing_folder_is_told_by_its_name(suffix):
    with pytest.raises(FileNotFoundError, match=f'^"missing/cube.{suffix}": there is no folder "missing"$'):
        cube().save(f"missing/cube.{suffix}")
