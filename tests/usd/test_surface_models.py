"""Material models: energy and colour compared with closed forms and with each other."""

import math

import mitsuba as mi
import numpy as np
import pytest
from mitsuba_subdivision.cage.contents import CageContents
from mitsuba_usd import surface_models
from mitsuba_usd.bsdfs import bsdf, interior
from mitsuba_usd.contents import ShapeContents, TextureContents
from mitsuba_usd.materialx_layers import library, numbers
from mitsuba_usd.materialx_nodes import node
from mitsuba_usd.stage_warnings import StageWarnings
from mitsuba_usd.surface_models import LEFT_OUT, MODELS, PREVIEW, conductor, conductor_reflectance
from mitsuba_usd.textures import Textures
from usd.stages import told

pytestmark = pytest.mark.usefixtures("variant_llvm_ad_rgb")

MATERIALX = ("standard_surface", "open_pbr_surface", "gltf_pbr")
COLOR = [0.2, 0.4, 0.8]
COPPER = [0.955, 0.638, 0.538]
# Relative noise of means of 65,536 samples whose lobes are chosen with other probabilities.
SAMPLED = 0.02
# Media have finite densities.
ABSORBED = 1e-3


def look(model, **given):
    """A material of a model; what is not given is as the library defines it."""
    if model == "UsdPreviewSurface":
        usual = dict(PREVIEW)
    else:
        declared = library().getNodeDef(f"ND_{model}_surfaceshader").getActiveInputs()
        usual = {e.getName(): numbers(e.getValueString(), e.getType()) for e in declared if e.getValueString()}
    assert not set(given) - set(usual) - {"attenuation_distance"}
    return surface_models.material("/paint", model, {**usual, **given})


def entry(material):
    notes = StageWarnings()
    cage = CageContents(np.zeros((3, 3)), np.array([3]), np.arange(3))
    return bsdf(ShapeContents("/shape", cage, np.eye(4), material=material), Textures(notes), notes), notes


def bsdf_of(model, **given):
    """The entry of a BSDF that is the same from both sides."""
    return entry(look(model, **given))[0]["bsdf"]


def albedo(bsdf, degrees, count=1 << 16):
    """What a surface reflects and what it lets through of light from an angle, by its own sampling."""
    sampler = mi.load_dict({"type": "independent"})
    sampler.seed(7, count)
    si = mi.SurfaceInteraction3f()
    si.wi = mi.Vector3f(math.sin(math.radians(degrees)), 0, math.cos(math.radians(degrees)))
    si.n, si.sh_frame = mi.Normal3f(0, 0, 1), mi.Frame3f(mi.Normal3f(0, 0, 1))
    si.t, si.p, si.uv = mi.Float(1), mi.Point3f(0), mi.Point2f(0.5)
    sample, weight = bsdf.sample(mi.BSDFContext(), si, sampler.next_1d(), sampler.next_2d())
    weights = np.broadcast_to(np.array(weight), (3, count))
    up = np.broadcast_to(np.array(sample.wo.z) > 0, (count,))
    return np.where(up, weights, 0).mean(axis=1), np.where(up, 0, weights).mean(axis=1)


def both(model, degrees=0.0, **given):
    return albedo(mi.load_dict(entry(look(model, **given))[0]), degrees)


DIFFUSE = [
    ("standard_surface", {"base": 0.5, "base_color": COLOR, "specular": 0.0}),
    ("open_pbr_surface", {"base_weight": 0.5, "base_color": COLOR, "specular_weight": 0.0}),
    ("gltf_pbr", {"base_color": [0.1, 0.2, 0.4], "metallic": 0.0, "specular": 0.0}),
]


@pytest.mark.parametrize(("model", "given"), DIFFUSE)
def test_diffuse_surfaces_reflect_their_colour(model, given):
    for degrees in (0, 60):
        reflected, transmitted = both(model, degrees, **given)
        np.testing.assert_allclose(reflected, [0.1, 0.2, 0.4], rtol=1e-3)
        assert (transmitted == 0).all()


METALS = [
    ("standard_surface", {"metalness": 1.0, "base_color": COLOR, "specular_roughness": 0.0}),
    ("open_pbr_surface", {"base_metalness": 1.0, "base_color": COLOR, "specular_roughness": 0.0}),
    ("gltf_pbr", {"metallic": 1.0, "base_color": COLOR, "roughness": 0.0}),
    ("UsdPreviewSurface", {"metallic": 1.0, "diffuseColor": COLOR, "roughness": 0.0}),
]


