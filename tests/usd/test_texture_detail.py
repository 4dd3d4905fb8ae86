"""Images that are finer than a picture shows are loaded smaller."""

from dataclasses import replace

import mitsuba as mi
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from mitsuba_subdivision.cage.contents import Attribute, CageContents
from mitsuba_usd.contents import (
    InstanceContents,
    MaterialContents,
    NodeContents,
    SceneContents,
    ShapeContents,
    TextureContents,
)
from mitsuba_usd.picture_detail import TEXELS_PER_PIXEL, texels_for_pictures
from mitsuba_usd.stage_warnings import StageWarnings
from mitsuba_usd.texture_image import read_texture_image, reduced
from mitsuba_usd.textures import Textures
from usd.stages import FOV, WIDTH, sensor_at

pytestmark = pytest.mark.usefixtures("variant_scalar_rgb")

DISTANCE = 10.0
# Half a level of 8 bits, and one where two roundings meet.
LEVEL = 1.01 / 255
# The depth of a flat square is known but for single precision.
ROUNDED = 1e-5
# Of 255. Chroma of neighbouring pixels is interpolated before a full image is halved.
JPEG_LEVELS = 4


def texture(file="a.png", **changes):
    return TextureContents(file, **{"channel": "rgb", "color_space": "sRGB", **changes})


def square(side=1.0, uv_side=1.0, to_world=None, *, has_texcoords=True):
    corners = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]], dtype=float)
    texcoords = Attribute(uv_side * corners[:, :2], "vertex") if has_texcoords else None
    cage = CageContents(side * (corners - [0.5, 0.5, 0]), np.array([4]), np.arange(4), texcoords=texcoords)
    return ShapeContents("/square", cage, np.eye(4) if to_world is None else to_world, material=0)


def needed_for(*shapes, inputs, **more):
    contents = SceneContents(shapes=[*shapes], materials=[MaterialContents("/m", inputs)], **more)
    return texels_for_pictures(contents, [sensor_at(DISTANCE)])


def pixels_of_unit(distance=DISTANCE):
    return WIDTH / (2 * distance * np.tan(np.radians(FOV / 2)))


@pytest.mark.parametrize("side", [0.1, 2.0])
@pytest.mark.parametrize("uv_side", [1.0, 4.0])
def test_texels_follow_from_pixels(side, uv_side):
    needed = needed_for(square(side, uv_side), inputs={"base_color": texture()})
    assert needed == {"a.png": pytest.approx(TEXELS_PER_PIXEL * pixels_of_unit() * side / uv_side, rel=ROUNDED)}


def test_the_corner_at_which_a_face_begins_does_not_matter():
    """Every edge has its own density of texels, the one from the last corner to the first, too."""
    texcoords, shape, needed = Attribute(np.array([[0, 0], [1, 0], [0.8, 0.5], [0, 0.3]]), "vertex"), square(), []
    for turn in range(4):
        cage = replace(shape.cage, face_vertices=np.roll(np.arange(4), turn), texcoords=texcoords)
        needed.append(needed_for(replace(shape, cage=cage), inputs={"base_color": texture()})["a.png"])
    assert needed == pytest.approx([needed[0]] * 4, rel=ROUNDED)


def test_the_copy_that_is_largest_in_the_picture_decides():
    near = np.eye(4)
    near[2, 3] = -DISTANCE / 2
    copies = {"groups": [[square()]], "instances": [InstanceContents("/i", 0, near)]}
    needed = needed_for(square(), inputs={"base_color": texture()}, **copies)["a.png"]
    assert needed == pytest.approx(TEXELS_PER_PIXEL * pixels_of_unit(DISTANCE / 2), rel=ROUNDED)


def test_where_the_detail_is_unknown_nothing_is_reduced():
    assert needed_for(square(has_texcoords=False), inputs={"base_color": texture()}) == {"a.png": np.inf}
    texcoord = NodeContents("texcoord", "vector2", {})
    elsewhere = NodeContents("image", "color3", {"file": texture(), "texcoord": texcoord})
    assert needed_for(square(), inputs={"base_color": elsewhere}) == {}


@given(st.integers(0, 2**32 - 1), st.sampled_from([1, 3, 4]), st.booleans())
def test_reduced_images_have_the_same_mean_light(seed, channels, is_srgb):
    pixels = np.random.default_rng(seed).integers(0, 256, (16, 32, channels), dtype=np.uint8)
    is_srgb = is_srgb and channels >= 3
    small = reduced(pixels, 4, is_srgb=is_srgb)
    assert small.shape == (4, 8, channels)
    expected = linear(pixels, is_srgb).reshape(4, 4, 8, 4, channels).mean(axis=(1, 3))
    if is_srgb:
        color = expected[..., :3]
        expected[..., :3] = np.where(color <= 0.0031308, 12.92 * color, 1.055 * color ** (1 / 2.4) - 0.055)
    np.testing.assert_allclose(small / 255, expected, rtol=0, atol=LEVEL)


def linear(pixels, is_srgb):
    values = pixels / 255
    if is_srgb:
        color = values[..., :3]
        values[..., :3] = np.where(color <= 0.04045, color / 12.92, ((color + 0.055) / 1.055) ** 2.4)
    return values


