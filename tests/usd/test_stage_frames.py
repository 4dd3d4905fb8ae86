"""Whole USD files in frames, saved as scenes, and with defaults."""

import os
from collections import Counter
from pathlib import Path

import mitsuba as mi
import mitsuba_subdivision as msub
import numpy as np
import pytest
from mitsuba_subdivision.__main__ import main
from mitsuba_subdivision.cage import CageError, CageWarning
from mitsuba_subdivision.files import open_stage
from mitsuba_subdivision.mitsuba_mesh import with_meshes
from mitsuba_subdivision.regression.scene import load_scene
from mitsuba_subdivision.studio.animation import FrameRange, StillPicture, Turntable
from mitsuba_subdivision.studio.saving import save_scene
from mitsuba_subdivision.studio.studio_entries import Look
from mitsuba_usd import scene_entries, stage_scenes
from mitsuba_usd.scene_entries import Surfaces
from mitsuba_usd.stage_scenes import StageScenes
from mitsuba_usd.stage_walk import StageReader, _StageWalk, is_still
from shapes.variants import exact, scalar
from usd import stages
from usd.stages import CUBE, FACES, POINTS, POLYGONS, SQUARE, bound, material, mesh, moved, prim, subset, texture

# Parts of stages move from time 1 to time 5.
RAISED = "(-1,-1,-1), (1,-1,-1), (-1,1,-1), (1,1,-1), (-.3,-.3,3), (.3,-.3,3), (-.3,.3,3), (.3,.3,3)"
COLORS = "(1,0,0), (0,1,0), (0,0,1), (1,1,0), (1,0,1), (0,1,1), (1,1,1), (0,0,0)"
MOVING = prim("Mesh", "moving", f"point3f[] points.timeSamples = {{1: [{stages.CORNERS}], 5: [{RAISED}]}}", FACES)
STILL = prim("Mesh", "still", CUBE, moved(translate=(2.6, 0.4, 0)), "color3f[] primvars:displayColor = [(.1,.2,.7)]")
TINTS = f'color3f[] primvars:displayColor = [{COLORS}] (interpolation = "vertex")'
TINTED = prim("Mesh", "tinted", CUBE, moved(translate={1: (-2.6, 0, 0), 5: (-2.6, 0, 2)}), TINTS)
# Polygons with a texture.
LARGE = SQUARE.replace("(-1,-1,0), (1,-1,0), (1,1,0), (-1,1,0)", "(-6,-6,-1.4), (6,-6,-1.4), (6,6,-1.4), (-6,6,-1.4)")
FLOOR = mesh("floor", LARGE, bound()) + material(
    "color3f inputs:diffuseColor.connect = </paint/texture.outputs:rgb>\n"
    "float inputs:roughness.connect = </paint/texture.outputs:r>",
    texture("tiles.png"),
)
INSTANCES = f'class Xform "ball" {{\n{prim("Mesh", "ball", CUBE)}}}\n' + "".join(
    prim("Xform", f"ball{n}", move, head="instanceable = true\nreferences = </ball>")
    for n, x in enumerate((-2, 2))
    for move in [moved(translate={1: (x, 3, 0), 5: (x, 3, 2)}, scale=(0.4,) * 3)]
)
LAMP_MOVES = moved(translate={1: (-4, -3, 5), 5: (4, -3, 5)})
LAMP = prim("SphereLight", "lamp", "float inputs:radius = 0.5", "float inputs:intensity = 60", LAMP_MOVES)
SKY = prim("DomeLight", "sky", "float inputs:intensity = 0.5", "asset inputs:texture:file = @sky.exr@")
LENS = "float focalLength = 35\nfloat horizontalAperture = 24\nfloat verticalAperture = 18"
ORBIT = moved(translate={1: (0, -14, 5), 5: (9, -11, 5)}, rotateZ={1: 0, 5: 39}, rotateX=72)
CAMERA = prim("Camera", "camera", LENS, ORBIT)
BARE = MOVING + STILL + TINTED + INSTANCES
WHOLE = BARE + FLOOR + LAMP + SKY + CAMERA