@pytest.mark.core
@pytest.mark.parametrize(("model", "given"), METALS)
def test_metals_reflect_their_colour_head_on_and_all_at_grazing_angles(model, given):
    np.testing.assert_allclose(both(model, 0, **given)[0], COLOR, rtol=1e-3)
    assert (both(model, 89.9, **given)[0] > 0.97).all()


def test_metals_below_a_coat_reflect_their_colour_whatever_the_specular_weight():
    """It only sets the colour of edges, so that a copper with a weight of 0 is not black."""
    given = {"metalness": 1.0, "base_color": COLOR, "coat": 1.0, "specular_roughness": 0.3}
    with_weight, without = (both("standard_surface", specular=weight, **given)[0] for weight in (1.0, 0.0))
    np.testing.assert_allclose(without, with_weight, rtol=SAMPLED)
    np.testing.assert_allclose(np.diff(without), np.diff(0.96 * np.array(COLOR)), atol=0.1)


def test_roughness_beyond_1_is_1():
    """Networks of nodes divide by masks, and a roughness of 80,000 shines like a lamp."""
    mask = TextureContents("none.png", "r", "raw", fallback=[0.00001] * 4)
    for beyond in (5.0, node("divide", "float", in1=0.8, in2=mask)):
        of_1, of_more = (both("standard_surface", 30, base_color=COLOR, specular_roughness=r) for r in (1.0, beyond))
        np.testing.assert_allclose(of_more, of_1, rtol=SAMPLED)


def test_metal_edges_have_the_models_colour():
    """Gulbrandsen's conductor for Standard Surface; for OpenPBR, a factor of Schlick's reflectance at 82 degrees."""
    edge = [1.0, 0.7, 0.5]
    for degrees in (0.0, 45.0, 75.0):
        given = {"metalness": 1.0, "base_color": COLOR, "specular_color": edge, "specular_roughness": 0.0}
        expected = conductor_reflectance(*conductor(COLOR, edge), np.cos(np.radians(degrees)))
        np.testing.assert_allclose(both("standard_surface", degrees, **given)[0], expected, rtol=1e-3)
    given = {"base_metalness": 1.0, "base_color": [0.9, 0.6, 0.3], "specular_roughness": 0.0}
    base, factor = np.array(given["base_color"]), np.array([0.95, 0.95, 0.9])
    angle = np.degrees(np.arccos(1 / 7))
    expected = factor * (base + (1 - base) * (6 / 7) ** 5)
    reflected = both("open_pbr_surface", angle, specular_color=factor.tolist(), **given)[0]
    np.testing.assert_allclose(reflected, expected, atol=0.01)


@pytest.mark.parametrize(("model", "color"), [("UsdPreviewSurface", "diffuseColor"), ("gltf_pbr", "base_color")])
def test_metal_edges_approach_white_as_in_schlick(model, color):
    """A conductor of Gulbrandsen's with a white edge is 0.13 too pale at 75 degrees."""
    for degrees in (0, 45, 60, 75, 82):
        expected = np.array(COPPER) + (1 - np.array(COPPER)) * (1 - np.cos(np.radians(degrees))) ** 5
        reflected = both(model, degrees, metallic=1.0, roughness=0.0, **{color: COPPER})[0]
        np.testing.assert_allclose(reflected, expected, atol=0.025)


GLASSES = [
    ("standard_surface", {"transmission": 1.0, "transmission_color": COLOR, "specular_roughness": 0.0}),
    ("open_pbr_surface", {"transmission_weight": 1.0, "transmission_color": COLOR, "specular_roughness": 0.0}),
    ("gltf_pbr", {"transmission": 1.0, "base_color": COLOR, "metallic": 0.0, "roughness": 0.0, "thickness": 1.0}),
]


@pytest.mark.core
@pytest.mark.parametrize(("model", "given"), GLASSES)
def test_glass_has_the_fresnel_reflectance_and_its_colour_at_each_side(model, given):
    """Of the index 1.5: 0.04 is reflected head-on; what gets through is compressed into a smaller solid angle."""
    reflected, transmitted = both(model, 0, **given)
    np.testing.assert_allclose(reflected, 0.04, atol=2e-3)
    np.testing.assert_allclose(transmitted * 1.5**2, 0.96 * np.array(COLOR), rtol=5e-3)


