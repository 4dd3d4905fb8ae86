"""The command ``render``: models, frames, options, errors, denoising; and shading and triangles of its scenes."""

import os
import sys
import warnings
from pathlib import Path

import drjit as dr
import mitsuba as mi
import mitsuba_subdivision as msub
import numpy as np
import pytest
from mitsuba_subdivision.__main__ import main
from mitsuba_subdivision.cage import named_cages
from mitsuba_subdivision.regression.image import load_image
from mitsuba_subdivision.regression.scene import BOX, load_scene, render_pixels
from mitsuba_subdivision.shapes import interaction_hook
from mitsuba_subdivision.shapes.exact_shading import ExactShading
from mitsuba_subdivision.studio.animation import FrameRange, StillPicture, Turntable, load_quietly
from mitsuba_subdivision.studio.cage_scenes import CageScenes, Model
from mitsuba_subdivision.studio.picture import ERRORS
from mitsuba_subdivision.studio.studio_entries import Look
from shapes.variants import exact, llvm, printed, scalar
from usd import stages

SCENES = Path(msub.example_file("human.xml")).parent
SMALL = ["--size", "20x15", "--spp", "4", "--rate", "2", "-m", "scalar_rgb"]
SCENE = '<scene version="3.0.0"><integrator type="path"/>{}</scene>'
CONSTANT = """<default name="radiance" value="0.25"/>
    <emitter type="constant"><float name="radiance" value="$radiance"/></emitter>"""
SENSOR = """<sensor type="perspective"><film type="hdrfilm"><integer name="width" value="{0}"/>
    <integer name="height" value="8"/></film></sensor>"""


@pytest.fixture
def folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    named_cages.cube().save("cube.obj")
    return tmp_path


def render(*words):
    return main(["render", *words])


def frame_range(path, look, numbers):
    return FrameRange(CageScenes(path, look, numbers=numbers), numbers)


def pixels(path):
    return np.array(mi.Bitmap(str(path)))


def test_options_of_mitsubas_own_program(folder):
    (folder / "two.xml").write_text(SCENE.format(CONSTANT + SENSOR.format(8) + SENSOR.format(12)))
    threads, level, paths = dr.thread_count(), mi.log_level(), [str(p) for p in mi.file_resolver()]
    options = ["-m", "scalar_rgb", "-t", "1", "-a", f"{folder};/tmp", "--spp", "1"]
    long = ["--sensor", "1", "--define", "radiance=0.5", "--variant", "scalar_rgb"]
    for words in (["-s", "1", "-D", "radiance=0.5"], long):
        assert render("two.xml", "-o", "a.exr", *options, *words) == 0
        assert pixels("a.exr").shape[:2] == (8, 12)
        np.testing.assert_allclose(pixels("a.exr")[..., :3], 0.5)
    assert (dr.thread_count(), mi.log_level(), [str(p) for p in mi.file_resolver()]) == (threads, level, paths)
    assert render("two.xml", "-o", "b.exr", "-m", "scalar_rgb", "--spp", "1") == 0
    assert pixels("b.exr").shape[:2] == (8, 8)


@pytest.mark.parametrize(("kind", "suffix"), [("rgba", ".jpg"), ("luminance", ".hdr")])
def test_pictures_are_written_without_the_alpha_or_the_grey_that_a_format_lacks(folder, kind, suffix):
    film = SENSOR.format(8).replace("</film>", f'<string name="pixel_format" value="{kind}"/></film>')
    (folder / "one.xml").write_text(SCENE.format(CONSTANT + film))
    assert render("one.xml", "-o", f"a{suffix}", "-m", "scalar_rgb", "--spp", "1") == 0
    assert pixels(f"a{suffix}").shape == (8, 8, 3)


@pytest.mark.usefixtures("folder")
def test_channels_by_name():
    assert render("cube.obj", "-o", "a.exr", *SMALL, "--aov", "normals,z") == 0
    names = {field.name for field in mi.Bitmap("a.exr").struct_()}
    assert names == {"R", "G", "B", "normals.X", "normals.Y", "normals.Z", "z.T"}
    assert render("cube.obj", "-o", "a.png", *SMALL, "--aov", "normals,z") == 1


