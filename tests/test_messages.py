"""What the command line tells of wrong input: one line, without tracebacks."""

import dataclasses
import errno
import os
import re
import subprocess
import sys

import mitsuba as mi
import numpy as np
import pytest
from mitsuba_subdivision.__main__ import main
from mitsuba_subdivision.cage.named_cages import cube
from mitsuba_subdivision.messages import print_error
from mitsuba_subdivision.regression.image import write_exr

SCENE = """<scene version="3.0.0"><integrator type="direct"/>
    <sensor type="perspective"><film type="hdrfilm"><integer name="width" value="4"/>
        <integer name="height" value="4"/></film></sensor>
    <shape type="subdivision"><string name="filename" value="cube.obj"/></shape>
</scene>"""
LOOP = SCENE.replace("</shape>", '<string name="scheme" value="loop"/></shape>')
BARE = SCENE.replace('<integrator type="direct"/>', "")
RENDER = ["render", "scene.xml", "-o", "picture.exr"]


@pytest.fixture
def folder(tmp_path, monkeypatch):
    cube().save(tmp_path / "cube.obj")
    (tmp_path / "scene.xml").write_text(SCENE)
    monkeypatch.chdir(tmp_path)
    return tmp_path


def render(*more):
    return main([*RENDER, "--variant", "scalar_rgb", *more])


@pytest.mark.parametrize(
    ("scene", "message"),
    [
        (LOOP, r".*line 10: face 1 has 4 corners; the scheme loop expects triangles only.*numbers count from 1\)"),
        (BARE, 'scene "scene.xml" has no integrator; expected one'),
    ],
    ids=["triangles expected", "no integrator"],
)
def test_errors_in_a_scene_are_one_line_without_a_traceback(folder, capsys, scene, message):
    (folder / "scene.xml").write_text(scene)
    assert render() == 1
    assert re.fullmatch(f"mitsuba-subdivision: error: {message}\n", capsys.readouterr().err)
    assert not (folder / "picture.exr").exists()


def test_warnings_name_no_place_in_the_code(folder, capsys):
    with (folder / "cube.obj").open("a") as file:
        file.write("t unheard 0/0/0\n")
    expected = 'cube.obj", line 16: tag "unheard 0/0/0" is not supported'
    assert main(["info", "cube.obj"]) == 0
    assert capsys.readouterr().err.startswith(f'mitsuba-subdivision: warning: "{expected}')
    assert render("--spp", "1") == 0
    assert expected in capsys.readouterr().err


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["info", "cube.obj", "--rate", "fine"], '"fine"; expected an integer'),
        (["info", "cube.obj", "--rate", "0"], "0; expected 1 or more"),
        (["info", "cube.obj", "--rate", "100000000000"], "expected 1024 or less"),
        (["figure", "domains", "--width", "8cm"], '"8cm"; expected a width from 84mm to 1200mm, or in inches'),
        (["figure", "domains", "--width", "3.3in"], '"3.3in"; expected a width from 84mm'),
    ],
)
@pytest.mark.usefixtures("folder")
def test_wrong_numbers_are_told(capsys, words, message):
    with pytest.raises(SystemExit):
        main(words)
    assert message in capsys.readouterr().err


@pytest.mark.parametrize("suffix", ["ply", "usda"])
@pytest.mark.usefixtures("folder")
def test_saving_into_a_missing_folder_is_told_by_its_name(suffix):
    with pytest.raises(FileNotFoundError, match=f'^"missing/cube.{suffix}": there is no folder "missing"$'):
        cube().save(f"missing/cube.{suffix}")


NEEDS_PASSES = "--batch is for passes; expected --pass, --passes, --dask or --reference beside it"


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ([*RENDER, "--batch", "4"], NEEDS_PASSES),
        ([*RENDER, "--tolerance", "alpha=0.1"], "--tolerance is stored with a reference; expected --reference"),
        ([*RENDER, "--filter", "foo"], 'Plugin "foo" not found'),
        (["render", "scene.xml", "-o", "picture.tif"], "expected a name ending in one of .exr, .png, .jpg, .hdr"),
        (["render", "missing.xml", "-o", "new/picture.exr"], 'scene "missing.xml" is not a file'),
        (["figure", "domains", "--format", "exr"], 'the figure "domains" is not drawn as exr; expected png or pdf'),
        (["figure", "creases", "--scheme", "loop"], 'on the figure "creases"; expected one of "domains", "artifact"'),
        (["figure", "hero", "--cage", "cube.obj"], '"hero"; expected one of "subdivision", "artifact", "error"'),
        (["figure", "domains", "--spp", "2"], '--spp has no effect on the figure "domains"'),
        (["tessellate", "cube.obj", "-o", "./cube.obj"], 'output "cube.obj" is an input as well'),
        (["tessellate", "cube.obj", "-o", "cube.obj/a.ply"], '"cube.obj" is a file; expected a folder'),
        (["figure", "domains", "-o", "cube.obj"], '"cube.obj" is a file; expected a folder'),
    ],
)
def test_what_does_nothing_or_harm_is_refused(folder, capsys, words, message):
    before = sorted(folder.iterdir())
    assert main([*words, *(["--variant", "scalar_rgb"] if words[0] == "render" else [])]) == 1
    told = capsys.readouterr().err
    assert message in told
    assert "Traceback" not in told
    assert sorted(folder.iterdir()) == before


