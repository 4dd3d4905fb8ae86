"""Stages as options change them: alpha, stronger layers, environments, studios, units and weights of lights."""

import mitsuba as mi
import mitsuba_subdivision as msub
import numpy as np
import pytest
from mitsuba_subdivision.__main__ import main
from mitsuba_subdivision.cage import CageError
from mitsuba_subdivision.regression.scene import load_scene
from mitsuba_subdivision.studio.animation import StillPicture
from mitsuba_subdivision.studio.picture import LEAST_LIGHTS
from mitsuba_subdivision.studio.studio_entries import Look
from mitsuba_usd.stage_scenes import StageScenes
from shapes.variants import scalar
from usd import stages
from usd.stages import CUBE, POLYGONS, SQUARE, bound, mesh, moved, prim, told
from usd.test_stage_frames import CAMERA, LAMP, LENS, RATE, STILL, write

DULL_SKY = prim("DomeLight", "sky", "float inputs:intensity = 0.5")


def command(path, *options, to="p.exr", samples=16):
    small = ["--size", "24x18", "--spp", str(samples), "--filter", "box", "--rate", "2", "-m", "scalar_rgb"]
    return main(["render", str(path), "-o", str(path.parent / to), *small, *options])


def rendered(path, *options, **more):
    assert command(path, *options, **more) == 0
    return np.array(mi.Bitmap(str(path.parent / "p.exr")))


@scalar
def test_a_transparent_picture_over_the_background_is_the_picture(tmp_path):
    """Of what is opaque, half clear, and shines itself."""
    glow = prim("Mesh", "g", CUBE, moved(translate=(-2.6, 0, 0)), "float inputs:intensity = 0.7", apis=["MeshLightAPI"])
    faded = prim("Mesh", "faded", CUBE, moved(translate=(0, 0, 2.2)), "float[] primvars:displayOpacity = [0.4]")
    settings = prim("RenderSettings", "settings", "bool cycles:background:transparent = 1")
    whole = STILL + glow + DULL_SKY + CAMERA
    path = write(tmp_path, whole)
    opaque, clear = rendered(path), rendered(path, "--transparent")
    color, alpha = clear[..., :3], clear[..., 3:]
    np.testing.assert_allclose(color + (1 - alpha) * 0.5, opaque, atol=1e-5)
    assert alpha[0, 0] == 0
    is_covered = alpha > 0.999
    assert np.count_nonzero(is_covered & (color[..., :1] > 0.65)) > 3
    assert np.count_nonzero(is_covered & (color[..., :1] < 0.5)) > 3
    # Through a mask, the sky is sampled in two ways.
    opaque, behind = (rendered(write(tmp_path, whole + faded), *more, samples=64) for more in ((), ("--transparent",)))
    np.testing.assert_allclose(behind[..., :3] + (1 - behind[..., 3:]) * 0.5, opaque, atol=0.03)
    # Rays meet two walls; some pixels lie on their outline.
    walls = behind[..., 3][(alpha[..., 0] == 0) & (behind[..., 3] > 0.2)]
    assert np.quantile(walls, 0.75) == pytest.approx(1 - 0.6**2, abs=0.06)
    asks = stages.write(tmp_path, whole + settings, "asks.usda", head='renderSettingsPrimPath = "/settings"')
    np.testing.assert_array_equal(rendered(asks), clear)
    # Eight bits have colours that are not multiplied by alpha.
    assert command(write(tmp_path, whole), "--transparent", to="p.png") == 0
    shown, is_seen = np.array(mi.Bitmap(str(tmp_path / "p.png"))) / 255, alpha[..., 0] > 0.1
    straight = color[is_seen] / alpha[is_seen]
    srgb = np.where(straight < 0.0031308, 12.92 * straight, 1.055 * np.maximum(straight, 1e-6) ** (1 / 2.4) - 0.055)
    np.testing.assert_allclose(shown[is_seen][:, :3], np.clip(srgb, 0, 1), atol=1.01 / 255)
    np.testing.assert_allclose(shown[..., 3:], alpha, atol=1.01 / 255)
    for options in (["-o", "p.jpg"], ["-o", "p.exr", "--passes", "2"]):
        assert command(path, "--transparent", *options) == 1