def write(folder, text, name="moving.usda"):
    """Write a stage, with the pictures that it may name beside it."""
    tiles = np.full((8, 8, 3), 200, np.uint8)
    tiles[:2, :3] = [220, 60, 40]
    mi.Bitmap(tiles).write(str(folder / "tiles.png"))
    mi.Bitmap(np.linspace(0, 1, 8 * 16 * 3, dtype=np.float32).reshape(8, 16, 3)).write(str(folder / "sky.exr"))
    return stages.write(folder, text, name)


LOOK = Look(size=(24, 18), spp=4)
RATE = {"tessellation_rate": 3}
FLYING = prim(
    "PointInstancer",
    "flying",
    "rel prototypes = </still>\nint[] protoIndices.timeSamples = {1: [0]}",
    "point3f[] positions.timeSamples = {1: [(0, 0, 5)]}\nvector3f[] velocities.timeSamples = {1: [(1, 0, 0)]}",
)
RIG = moved(translate={1: (0, 0, 0), 5: (1, 0, 0)})


def frame_range(path, numbers):
    return FrameRange(StageScenes(path, LOOK, RATE, numbers=numbers), numbers)


def pixels(loaded):
    """A picture; with LLVM, which compiles for seconds, only the distances that rays through its pixels travel."""
    if mi.variant() == "scalar_rgb":
        return np.array(mi.render(loaded.scene, spp=4, seed=3))
    width, height = LOOK.size
    places = (np.indices((width, height)).reshape(2, -1) + 0.5) / [[width], [height]]
    ray, _ = loaded.sensor.sample_ray(0, 0, mi.Point2f(places), mi.Point2f(0.5))
    return np.minimum(loaded.scene.ray_intersect_preliminary(ray).t, 100)


def alone(path, time):
    return pixels(load_scene(msub.usd_scene(path, mi, time=time, size=LOOK.size, spp=LOOK.spp, **RATE), None, "box"))


def recorded(monkeypatch, module, name):
    """What a function of a module is called with from now on."""
    calls, call = [], getattr(module, name)
    monkeypatch.setattr(module, name, lambda *given, **more: calls.append((given, more)) or call(*given, **more))
    return calls


def frames(path, times):
    return [pixels(loaded) for loaded in frame_range(path, range(1, 6, 2)).frames(times, "box")]


def assert_each_is_as_alone(path, times, pictures):
    for time, picture in zip(times, pictures, strict=True):
        np.testing.assert_allclose(picture, alone(path, time), atol=1e-4)
    assert np.abs(pictures[0] - pictures[1]).mean() > 0.01


def on_film(loaded, points):
    """Where points are on the film, from 0 to 1."""
    place = mi.Interaction3f()
    places = []
    for point in points:
        place.p = mi.Point3f(point)
        places.append(np.array(loaded.sensor.sample_direction(place, mi.Point2f(0))[0].uv).ravel())
    return np.array(places) / loaded.size


