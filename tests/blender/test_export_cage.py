"""Scenes that scenes/export_cage.py writes, against Blender's own subdivision and renders.

The environment variable BLENDER names the program, or a Python that has the package bpy.
"""

import functools
import importlib.util
import itertools
import json
import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import mitsuba as mi
import mitsuba_subdivision as msub
import numpy as np
import pytest
from mitsuba_subdivision.__main__ import main
from scipy.spatial import cKDTree

USD = ("Usd", "UsdGeom", "UsdLux", "UsdShade")
Usd, UsdGeom, UsdLux, UsdShade = (pytest.importorskip(f"pxr.{name}") for name in USD)
BLENDER = os.environ.get("BLENDER") or shutil.which("blender") or (importlib.util.find_spec("bpy") and sys.executable)
if not BLENDER:
    pytest.skip("there is neither the program blender nor the package bpy", allow_module_level=True)

SCRIPT = Path(__file__).parents[2] / "scenes" / "export_cage.py"
SCENES = Path(__file__).with_name("scenes.py")
SEGMENTS = 8  # 2 ** LEVEL of the model.
# Blender computes in single precision, with coordinates up to 3, and its patches at vertices with creases are
# approximations, of which the model asks the best.
TOLERANCE = 3e-6
# The least difference that a wrong rule makes.
DIFFERENCE = 5e-3


def blender(script, *arguments, scene=None):
    """Run a script without a window and without a user's settings, in a scene."""
    if Path(BLENDER).name.startswith("python"):
        command = [BLENDER, script, *(["--blend", scene] if scene else ["--"]), *arguments]
    else:
        command = [BLENDER, "-b", *([scene] if scene else []), "--python", script, "--", *arguments]
    command = [*map(str, command)]
    return subprocess.run(command, capture_output=True, text=True, encoding="utf-8", timeout=100, check=False)


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """Makes a scene of a kind once: its export as USD, what Blender knows of it, and what the export tells."""

    @functools.cache
    def make(kind):
        model = tmp_path_factory.mktemp(kind) / f"{kind}.blend"
        usda, other = model.with_suffix(".usda"), model.with_suffix(".json")
        done = blender(SCENES, kind, model, other)
        assert other.exists(), done.stdout + done.stderr
        done = blender(SCRIPT, usda, *["--animation"] * (kind == "shown"), scene=model)
        assert done.returncode == 0, done.stderr
        return usda, json.loads(other.read_text()), done.stderr

    return make


@pytest.fixture(scope="module")
def scene(made):
    """A scene, its export as USD, what Blender makes of each object, and what the export tells."""
    usda, answers, told = made("model")
    return usda.with_suffix(".blend"), usda, {name: np.array(rows) for name, rows in answers.items()}, told


def cage_of(usda, name):
    return msub.ControlCage.from_file(usda, prim="/root/" + re.sub(r"\W", "_", name))


def distance(ours, theirs):
    """Largest distance of a row from the nearest one of the other rows, in both directions."""
    return max(cKDTree(a).query(b)[0].max() for a, b in ((ours, theirs), (theirs, ours)))


def points_and_texcoords(cage):
    surface = msub.LimitSurface(cage).tessellate(rate=SEGMENTS)
    return np.concatenate([surface.positions, surface.texcoords], axis=1)


def test_surfaces_are_blenders_with_every_rule_of_its_modifier(scene):
    """Rows are points with texture coordinates, at the same parameters: those of Blender lie on its limit surface."""
    _, usda, answers, _ = scene
    assert len(answers) == 14
    wrong = {name: distance(points_and_texcoords(cage_of(usda, name)), rows) for name, rows in answers.items()}
    assert max(wrong.values()) < TOLERANCE, wrong
    # Each rule changes this scene, so that a wrong one is seen.
    rows = [rows for name, rows in answers.items() if name != "mirrored"]
    assert min(np.abs(one - other).max() for one, other in itertools.combinations(rows, 2)) > DIFFERENCE


