"""Displacement of stages against formulas, at rates that show it."""

import mitsuba as mi
import mitsuba_subdivision as msub
import numpy as np
import pytest
from mitsuba_usd import copies
from usd import stages
from usd.stages import CUBE, SQUARE, bound, camera, mesh, moved, prim, shader, texture, told
from usd.test_usd_scene import instancer

# Single precision of points of a few units.
ROUNDING = 2e-6
# Between texels, bilinear heights are an eighth of their second derivatives, along u and v, away from a product of
# sines of amplitude 0.2 with one period in 64 texels.
BILINEAR = 2 * 0.2 * (2 * np.pi / 64) ** 2 / 8
CREASES = (
    "int[] creaseIndices = [0, 1, 2, 3, 0]\nint[] creaseLengths = [5]\nfloat[] creaseSharpnesses = [10, 10, 10, 10]"
)
# A subdivided square that stays one.
SHEET = SQUARE.replace("none", "catmullClark") + CREASES
HEIGHTS = "float inputs:displacement.connect = </paint/texture.outputs:r>"
PRIMVAR = 'float[] primvars:h = {} (interpolation = "{}")'
READER = shader("texture", "UsdPrimvarReader_float", 'string inputs:varname = "h"', "float outputs:r")
SCALED = texture("heights.png", "raw", "float4 inputs:scale = (0.5, 1, 1, 1)\nfloat4 inputs:bias = (-0.2, 0, 0, 0)")
MOVED = texture("heights.png", "raw", "float4 inputs:bias = (-0.4, 0, 0, 0)")
HALF = "float inputs:scale = 0.5"
UNCONNECTED = "outputs:other"


def paint(given, *nodes, kind="UsdPreviewSurface", output="outputs:displacement"):
    """A material whose displacement is that of a node of a kind, or the picture itself."""
    source = "texture.outputs:r" if kind is None else "heights.outputs:out"
    connected = f"token {output}.connect = </paint/{source}>"
    surface = "token outputs:surface.connect = </paint/surface.outputs:surface>"
    own = shader("surface", "UsdPreviewSurface", given if output == UNCONNECTED else "", "token outputs:surface")
    heights = "" if kind is None else shader("heights", kind, given, "token outputs:out")
    return prim("Material", "paint", surface, connected, own, heights, *nodes)


def points(shape):
    return np.array(mi.traverse(shape)["vertex_positions"]).reshape(-1, 3)


@pytest.fixture
def sheet(tmp_path):
    """Function that makes the shape of a square in a stage, of which nothing is told."""
    u = 2 * np.pi * (np.arange(64) + 0.5) / 64
    values = 0.5 + 0.4 * np.sin(u) * np.cos(u)[:, None]
    mi.Bitmap((65535 * values[..., None]).round().astype(np.uint16)).write(str(tmp_path / "heights.png"))

    def make(text, *body, **options):
        path = stages.write(tmp_path, camera() + text + mesh("sheet", SHEET, *body, bound()))
        entries, messages = told(msub.usd_scene, path, mi, size=(64, 64), **options)
        assert not messages
        return next(shape for shape in mi.load_dict(entries).shapes() if shape.id() == "sheet")

    return make


def test_a_constant_moves_points_along_normals(tmp_path, variant_scalar_rgb):  # noqa: ARG001
    """A ball around a cube grows by it, in the space of the mesh."""
    cube = mesh("cube", CUBE, moved(scale=(2, 2, 2)), bound())
    plain, displaced = (
        points(
            next(s for s in mi.load_dict(msub.usd_scene(path, mi, tessellation_rate=6)).shapes() if s.id() == "cube")
        )
        for height in (0, 0.25)
        for path in [stages.write(tmp_path, paint(f"float inputs:displacement = {height}") + cube)]
    )
    away = displaced - plain
    np.testing.assert_allclose(np.linalg.norm(away, axis=1), 2 * 0.25, atol=ROUNDING)
    cosines = (plain * away).sum(axis=1) / np.linalg.norm(plain, axis=1) / 0.5
    # By symmetry, normals at corners, middles of edges and of faces are those of the ball.
    assert np.isclose(cosines, 1, atol=ROUNDING).sum() >= 8 + 12 + 6
    assert cosines.min() > 0.95


WAYS = {
    "preview surface": paint(HEIGHTS, SCALED),
    "MaterialX": paint(f"{HEIGHTS}\n{HALF}", MOVED, kind="ND_displacement_float", output="outputs:mtlx:displacement"),
    "Mitsuba": paint("", SCALED, kind=None, output="outputs:mitsuba:displacement"),
}