@pytest.mark.skipif(not hasattr(os, "sched_setaffinity"), reason="a process cannot be kept to one core here")
def test_one_core_reads_and_writes_openexr(folder):
    """A picture, and passes."""
    mi.Bitmap(np.full((16, 32, 3), 0.5, np.float32)).write(str(folder / "sky.exr"))
    sky = '<emitter type="envmap"><string name="filename" value="sky.exr"/></emitter>'
    (folder / "sky.xml").write_text(SCENE.format(sky + SENSOR.format(4)))
    code = f"""import os; os.sched_setaffinity(0, {{{min(os.sched_getaffinity(0))}}})
from mitsuba_subdivision.__main__ import main
words = "render sky.xml -m scalar_rgb --spp 2 -t 1 -o".split()
raise SystemExit(main([*words, "a.exr"]) or main([*words, "b.exr", "--passes", "2"]))"""
    # Where all wait for a thread that there is not, they wait for ever.
    printed(code)
    for name in ("a.exr", "b.exr"):
        np.testing.assert_allclose(pixels(name)[..., :3], 0.5, rtol=1e-3)


@scalar
def test_turntables_are_closed():
    table = Turntable(CageScenes(named_cages.cube(), Look(size=(24, 18), spp=64, rate=4, view="front")), 4)
    for number in (1, 5):
        np.testing.assert_allclose(table.matrix(number), np.eye(4), atol=1e-12)
    frames = (loaded for number in (1, 2, 1.5) for loaded in table.frames([number], None))
    first, quarter, between = (np.array(mi.render(loaded.scene)) for loaded in frames)
    # A cube is the same after a quarter of a turn, but for noise.
    assert np.abs(first - quarter).mean() < 0.5 * np.abs(first - between).mean()


def test_existing_frames_are_kept(folder, capsys):
    pytest.importorskip("imageio")
    words = ["cube.obj", "-o", "spin.gif", "--turntable", "3", *SMALL]
    assert render(*words) == 0
    frames = [folder / f"spin_000{i}.png" for i in (1, 2, 3)]
    before = {path: path.stat().st_mtime_ns for path in frames}
    second = frames[1].read_bytes()
    frames[1].unlink()
    capsys.readouterr()
    assert render(*words) == 0
    said = capsys.readouterr()
    assert said.out == "spin_0002.png\nspin.gif\n"
    assert "2 of 3 frames exist" in said.err
    assert [path.stat().st_mtime_ns == before[path] for path in frames] == [True, False, True]
    assert frames[1].read_bytes() == second
    import imageio.v3 as iio

    assert iio.imread("spin.gif").shape == (3, 15, 20, 3)
    # Of a frame, in milliseconds, at the usual rate of 25 in a second.
    assert iio.immeta("spin.gif")["duration"] == 40


@pytest.mark.parametrize(
    ("package", "words", "extra"),
    [("imageio.v2", ["a.mp4", "--turntable", "3"], "video"), ("mitsuba_oidn", ["a.png", "--denoise"], "denoise")],
)
def test_missing_packages_name_the_extra(folder, capsys, monkeypatch, package, words, extra):
    monkeypatch.setitem(sys.modules, package, None)
    assert render("cube.obj", "-o", *words, *SMALL) == 1
    assert f'pip install "mitsuba-subdivision[{extra}]"' in capsys.readouterr().err
    assert list(folder.glob("*.png")) == []