@pytest.mark.parametrize(("model", "given"), GLASSES)
def test_thin_glass_has_its_colour_after_one_sheet(model, given):
    """With reflections to and fro within the sheet, 2 F / (1 + F) is reflected."""
    names = {"standard_surface": "thin_walled", "open_pbr_surface": "geometry_thin_walled"}
    thin = {names[model]: 1.0} if model in names else {"thickness": 0.0}
    reflected, transmitted = both(model, 0, **{**given, **thin})
    expected = 0.08 / 1.04
    np.testing.assert_allclose(reflected, expected, atol=3e-3)
    np.testing.assert_allclose(transmitted, (1 - expected) * np.array(COLOR), rtol=5e-3)


def test_opacity_of_preview_surfaces_is_clear_glass_unless_it_is_presence():
    glass, _ = entry(look("UsdPreviewSurface", opacity=0.0, roughness=0.0))
    assert (glass["type"], glass["int_ior"]) == ("dielectric", 1.5)
    half, _ = entry(look("UsdPreviewSurface", opacity=0.25, roughness=0.5, diffuseColor=COLOR))
    assert (half["type"], half["weight"], half["bsdf_1"]["type"]) == ("blendbsdf", 0.75, "dielectric")
    image = TextureContents("none.png", "r", "raw", fallback=[0.25] * 4)
    for mode, given, kind in (("", image, "mask"), ("presence", 0.25, "mask"), ("transparent", image, "blendbsdf")):
        assert entry(look("UsdPreviewSurface", opacity=given, opacityMode=mode))[0]["type"] == kind
    for opacity, expected in ((0.4, 0.0), (0.6, 1.0)):
        cut, _ = entry(look("UsdPreviewSurface", opacity=opacity, opacityThreshold=0.5))
        assert cut.get("opacity", 1.0) == expected


WHITE = [1.0] * 3
WHITES = [
    ("standard_surface", {"base_color": WHITE, "metalness": 1.0, "specular_roughness": 0.3}),
    ("standard_surface", {"base_color": WHITE, "transmission": 0.5, "specular_roughness": 0.3}),
    ("standard_surface", {"base_color": WHITE, "subsurface": 0.5, "subsurface_color": WHITE, "thin_walled": 1.0}),
    ("open_pbr_surface", {"base_color": WHITE, "specular_roughness": 0.4, "coat_weight": 1.0}),
    ("open_pbr_surface", {"transmission_weight": 1.0, "specular_roughness": 0.4}),
    ("gltf_pbr", {"base_color": WHITE, "metallic": 0.5, "roughness": 0.4, "clearcoat": 1.0}),
    ("UsdPreviewSurface", {"diffuseColor": WHITE, "opacity": 0.5, "roughness": 0.4, "clearcoat": 1.0}),
]


@pytest.mark.parametrize(("model", "given"), WHITES)
def test_white_surfaces_nearly_keep_their_light_and_hardly_add_to_it(model, given):
    """`principled` adds reflections to a diffuse part that it weakens only towards grazing angles: up to 0.07."""
    for degrees in (0, 45):
        reflected, transmitted = both(model, degrees, **given)
        # Radiance on the inner side of glass is that of a smaller solid angle.
        total = reflected + transmitted * (1.0 if "thin_walled" in given else 1.5**2)
        assert 0.8 < total.min() <= total.max() < 1.08, (model, given, degrees, total)


def test_equal_materials_of_different_models_agree():
    for model, color, given in (
        ("standard_surface", "base_color", {"specular_IOR": 1.6, "specular_roughness": 0.4}),
        ("open_pbr_surface", "base_color", {"specular_ior": 1.6, "specular_roughness": 0.4}),
        ("gltf_pbr", "base_color", {"metallic": 0.0, "roughness": 0.4, "ior": 1.6}),
        ("UsdPreviewSurface", "diffuseColor", {"roughness": 0.4, "ior": 1.6}),
    ):
        lobe = bsdf_of(model, **given, **{color: COLOR})
        assert [*lobe["base_color"]["value"], lobe["roughness"], lobe["eta"]] == pytest.approx([*COLOR, 0.4, 1.6])
    # Reflections are the same from the inside. By the specification, the coat has the same index.
    given = {"metallic": 0.4, "ior": 0.5, "clearcoat": 0.7, "clearcoatRoughness": 0.2}
    coated = entry(look("UsdPreviewSurface", **given, diffuseColor=COLOR))[0]
    base, coat = coated["bsdf_0"]["bsdf"], coated["bsdf_1"]["bsdf"]
    assert [base["metallic"], base["eta"], coat["eta"], coat["alpha"]] == pytest.approx([0.4, 2.0, 2.0, 0.04])
    assert base["base_color"]["value"] == pytest.approx(COLOR)