@pytest.mark.usefixtures("folder")
def test_a_variant_that_does_not_run_is_one_line(capsys, monkeypatch):
    monkeypatch.setattr("drjit.has_backend", lambda _: False)
    assert main([*RENDER, "--variant", "cuda_ad_rgb"]) == 1
    expected = "mitsuba-subdivision: error: variant cuda_ad_rgb needs an NVIDIA GPU, and Dr.Jit finds none\n"
    assert capsys.readouterr().err == expected


def test_no_render_begins_for_an_output_that_cannot_be(folder, capsys, monkeypatch):
    (folder / "a.exr").mkdir()
    monkeypatch.setattr(mi, "render", lambda *_, **__: pytest.fail("rendered"))
    for output, message in (
        ("a.exr", 'output "a.exr" is a folder; expected a file'),
        ("cube.obj/b.exr", '"cube.obj" is a file; expected a folder'),
        ("/proc/b.exr", 'output "/proc/b.exr": '),
    ):
        for more in ([], ["--passes", "2"]):
            assert render("-o", output, *more) == 1
            assert message in capsys.readouterr().err


@pytest.mark.parametrize("more", [[], ["--passes", "2"]])
def test_a_picture_of_the_scene_is_no_output(folder, capsys, more):
    light = folder / "light.exr"
    write_exr(light, np.ones((2, 4, 3)))
    emitter = '</shape><emitter type="envmap"><string name="filename" value="light.exr"/></emitter>'
    (folder / "scene.xml").write_text(SCENE.replace("</shape>", emitter))
    before = light.read_bytes()
    assert render("-o", str(light), "--spp", "2", *more) == 1
    assert "is an input as well; expected another file" in capsys.readouterr().err
    assert light.read_bytes() == before


def test_every_command_makes_the_folder_of_its_output(folder):
    picture = str(folder / "a" / "b" / "picture.exr")
    assert render("-o", picture, "--spp", "2", "--passes", "1") == 0
    assert main(["merge", picture, "-o", "c/d/merged.exr"]) == 0
    assert main(["compare", picture, "c/d/merged.exr", "--json", "e/f.json", "--html", "g/h"]) == 0
    assert main(["tessellate", "cube.obj", "-o", "i/j/cube.ply"]) == 0
    assert main(["figure", "refinement", "--format", "pdf", "-o", "k/l"]) == 0
    for name in (picture, "c/d/merged.exr", "e/f.json", "g/h/index.html", "i/j/cube.ply", "k/l/refinement.pdf"):
        assert (folder / name).is_file()


def test_names_of_formats_may_have_capital_letters(folder):
    for name, start in (("A.EXR", b"v/1\x01"), ("A.PNG", b"\x89PNG"), ("A.JPG", b"\xff\xd8\xff")):
        assert render("-o", name, "--spp", "1") == 0
        assert (folder / name).read_bytes().startswith(start)


def test_figures_have_the_options_that_the_command_line_knows():
    from mitsuba_subdivision.figures import FIGURES, FigureOptions

    known = {field.name for field in dataclasses.fields(FigureOptions)}
    for figure in FIGURES.values():
        assert set(figure.options) <= known
        assert set(figure.formats) <= set(FigureOptions.formats)


@pytest.mark.parametrize("words", [["info", "cube.obj"], ["info", "missing.obj"], ["--help"]])
def test_a_closed_pipe_is_no_error(folder, words):
    # The status is what it is where somebody listens, and nothing is said.
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)}
    command = [sys.executable, "-m", "mitsuba_subdivision", *words]
    read, write = os.pipe()
    os.close(read)
    is_wrong = "missing.obj" in words
    streams = {"stderr" if is_wrong else "stdout": write, "stdout" if is_wrong else "stderr": subprocess.PIPE}
    done = subprocess.run(command, cwd=folder, env=environment, text=True, check=False, **streams)
    os.close(write)
    assert done.returncode == is_wrong
    assert not done.stdout
    assert not done.stderr


# The reason is told that its message refers to.
CAUSED = RuntimeError("drjit.custom(<op>): error while performing a custom differentiable operation. (see above).")
CAUSED.__cause__ = RuntimeError("the texture is odd")


@pytest.mark.parametrize(
    ("error", "told"),
    [
        (OSError(errno.ENOSPC, "No space left on device"), "No space left on device"),
        (OSError(errno.EROFS, "Read-only file system", "a.exr"), '"a.exr": Read-only file system'),
        (MemoryError(), "there is not enough memory"),
        (ValueError("wrong"), "wrong"),
        (CAUSED, "the texture is odd"),
    ],
)
def test_errors_are_sentences(capsys, error, told):
    print_error(error)
    assert capsys.readouterr().err == f"mitsuba-subdivision: error: {told}\n"