def test_the_add_on_mends_what_blender_writes(scene, tmp_path, monkeypatch):
    monkeypatch.setenv("BLENDER_USER_RESOURCES", str(tmp_path))
    script, usda, name = tmp_path / "script.py", tmp_path / "model.usda", "ALL_NONE"
    steps = [f"preferences.addon_install(filepath={str(SCRIPT)!r})", 'preferences.addon_enable(module="export_cage")']
    steps += [f"wm.open_mainfile(filepath={str(scene[0])!r})", f"wm.usd_export(filepath={str(usda)!r})"]
    script.write_text("\n".join(["import bpy", *(f"bpy.ops.{step}" for step in steps)]), encoding="utf-8")
    blender(script)
    np.testing.assert_array_equal(cage_of(usda, name).contents.creases, cage_of(scene[1], name).contents.creases)


def test_objects_are_placed_and_losses_printed(scene):
    """Transforms reach the cage, hidden objects are left out, and modifiers below the subdivision are told."""
    _, usda, _, told = scene
    base, moved = cage_of(usda, "ALL_PRESERVE_BOUNDARIES"), cage_of(usda, "Würfel 1.001")
    # Blender's rotation_euler turns about x first, then y, then z.
    matrix = np.diag([-1.0, 1.5, 2.0])
    for a, b, angle in ((1, 2, 0.1), (2, 0, 0.2), (0, 1, 0.3)):
        turn = np.eye(3)
        turn[[a, b], [a, b]], turn[a, b], turn[b, a] = np.cos(angle), -np.sin(angle), np.sin(angle)
        matrix = turn @ matrix
    np.testing.assert_allclose(moved.positions, base.positions @ matrix.T + [1, 2, 3], atol=1e-6)
    assert 'object "Würfel 1.001": modifiers below "Subdivision" are left out: Thickness' in told
    for name, height in (("holder", 5), ("holder_001", 7)):
        np.testing.assert_allclose(cage_of(usda, name).positions, np.add(base.positions, [0, 0, height]), atol=1e-6)
    assert '"hidden"' not in usda.read_text(encoding="utf-8")
    with pytest.raises(msub.CageError, match="not to be subdivided"):
        cage_of(usda, "Ground")


def test_materials_are_bound_to_faces(scene):
    stage = Usd.Stage.Open(str(scene[1]))
    assert not stage.GetCompositionErrors()
    for name in ("ALL_NONE", "Würfel_1_001"):
        mesh = UsdGeom.Imageable(stage.GetPrimAtPath(f"/root/{name}/Mesh"))
        parts = UsdGeom.Subset.GetGeomSubsets(mesh, "face", "materialBind")
        bound = {part.GetIndicesAttr().Get()[-1]: bound_color(part.GetPrim()) for part in parts}
        assert bound == {10: pytest.approx((0.9, 0.6, 0.2)), 11: pytest.approx((0.8, 0.1, 0.05))}
    # Its first slot has a material of the object.
    parts = stage.GetPrimAtPath("/root/no_creases/Mesh").GetChildren()
    assert [bound_color(part) for part in parts] == 2 * [pytest.approx((0.9, 0.6, 0.2))]
    assert bound_color(stage.GetPrimAtPath("/root/Ground/Mesh")) == pytest.approx((0.9, 0.6, 0.2))


def test_polygons_with_smooth_shading_have_normals(scene):
    """Those of a tetrahedron around the origin point away from it."""
    stage = Usd.Stage.Open(str(scene[1]))
    mesh = UsdGeom.Mesh(stage.GetPrimAtPath("/root/Smooth/Mesh"))
    corners = np.array(mesh.GetPointsAttr().Get())[np.array(mesh.GetFaceVertexIndicesAttr().Get())]
    np.testing.assert_allclose(mesh.GetNormalsAttr().Get(), corners / np.sqrt(3), atol=1e-3)
    assert mesh.GetNormalsInterpolation() == "faceVarying"


def bound_color(prim):
    material, _ = UsdShade.MaterialBindingAPI(prim).ComputeBoundMaterial()
    return tuple(material.ComputeSurfaceSource("mtlx")[0].GetInput("base_color").Get())


# Largest distance of points up to thirty units away, in single precision.
POINT_TOLERANCE = 3e-5