@scalar
def test_stronger_layers_change_their_prims_and_warn_of_missing_ones(tmp_path):
    path, over = write(tmp_path, STILL + LAMP + DULL_SKY + CAMERA), tmp_path / "look.usda"
    changes = {
        "lamp": 'token visibility = "invisible"',
        "sky": "float inputs:intensity = 2",
        "still": "color3f[] primvars:displayColor = [(1, 0, 0)]",
        "camera": "float focalLength = 70",
        "other": "",
    }
    over.write_text("#usda 1.0\n" + "".join(f'over "{name}" {{\n{text}\n}}\n' for name, text in changes.items()))
    scene, messages = told(msub.usd_scene, path, mi, over=over)
    assert messages == [f'"{over}": there are no prims /other to change']
    assert "lamp" not in scene
    assert scene["sky"]["radiance"]["value"] == [2.0] * 3
    assert scene["still"]["bsdf"]["bsdf"]["reflectance"]["value"] == [1.0, 0.0, 0.0]
    assert scene["sensor"]["fov"] == pytest.approx(np.degrees(2 * np.arctan(24 / 140)))
    # The up axis is of the stage's own layer, which stays as it is.
    own = msub.usd_scene(path, mi)
    assert told(StageScenes(path, Look(), RATE, over=over).at)[0].up == "z"
    np.testing.assert_array_equal(*(np.array(entries["sensor"]["to_world"].matrix) for entries in (scene, own)))
    over.write_text('#usda 1.0\nover "lamp" {\n    token\n}\n')
    with pytest.raises(CageError, match=r'look\.usda", line 3'):
        msub.usd_scene(path, mi, over=over)
    with pytest.raises(FileNotFoundError):
        msub.usd_scene(path, mi, over=tmp_path / "none.usda")


@pytest.mark.parametrize("axis", "YZ")
@scalar
def test_an_environment_is_a_dome_in_place_of_all_lights(tmp_path, axis):
    """As if the stage had it, turned about the axis that points up."""
    write(tmp_path, "")
    glow = prim("Mesh", "glowing", CUBE, "float inputs:intensity = 1", apis=["MeshLightAPI"])
    lit = stages.write(tmp_path, STILL + LAMP + glow, "lit.usda", up=axis)
    picture, turn = "asset inputs:texture:file = @sky.exr@\nfloat inputs:intensity = 3", moved(**{f"rotate{axis}": 40})
    own = stages.write(tmp_path, STILL + prim("DomeLight_1", "sky", picture, turn), "own.usda", up=axis)
    look = Look(size=(24, 18), environment=tmp_path / "sky.exr", turn=40, strength=3)
    given, expected = (StillPicture(StageScenes(file, look, RATE)).scene for file in (lit, own))
    expected = msub.usd_scene(own, mi)
    assert {"lamp", "key_light", "ground"}.isdisjoint(given)
    assert "emitter" not in given["glowing"]
    domes = [mi.traverse(mi.load_dict(entry)) for entry in (given["environment"], expected["sky"])]
    np.testing.assert_allclose(*(np.array(dome["to_world"].matrix) for dome in domes), atol=1e-6)
    np.testing.assert_allclose(*(np.array(dome["data"]) * np.array(dome["scale"]) for dome in domes), rtol=1e-5)