@scalar
@pytest.mark.parametrize("more", ["", LAMP, CAMERA, LAMP + CAMERA], ids=["bare", "lamp", "camera", "lamp and camera"])
def test_turntables_turn_the_stage_before_its_camera(tmp_path, more):
    path = write(tmp_path, STILL + FLOOR + more)
    table = Turntable(StageScenes(path, LOOK, RATE), 4)
    assert ("key_light" in table.scene) == (LAMP not in more)
    points = Surfaces().points(StageReader(path).at())
    middle = (points.min(axis=0) + points.max(axis=0)) / 2
    quarter = np.array([[0, 1, 0], [-1, 0, 0], [0, 0, 1]])
    for turns, loaded in enumerate(table.frames([1, 2, 3], "box")):
        if turns == 0:
            first = load_scene(with_meshes(table.scene), None, "box")
            if CAMERA in more:
                np.testing.assert_array_equal(pixels(loaded), alone(path, None))
        # Counter-clockwise from above.
        turned = (points - middle) @ np.linalg.matrix_power(quarter, turns) + middle
        np.testing.assert_allclose(on_film(loaded, points), on_film(first, turned), atol=1e-4)
        if CAMERA not in more:
            # All of the stage is seen at all times.
            assert (np.abs(on_film(loaded, points) - 0.5) < 0.5).all()
        if more == LAMP:
            (lamp,) = (shape for shape in loaded.scene.shapes() if shape.is_emitter() and shape.id() == "lamp")
            np.testing.assert_allclose(np.array(lamp.bbox().center()), [-4, -3, 5], atol=1e-5)
        if more == "":
            # Seen from the camera, the studio's light stays where it is.
            matrices = [mi.traverse(frame.scene)["key_light.to_world"].matrix for frame in (loaded, first)]
            centers = np.array(matrices)[:, :3, 3]
            np.testing.assert_allclose(on_film(loaded, centers[:1]), on_film(first, centers[1:]), atol=1e-4)


@pytest.mark.parametrize("variant", ["scalar_rgb", "llvm_ad_rgb"])
def test_frames_equal_pictures_of_single_times(tmp_path, monkeypatch, request, variant):
    """Points, transforms, instances, lights and camera move; weights are made once for each cage."""
    request.getfixturevalue(f"variant_{variant}")
    made = recorded(monkeypatch, scene_entries, "subdivision")
    path, times = write(tmp_path, WHOLE), (1, 3, 5)
    pictures = frames(path, times)
    assert sorted(shape.name for (shape, *_), _ in made) == ["/ball", "/moving", "/still", "/tinted"]
    assert_each_is_as_alone(path, times, pictures)


@scalar
def test_a_stage_with_only_a_moving_camera_is_loaded_once(tmp_path, monkeypatch):
    """On a rig, with its focal length and its focus."""
    made = [recorded(monkeypatch, stage_scenes, "scene_entries"), recorded(monkeypatch, _StageWalk, "contents")]
    focus = "float fStop = 5.6\nfloat focusDistance.timeSamples = {1: 9, 5: 14}"
    lens = f"float focalLength.timeSamples = {{1: 35, 5: 50}}\n{focus}"
    rig = prim("Xform", "rig", RIG, CAMERA.replace("float focalLength = 35", lens))
    path = write(tmp_path, STILL + FLOOR + LAMP.replace(LAMP_MOVES, moved(translate=(4, -3, 5))) + rig)
    pictures = frames(path, (1, 3, 5))
    assert [len(calls) for calls in made] == [1, 1]
    assert_each_is_as_alone(path, (1, 3, 5), pictures)


@pytest.mark.parametrize("moving", [MOVING, LAMP, INSTANCES, FLYING, prim("Xform", "rig", RIG, STILL)])
def test_a_stage_is_still_only_if_nothing_but_cameras_moves(tmp_path, moving):
    assert is_still(open_stage(write(tmp_path, STILL + CAMERA)))
    assert not is_still(open_stage(write(tmp_path, STILL + CAMERA + moving)))