@pytest.fixture(scope="module")
def shown(made):
    """A stage of what a render shows, its points in Blender, and what the export tells."""
    usda, (_, points), told = made("shown")
    return Usd.Stage.Open(str(usda)), points, told


def test_points_equal_those_of_a_render(shown):
    """With render levels, hidden objects, curves, texts, instances; objects with subdivision are their cages."""
    stage, expected, told = shown
    found, cages, place = {}, {}, UsdGeom.XformCache(1)
    for prim in Usd.PrimRange(stage.GetDefaultPrim(), Usd.TraverseInstanceProxies()):
        if prim.IsA(UsdGeom.Mesh):
            owner = prim.GetAttribute("userProperties:blender:object_name").Get()
            points = np.array(UsdGeom.Mesh(prim).GetPointsAttr().Get(1))
            matrix = np.array(place.GetLocalToWorldTransform(prim))
            is_cage = UsdGeom.Mesh(prim).GetSubdivisionSchemeAttr().Get() != "none"
            (cages if is_cage else found).setdefault(owner, []).append(points @ matrix[:3, :3] + matrix[3, :3])
    counts = {name: len(parts) for name, parts in expected.items()}
    assert {name: len(parts) for name, parts in (found | cages).items()} == counts
    # A bevel of 12 sides has 6 rings in renders, and 3 in the viewport.
    assert {name: len(parts[0]) for name, parts in cages.items()} == {
        **dict.fromkeys(("part", "2nd.thick", "key", "rigged", "creased"), 8),
        "wire": 72,
    }
    for name, parts in found.items():
        assert distance(np.concatenate(parts), np.concatenate(expected[name])) < POINT_TOLERANCE, name
    assert 'object "2nd.thick": modifiers below "Subsurf" are left out: Solidify' in told


def test_animated_properties_have_samples(shown):
    stage, _, told = shown
    assert (stage.GetStartTimeCode(), stage.GetEndTimeCode()) == (1, 3)

    def values(path, *times):
        return [np.array(stage.GetAttributeAtPath(f"/root/{path}").Get(time)) for time in times]

    # Blender eases in and out; frame 2 is half-way.
    base, middle, larger = values("key/Mesh.points", 1, 2, 3)
    np.testing.assert_allclose([middle, larger], [1.5 * base, 2 * base], rtol=1e-6)
    np.testing.assert_allclose(values("Sun/Sun.inputs:intensity", 1, 3), [1, 3], rtol=1e-6)
    np.testing.assert_allclose(values("Camera/Camera.horizontalAperture", 1, 3), [250, 251], rtol=1e-6)
    np.testing.assert_allclose(values("Camera/Camera.shutter:close", 1), [0.25])
    assert stage.GetAttributeAtPath("/root/leaving/Mesh.visibility").Get(3) == "invisible"
    assert 'markers change the camera: the file has "Camera" at all frames' in told
    assert stage.GetRelationshipAtPath("/Render/Settings.camera").GetTargets() == ["/root/Camera/Camera"]
    np.testing.assert_allclose(values("holder.xformOp:scale", 3), [[1, 1, 1.5]], rtol=1e-6)
    np.testing.assert_allclose(np.unique(values("creased/Mesh.creaseSharpnesses", 1, 2)), [0, 2.025], rtol=1e-6)


# Relative and absolute difference of means of the pixels of an object.
MEAN, DARK = 0.05, 0.004
# Mitsuba's BSDFs are other models of reflection: see the table of the guide.
OTHERS, MEAN_OF_OTHERS = ("block_0", "block_2", "block_3", "tile_4"), 0.15
OPTIONS = {"shown": ["--spp", "64", "--time", "2", "--shutter", "4"]}