@llvm
def test_frames_equal_pictures_of_single_files(folder):
    """Of a cage that moves, with other faces in the third."""
    cage = msub.ControlCage.from_file(SCENES / "cages" / "propeller.obj")
    for number in (1, 2, 3):
        moved = cage.with_positions(cage.positions + 0.3 * number * np.sin(cage.positions[:, [2, 0, 1]]))
        (moved.refined() if number == 3 else moved).save(folder / f"f_{number:02d}.obj")
    look = Look(size=(20, 15), spp=16, rate=2, up="z", cage=True)
    moving = frame_range(folder / "f_%02d.obj", look, range(1, 4))
    for number, loaded in zip((1, 2, 3), moving.frames([1, 2, 3], "box"), strict=True):
        source = CageScenes(folder / f"f_{number:02d}.obj", look)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            alone = {**moving.scene, "surface": source.scene(source.at())["surface"]}
        # The wire of a frame is as thick as that of the first.
        alone.pop("cage")
        assert {"surface", "cage"} <= {shape.id() for shape in loaded.scene.shapes()}
        apart = load_quietly(alone, "box").scene
        for name in ("surface.vertex_positions", "surface.vertex_normals"):
            a, b = (np.array(mi.traverse(scene)[name]) for scene in (loaded.scene, apart))
            np.testing.assert_allclose(a, b, atol=2e-6)


@scalar
def test_limit_points_are_evaluated_once(monkeypatch):
    evaluated, limit_points = [], Model.limit_points
    monkeypatch.setattr(Model, "limit_points", lambda *given: evaluated.append(1) or limit_points(*given))
    msub.studio_scene(named_cages.cube(), cage=True)
    assert len(evaluated) == 1


@scalar
def test_times_of_a_usd_file_are_frames(folder):
    pytest.importorskip("pxr")
    cage = named_cages.cube()
    stages.write(folder, stages.mesh_of(cage, "m", {time: time * cage.positions for time in (1, 5)}), "m.usda")
    moving = frame_range(folder / "m.usda", Look(size=(20, 15), spp=4, rate=2), range(1, 6, 2))
    points = (mi.traverse(loaded.scene)["surface.control_points"] for loaded in moving.frames([1, 3, 5], None))
    np.testing.assert_allclose([np.abs(np.array(values)).max() for values in points], [1, 3, 5], rtol=1e-6)
    assert render("m.usda", "-o", "m.png", "--frames", "1:5:4", *SMALL) == 0
    assert {path.name for path in folder.glob("m_*.png")} == {"m_0001.png", "m_0005.png"}
    assert render("m.usda", "-o", "m.png", "--prim", "/none", *SMALL) == 1


EXACT = ["--size", "20x15", "--rate", "2", "--shading", "exact"]


@exact
@pytest.mark.parametrize(
    "words",
    [
        ["cube.obj", "-o", "a.exr", *EXACT],
        ["cube.obj", "-o", "a_%d.png", *EXACT, "--turntable", "2"],
        ["scene.xml", "-o", "a.exr"],
        ["scene.xml", "-o", "a.exr", "--passes", "2"],
    ],
)
@llvm
def test_an_error_at_a_hit_ends_the_command(folder, capsys, monkeypatch, words):
    shape = """<shape type="subdivision"><string name="filename" value="cube.obj"/>
        <string name="shading" value="exact"/></shape>"""
    (folder / "scene.xml").write_text(SCENE.format(CONSTANT + SENSOR.format(8) + shape))

    def fail(*_):
        raise ValueError("no surface")

    monkeypatch.setattr(ExactShading, "complete", fail)
    assert render(*words, "--spp", "4", "-m", "llvm_ad_rgb") == 1
    assert capsys.readouterr().err.endswith("error: no surface\n")
    assert {path.name for path in folder.iterdir()} == {"cube.obj", "scene.xml"}


CUBE = named_cages.cube()
TINY = ["--size", "20x15", "--spp", "4"]
# Largest part of the error with as many samples; measured 0.34.
LEFT = 0.6