@scalar
def test_changes_between_frames_are_shown(tmp_path):
    """Visibility, other faces and other colours; a studio that sees all frames and stands still."""
    faces = FACES.replace("Counts = [4, 4, 4, 4, 4, 4]", "Counts.timeSamples = {1: [4, 4, 4, 4, 4, 4], 3: [4, 4]}")
    faces = faces.replace("Indices = [", "Indices.timeSamples = {1: [").replace("5]", "5], 3: [0,2,3,1, 4,5,7,6]}")
    text = prim("Mesh", "hidden", CUBE, 'token visibility.timeSamples = {1: "invisible", 3: "inherited"}') + MOVING
    text += prim("Mesh", "other", POINTS.replace("(1,", "(4,"), faces)
    text += STILL.replace("displayColor = [(.1,.2,.7)]", "displayColor.timeSamples = {1: [(1,0,0)], 5: [(0,1,0)]}")
    scenes = list(frame_range(write(tmp_path, text), range(1, 6, 2)).frames([1, 3, 5], "box"))
    shapes = [len(frame.scene.shapes()) for frame in scenes]
    assert shapes[1] == shapes[0] + 1
    assert len({str(mi.traverse(frame.scene)["sensor.to_world"]) for frame in scenes}) == 1
    tips = np.array([[-0.2, 0, 2], [4, 0, 0], [3.4, 0.4, 0]])
    assert (np.abs(on_film(scenes[0], tips) - 0.5) < 0.5).all()
    assert np.abs(pixels(scenes[0]) - pixels(scenes[2])).mean() > 0.01
    with pytest.raises(CageError, match="nothing is visible in any frame; expected visible meshes"):
        frame_range(write(tmp_path, LAMP + CAMERA, "empty.usda"), range(1, 3))


@scalar
def test_a_saved_stage_renders_to_the_same_picture(tmp_path):
    path = write(tmp_path, WHOLE)
    written = save_scene(StillPicture(StageScenes(path, LOOK, RATE, time=2)).scene, tmp_path / "saved" / "moving.xml")
    # The cubes are one file.
    assert Counter(path.suffix for path in written) == {".obj": 2, ".ply": 2, ".png": 1, ".exr": 2, ".xml": 1}
    np.testing.assert_allclose(pixels(load_scene(written[-1], None, "box")), alone(path, 2), atol=1e-5)


# Two materials, far from the origin, beside things of a millionth of their size.
PARTS = mesh("parts", CUBE, subset([0, 1]), subset([2, 3], "gold", "rest"), moved(translate=(535, 535, 0), rotateY=20))
PARTS += material("float inputs:opacity = 0.3") + material("float inputs:metallic = 1", name="gold")
SPECK = prim("Mesh", "speck", CUBE.replace("(-1,", "(-2,"), moved(scale=(3e-7, 6e-7, 4e-7)))
AFAR = prim("Camera", "camera", LENS, moved(translate=(535, 528, 2), rotateX=80))


@scalar
def test_parts_of_a_mesh_are_saved_with_their_faces_and_a_camera_far_from_the_origin(tmp_path):
    path = write(tmp_path, PARTS + SPECK + AFAR)
    written = save_scene(StillPicture(StageScenes(path, LOOK, RATE)).scene, tmp_path / "parts.xml")
    # All parts of a mesh read one file.
    assert Counter(path.suffix for path in written) == {".obj": 2, ".xml": 1}
    loaded = load_scene(written[-1], None, "box")
    np.testing.assert_allclose(pixels(loaded), alone(path, None), atol=1e-5)
    boxes = [np.ptp([shape.bbox().min, shape.bbox().max], axis=0) for shape in loaded.scene.shapes()]
    speck = min(boxes, key=np.max)
    # The cube is half as long again along x, and shrinks alike along all axes.
    np.testing.assert_allclose(speck / speck[2], [3 / 4 * 1.5, 6 / 4, 1], rtol=0.05)


ASSETS = Path(os.environ.get("PXR_AR_DEFAULT_SEARCH_PATH", "no folder").split(os.pathsep)[0])
GALLERY = {
    "chess": "OpenChessSet/chess_set.usda",
    "balls": "StandardShaderBall/standard_shader_ball_scene.usda",
    "elephant": "ElephantWithMonochord/SoC-ElephantWithMonochord.usdc",
    "teapot": "Teapot/Teapot.usd",
    "vehicles": "Vehicles/USD_Mini_Car_Kit/assets/vehicles/vehicleVariants.usda",
    "pyramids": "SubdivisionSurfaces/Creases_SpinningPyramids.usda",
    "blocks": "McUsd/McUsd.usda",
}


