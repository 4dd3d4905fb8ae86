"""Displacement of stages against formulas, at rates that show it."""

import mitsuba as mi
import mitsuba_subdivision as msub
import numpy as np
import pytest
from mitsuba_subdivision.studio import Look
from mitsuba_usd import StageScenes, copies
from usd import stages
from usd.stages import CUBE, SQUARE, bound, camera, mesh, moved, prim, shader, texture, told
from usd.test_usd_scene import instancer

# Single precision of points of a few units.
ROUNDING = 2e-6
# Between texels, bilinear heights are an eighth of their second derivatives, along u and v, away from a product of
# sines of amplitude 0.2 with one period in 64 texels.
BILINEAR = 2 * 0.2 * (2 * np.pi / 64) ** 2 / 8
SHEET = SQUARE.replace("none", "catmullClark")
HEIGHT = "float inputs:displacement"
HEIGHTS = f"{HEIGHT}.connect = </paint/texture.outputs:r>"
PRIMVAR = 'float[] primvars:h = {} (interpolation = "{}")'
READER = shader("texture", "UsdPrimvarReader_float", 'string inputs:varname = "h"', "float outputs:r")
SCALED = texture("heights.png", "raw", "float4 inputs:scale = (0.5, 1, 1, 1)\nfloat4 inputs:bias = (-0.2, 0, 0, 0)")
MOVED = texture("heights.png", "raw", "float4 inputs:bias = (-0.4, 0, 0, 0)")


def paint(given, *nodes, kind="UsdPreviewSurface", output="outputs:displacement", source="heights.outputs:out"):
    """A material whose displacement is that of a node of a kind, or another source."""
    connected = f"token {output}.connect = </paint/{source}>"
    surface = "token outputs:surface.connect = </paint/surface.outputs:surface>"
    own = shader("surface", "UsdPreviewSurface", given if "other" in output else "", "token outputs:surface")
    return prim(
        "Material", "paint", surface, connected, own, shader("heights", kind, given, "token outputs:out"), *nodes
    )


@pytest.fixture
def points(tmp_path):
    """Function that returns the vertices of a mesh with a material, of which nothing is told."""
    u = 2 * np.pi * (np.arange(64) + 0.5) / 64
    values = 0.5 + 0.4 * np.sin(u) * np.cos(u)[:, None]
    mi.Bitmap((65535 * values[..., None]).round().astype(np.uint16)).write(str(tmp_path / "heights.png"))

    def make(text, *body, **options):
        path = stages.write(tmp_path, camera() + text + mesh("shape", *body, bound()))
        entries, messages = told(msub.usd_scene, path, mi, size=(64, 64), **options)
        assert not messages
        shape = next(shape for shape in mi.load_dict(entries).shapes() if shape.id() == "shape")
        return np.array(mi.traverse(shape)["vertex_positions"]).reshape(-1, 3)

    return make


def test_a_constant_moves_points_along_normals(points, variant_scalar_rgb):  # noqa: ARG001
    """A ball around a cube grows by it, in the space of the mesh."""
    body = CUBE, moved(scale=(2, 2, 2))
    plain, displaced = (points(paint(f"{HEIGHT} = {h}"), *body, tessellation_rate=6) for h in (0, 0.25))
    away = displaced - plain
    np.testing.assert_allclose(np.linalg.norm(away, axis=1), 2 * 0.25, atol=ROUNDING)
    cosines = (plain * away).sum(axis=1) / np.linalg.norm(plain, axis=1) / 0.5
    # By symmetry, normals at corners, middles of edges and of faces are those of the ball.
    assert np.isclose(cosines, 1, atol=ROUNDING).sum() >= 8 + 12 + 6


HALVED = f"{HEIGHTS}\nfloat inputs:scale = 0.5"
MATERIALX = paint(HALVED, MOVED, kind="ND_displacement_float", output="outputs:mtlx:displacement")
OWN = paint("", SCALED, output="outputs:mitsuba:displacement", source="texture.outputs:r")


@pytest.mark.parametrize("variant", ["llvm_ad_rgb", "scalar_rgb"])
@pytest.mark.parametrize("text", [paint(HEIGHTS, SCALED), MATERIALX, OWN], ids=["preview", "MaterialX", "Mitsuba"])
def test_pictures_are_heights_of_a_plane(points, request, text, variant):
    """At the rates that a picture needs, with exact shading and without."""
    request.getfixturevalue(f"variant_{variant}")
    x, y, z = points(text, SHEET).T
    assert len(x) > 30**2
    expected = 0.05 + 0.2 * np.sin(np.pi * (x + 1)) * np.cos(np.pi * (y + 1))
    np.testing.assert_allclose(z, expected, atol=1.05 * BILINEAR)