@pytest.mark.parametrize("kind", ["look", "shown", "studio", "houses"])
@pytest.mark.filterwarnings("ignore::mitsuba_subdivision.CageWarning")  # Of what is left out.
def test_objects_are_as_bright_as_in_cycles(made, kind):
    """Materials, lights, the world and the camera, also where they move."""
    usda, (names, _), _ = made(kind)
    picture, options = usda.with_name("mitsuba.exr"), OPTIONS.get(kind, ["--spp", "128"])
    assert main(["render", str(usda), "-o", str(picture), "--filter", "box", *options]) == 0
    expected, result = np.array(mi.Bitmap(str(usda.with_suffix(".exr")))), np.array(mi.Bitmap(str(picture)))
    assert result.shape[:2] == expected.shape[:2]
    wrong, numbers = {}, expected[..., -1].astype(int)
    for number in np.unique(numbers):
        name = ["world", *names][number]
        ours, theirs = (each[numbers == number, :3].mean(axis=0) for each in (result, expected))
        if not np.allclose(ours, theirs, rtol=MEAN_OF_OTHERS if name in OTHERS else MEAN, atol=DARK):
            wrong[name] = ours, theirs
    assert not wrong


def test_omissions_are_printed(made):
    usda, _, told = made("look")
    for what in (
        'light "Lamp": left out: its spread',
        'object "tile_12": left out: rays to which it is invisible (shadow)',
        'material "paint_12": the Glass BSDF is left out',
        'material "paint_12": the Voronoi Texture is left out',
        'material "paint_12": the Alpha of "Tint" at "Alpha" is left out',
    ):
        assert told.count(f"export_cage: {what}") == 1, told
    # What is written is not told.
    assert all(f'"paint_{number}"' not in told for number in range(12))
    # Blender interpolates colours linearly, also on surfaces.
    stage = Usd.Stage.Open(str(usda))
    assert stage.GetAttributeAtPath("/root/tile_10/Mesh.primvars:Tint").GetMetadata("interpolation") == "varying"
    assert stage.GetAttributeAtPath("/root/Camera/Camera.fStop").Get() == 50  # 0.5, in units of a centimetre.


def test_an_obj_file_has_the_same_cage(scene, tmp_path):
    blend, usda, _, _ = scene
    obj, name = tmp_path / "house.obj", "PRESERVE_CORNERS_PRESERVE_CORNERS"
    done = blender(SCRIPT, obj, "--object", name, scene=blend)
    assert done.returncode == 0, done.stderr
    result, expected = msub.ControlCage.from_file(obj), cage_of(usda, name)
    np.testing.assert_array_equal(result.positions, expected.positions)
    np.testing.assert_array_equal(result.face_vertices, expected.face_vertices)
    ours, theirs = (cage.texcoords.values[cage.texcoords.indices] for cage in (result, expected))
    np.testing.assert_array_equal(ours, theirs)
    assert len(result.texcoords.values) == len(expected.texcoords.values)
    assert result.contents.rules == expected.contents.rules
    # USD has sharpness in single precision.
    for rows in ("creases", "corners"):
        np.testing.assert_allclose(getattr(result.contents, rows), getattr(expected.contents, rows), rtol=1e-7)
    # In OBJ files faces of a mirrored object are turned over; readers of USD do it themselves.
    done = blender(SCRIPT, obj, "--object", "Würfel 1.001", "--animation", scene=blend)
    assert done.returncode == 0, done.stderr
    ours, theirs = (points_and_texcoords(c) for c in (msub.ControlCage.from_file(obj), cage_of(usda, "Würfel 1.001")))
    assert distance(ours, theirs) < TOLERANCE


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["model.stl"], '"model.stl" ends with ".stl"; expected .usda, .usdc or .obj'),
        (["model.obj"], "a render shows 17 cages of all objects; choose one with --object: "),
        (["model.usda", "--object", "hidden"], 'a render shows 0 meshes of hidden; choose one with --object: "ALL_'),
        (["no/such/folder/model.usda"], "no/such/folder/model.usda: No such file or directory"),
    ],
)
def test_errors_are_messages_and_a_status(scene, tmp_path, monkeypatch, arguments, message):
    monkeypatch.chdir(tmp_path)
    done = blender(SCRIPT, *arguments, scene=scene[0])
    assert done.returncode == 1
    assert f"export_cage: {message}" in done.stderr
    assert "Traceback" not in done.stderr
    assert not list(tmp_path.glob("*.*"))
