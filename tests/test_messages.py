"""Messages of the command line: one line about wrong input, without tracebacks, and progress of long work."""

import dataclasses
import errno
import io
import os
import re
import subprocess
import sys
from pathlib import Path

import mitsuba as mi
import numpy as np
import pytest
from mitsuba_subdivision import example_file, messages
from mitsuba_subdivision.__main__ import main
from mitsuba_subdivision.cage.named_cages import cube
from mitsuba_subdivision.figures import FIGURES, FigureOptions
from mitsuba_subdivision.figures.output import write_figure
from mitsuba_subdivision.messages import counted, print_error, print_remark, timed
from mitsuba_subdivision.regression.image import write_exr

SCENE = (Path(__file__).parent / "data" / "cube.xml").read_text()
LOOP = SCENE.replace("</shape>", '<string name="scheme" value="loop"/></shape>')
BARE = SCENE.replace('<integrator type="$integrator"/>', "")
RENDER = ["render", "scene.xml", "-o", "picture.exr"]
ENVIRONMENT = {**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)}


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
        ("info cube.obj --rate fine", '"fine"; expected an integer'),
        ("info cube.obj --rate 0", '"0"; expected an integer from 1 to 1024'),
        ("info cube.obj --rate 100000000000", "expected an integer from 1 to 1024"),
        ("figure domains --width 8cm", '"8cm"; expected a width from 84mm to 1200mm, or in inches'),
        ("figure domains --width 3.3in", '"3.3in"; expected a width from 84mm'),
        ("render cube.obj -o a.png --size 0x4", '"0x4"; expected width and height of 1 or more'),
        ("render cube.obj -o a.png --size 4", '"4"; expected width and height'),
        ("render cube.obj -o a.png --view left", "invalid choice: 'left'"),
        ("render cube.obj -o a.png --turntable 0", '"0"; expected an integer, 1 or more'),
        ("render cube.obj -o a.png --frames 3:1", '"3:1"; expected FIRST:LAST or FIRST:LAST:STEP'),
        ("render cube.obj -o a.png --fps 0", '"0"; expected a number above 0'),
        ("render cube.obj -o a.png --azimuth nan", '"nan"; expected a number'),
        ("render scene.xml -o a.exr --seed 4294967296", '"4294967296"; expected an integer from 0 to 4294967295'),
        ("render scene.xml -o a.exr -s -1", '"-1"; expected an integer, 0 or more'),
        ("render scene.xml -o a.exr --pass 3/2", '"3/2"; expected I/N with I from 1 to N'),
        ("render scene.xml -o a.exr -D a", '"a"; expected NAME=VALUE'),
    ],
)
@pytest.mark.usefixtures("folder")
def test_wrong_values_are_errors(capsys, words, message):
    with pytest.raises(SystemExit) as stop:
        main(words.split())
    assert stop.value.code == 2
    assert message in capsys.readouterr().err


NEEDS_PASSES = "--batch is for passes; expected --pass, --passes, --dask or --reference beside it"
NO_NOISE = "--denoise removes the noise that passes and references measure; expected no --pass"
ROOK = example_file("rook.xml")
REFUSED = [
    ("render scene.xml -o a.exr --batch 4", NEEDS_PASSES),
    ("render scene.xml -o a.exr --tolerance alpha=0.1", "--tolerance is stored with a reference; expected --reference"),
    ("render scene.xml -o a.exr --filter foo", 'Plugin "foo" not found'),
    ("render scene.xml -o a.tif", "expected a name ending in one of .exr, .png, .jpg, .hdr"),
    ("render scene.xml -o a.png --passes 2", "ending in .exr"),
    ("render scene.xml -o a.exr --passes 2 --pass 1/2", "expected one of them"),
    ("render scene.xml -o a.exr --reference --filter tent", 'filter "box"'),
    ("render scene.xml -o a.exr --passes 9 --spp 8 --batch 4", "2 batches, fewer than 9 passes"),
    ("render scene.xml -o a.exr --dask nonsense://", "Dask"),
    ("render scene.xml -o a.exr --denoise --reference", NO_NOISE),
    ("render scene.xml -o a.exr --denoise --passes 2", NO_NOISE),
    ("render scene.xml -o a.exr --denoise --filter gaussian", '--denoise needs the filter "box", not "gaussian"'),
    (f"render {ROOK} -o a.png --cage", "--cage was given for the scene"),
    (f"render {ROOK} -o a.png -s 2", "there is no sensor 2; the scene has one sensor, 0"),
    ("render missing.xml -o new/picture.exr", 'scene "missing.xml" is not a file'),
    ("render none.obj -o a.png", '"none.obj": there is no such file; expected a model'),
    ("render f_%04d.obj -o a.png", "or --frames for a name of several files"),
    ("render text.obj -o a.png", '"text.obj": there are no faces'),
    ("render cube.stl -o a.png", "expected a model (.obj"),
    ("render cube.off -o a.png", "expected a Mitsuba scene (.xml) or a model (.obj"),
    ("render cube.obj -o a.tga", "expected a name ending in one of .exr"),
    ("render cube.obj -o a.gif", "--turntable or --frames for a video"),
    ("render cube.obj -o a.png --elevation 100", "expected -90 to 90 degrees"),
    ("render cube.obj -o a.png --frames 1:2", "expected a name such as frame_%04d.obj"),
    ("render f_%04d.obj -o a.png --frames 1:2", '"f_0001.obj": there is no such file (2 such files)'),
    ("render cube.obj -o a.png --prim /a", "expected it for USD files only"),
    ("render cube.obj -o a.png --checker", "has no texture coordinates"),
    ("render cube.obj -o a.png --texture-size 8", "expected it for a whole USD file"),
    ("render cube.obj -o a.png -D a=1", "-D was given for the model"),
    ("render cube.obj -o a.png -s 0", "--sensor was given for the model"),
    ("render cube.obj -o a.png --fps 5", "--fps is for videos"),
    ("render cube.obj -o a.png --turntable 2 --frames 1:2", "expected only one of them"),
    ("render cube.obj -o a.png --save-scene a.txt", "expected a name ending in .xml"),
    ("figure domains --format exr", 'the figure "domains" is not drawn as exr; expected png or pdf'),
    ("figure creases --scheme loop", 'on the figure "creases"; expected one of "domains", "artifact"'),
    ("figure hero --cage cube.obj", '"hero"; expected one of "subdivision", "artifact", "error"'),
    ("figure domains --spp 2", '--spp has no effect on the figure "domains"'),
    ("tessellate cube.obj -o ./cube.obj", 'output "cube.obj" is an input as well'),
    ("tessellate cube.obj -o cube.obj/a.ply", '"cube.obj" is a file; expected a folder'),
    ("figure domains -o cube.obj", '"cube.obj" is a file; expected a folder'),
]