@exact
@llvm
def test_still_pictures_follow_the_sensor_and_others_do_not(folder, capfd):
    made = msub.studio_scene(CUBE)
    surface = made["surface"]
    assert surface["shading"] == "exact"
    assert (surface["tessellation"], surface["pixel_error"], surface["outline"]) == ("adaptive", 0.1, "sensor")
    assert surface["sensor_to_world"] == made["sensor"]["to_world"]
    model, source = Model(CUBE), CageScenes(CUBE, Look(shading="exact"))
    assert StillPicture(source).scene["surface"].keys() == surface.keys()
    for scene in (StillPicture(source, follows_sensor=False).scene, Turntable(source, 4).scene):
        assert scene["surface"]["tessellation_rate"] == model.default_rate
    assert msub.studio_scene(CUBE, rate=3)["surface"]["tessellation_rate"] == 3
    assert capfd.readouterr() == ("", "")
    # Scenes that are saved are to be edited.
    assert render("cube.obj", "-o", "a.png", *TINY, "--save-scene", "a.xml", "-m", "llvm_ad_rgb") == 0
    text = (folder / "a.xml").read_text()
    assert "adaptive" not in text
    assert '<string name="shading" value="exact"/>' in text


@exact
@llvm
def test_outlines_are_within_the_error():
    """The part of each pixel that a black model covers is that of a much finer one, but for a strip along its edge."""
    made, fine = (msub.studio_scene(CUBE, size=(48, 36), spp=256, **more) for more in ({}, {"rate": 64}))

    def covered(scene):
        kept = {name: scene[name] for name in ("type", "sensor", "integrator")}
        black = {"type": "diffuse", "reflectance": 0.0}
        loaded = mi.load_dict({**kept, "surface": {**scene["surface"], "bsdf": black}, "sky": {"type": "constant"}})
        return 1 - np.array(mi.render(loaded))[..., 0]

    expected = covered(fine)
    assert expected.min() < 0.01
    assert expected.max() > 0.99
    assert np.abs(covered(made) - expected).max() < 2**0.5 * ERRORS["exact"]


@scalar
def test_scalar_variants_keep_vertex_normals_with_one_message(capfd):
    made = msub.studio_scene(CUBE)
    assert made["surface"]["tessellation_rate"] == Model(CUBE).default_rate
    assert "shading" not in made["surface"]
    out, err = capfd.readouterr()
    assert out == ""
    assert err.count("\n") == 1
    assert "normals are interpolated between vertices: exact shading needs a variant of llvm or cuda" in err
    assert msub.studio_scene(CUBE, shading="vertex")["surface"].keys() == made["surface"].keys()
    assert msub.studio_scene(CUBE, shading="exact")["surface"]["shading"] == "exact"
    assert capfd.readouterr() == ("", "")


@pytest.mark.parametrize("words", [["--rate", "2"], ["--turntable", "2"]])
@llvm
@pytest.mark.usefixtures("folder")
def test_the_command_prints_one_line_about_missing_exact_shading(monkeypatch, capfd, words):
    monkeypatch.setattr(interaction_hook, "hook_problem", lambda: "needs another computer")
    assert render("cube.obj", "-o", "a.png", *TINY, *words, "-m", "llvm_ad_rgb") == 0
    assert capfd.readouterr().err.count("exact shading needs another computer\n") == 1
    assert render("cube.obj", "-o", "b.png", *TINY, *words, "--shading", "vertex", "-m", "llvm_ad_rgb") == 0
    assert "exact shading" not in capfd.readouterr().err


@scalar
def test_denoising_removes_noise():
    pytest.importorskip("mitsuba_oidn")
    scene = msub.studio_scene(CUBE, size=(48, 36), rate=2)
    expected, noisy = (render_pixels(load_scene(scene, None, BOX).scene, seed, spp) for seed, spp in ((1, 128), (2, 8)))
    result = msub.render_denoised(scene, 8, 2)
    assert result.shape == expected.shape
    np.testing.assert_array_equal(result[..., 3:], noisy[..., 3:])
    error, before = (np.sqrt(np.mean((image - expected)[..., :3] ** 2)) for image in (result, noisy))
    assert error < LEFT * before


@pytest.mark.usefixtures("folder")
def test_denoised_pictures_are_no_references(capsys):
    pytest.importorskip("mitsuba_oidn")
    assert render("cube.obj", "-o", "a.exr", *TINY, "-m", "scalar_rgb", "--denoise") == 0
    assert load_image("a.exr").metadata["denoised"]
    assert main(["compare", "a.exr", "a.exr"]) == 3
    assert '"a.exr" is denoised; expected the render with its noise' in capsys.readouterr().err
