"""Images that are finer than a picture shows are loaded smaller."""

import mitsuba as mi
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from mitsuba_subdivision.cage.attributes import Attribute
from mitsuba_subdivision.cage.contents import CageContents
from mitsuba_subdivision.usd.contents import (
    InstanceContents,
    MaterialContents,
    NodeContents,
    SceneContents,
    ShapeContents,
    TextureContents,
)
from mitsuba_subdivision.usd.texture_detail import TEXELS_PER_PIXEL, reduced, texels_for_picture

pytestmark = pytest.mark.usefixtures("variant_scalar_rgb")

WIDTH, FOV, DISTANCE = 640, 30.0, 10.0
# Half a level of 8 bits, and one where two roundings meet.
LEVEL = 1.01 / 255
# The depth of a flat square is known but for single precision.
ROUNDED = 1e-5


def texture(file="a.png", **changes):
    usual = {
        "channel": "rgb",
        "color_space": "sRGB",
        "wrap": "repeat",
        "scale": [1] * 4,
        "bias": [0] * 4,
        "to_uv": np.eye(3),
        "texcoords": "st",
        "fallback": [0, 0, 0, 1],
    }
    return TextureContents(file, **{**usual, **changes})


def square(side=1.0, uv_side=1.0, to_world=None, *, has_texcoords=True):
    corners = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]], dtype=float)
    texcoords = Attribute(uv_side * corners[:, :2], "vertex") if has_texcoords else None
    cage = CageContents(side * (corners - [0.5, 0.5, 0]), np.array([4]), np.arange(4), texcoords=texcoords)
    return ShapeContents("/square", cage, np.eye(4) if to_world is None else to_world, material=0)


def scene(*shapes, inputs, groups=(), instances=()):
    return SceneContents("z", [*shapes], [*groups], [*instances], [MaterialContents("/m", inputs)], [], None, None)


def sensor(distance=DISTANCE):
    return {
        "type": "perspective",
        "fov": FOV,
        "fov_axis": "x",
        "near_clip": 0.01,
        "to_world": mi.ScalarTransform4f().translate([0, 0, -distance]),
        "film": {"type": "hdrfilm", "width": WIDTH, "height": WIDTH // 2},
    }


def pixels_of_unit(distance=DISTANCE):
    return WIDTH / (2 * distance * np.tan(np.radians(FOV / 2)))


@pytest.mark.parametrize("side", [0.1, 2.0])
@pytest.mark.parametrize("uv_side", [1.0, 4.0])
def test_texels_follow_from_pixels(side, uv_side):
    found = texels_for_picture(scene(square(side, uv_side), inputs={"base_color": texture()}), sensor())
    assert found == {"a.png": pytest.approx(TEXELS_PER_PIXEL * pixels_of_unit() * side / uv_side, rel=ROUNDED)}


def test_the_copy_that_is_largest_in_the_picture_decides():
    near = np.eye(4)
    near[2, 3] = -DISTANCE / 2
    shapes = scene(
        square(), inputs={"base_color": texture()}, groups=[[square()]], instances=[InstanceContents("/i", 0, near)]
    )
    found = texels_for_picture(shapes, sensor())["a.png"]
    assert found == pytest.approx(TEXELS_PER_PIXEL * pixels_of_unit(DISTANCE / 2), rel=ROUNDED)


def test_where_the_detail_is_unknown_nothing_is_reduced():
    without = scene(square(has_texcoords=False), inputs={"base_color": texture()})
    assert texels_for_picture(without, sensor()) == {"a.png": np.inf}
    elsewhere = NodeContents(
        "image", "color3", {"file": texture(), "texcoord": NodeContents("texcoord", "vector2", {})}
    )
    assert texels_for_picture(scene(square(), inputs={"base_color": elsewhere}), sensor()) == {}


@given(st.integers(0, 2**32 - 1), st.sampled_from([1, 3, 4]), st.booleans())
def test_reduced_images_have_the_same_mean_light(seed, channels, is_srgb):
    pixels = np.random.default_rng(seed).integers(0, 256, (16, 32, channels), dtype=np.uint8)
    is_srgb = is_srgb and channels >= 3
    small = reduced(pixels, 4, is_srgb=is_srgb)
    assert small.shape == (4, 8, channels)
    expected = linear(pixels, is_srgb).reshape(4, 4, 8, 4, channels).mean(axis=(1, 3))
    if is_srgb:
        expected[..., :3] = np.where(
            expected[..., :3] <= 0.0031308, 12.92 * expected[..., :3], 1.055 * expected[..., :3] ** (1 / 2.4) - 0.055
        )
    np.testing.assert_allclose(small / 255, expected, rtol=0, atol=LEVEL)


def linear(pixels, is_srgb):
    values = pixels / 255
    if is_srgb:
        color = values[..., :3]
        values[..., :3] = np.where(color <= 0.04045, color / 12.92, ((color + 0.055) / 1.055) ** 2.4)
    return values


@pytest.mark.parametrize(("needed", "side"), [(np.inf, 64), (65, 64), (33, 64), (32, 32), (17, 32), (1, 1), (0, 1)])
def test_images_keep_as_many_pixels_as_are_needed(needed, side):
    pixels = np.full((64, 64, 3), 200, dtype=np.uint8)
    found = reduced(pixels, needed, is_srgb=True)
    assert found.shape == (side, side, 3)
    assert (found == 200).all()


def test_odd_sides_and_other_types_stay():
    odd = np.zeros((63, 64, 3), dtype=np.uint8)
    assert reduced(odd, 1, is_srgb=True) is odd
    half = np.zeros((64, 64, 3), dtype=np.float32)
    assert reduced(half, 1, is_srgb=False) is half