@pytest.mark.parametrize(("words", "message"), REFUSED)
def test_useless_and_harmful_options_are_refused_before_writing(folder, capsys, words, message):
    (folder / "text.obj").write_text("v 1 2\n")
    before = sorted(folder.iterdir())
    assert main([*words.split(), *(["--variant", "scalar_rgb"] if words.startswith("render") else [])]) == 1
    told = capsys.readouterr().err
    assert message in told
    assert "Traceback" not in told
    assert sorted(folder.iterdir()) == before


@pytest.mark.usefixtures("folder")
def test_failing_variants_are_one_line(capsys, monkeypatch):
    monkeypatch.setattr("drjit.has_backend", lambda _: False)
    assert main([*RENDER, "--variant", "cuda_ad_rgb"]) == 1
    expected = "mitsuba-subdivision: error: variant cuda_ad_rgb needs an NVIDIA GPU, and Dr.Jit finds none\n"
    assert capsys.readouterr().err == expected


def test_renders_do_not_begin_for_invalid_outputs(folder, capsys, monkeypatch):
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


@pytest.mark.usefixtures("few_pixels")
def test_every_command_makes_the_folder_of_its_output(folder, monkeypatch):
    picture = str(folder / "a" / "b" / "picture.exr")
    # Of reports and figures, drawing takes most of the time.
    monkeypatch.setitem(write_figure.__kwdefaults__, "layouts", 1)
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
    known = {field.name for field in dataclasses.fields(FigureOptions)}
    for figure in FIGURES.values():
        assert set(figure.options) <= known
        assert set(figure.formats) <= set(FigureOptions.formats)


def test_commands_import_only_their_own_modules():
    """The program's own help neither, which lists all."""
    program = """import sys
from mitsuba_subdivision.commands import COMMANDS, parser
assert all(name in parser(["info"]).format_help() for name in COMMANDS)
print([name for name in sys.modules if name.startswith("mitsuba_subdivision.")])"""
    done = subprocess.run([sys.executable, "-c", program], env=ENVIRONMENT, capture_output=True, text=True, check=True)
    assert "mitsuba_subdivision.commands.info" in done.stdout
    assert not re.search(r"\.(studio|regression|figures|commands\.render)\b", done.stdout)


@pytest.mark.parametrize("words", [["info", "cube.obj"], ["info", "missing.obj"]])
def test_a_closed_pipe_is_no_error(folder, words):
    # The status is what it is where somebody listens, and nothing is said.
    command = [sys.executable, "-m", "mitsuba_subdivision", *words]
    read, write = os.pipe()
    os.close(read)
    is_wrong = "missing.obj" in words
    streams = {"stderr" if is_wrong else "stdout": write, "stdout" if is_wrong else "stderr": subprocess.PIPE}
    done = subprocess.run(command, cwd=folder, env=ENVIRONMENT, text=True, check=False, **streams)
    os.close(write)
    assert (done.returncode, done.stdout or "", done.stderr or "") == (is_wrong, "", "")


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


class Terminal(io.StringIO):
    def isatty(self):
        return True


@pytest.fixture
def terminal(monkeypatch):
    def replaced(stream, patience=0.0):
        monkeypatch.setattr("sys.stderr", stream)
        monkeypatch.setattr(messages, "PATIENCE", patience)
        return stream

    return replaced


def test_progress_counts_on_one_line_is_wiped_and_leaves_messages_on_other_lines(terminal):
    stream = terminal(Terminal())
    assert list(counted("abc", "Letters")) == ["a", "b", "c"]
    assert "Letters" in stream.getvalue()
    assert not stream.getvalue().split("\r")[-1].strip()
    for letter in counted("ab", "Letters"):
        print_remark(letter)
    assert all(f"\r\x1b[Kmitsuba-subdivision: {letter}\n" in stream.getvalue() for letter in "ab")


@pytest.mark.parametrize(("kind", "patience"), [(Terminal, 60.0), (io.StringIO, 0.0)])
def test_short_work_and_pipes_show_nothing(terminal, kind, patience):
    stream = terminal(kind(), patience)
    assert list(counted([1, 2], "Numbers")) == [1, 2]
    assert not stream.getvalue()


def test_progress_lines_are_wiped(terminal):
    stream = terminal(Terminal())
    with timed("Rendering") as at:
        at("part 2 of 3")
    assert "Rendering part 2 of 3" in stream.getvalue()
    assert not stream.getvalue().split("\r")[-1].strip()
    terminal(pipe := io.StringIO())
    with timed("Rendering") as at:
        at("part 2 of 3")
    assert not pipe.getvalue()
