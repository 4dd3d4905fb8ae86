"""Shading and triangles that scenes of this package have by default."""

import mitsuba as mi
import mitsuba_subdivision as msub
import numpy as np
import pytest
from mitsuba_subdivision.__main__ import main
from mitsuba_subdivision.cage import named_cages
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
    size = 64, 48
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


@pytest.mark.parametrize("words", [[], ["--turntable", "2"], ["--rate", "2"]])
@llvm
def test_the_command_says_once_what_it_does_elsewhere(tmp_path, monkeypatch, capfd, words):
    CUBE.save(tmp_path / "cube.obj")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(interaction_hook, "hook_problem", lambda: "needs another computer")
    assert main(["render", "cube.obj", "-o", "a.png", *SMALL, *words, "-m", "llvm_ad_rgb"]) == 0
    assert capfd.readouterr().err.count("exact shading needs another computer\n") == 1
    assert main(["render", "cube.obj", "-o", "b.png", *SMALL, *words, "--shading", "vertex", "-m", "llvm_ad_rgb"]) == 0
    assert "exact shading" not in capfd.readouterr().err


@exact
@llvm
def test_scenes_that_are_saved_do_not_follow_their_sensor(tmp_path, monkeypatch):
    """It is to be edited."""
    CUBE.save(tmp_path / "cube.obj")
    monkeypatch.chdir(tmp_path)
    assert main(["render", "cube.obj", "-o", "a.png", *SMALL, "--save-scene", "a.xml", "-m", "llvm_ad_rgb"]) == 0
    text = (tmp_path / "a.xml").read_text()
    assert "adaptive" not in text
    assert '<string name="shading" value="exact"/>' in text
