"""Cages that scenes/export_cage.py takes out of Blender, against Blender's own subdivision of the same objects."""

import json
import os
import re
import shutil
import subprocess
from pathlib import Path

import mitsuba_subdivision as msub
import numpy as np
import pytest
from scipy.spatial import cKDTree

pytest.importorskip("pxr")
BLENDER = os.environ.get("BLENDER") or shutil.which("blender")
if BLENDER is None:
    pytest.skip("there is no program blender", allow_module_level=True)

SCRIPT = Path(__file__).parents[2] / "scenes" / "export_cage.py"
MODEL = Path(__file__).with_name("model.py")
SEGMENTS = 8  # 2 ** LEVEL of the model.
# Blender computes in single precision, with coordinates up to 3, and its patches at vertices with creases are
# approximations, of which the model asks the best.
TOLERANCE = 3e-6
# The least difference that a wrong rule makes.
DIFFERENCE = 5e-3


def blender(*arguments):
    """Run Blender without a window and without a user's settings."""
    command = [BLENDER, "-b", *map(str, arguments)]
    return subprocess.run(command, capture_output=True, text=True, encoding="utf-8", timeout=100, check=False)


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    """A scene, its export as USD, and what Blender makes of each object."""
    folder = tmp_path_factory.mktemp("blender")
    files = folder / "model.blend", folder / "answers.json", folder / "model.usda"
    made = blender("--python", MODEL, "--", *files[:2])
    assert files[1].exists(), made.stdout + made.stderr
    exported = blender(files[0], "--python", SCRIPT, "--", files[2])
    assert exported.returncode == 0, exported.stderr
    answers = {name: np.array(rows) for name, rows in json.loads(files[1].read_text()).items()}
    return files[0], files[2], answers, exported.stderr


def cage_of(usda, name):
    return msub.ControlCage.from_file(usda, prim="/World/" + re.sub(r"\W", "_", name, flags=re.ASCII))


def distance(ours, theirs):
    """Largest distance of a row from the nearest one of the other rows, in both directions."""
    return max(cKDTree(a).query(b)[0].max() for a, b in ((ours, theirs), (theirs, ours)))


def points_and_texcoords(cage):
    found = msub.LimitSurface(cage).tessellate(rate=SEGMENTS)
    return np.concatenate([found.positions, found.texcoords], axis=1)


def test_surfaces_are_blenders_with_every_rule_of_its_modifier(scene):
    """Rows are points with texture coordinates, at the same parameters: those of Blender lie on its limit surface."""
    _, usda, answers, _ = scene
    assert len(answers) == 14
    wrong = {name: distance(points_and_texcoords(cage_of(usda, name)), rows) for name, rows in answers.items()}
    assert max(wrong.values()) < TOLERANCE, wrong


def test_rules_of_the_modifier_matter_in_this_scene(scene):
    """So that the test above would see a wrong one."""
    *_, answers, _ = scene
    rows = [rows for name, rows in answers.items() if name != "mirrored"]
    assert len(rows) == 13
    for i, one in enumerate(rows):
        for other in rows[:i]:
            assert np.abs(one - other).max() > DIFFERENCE


def test_objects_are_placed_and_told(scene):
    """Transforms reach the cage, hidden objects are left out, and modifiers below the subdivision are told."""
    _, usda, _, told = scene
    base, moved = cage_of(usda, "ALL_PRESERVE_BOUNDARIES"), cage_of(usda, "Würfel 1.001")
    # Blender's rotation_euler turns about x first, then y, then z.
    turns = [(1, 2, 0.1), (2, 0, 0.2), (0, 1, 0.3)]
    matrix = np.diag([-1.0, 1.5, 2.0])
    for a, b, angle in turns:
        turn = np.eye(3)
        turn[[a, b], [a, b]], turn[a, b], turn[b, a] = np.cos(angle), -np.sin(angle), np.sin(angle)
        matrix = turn @ matrix
    np.testing.assert_allclose(moved.positions, base.positions @ matrix.T + [1, 2, 3], atol=1e-6)
    assert 'object "Würfel 1.001": modifiers below "Subdivision" are left out: Thickness' in told
    # Instances of a collection.
    for name, height in (("part", 5), ("part_2", 7)):
        np.testing.assert_allclose(cage_of(usda, name).positions, np.add(base.positions, [0, 0, height]), atol=1e-6)
    text = usda.read_text(encoding="utf-8")
    assert '"hidden"' not in text
    assert 'displayName = "Würfel 1.001"' in text
    with pytest.raises(msub.CageError, match="not to be subdivided"):
        cage_of(usda, "Ground")


