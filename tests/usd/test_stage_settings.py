"""Render settings, products and variables of stages, as the command `render` follows them."""

from functools import partial

import mitsuba as mi
import mitsuba_subdivision as msub
import numpy as np
import OpenEXR
import pytest
from mitsuba_subdivision.__main__ import main
from mitsuba_subdivision.cage import named_cages
from mitsuba_usd.stage_settings import read_variant
from usd import stages
from usd.stages import CUBE, SQUARE, camera, mesh, moved, prim, told

pytestmark = pytest.mark.usefixtures("variant_scalar_rgb")

NAMED = 'renderSettingsPrimPath = "/settings"'
SOURCES = {"depth": "depth", "N": "normal", "where": "P", "albedo": "albedo", "st": "uv", "id": "primId"}
TYPES = {"depth": "depth", "N": "sh_normal", "where": "position", "albedo": "albedo", "st": "uv", "id": "shape_index"}
SIZE = (12, 8)


@pytest.fixture
def stage(tmp_path):
    return partial(stages.write, tmp_path, head=NAMED)


def settings(*lines):
    return prim("RenderSettings", "settings", f"uniform int2 resolution = {SIZE}", *lines)


def variable(name, source):
    return prim("RenderVar", name, f'uniform string sourceName = "{source}"')


def product(name, variables, *lines):
    targets = ", ".join(f"</{variable}>" for variable in variables)
    return prim(
        "RenderProduct", name, f'token productName = "/out/{name}.exr"', f"rel orderedVars = [{targets}]", *lines
    )


def channels(path):
    found = OpenEXR.File(str(path), separate_channels=True).channels()
    return {name: channel.pixels for name, channel in found.items()}


SHOWN = mesh("square", SQUARE, moved(rotateY=20, scale=(0.05, 0.05, 0.05)))
SHOWN += camera("float2 clippingRange = (0.01, 9)", placed=moved(translate=(0, 0, 0.5)))


def test_products_are_files_with_named_channels_of_mitsubas_integrator(stage, tmp_path, monkeypatch):
    """Of a small model, too, with lengths of the stage; and one product's picture has all channels."""
    monkeypatch.chdir(tmp_path)
    variables = "".join(variable(name, source) for name, source in (*SOURCES.items(), ("beauty", "raw")))
    several = product("first", ["beauty", "depth", "N"]) + product("second", [name for name in SOURCES if name != "N"])
    text = (
        settings(
            "rel products = [</first>, </second>]",
            "int mitsuba:sample_count = 4",
            'string mitsuba:variant = "scalar_rgb"',
        )
        + variables
        + several
        + SHOWN
    )
    path = stage(text)
    assert main(["render", str(path), "-o", "a.exr", "--filter", "box"]) == 0
    scene = msub.usd_scene(stage(text.replace("rel products", "rel other"), "plain.usda"), mi)
    aovs = ",".join(f"{name}:{kind}" for name, kind in TYPES.items())
    scene["integrator"] = {"type": "aov", "aovs": aovs, "image": scene["integrator"]}
    scene["sensor"]["film"]["rfilter"] = {"type": "box"}
    loaded = mi.load_dict(scene)
    expected = dict(
        zip(["R", "G", "B", *loaded.integrator().aov_names()[4:]], np.array(mi.render(loaded)).T, strict=True)
    )
    whole, first, second = (channels(tmp_path / f"a{name}.exr") for name in ("", "_first", "_second"))
    assert whole.keys() == expected.keys()
    assert first.keys() == {"R", "G", "B", "depth.T", "N.X", "N.Y", "N.Z"}
    assert second.keys() == expected.keys() - first.keys() | {"depth.T"}
    for name, values in whole.items():
        np.testing.assert_allclose(values, expected[name].T, atol=1e-4)
        for part in (first, second):
            assert name not in part or np.array_equal(part[name], values)
    assert first["depth.T"].max() > 0.4


def test_channels_of_the_command_line(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    named_cages.cube().save("cube.obj")
    words = ["render", "cube.obj", "--size", "12x8", "--spp", "1", "--rate", "2", "-m", "scalar_rgb"]
    words += ["--aov", "normals,z"]
    assert main([*words, "-o", "a.exr"]) == 0
    assert channels("a.exr").keys() == {"R", "G", "B", "normals.X", "normals.Y", "normals.Z", "z.T"}
    assert main([*words, "-o", "a.png"]) == 1


def test_parameters_of_mitsuba_and_a_crop(stage):
    """Pixels with their centres in the window are rendered; options are stronger than settings."""
    text = settings(
        'string mitsuba:integrator:type = "direct"',
        "int mitsuba:integrator:emitter_samples = 2",
        "int mitsuba:sample_count = 16",
        "uniform float4 dataWindowNDC = (0.25, 0, 1, 0.5)",
    )
    lens = 'string mitsuba:sensor:type = "thinlens"\nfloat mitsuba:sensor:aperture_radius = 0.5\n'
    lens += 'float mitsuba:sensor:focus_distance = 3\nstring mitsuba:sensor:film:filter:type = "box"'
    path = stage(text + camera(lens) + mesh("cube", CUBE))
    entries = msub.usd_scene(path, mi)
    assert entries["integrator"] == {"type": "direct", "emitter_samples": 2}
    sensor = mi.load_dict(entries["sensor"])
    assert (entries["sensor"]["aperture_radius"], sensor.sampler().sample_count()) == (0.5, 16)
    assert "BoxFilter" in str(sensor.film().rfilter())
    assert [*sensor.film().crop_size(), *sensor.film().crop_offset()] == [9, 4, 3, 4]
    assert msub.usd_scene(path, mi, spp=4)["sensor"]["sampler"]["sample_count"] == 4


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (settings("int mitsuba:integrator:gain = 2"), "mitsuba:integrator is ignored: "),
        (
            settings("int mitsuba:sample_count = 0"),
            "mitsuba:sample_count of render settings is ignored; expected a num",
        ),
        (
            settings() + camera('string mitsuba:sensor:type = "irradiancemeter"', name="b"),
            "mitsuba:sensor is ignored: ",
        ),
        (settings() + mesh("b", CUBE, 'string mitsuba:sensor = "/camera"'), "mitsuba:sensor of shapes is ignored"),
        (settings("rel products = </a>") + product("a", ["v"]) + variable("v", "lpe:C<RD>"), "lpe:C<RD>"),
        (
            settings("rel products = [</a>, </b>]")
            + product("a", [])
            + product("b", [], "uniform int2 resolution = (4, 4)"),
            "resolution of render products is ignored; the first has the picture (/b)",
        ),
    ],
)
def test_settings_that_are_not_followed_are_told(stage, text, message):
    _, (warning,) = told(msub.usd_scene, stage(text + mesh("cube", CUBE)), mi)
    assert message in warning


def test_the_variant_of_a_stage(stage, tmp_path):
    path = stage(settings('string mitsuba:variant = "scalar_mono"') + mesh("cube", CUBE))
    over = stages.write(tmp_path, 'over "settings" {\nstring mitsuba:variant = "scalar_rgb"\n}', "over.usda")
    assert [read_variant(path, None), read_variant(path, over), read_variant(over, None)] == [
        "scalar_mono",
        "scalar_rgb",
        None,
    ]