ROUGH_METAL = {"metalness": 1.0, "specular_roughness": 0.5, "specular_anisotropy": 0.75}
OPEN_METAL = {"base_metalness": 1.0, "specular_roughness": 0.5, "specular_roughness_anisotropy": 0.5}
GLTF_METAL = {"metallic": 1.0, "base_color": COLOR, "roughness": 0.5}
OPEN_WIDTH = 0.25 * np.sqrt(2 / (1 + 0.5**2))


@pytest.mark.parametrize(
    ("model", "given", "widths"),
    [
        # Of Standard Surface: widths are r^2 / sqrt(1 - a) and r^2 sqrt(1 - a); the others have others.
        ("standard_surface", ROUGH_METAL, (0.5, 0.125)),
        *(("standard_surface", {**ROUGH_METAL, "specular_rotation": turn}, (0.125, 0.5)) for turn in (0.25, 0.75)),
        ("standard_surface", {**ROUGH_METAL, "specular_rotation": 0.1}, (0.5, 0.125)),
        ("open_pbr_surface", OPEN_METAL, (OPEN_WIDTH, OPEN_WIDTH / 2)),
        ("gltf_pbr", {**GLTF_METAL, "anisotropy_strength": 0.5}, (0.25 + 0.75 * 0.25, 0.25)),
        ("gltf_pbr", {**GLTF_METAL, "anisotropy_strength": 1.0}, (1, 0.25)),
    ],
)
def test_anisotropy_is_the_ratio_of_widths_and_turns_by_quarters(model, given, widths):
    bsdf = bsdf_of(model, **given)
    assert (bsdf["alpha_u"], bsdf["alpha_v"]) == pytest.approx(widths)
    # Of principled, the widths are r^2 / sqrt(1 - 0.9 a) and r^2 sqrt(1 - 0.9 a).
    assert bsdf_of("standard_surface", specular_anisotropy=0.45)["anisotropic"] == pytest.approx(0.5)


COATED = {"base_metalness": 1.0, "base_color": COPPER, "coat_weight": 1.0}
TURNED = {"metalness": 1.0, "specular_anisotropy": 0.5, "specular_rotation": 0.1}
# Materials, and the warning about each, or None.
TOLD = [
    ("open_pbr_surface", {**COATED, "specular_color": [1.0, 1.0, 1.0]}, None),
    ("open_pbr_surface", {**COATED, "specular_color": [0.6] * 3, "fuzz_weight": 1.0}, "edge colours"),
    ("standard_surface", TURNED, "rounded to quarter turns"),
]


@pytest.mark.parametrize(("model", "given", "message"), TOLD)
def test_unsupported_inputs_warn(model, given, message):
    _, notes = entry(look(model, **given))
    assert [message in warning for warning in told(notes.warn, "stage")[1]] == [True] * bool(message)


def test_the_strength_of_reflections_is_an_index_of_refraction():
    """Half of 0.04 head-on, and what a specular workflow says."""
    half = bsdf_of("standard_surface", specular=0.5)
    strong = bsdf_of("UsdPreviewSurface", useSpecularWorkflow=1.0, specularColor=[0.2] * 3, metallic=1.0)
    for lobe, expected in ((half, 0.02), (strong, 0.2)):
        assert ((lobe["eta"] - 1) / (lobe["eta"] + 1)) ** 2 == pytest.approx(expected)
    assert strong["metallic"] == 0


def test_coats_dim_the_base():
    """By their colour, and in OpenPBR by what they reflect back."""
    dimmed = look("standard_surface", base_color=[0.5] * 3, coat=1.0, coat_color=[1.0, 0.5, 0.2]).inputs["base_color"]
    np.testing.assert_allclose(dimmed, 0.5 * np.array([1, 0.5, 0.2]))
    dimmed = look("open_pbr_surface", base_color=[0.5] * 3, coat_weight=1.0, coat_ior=1.5).inputs["base_color"]
    inner = 1 - 0.96 / 1.5**2
    np.testing.assert_allclose(dimmed, 0.5 * (1 - inner) / (1 - 0.5 * inner))
    bumps = TextureContents("bumps.png", "rgb", "raw")
    for model, expected in (("standard_surface", {"normal"}), ("UsdPreviewSurface", {"normal", "coat_normal"})):
        inputs = surface_models.material("/paint", model, {"normal": bumps, "opacityMode": ""}).inputs
        assert {name for name, value in inputs.items() if value is bumps} == expected