def test_materials_lights_and_camera_are_usds(scene):
    """Also those of meshes that several objects share, which are instances of one class."""
    from pxr import Usd, UsdGeom, UsdLux, UsdShade

    stage = Usd.Stage.Open(str(scene[1]))
    assert not stage.GetCompositionErrors()
    assert stage.GetDefaultPrim().GetName() == "World"
    assert UsdGeom.GetStageUpAxis(stage) == "Z"
    world = stage.GetPrimAtPath("/World")
    for name in ("ALL_NONE", "W_rfel_1_001"):
        mesh = stage.GetPrimAtPath(f"/World/{name}/Cage")
        subsets = UsdGeom.Subset.GetGeomSubsets(UsdGeom.Imageable(mesh), "face", "materialBind")
        bound = {each.GetIndicesAttr().Get()[-1]: bound_color(UsdShade, each.GetPrim()) for each in subsets}
        assert bound == {10: pytest.approx((0.9, 0.6, 0.2)), 11: pytest.approx((0.8, 0.1, 0.05))}
    # Its first slot has a material of the object.
    mesh = stage.GetPrimAtPath("/World/no_creases/Cage")
    subsets = UsdGeom.Subset.GetGeomSubsets(UsdGeom.Imageable(mesh), "face", "materialBind")
    assert [bound_color(UsdShade, each.GetPrim()) for each in subsets] == 2 * [pytest.approx((0.9, 0.6, 0.2))]
    shared = [stage.GetPrimAtPath(f"/World/{name}") for name in ("ALL_NONE", "no_creases", "W_rfel_1_001")]
    assert [each.IsInstance() for each in shared] == [False, False, True]
    assert bound_color(UsdShade, stage.GetPrimAtPath("/World/Ground/Cage")) == pytest.approx((0.9, 0.6, 0.2))
    camera = UsdGeom.Camera(stage.GetPrimAtPath("/World/Camera")).GetCamera()
    # Blender's default sensor is 36 mm wide, and its picture 1920 x 1080.
    assert camera.GetFieldOfView(camera.FOVHorizontal) == pytest.approx(2 * np.degrees(np.arctan(18 / 80)), rel=1e-6)
    assert camera.aspectRatio == pytest.approx(1920 / 1080)
    assert camera.transform.ExtractTranslation() == (0, -8, 3)
    lights = {each.GetName(): each for each in world.GetChildren() if each.HasAPI(UsdLux.LightAPI)}
    assert {name: str(each.GetTypeName()) for name, each in lights.items()} == {
        "SUN": "DistantLight",
        "AREA": "RectLight",
        "POINT": "SphereLight",
        "SPOT": "SphereLight",
        "World": "DomeLight",
    }
    intensity = {name: UsdLux.LightAPI(each).GetIntensityAttr().Get() for name, each in lights.items()}
    assert intensity["SUN"] == 100
    assert intensity["POINT"] == intensity["SPOT"] == pytest.approx(100 / np.pi)
    # Area lights were darker before Blender 4.0.
    assert intensity["AREA"] in (pytest.approx(100 / 4), pytest.approx(100 / np.pi))
    assert UsdLux.LightAPI(lights["World"]).GetColorAttr().Get() == pytest.approx((0.1, 0.2, 0.3))


def bound_color(UsdShade, prim):
    material, _ = UsdShade.MaterialBindingAPI(prim).ComputeBoundMaterial()
    shader, _, _ = material.ComputeSurfaceSource()
    assert shader.GetIdAttr().Get() == "UsdPreviewSurface"
    return tuple(shader.GetInput("diffuseColor").Get())


def test_an_obj_file_has_the_same_cage(scene, tmp_path):
    blend, usda, _, _ = scene
    obj, name = tmp_path / "house.obj", "PRESERVE_CORNERS_PRESERVE_CORNERS"
    done = blender(blend, "--python", SCRIPT, "--", obj, "--object", name)
    assert done.returncode == 0, done.stderr
    found, expected = msub.ControlCage.from_file(obj), cage_of(usda, name)
    np.testing.assert_array_equal(found.positions, expected.positions)
    np.testing.assert_array_equal(found.face_vertices, expected.face_vertices)
    np.testing.assert_array_equal(found.texcoords.indices, expected.texcoords.indices)
    np.testing.assert_array_equal(found.texcoords.values, expected.texcoords.values)
    assert found.contents.rules == expected.contents.rules
    # USD has sharpness in single precision.
    for rows in ("creases", "corners"):
        np.testing.assert_allclose(getattr(found.contents, rows), getattr(expected.contents, rows), rtol=1e-7)
    # In OBJ files faces of a mirrored object are turned over; readers of USD do it themselves.
    done = blender(blend, "--python", SCRIPT, "--", obj, "--object", "Würfel 1.001")
    assert done.returncode == 0, done.stderr
    ours, theirs = (points_and_texcoords(c) for c in (msub.ControlCage.from_file(obj), cage_of(usda, "Würfel 1.001")))
    assert distance(ours, theirs) < TOLERANCE


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["model.stl"], 'output "model.stl" has the extension ".stl"; expected .usda or .obj'),
        (["model.obj"], "OBJ files hold one cage, but there are 17; choose with --object: "),
        (["model.usda", "--object", "hidden"], 'a render shows no mesh of the object "hidden"; expected one of "ALL_'),
        (["no/such/folder/model.usda"], "no/such/folder/model.usda: No such file or directory"),
    ],
)
def test_errors_are_messages_and_a_status(scene, tmp_path, monkeypatch, arguments, message):
    monkeypatch.chdir(tmp_path)
    done = blender(scene[0], "--python", SCRIPT, "--", *arguments)
    assert done.returncode == 1
    assert f"export_cage: {message}" in done.stderr
    assert "Traceback" not in done.stderr
    assert not list(tmp_path.iterdir())
