"""Shading and triangles that whole stages have by default."""

import mitsuba as mi
import mitsuba_subdivision as msub
import pytest
from mitsuba_subdivision.shapes.mitsuba_3_9_hook.interaction_hook import hook_problem
from mitsuba_subdivision.studio.animation import FrameRange, StillPicture, Turntable
from mitsuba_subdivision.studio.studio_entries import Look
from mitsuba_usd.stage_scenes import StageScenes
from usd.stages import CUBE, POLYGONS, moved, prim

exact = pytest.mark.skipif(hook_problem() is not None, reason=str(hook_problem()))
INSTANCES = prim("Xform", "source", prim("Mesh", "inside", CUBE)) + "".join(
    prim("Xform", name, moved(translate=(x, 0, 0)), head="instanceable = true\nreferences = </source>")
    for name, x in (("one", 0), ("two", 3))
)
LOOK = Look(size=(64, 48), spp=1)


@pytest.fixture
def path(stage):
    return stage(prim("Mesh", "alone", CUBE) + INSTANCES)


def surfaces(scene):
    """Limit surfaces of a scene that stand alone, and those in groups."""
    alone = [each for each in scene.values() if isinstance(each, dict) and each["type"] == "subdivision"]
    alone = [each for each in alone if each is not scene.get("ground")]
    groups = [each for each in scene.values() if isinstance(each, dict) and each["type"] == "shapegroup"]
    return alone, [shape for group in groups for name, shape in group.items() if name != "type"]


@exact
@pytest.mark.usefixtures("variant_llvm_ad_rgb")
def test_a_still_picture_is_exact_with_outlines_for_its_camera(path, capfd):
    scene = msub.usd_scene(path, mi, size=(1280, 960))
    alone, grouped = surfaces(scene)
    assert alone
    assert grouped
    assert {each["shading"] for each in (*alone, *grouped)} == {"exact"}
    for each in alone:
        assert (each["pixel_error"], each["outline"]) == (0.1, "sensor")
        assert each["sensor_to_world"] == scene["sensor"]["to_world"]
    assert all(each["tessellation_rate"] == 8 for each in grouped)
    assert mi.load_dict(scene).shapes()
    assert capfd.readouterr() == ("", "")
    for given in ({"tessellation_rate": 3}, {"shading": "vertex"}):
        (kept, _), (name, value) = surfaces(msub.usd_scene(path, mi, **given)), *given.items()
        assert all(each[name] == value and "tessellation" not in each for each in kept)


@exact
@pytest.mark.usefixtures("variant_llvm_ad_rgb")
def test_frames_and_saved_scenes_follow_no_sensor(path):
    for shown in (
        StillPicture(StageScenes(path, LOOK, {}), follows_sensor=False),
        Turntable(StageScenes(path, LOOK, {}), 2),
        FrameRange(StageScenes(path, LOOK, {}, numbers=range(1, 3)), range(1, 3)),
    ):
        alone, _ = surfaces(shown.scene)
        assert alone
        assert all(each["shading"] == "exact" and 1 <= each["tessellation_rate"] <= 8 for each in alone)


@pytest.mark.usefixtures("variant_scalar_rgb")
def test_scalar_variants_have_normals_of_vertices_and_say_so_once(path, stage, capfd):
    automatic, given = (surfaces(msub.usd_scene(path, mi, **more)) for more in ({}, {"shading": "vertex"}))
    assert [each["tessellation_rate"] for each in automatic[0]] == [each["tessellation_rate"] for each in given[0]]
    assert {each["shading"] for each in (*automatic[0], *automatic[1])} == {"vertex"}
    out, err = capfd.readouterr()
    assert out == ""
    assert err.count("normals are interpolated between vertices: exact shading needs a variant of llvm") == 1
    frames = FrameRange(StageScenes(path, LOOK, {}, numbers=range(1, 4)), range(1, 4))
    assert len(list(frames.frames(frames.numbers, None))) == 3
    assert capfd.readouterr().err.count("\n") == 1
    polygons = stage(prim("Mesh", "flat", CUBE, POLYGONS), "flat.usda")
    msub.usd_scene(polygons, mi)
    msub.usd_scene(path, mi, face_normals=True)
    assert capfd.readouterr().err == ""
