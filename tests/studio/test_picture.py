"""Shading and triangles that scenes of this package have by default, and pictures that Open Image Denoise denoises."""

import sys

import mitsuba as mi
import mitsuba_subdivision as msub
import numpy as np
import pytest
from mitsuba_subdivision.__main__ import main
from mitsuba_subdivision.cage import named_cages
from mitsuba_subdivision.regression.image import load_image
from mitsuba_subdivision.regression.scene import BOX, load_scene, render_pixels
from mitsuba_subdivision.shapes import interaction_hook
from mitsuba_subdivision.shapes.interaction_hook import hook_problem
from mitsuba_subdivision.studio.animation import StillPicture, Turntable
from mitsuba_subdivision.studio.cage_scenes import CageScenes, Model
from mitsuba_subdivision.studio.picture import ERRORS
from mitsuba_subdivision.studio.studio_entries import Look

exact = pytest.mark.skipif(hook_problem() is not None, reason=str(hook_problem()))
llvm = pytest.mark.usefixtures("variant_llvm_ad_rgb")
CUBE = named_cages.cube()
SMALL = ["--size", "20x15", "--spp", "4"]
# Of the error by as many samples, at most: measured 0.34.
LEFT = 0.6


@pytest.fixture
def file(tmp_path, monkeypatch):
    """Name of a file of the cube in the working folder."""
    monkeypatch.chdir(tmp_path)
    CUBE.save("cube.obj")
    return "cube.obj"


@exact
@llvm
def test_still_pictures_follow_the_sensor_and_others_do_not(capfd):
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


@exact
@llvm
def test_outlines_are_within_the_error():
    """The part of each pixel that a black model covers is that of a much finer one, but for a strip along its edge."""
    size = 48, 36
    made, fine = (msub.studio_scene(CUBE, size=size, spp=256, **more) for more in ({}, {"rate": 64}))

    def covered(scene):
        kept = {name: scene[name] for name in ("type", "sensor", "integrator")}
        black = {"type": "diffuse", "reflectance": 0.0}
        loaded = mi.load_dict({**kept, "surface": {**scene["surface"], "bsdf": black}, "sky": {"type": "constant"}})
        return 1 - np.array(mi.render(loaded))[..., 0]

    expected = covered(fine)
    assert expected.min() < 0.01
    assert expected.max() > 0.99
    assert np.abs(covered(made) - expected).max() < 2**0.5 * ERRORS["exact"]


@pytest.mark.usefixtures("variant_scalar_rgb")
def test_scalar_variants_keep_normals_of_vertices_and_say_so_once(capfd):
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
def test_the_command_says_once_what_it_does_elsewhere(file, monkeypatch, capfd, words):
    monkeypatch.setattr(interaction_hook, "hook_problem", lambda: "needs another computer")
    assert main(["render", file, "-o", "a.png", *SMALL, *words, "-m", "llvm_ad_rgb"]) == 0
    assert capfd.readouterr().err.count("exact shading needs another computer\n") == 1
    assert main(["render", file, "-o", "b.png", *SMALL, *words, "--shading", "vertex", "-m", "llvm_ad_rgb"]) == 0
    assert "exact shading" not in capfd.readouterr().err


@exact
@llvm
def test_scenes_that_are_saved_do_not_follow_their_sensor(file, tmp_path):
    """It is to be edited."""
    assert main(["render", file, "-o", "a.png", *SMALL, "--save-scene", "a.xml", "-m", "llvm_ad_rgb"]) == 0
    text = (tmp_path / "a.xml").read_text()
    assert "adaptive" not in text
    assert '<string name="shading" value="exact"/>' in text


@pytest.mark.usefixtures("variant_scalar_rgb")
def test_denoising_removes_noise():
    pytest.importorskip("mitsuba_oidn")
    scene = msub.studio_scene(CUBE, size=(48, 36), rate=2)
    expected, noisy = (render_pixels(load_scene(scene, None, BOX).scene, seed, spp) for seed, spp in ((1, 128), (2, 8)))
    result = msub.render_denoised(scene, 8, 2)
    assert result.shape == expected.shape
    np.testing.assert_array_equal(result[..., 3:], noisy[..., 3:])
    error, before = (np.sqrt(np.mean((image - expected)[..., :3] ** 2)) for image in (result, noisy))
    assert error < LEFT * before


def test_denoised_pictures_are_no_references(file, capsys):
    pytest.importorskip("mitsuba_oidn")
    assert main(["render", file, "-o", "a.exr", *SMALL, "-m", "scalar_rgb", "--denoise"]) == 0
    assert load_image("a.exr").metadata["denoised"]
    assert main(["compare", "a.exr", "a.exr"]) == 3
    assert '"a.exr" is denoised, which removes what is compared; expected one as rendered' in capsys.readouterr().err


def test_a_missing_denoiser_names_the_extra(file, capsys, monkeypatch):
    monkeypatch.setitem(sys.modules, "mitsuba_oidn", None)
    assert main(["render", file, "-o", "a.png", "--denoise"]) == 1
    assert 'pip install "mitsuba-subdivision[denoise]"' in capsys.readouterr().err