NEEDED = [(np.inf, 64), (65, 64), (33, 64), (32, 32), (17, 32), (1, 1), (0, 1)]
CASES = [((64, 128), [needed], (side, 2 * side)) for needed, side in NEEDED]
CASES += [((63, 64), [np.inf, 33], (32, 32)), ((64, 64), [np.inf, 64], (64, 64)), ((5, 3), [np.inf, 1], (1, 1))]


@pytest.mark.parametrize(("size", "limits", "expected"), CASES)
def test_images_keep_as_many_pixels_as_are_needed_and_no_more_than_a_limit(size, limits, expected):
    small = reduced(np.full((*size, 3), 200, dtype=np.uint8), *limits, is_srgb=True)
    assert small.shape == (*expected, 3)
    assert (small == 200).all()


def test_a_picture_that_repeats_needs_fewer_texels():
    """Where two uses of a file repeat it differently, the one that shows most of it decides."""
    often, once = (texture(to_uv=np.diag([repeats, repeats, 1.0])) for repeats in (4, 1))
    of_both = needed_for(square(), inputs={"base_color": often, "emission": once})["a.png"]
    assert of_both == pytest.approx(4 * needed_for(square(), inputs={"base_color": often})["a.png"])


@pytest.mark.parametrize("dtype", [np.uint16, np.float16, np.float32])
@pytest.mark.parametrize("is_srgb", [True, False])
def test_images_of_other_types_are_halved_as_bytes_are(dtype, is_srgb):
    pixels = np.random.default_rng(0).integers(0, 256, (16, 8, 4), dtype=np.uint8)
    others = pixels * np.uint16(257) if dtype == np.uint16 else (pixels / 255).astype(dtype)
    small = reduced(others, 4, is_srgb=is_srgb) / (65535 if dtype == np.uint16 else 1)
    np.testing.assert_allclose(small, reduced(pixels, 4, is_srgb=is_srgb) / 255, rtol=0, atol=LEVEL)


@pytest.mark.parametrize(("channels", "space"), [(1, "auto"), (3, "auto"), (3, "raw")])
def test_jpeg_files_are_decoded_at_a_scale(tmp_path, channels, space):
    """As files that are decoded in full and halved then, but for what a scaled transform leaves out."""
    x, y = np.meshgrid(np.linspace(0, 9, 256), np.linspace(0, 5, 128))
    waves = np.stack([np.sin(x), np.cos(y), np.sin(x + y)][:channels], axis=-1)
    path = str(tmp_path / "a.jpg")
    mi.Bitmap(np.uint8(127 + 120 * waves)).write(path, quality=95)
    full = read_texture_image(path).pixels
    assert full.shape == (128, 256, channels)
    for needed in (64, 17, 8):
        small = read_texture_image(path, space, needed).pixels
        expected = reduced(full, needed, is_srgb=space == "auto" and channels == 3)
        assert small.shape == expected.shape
        np.testing.assert_allclose(small.astype(float), expected, rtol=0, atol=JPEG_LEVELS)


def test_one_file_is_read_for_each_of_its_uses(tmp_path):
    """What is halved as colours is another picture than that halved as numbers; a light needs the whole of it."""
    x, y = np.meshgrid(np.arange(64), np.arange(64))
    stripes, path = np.uint8(255 * ((x + y) % 2))[..., None].repeat(3, axis=2), str(tmp_path / "a.png")
    mi.Bitmap(stripes).write(path)
    uses = texture(path), texture(path, color_space="raw")
    for order in (uses, uses[::-1]):
        textures = Textures(StageWarnings(), {path: 8.0})
        textures.read(order)
        for use in uses:
            np.testing.assert_allclose(textures.mean(use), 0.5, rtol=0, atol=0.01)
        assert textures.radiance(path, np.ones(3)).size().x == 64


def test_a_jpeg_of_many_pixels_is_no_attack(tmp_path, monkeypatch):
    image = pytest.importorskip("PIL.Image")
    path = str(tmp_path / "a.jpg")
    mi.Bitmap(np.full((64, 64, 3), 127, np.uint8)).write(path)
    monkeypatch.setattr(image, "MAX_IMAGE_PIXELS", 100)
    assert read_texture_image(path, "sRGB", 8).pixels.shape == (8, 8, 3)


def test_two_components_are_red_and_green(monkeypatch):
    values = np.random.default_rng(1).random((4, 4, 2)).astype(np.float32)
    monkeypatch.setattr("mitsuba_usd.textures.baked", lambda *_: (values, np.eye(3), "repeat"))
    given = NodeContents("texcoord", "vector2", {"name": "st"})
    color = np.array(Textures(StageWarnings()).color(given)["bitmap"])
    np.testing.assert_array_equal(color, np.pad(values, ((0, 0), (0, 0), (0, 1))))


def test_tiles_are_read_smaller_each(tmp_path):
    for number in (1001, 1002):
        mi.Bitmap(np.full((64, 64, 3), number - 1000, np.uint8)).write(str(tmp_path / f"a.{number}.png"))
    for limits, shape in (([20], (32, 64, 3)), ([20, 16], (16, 32, 3))):
        assert read_texture_image(str(tmp_path / "a.<UDIM>.png"), "raw", *limits).pixels.shape == shape