@pytest.mark.parametrize("variant", ["llvm_ad_rgb", "scalar_rgb"])
@pytest.mark.parametrize("text", WAYS.values(), ids=WAYS)
def test_pictures_are_heights_of_a_plane(sheet, request, text, variant):
    """At the rates that a picture needs, with exact shading and without."""
    request.getfixturevalue(f"variant_{variant}")
    x, y, z = points(sheet(text)).T
    assert len(x) > 30**2
    expected = 0.05 + 0.2 * np.sin(np.pi * (x + 1)) * np.cos(np.pi * (y + 1))
    np.testing.assert_allclose(z, expected, atol=1.05 * BILINEAR)


def test_primvars_are_heights(sheet, variant_scalar_rgb):  # noqa: ARG001
    """Of vertices, and of the whole mesh."""
    ways = paint(HEIGHTS, READER), paint(f"{HEIGHTS}\n{HALF}", READER, kind="ND_displacement_float")
    for text, factor in zip(ways, (1, 0.5), strict=True):
        z = points(sheet(text, PRIMVAR.format([0.1, 0.3, 0.3, 0.1], "vertex")))[:, 2]
        np.testing.assert_allclose([z.min(), z.max()], [0.1 * factor, 0.3 * factor], atol=ROUNDING)
        np.testing.assert_allclose(points(sheet(text, PRIMVAR.format([0.2], "constant")))[:, 2], 0.2 * factor)


@pytest.mark.parametrize("least", [2, 9])
def test_many_instances_are_displaced_in_their_own_space(tmp_path, monkeypatch, variant_llvm_ad_rgb, least):  # noqa: ARG001
    """As shapes of their own, or as instances."""
    monkeypatch.setattr(copies, "LEAST_INSTANCES", least)
    sizes = "float3[] scales = [(1, 1, 1), (1, 1, 1), (2, 2, 2)]"
    text = paint("float inputs:displacement = 0.25") + instancer(
        [(0, 0, 0), (5, 0, 0), (9, 0, 0)], mesh("sheet", SHEET, bound()), sizes
    )
    scene = mi.load_dict(msub.usd_scene(stages.write(tmp_path, text), mi))
    rays = mi.Ray3f(mi.Point3f([0, 5, 9], 0.3, 20), mi.Vector3f(0, 0, -1))
    np.testing.assert_allclose(scene.ray_intersect(rays).p[2], [0.25, 0.25, 0.5], atol=1e-5)


def test_displacement_that_is_ignored_is_told(tmp_path, variant_scalar_rgb):  # noqa: ARG001
    height = "float inputs:displacement = 1"
    pairs = PRIMVAR.replace("float[]", "float2[]").format([(1, 2)] * 4, "vertex")
    for text, body, expected in (
        (paint(height), SQUARE, "displacement of meshes that are not subdivided is ignored (/sheet)"),
        (paint(height, output=UNCONNECTED), SHEET, "no connected outputs:displacement (/paint)"),
        (
            paint(HEIGHTS, READER),
            f"{SHEET}\n{pairs}",
            'by the primvar "h" is ignored; expected one number per value (/sheet)',
        ),
    ):
        path = stages.write(tmp_path, text + mesh("sheet", body, bound()))
        _, messages = told(msub.usd_scene, path, mi)
        assert [message.endswith(expected) for message in messages] == [True], messages


def test_the_street_of_the_gallery_has_stones(variant_llvm_ad_rgb):  # noqa: ARG001
    """As high as its nodes say, at a rate that shows them."""
    entries, messages = told(msub.usd_scene, msub.example_file("cobbles.usda"), mi, size=(64, 36))
    street = entries["Scene_Street"]
    heights = np.array(street["displacement"]["bitmap"])
    assert not messages
    assert street["tessellation_rate"] > 8
    # Between joints and tops, 0.16 times 1 apart, with some grain.
    assert 0.15 < np.ptp(np.quantile(heights, [0.02, 0.98])) < 0.18


def test_levels_of_subdivision_are_rates(tmp_path, variant_scalar_rgb):  # noqa: ARG001
    """Options of the command win."""
    path = stages.write(tmp_path, mesh("sheet", SHEET, "int mitsuba:subdivision_level = 4"))
    counts = [
        msub.usd_scene(path, mi, **options)["sheet"]["tessellation_rate"] for options in ({}, {"tessellation_rate": 3})
    ]
    assert counts == [16, 3]
