"""OpenEXR files: what comes back, and what is refused."""

import os
from operator import attrgetter

import mitsuba as mi
import numpy as np
import OpenEXR
import pytest
from mitsuba_subdivision.regression import RegressionError
from mitsuba_subdivision.regression import image as images
from mitsuba_subdivision.regression.image import load_image, read_channels, save_image, write_channels, write_exr
from regression.random_images import random_image

PIXELS = np.arange(24, dtype=np.float32).reshape(2, 4, 3)


def test_an_image_comes_back_as_it_was_and_gives_the_same_bytes_again(tmp_path, np_rng):
    before = random_image(np_rng)
    save_image(tmp_path / "a.exr", before)
    after = load_image(tmp_path / "a.exr")
    names = [
        "pixels",
        "paired",
        "estimate.variance",
        "estimate.count",
        *(f"probe.{name}" for name in vars(after.probe)),
    ]
    for values in map(attrgetter, names):
        assert np.array_equal(values(after), values(before))
    assert after.metadata == {"schema": 1, **before.metadata}
    save_image(tmp_path / "b.exr", after)
    assert (tmp_path / "a.exr").read_bytes() == (tmp_path / "b.exr").read_bytes()


def test_metadata_keep_their_digits_and_their_order_does_not_change_the_bytes(tmp_path):
    metadata = {"x": 0.01, "y": {"u": 2, "v": 3}}
    for name, given in (("a.exr", metadata), ("b.exr", {"y": {"v": 3, "u": 2}, "x": 0.01})):
        write_exr(tmp_path / name, PIXELS, given)
    assert (tmp_path / "a.exr").read_bytes() == (tmp_path / "b.exr").read_bytes()
    assert read_channels(tmp_path / "a.exr")[1] == metadata


def test_any_file_with_r_g_b_is_an_image_and_standard_error_is_where_it_was_after_reading(tmp_path):
    before = os.fstat(2)
    write_exr(tmp_path / "a.exr", PIXELS)
    result = load_image(tmp_path / "a.exr")
    assert np.array_equal(result.pixels, PIXELS)
    assert result.estimate is result.probe is result.paired is None
    (tmp_path / "broken.exr").write_bytes((tmp_path / "a.exr").read_bytes()[:-20])
    with pytest.raises(RegressionError, match=r"broken\.exr"):
        read_channels(tmp_path / "broken.exr")
    assert (os.fstat(2).st_dev, os.fstat(2).st_ino) == (before.st_dev, before.st_ino)


@pytest.mark.threads
def test_other_programs_read_one_part_with_layers(tmp_path, np_rng, variant_scalar_rgb):  # noqa: ARG001
    save_image(tmp_path / "a.exr", random_image(np_rng))
    layers = dict(mi.Bitmap(str(tmp_path / "a.exr")).split())
    assert {"<root>", "variance", "paired", "P", "Ns", "uv"} <= set(layers)


HEADER = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}


def write(path, *content):
    with OpenEXR.File(*content) as file:
        file.write(str(path))


def channels(**changes):
    result = dict.fromkeys("RGB", PIXELS[..., 0])
    result |= {f"variance.{name}": PIXELS[..., 0] for name in "RGB"} | {"N": np.full((2, 4), 3)}
    result |= changes
    return {name: values for name, values in result.items() if values is not None}


UNUSABLE = {
    "is not a file": lambda path: None,  # noqa: ARG005
    "not an OpenEXR file": lambda path: path.write_bytes(b"P6 4 2 255 "),
    "has 2 parts": lambda path: write(path, [OpenEXR.Part(dict(HEADER), {"RGB": PIXELS}, name) for name in "ab"]),
    "no channels R, G, B; found Y": lambda path: write_channels(path, {"Y": PIXELS[..., 0]}),
    "has no channel G; expected R, G, B": lambda path: write_channels(path, channels(G=None)),
    "has no channel variance.B": lambda path: write_channels(path, channels(**{"variance.B": None})),
    "no channel N": lambda path: write_channels(path, channels(N=None)),
    "has pixels without samples .channel N is 0": lambda path: write_channels(path, channels(N=np.zeros((2, 4), int))),
    "without P.Y": lambda path: write_channels(path, channels(**{"P.X": PIXELS[..., 0]})),
    "metadata of schema 2; this version reads schema 1": lambda path: write_exr(path, PIXELS, {"schema": 2}),
    "not JSON": lambda path: write(path, {**HEADER, images.METADATA_ATTRIBUTE: "{"}, {"RGB": PIXELS}),
}


@pytest.mark.parametrize(("message", "write"), UNUSABLE.items(), ids=UNUSABLE)
def test_what_is_wrong_is_said_with_the_file(tmp_path, message, write):
    path = tmp_path / "broken.exr"
    write(path)
    with pytest.raises(RegressionError, match=message) as error:
        load_image(path)
    assert "broken.exr" in str(error.value)