def test_coats_reflect_as_dielectrics_at_every_angle_and_dim_the_base_by_their_mean():
    mean = float(mi.fresnel_diffuse_reflectance(mi.Float(1.6))[0])
    given = {"base_color": COLOR, "specular": 0.0, "coat": 0.5, "coat_IOR": 1.6, "coat_roughness": 0.0}
    for degrees in (0, 45, 60, 80):
        reflected = 0.5 * conductor_reflectance(1.6, 0, math.cos(math.radians(degrees)))
        expected = (1 - 0.5 * mean) * np.array(COLOR) + reflected
        np.testing.assert_allclose(both("standard_surface", degrees, **given)[0], expected, rtol=SAMPLED)


def test_bodies_absorb_nothing_without_a_distance_and_all_of_a_missing_channel():
    """By glTF's extension for volumes, the distance is infinite unless it is given."""
    body = {"transmission": 1.0, "thickness": 1.0, "attenuation_color": COLOR}
    assert "depth" not in look("gltf_pbr", **body).inputs
    assert look("gltf_pbr", **body, attenuation_distance=2.0).inputs["depth"] == 2.0
    inputs = {"transmission": 1.0, "transmission_depth": 2.0, "transmission_color": [0.0, 0.5, 1.0]}
    medium = interior(look("standard_surface", **inputs))["interior"]
    along = np.exp(-2 * medium["scale"] * np.array(medium["sigma_t"]["value"]))
    np.testing.assert_allclose(along, [0, 0.5, 1], rtol=0, atol=ABSORBED)


@pytest.mark.parametrize(
    ("model", "given", "part"),
    [
        ("standard_surface", {"thin_walled": 1.0, "subsurface": 0.5}, 0.5),
        # OpenPBR lets half of the light out on either side.
        ("open_pbr_surface", {"geometry_thin_walled": 1.0, "subsurface_weight": 0.5}, 0.25),
    ],
)
def test_sheets_transmit_the_models_share_of_diffuse_light(model, given, part):
    reflected, transmitted = both(model, base_color=[0.8] * 3, subsurface_color=[0.8] * 3, **given)
    np.testing.assert_allclose(transmitted, 0.8 * part, rtol=SAMPLED)
    assert reflected.min() > 0.8 * (1 - part) - SAMPLED


def test_emission_and_presence():
    for model, given, expected in (
        ("standard_surface", {"emission": 2.0, "emission_color": COLOR}, [0.4, 0.8, 1.6]),
        ("open_pbr_surface", {"emission_luminance": 2.0}, [2.0] * 3),
        ("gltf_pbr", {"emissive": COLOR, "emissive_strength": 3.0}, [0.6, 1.2, 2.4]),
    ):
        assert look(model, **given).inputs["emission"] == pytest.approx(expected)
    assert look("standard_surface", opacity=[0.5] * 3).inputs["opacity"] == pytest.approx(0.5)
    for mode, expected in ((0.0, None), (1.0, 0.0), (2.0, 0.4)):
        assert look("gltf_pbr", alpha=0.4, alpha_mode=mode).inputs.get("opacity") == expected


def test_every_input_of_every_model_is_used_or_warns():
    silent = {"subsurface_radius", "subsurface_scale", "subsurface_anisotropy", "subsurface_radius_scale"}
    silent |= {"subsurface_scatter_anisotropy", "occlusion", "tangent", "geometry_tangent", "geometry_coat_tangent"}
    # Of what is left itself.
    silent |= {"thin_film_IOR", "thin_film_ior", "transmission_dispersion_abbe_number", "iridescence_ior"}
    silent |= {"iridescence_thickness", "coat_rotation", "sheen_roughness", "fuzz_roughness", "displacement"}
    silent |= {"coat_normal", "geometry_coat_normal", "clearcoat_normal", "normal", "geometry_normal"}
    for model in (*MATERIALX, "UsdPreviewSurface"):
        read = set()

        def given(key, read=read):
            read.add(key)
            return {"alpha_mode": 2.0, "opacityMode": "", "thickness": 1.0}.get(key, 0.5)

        MODELS[model](given)
        MODELS[model](lambda key, given=given: 1.0 if key == "useSpecularWorkflow" else given(key))
        declared = {port.getName() for port in library().getNodeDef(f"ND_{model}_surfaceshader").getActiveInputs()}
        assert read <= declared | {"attenuation_distance"}
        missing = declared - read - set(LEFT_OUT[model]) - silent
        assert missing <= {"alpha_cutoff", "thin_film_thickness"}, (model, missing)