@scalar
def test_messages_name_the_studios_additions_and_their_reason(tmp_path, capfd):
    """Lights that are invisible, inactive or without power are none."""
    weak = prim("SphereLight", "weak", "float inputs:intensity = 0")
    hidden = prim("DomeLight", "sky", 'token visibility = "invisible"')
    path = write(tmp_path, STILL + weak + hidden + prim("DiskLight", "out", head="active = false"))
    assert rendered(path).max() > 0.1
    reasons = "(/weak has no power, /sky is invisible, /out is inactive)"
    added = "the studio's camera and lights are added; --no-studio renders without its lights\n"
    assert f"no camera and no visible light {reasons}: {added}" in capfd.readouterr().err
    assert rendered(path, "--no-studio").max() == 0
    assert f"no camera and no visible light {reasons}: the studio's camera is added\n" in capfd.readouterr().err
    empty = write(tmp_path, "", "empty.usda")
    assert rendered(empty, "--no-studio").max() == 0
    assert command(empty) == 1
    capfd.readouterr()
    rendered(write(tmp_path, STILL + LAMP + CAMERA))
    assert "studio" not in capfd.readouterr().err


@scalar
def test_cameras_have_names_shutters_intervals_and_still_frames_a_message(tmp_path, capfd):
    other = prim("Scope", "rig", prim("Camera", "far", "float focalLength = 10", moved(translate=(0, 0, 50))))
    path = write(tmp_path, STILL + DULL_SKY + CAMERA.replace("1: ", "0: ").replace("5: ", "1: ") + other)
    assert msub.usd_scene(path, mi, camera="far")["sensor"]["fov"] == pytest.approx(92.672, abs=1e-3)
    for name in ("/rig/far", "far"):
        np.testing.assert_array_equal(rendered(path, "--camera", name), rendered(path, "--camera", "/rig/far"))
    assert command(path, "--camera", "near") == 1
    assert 'there is no camera "near"; expected one of /camera, /rig/far' in capfd.readouterr().err
    # The mean of both halves of the interval.
    blurred = rendered(path, "--time", "0.5", "--shutter", "-0.25:0.75:2")
    halves = [rendered(path, "--time", time, samples=8) for time in ("0.5", "1")]
    assert np.abs(blurred - np.mean(halves, axis=0)).mean() < 0.25 * np.abs(halves[0] - halves[1]).mean()
    # At rest, sub-frames have samples of their own.
    one, both = (rendered(path, "--time", "7", "--shutter", f"0:1:{count}", samples=count) for count in (1, 2))
    assert not np.array_equal(one, both)
    assert command(path, "--time", "1", "--shutter", "2") == 1
    assert "or an interval, such as --shutter -0.25:0.25" in capfd.readouterr().err
    assert command(write(tmp_path, STILL + DULL_SKY), "--frames", "1:2", to="f.exr") == 0
    assert "nothing changes with time; all frames are the same picture" in capfd.readouterr().err
    assert command(tmp_path / "model.blend") == 1
    assert "a file for programs such as Blender, which can convert it to USD" in capfd.readouterr().err


def of_unit(unit):
    """A box and glass that absorbs on a floor, by lamps of all kinds, before a camera with depth of field."""

    def at(*place, **more):
        return moved(translate=tuple(unit * x for x in place), **more)

    whole, size = "bool inputs:normalize = 1\nfloat inputs:intensity =", (unit,) * 3
    glass = "float inputs:transmission = 1\ncolor3f inputs:transmission_color = (.9, .4, .3)\ntoken outputs:surface"
    kind = 'uniform token info:id = "ND_standard_surface_surfaceshader"'
    depth = f"float inputs:transmission_depth = {unit}"
    lens = f"float focusDistance = {11 * unit}\nfloat fStop = {0.5 / unit}\n"
    lens += f"float2 clippingRange = ({unit}, {99 * unit})"
    parts = [
        prim("Mesh", "box", CUBE, POLYGONS, at(0, 0, 1, scale=size)),
        mesh("ball", CUBE, bound("glass"), at(2, -1, 0.7, scale=size)),
        prim("Mesh", "floor", SQUARE, moved(scale=(8 * unit,) * 3)),
        prim("DistantLight", "sun", f"{whole} 0.5"),
        prim("SphereLight", "sphere", f"float inputs:radius = {unit}\nfloat inputs:intensity = 30", at(-3, -3, 5)),
        prim("RectLight", "rect", f"{whole} {60 * unit**2}", at(3, 0, 5, scale=size)),
        prim("SphereLight", "point", f"bool treatAsPoint = 1\n{whole} {20 * unit**2}", at(0, 3, 3)),
        prim("Camera", "camera", LENS, lens, at(0, -10, 5, rotateX=65)),
        prim(
            "Material",
            "glass",
            "token outputs:surface.connect = </glass/s.outputs:surface>",
            prim("Shader", "s", kind, depth, glass),
        ),
    ]
    return "".join(parts)