def test_primvars_are_heights(points, variant_scalar_rgb):  # noqa: ARG001
    """Of vertices, and of the whole mesh."""
    ways = paint(HEIGHTS, READER), MATERIALX.replace(MOVED, READER)
    for text, factor in zip(ways, (1, 0.5), strict=True):
        z = points(text, SHEET, PRIMVAR.format([0.1, 0.3, 0.3, 0.1], "vertex"))[:, 2]
        np.testing.assert_allclose([z.min(), z.max()], [0.1 * factor, 0.3 * factor], atol=ROUNDING)
        np.testing.assert_allclose(points(text, SHEET, PRIMVAR.format([0.2], "constant"))[:, 2], 0.2 * factor)


def test_the_camera_of_the_studio_sees_displaced_surfaces(tmp_path, variant_scalar_rgb):  # noqa: ARG001
    stages.flat(tmp_path / "heights.png", (255,))
    primvar = PRIMVAR.format([0.1, -0.3, 0.1, 0.1], "vertex")
    for text in (paint(f"{HEIGHT} = -0.3"), paint(HEIGHTS, READER), paint(HEIGHTS, SCALED)):
        source = StageScenes(stages.write(tmp_path, text + mesh("sheet", SHEET, primvar, bound())), Look(), {})
        assert np.ptp(source.points(source.at())[:, 2]) == pytest.approx(0.6)


@pytest.mark.parametrize("least", [2, 9])
def test_many_instances_are_displaced_in_their_own_space(tmp_path, monkeypatch, variant_llvm_ad_rgb, least):  # noqa: ARG001
    """As shapes of their own, or as instances."""
    monkeypatch.setattr(copies, "LEAST_INSTANCES", least)
    sizes = "float3[] scales = [(1, 1, 1), (1, 1, 1), (2, 2, 2)]"
    text = instancer([(0, 0, 0), (5, 0, 0), (9, 0, 0)], mesh("sheet", SHEET, bound()), sizes)
    scene = mi.load_dict(msub.usd_scene(stages.write(tmp_path, text + paint(f"{HEIGHT} = 0.25")), mi))
    rays = mi.Ray3f(mi.Point3f([0, 5, 9], 0.3, 20), mi.Vector3f(0, 0, -1))
    np.testing.assert_allclose(scene.ray_intersect(rays).p[2], [0.25, 0.25, 0.5], atol=1e-5)


def test_ignored_displacements_warn(tmp_path, variant_scalar_rgb):  # noqa: ARG001
    pairs = PRIMVAR.replace("float[]", "float2[]").format([(1, 2)] * 4, "vertex")
    for text, body, expected in (
        (paint(f"{HEIGHT} = 1"), SQUARE, "displacement of meshes that are not subdivided is ignored (/sheet)"),
        (paint(f"{HEIGHT} = 1", output="outputs:other"), SHEET, "no connected outputs:displacement (/paint)"),
        (paint(HEIGHTS, READER), SHEET + pairs, "its fallback is used; expected one number per value (/sheet)"),
    ):
        _, (message,) = told(msub.usd_scene, stages.write(tmp_path, text + mesh("sheet", body, bound())), mi)
        assert message.endswith(expected)


@pytest.mark.long
def test_the_street_of_the_gallery_has_stones(variant_llvm_ad_rgb):  # noqa: ARG001
    """As high as its nodes say, 0.16 with some grain, at a rate that shows them."""
    street = msub.usd_scene(msub.example_file("cobbles.usda"), mi, size=(64, 36))["Scene_Street"]
    heights = np.array(street["displacement"]["bitmap"])
    assert 0.15 < np.ptp(np.quantile(heights, [0.02, 0.98])) < 0.18
    assert street["tessellation_rate"] > 8


def test_levels_of_subdivision_are_rates(points, variant_scalar_rgb):  # noqa: ARG001
    """Options win."""
    body = SHEET, "int mitsuba:subdivision_level = 2"
    assert [len(points("", *body)), len(points("", *body, tessellation_rate=3))] == [5**2, 4**2]