@scalar
@pytest.mark.skipif(not (ASSETS / "McUsd").is_dir(), reason="PXR_AR_DEFAULT_SEARCH_PATH has no full_assets of usd-wg")
@pytest.mark.parametrize("stage", GALLERY.values(), ids=GALLERY)
@pytest.mark.filterwarnings("ignore::mitsuba_subdivision.CageWarning")
def test_stages_of_the_gallery_are_saved_and_render_to_the_same_pictures(tmp_path, stage):
    scene = StillPicture(StageScenes(ASSETS / stage, LOOK, {"tessellation_rate": 1})).scene
    *_, written = save_scene(scene, tmp_path / "saved.xml")
    a, b = (pixels(load_scene(source, None, "box")) for source in (with_meshes(scene), written))
    # Coordinates of vertices are rounded otherwise, which a reflection amplifies where a path is long.
    assert np.abs(a - b).mean() < 1e-5 * a.mean()


@scalar
def test_the_command_shows_and_saves_whole_stages(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    write(tmp_path, BARE)
    small = "--size 16x12 --spp 1 --rate 2 -m scalar_rgb"
    for command in (
        f"moving.usda -o turn.png --turntable 2 --save-scene s/one.xml {small}",
        f"moving.usda -o f.png --frames 1:5:4 {small}",
        "s/one.xml -o again.png -m scalar_rgb",
    ):
        assert main(["render", *command.split()]) == 0
    names = ("turn_0001.png", "turn_0002.png", "f_0005.png", "again.png")
    first, second, third, again = (np.array(mi.Bitmap(name)).astype(int) for name in names)
    np.testing.assert_allclose(first, again, atol=1)
    assert min(np.abs(first - other).mean() for other in (second, third)) > 1
    for number in (1, 2):
        write(tmp_path, STILL, f"g_{number}.usda")
    of_files = f"render g_%d.usda -o g.png {small} --frames"
    assert main([*of_files.split(), "1:2"]) == 0
    capsys.readouterr()
    assert main([*of_files.split(), "1:3"]) == 1
    assert '"g_3.usda": there is no such file; expected one for each frame' in capsys.readouterr().err


TEXTURE_SIDE = 64
# The camera moves from afar to near; the nearest frame is neither the first nor the last.
APPROACH = prim("Camera", "camera", LENS, moved(translate={1: (0, 0, 90), 2: (0, 0, 40), 3: (0, 0, 70)}))
# Here it comes near while the shutter is open.
OPENED = APPROACH.replace("float focal", "double shutter:open = 0\ndouble shutter:close = 1\nfloat focal")
OPENED = OPENED.replace("2: (0, 0, 40)", "2: (0, 0, 10)")


@pytest.fixture
def sides(tmp_path, monkeypatch):
    """Function that takes what shows a stage, and returns the sides of the floor's texture in its scenes."""
    asked = recorded(monkeypatch, stage_scenes, "scene_entries")

    def sides_of(camera, show):
        path = write(tmp_path, FLOOR + LAMP + camera)
        # In place of a smaller one.
        mi.Bitmap(np.full((TEXTURE_SIDE, TEXTURE_SIDE, 3), 200, np.uint8)).write(str(tmp_path / "tiles.png"))
        asked.clear()
        show(path)
        # Made again of what the scenes are made of.
        entries = (scene_entries.scene_entries(*given, **{**more, "loaded": None}) for given, more in asked[:])
        return [entry.get("bsdf", entry)["base_color"]["bitmap"].size()[0] for entry in (e["paint"] for e in entries)]

    return sides_of


def stills(*times):
    return lambda path: [StillPicture(StageScenes(path, LOOK, RATE, time=time)) for time in times]


@scalar
@pytest.mark.filterwarnings("ignore:.*shutters of cameras have no effect")
def test_textures_are_as_fine_as_the_most_demanding_frame(sides):
    """Alike in all frames, so that nothing changes from one to the next, and no finer than that."""
    first, nearest, last = sides(APPROACH, stills(1, 2, 3))
    assert first <= last < nearest < TEXTURE_SIDE
    shown = sides(APPROACH, lambda path: [*frame_range(path, range(1, 4)).frames([3, 1], "box")])
    assert shown == [nearest] * 2
    assert sides(APPROACH, lambda path: Turntable(StageScenes(path, LOOK, RATE), 4))[0] == first
    edited = sides(APPROACH, lambda path: Turntable(StageScenes(path, LOOK, RATE), 4, follows_sensor=False))
    assert edited[0] == TEXTURE_SIDE
    # Of a frame, by its part that shows most.
    first, middle, last = sides(OPENED, stills(1, 1.25, 1.75))
    assert first == middle < last < TEXTURE_SIDE
    numbers = range(1, 2)

    def show(path):
        blurred = StageScenes(path, LOOK, RATE, numbers=numbers, shutter=2)
        assert len([*FrameRange(blurred, numbers).frames([1], "box")]) == 2

    assert sides(OPENED, show)[0] == last


@scalar
def test_warnings_of_all_frames_come_once(tmp_path):
    fin = CUBE.replace("4]", "4, 4]", 1).replace("7,5]", "7,5, 0,1,7,6]")
    path = write(tmp_path, prim("Mesh", "fin", fin) + prim("Points", "hair") + LAMP)
    shown, messages = stages.told(lambda: [*frame_range(path, range(1, 3)).frames([1, 2], "box")])
    assert (len(shown), len(messages)) == (2, 2)
    messages.sort(key=len)
    assert "Points are ignored (/hair)" in messages[0]
    assert messages[1].startswith(f'"{path}", prim /fin: the faces are no manifold')


def crossing(folder, opens, closes):
    """A bright square, a quarter of the picture wide, that moves by half a picture from time 0 to 1."""
    square = SQUARE.replace("(-1,", "(-.5,").replace("(1,", "(.5,"), "color3f inputs:color = (1, 1, 1)"
    move = moved(translate={0: (-1.5, 0, 0), 1: (0.5, 0, 0)})
    aperture = "float horizontalAperture = 40\nfloat verticalAperture = 20"
    shutter = f"double shutter:open = {opens}\ndouble shutter:close = {closes}"
    view = 'token projection = "orthographic"', aperture, shutter, moved(translate=(0, 0, 5))
    text = prim("Mesh", "square", *square, move, apis=["MeshLightAPI"]) + prim("Camera", "camera", *view)
    return write(folder, text)


def test_shutters_blur_a_moving_square_by_its_time_in_a_pixel(tmp_path):
    """Pixels are a quarter wide: from one of 16 sub-frames to the next, the square moves by a quarter of one."""
    left = -2 + 0.25 * np.arange(16)
    start = -2 + 2 * np.linspace(0.25, 0.75, 20001)[:, None]
    covered = np.clip(np.minimum(start + 1, left + 0.25) - np.maximum(start, left), 0, 0.25).mean(axis=0) / 0.25
    picture = str(tmp_path / "a.exr")
    options = "--size 16x8 --spp 64 --filter box -m scalar_rgb --time 0.5 --shutter 16"
    assert main(["render", str(crossing(tmp_path, -0.25, 0.25)), "-o", picture, *options.split()]) == 0
    image = np.array(mi.Bitmap(picture))[..., 1]
    # Each sub-frame has 4 samples in a row of the pixel, of which an edge of the square may hit one more or fewer.
    np.testing.assert_allclose(image, np.tile(covered, (8, 1)), atol=1 / 16)
    np.testing.assert_allclose(image.mean(axis=0), covered, atol=1 / 64)


def test_shutters_need_a_time_and_an_open_interval(tmp_path, capsys):
    path, cage = crossing(tmp_path, 0, 0), tmp_path / "cage.obj"
    cage.write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n")
    command = ["-m", "scalar_rgb", "-o", str(tmp_path / "x.png"), "--shutter", "2"]
    for arguments, message in (
        ([str(path), "--time", "1"], "shutter:open is 0, and shutter:close 0; expected a camera whose shutter opens"),
        ([str(path)], "expected --time or --frames\n"),
        ([str(path), "--time", "1", "--turntable", "3"], "not --turntable"),
        ([str(cage), "--time", "1"], "one cage"),
    ):
        assert main(["render", *arguments, *command]) != 0
        assert message in capsys.readouterr().err
    with pytest.warns(CageWarning, match="shutters of cameras have no effect without"):
        StillPicture(StageScenes(crossing(tmp_path, 0, 0.5), LOOK, RATE))


@pytest.fixture
def path(tmp_path):
    return write(tmp_path, STILL + INSTANCES)


def surfaces(scene):
    """Limit surfaces of a scene that stand alone, and those in groups."""
    entries = [entry for name, entry in scene.items() if isinstance(entry, dict) and name != "ground"]
    groups = [entry for entry in entries if entry["type"] == "shapegroup"]
    grouped = [shape for group in groups for name, shape in group.items() if name != "type"]
    return [entry for entry in entries if entry["type"] == "subdivision"], grouped


@exact
@pytest.mark.usefixtures("variant_llvm_ad_rgb")
def test_still_pictures_are_exact_with_outlines_for_their_camera_and_others_follow_none(path, capfd):
    scene = msub.usd_scene(path, mi, size=(1280, 960))
    alone, grouped = surfaces(scene)
    assert {entry["shading"] for entry in (*alone, *grouped)} == {"exact"}
    assert {(entry["pixel_error"], entry["outline"]) for entry in alone} == {(0.1, "sensor")}
    assert all(entry["sensor_to_world"] == scene["sensor"]["to_world"] for entry in alone)
    assert {entry["tessellation_rate"] for entry in grouped} == {8}
    assert mi.load_dict(scene).shapes()
    assert capfd.readouterr() == ("", "")
    for given in ({"tessellation_rate": 3}, {"shading": "vertex"}):
        alone, _ = surfaces(msub.usd_scene(path, mi, **given))
        assert all(entry.items() >= given.items() and "tessellation" not in entry for entry in alone)
    for shown in (
        StillPicture(StageScenes(path, LOOK, {}), follows_sensor=False),
        Turntable(StageScenes(path, LOOK, {}), 2),
        FrameRange(StageScenes(path, LOOK, {}, numbers=range(1, 3)), range(1, 3)),
    ):
        alone, _ = surfaces(shown.scene)
        assert alone
        assert all(entry["shading"] == "exact" and 1 <= entry["tessellation_rate"] <= 8 for entry in alone)


@scalar
def test_scalar_variants_use_vertex_normals_with_one_message(path, tmp_path, capfd):
    automatic, given = (surfaces(msub.usd_scene(path, mi, **more)) for more in ({}, {"shading": "vertex"}))
    assert [entry["tessellation_rate"] for entry in automatic[0]] == [entry["tessellation_rate"] for entry in given[0]]
    assert {entry["shading"] for entry in (*automatic[0], *automatic[1])} == {"vertex"}
    out, err = capfd.readouterr()
    message = "normals are interpolated between vertices: exact shading needs a variant of llvm"
    assert (out, err.count(message)) == ("", 1)
    frames = FrameRange(StageScenes(path, LOOK, {}, numbers=range(1, 4)), range(1, 4))
    assert len(list(frames.frames(frames.numbers, None))) == 3
    assert capfd.readouterr().err.count("\n") == 1
    msub.usd_scene(write(tmp_path, prim("Mesh", "flat", CUBE, POLYGONS), "flat.usda"), mi)
    msub.usd_scene(path, mi, face_normals=True)
    assert capfd.readouterr().err == ""