@scalar
@pytest.mark.filterwarnings("ignore::mitsuba_subdivision.CageWarning")
def test_models_of_a_millimetre_and_of_kilometres_are_the_same_picture(tmp_path):
    """Contact shadows, powers, absorption and lenses are those of unit 1. Rounding lets few paths differ."""
    expected = rendered(write(tmp_path, of_unit(1)))
    for unit in (1e-4, 1e-2, 1e4):
        picture = rendered(write(tmp_path, of_unit(unit)))
        is_other = np.abs(picture - expected).max(axis=2) > 0.02 * expected.mean()
        assert is_other.mean() < 0.02, unit
        np.testing.assert_allclose(picture.mean(), expected.mean(), rtol=0.02)


@pytest.mark.usefixtures("variant_llvm_ad_rgb")
def test_light_weights_follow_contributions_and_keep_the_mean(tmp_path):
    """By weights of the loaded scene or of its entries: of lamps, a sky, and meshes that shine, subdivided or not."""
    coordinates = f'texCoord2f[] primvars:st = [{"(0, 0), (1, 1)," * 4}] (interpolation = "vertex")'
    mesh_light = {"apis": ["MeshLightAPI"]}
    lights = [
        prim("SphereLight", "emitter", "float inputs:intensity = 0.2", moved(translate=(-4, -3, 4))),
        prim("SphereLight", "strong", "float inputs:intensity = 40", moved(translate=(-2, -3, 4))),
        prim("Mesh", "panel", SQUARE, "float inputs:intensity = 0.02", moved(translate=(0, 0, 4)), **mesh_light),
        prim("Mesh", "glow", CUBE, coordinates, "float inputs:intensity = 0.02", **mesh_light),
        DULL_SKY.replace("0.5", "0.01"),
    ]
    floor = prim("Mesh", "floor", SQUARE, moved(scale=(9, 9, 1)))

    def loaded(count, **more):
        # Loading takes the tensor out of its dictionary.
        bitmap = {"type": "bitmap", "raw": True, "data": mi.TensorXf(np.full((2, 2, 1), 0.01, np.float32))}
        path, more = write(tmp_path, floor + "".join(lights[:count]) + CAMERA), {**more, "displacement": bitmap, **RATE}
        return load_scene(msub.usd_scene(path, mi, size=(16, 12), shading="vertex", **more), None, "box").scene

    def pictures(scene):
        return np.array([np.array(mi.render(scene, spp=16, seed=seed))[..., 0] for seed in range(12)])

    def weights(scene):
        return [float(mi.traverse(light)["sampling_weight"]) for light in scene.emitters()]

    scene = loaded(len(lights))
    before = pictures(scene)
    assert msub.weigh_lights(scene)
    after = pictures(scene)
    assert np.median(after.var(axis=0)) < 0.6 * np.median(before.var(axis=0))
    error = np.sqrt((before.var(axis=0).sum() + after.var(axis=0).sum()) / len(before)) / before[0].size
    assert abs(after.mean() - before.mean()) < 4 * error
    assert min(weights(scene)) == pytest.approx(0.03, rel=1e-6)
    of_entries = loaded(len(lights), weigh_lights=True)
    assert weights(of_entries) == weights(scene)
    np.testing.assert_array_equal(*(np.array(mi.render(each, spp=16)) for each in (of_entries, scene)))
    # Weights that are given stay, and few lights are chosen alike.
    assert not msub.weigh_lights(scene)
    assert not msub.weigh_lights(loaded(LEAST_LIGHTS - 1))
