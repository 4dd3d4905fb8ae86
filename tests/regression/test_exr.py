import os
from operator import attrgetter

import mitsuba as mi
import numpy as np
import OpenEXR
import pytest
from mitsuba_subdivision.regression import RegressionError
from mitsuba_subdivision.regression import image as images
from mitsuba_subdivision.regression.compare import compare
from mitsuba_subdivision.regression.image import load_image, read_channels, save_image, write_channels, write_exr
from regression.random_images import random_image

PIXELS = np.arange(24, dtype=np.float32).reshape(2, 4, 3)


def test_images_round_trip_bit_by_bit(tmp_path, np_rng):
    before = random_image(np_rng)
    save_image(tmp_path / "a.exr", before)
    after = load_image(tmp_path / "a.exr")
    names = ["pixels", "paired", "estimate.variance", "estimate.count", *(f"probe.{n}" for n in vars(after.probe))]
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


def test_any_rgb_file_is_an_image_and_reading_restores_standard_error(tmp_path):
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
    assert {"<root>", "variance", "paired", "probe_P", "probe_Ns", "probe_uv"} <= set(layers)


HEADER = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}


def write(path, *content):
    with OpenEXR.File(*content) as file:
        file.write(str(path))


def channels(**changes):
    result = dict.fromkeys("RGB", PIXELS[..., 0])
    result |= {f"variance.{name}": PIXELS[..., 0] for name in "RGB"} | {"N": np.full((2, 4), 3)}
    result |= changes
    return {name: values for name, values in result.items() if values is not None}


def with_windows(path, pixels, display, data, **others):
    """Write a picture whose data window is another one than its display window."""
    header = {**HEADER, "displayWindow": display, "dataWindow": data}
    left, top, right, bottom = (*data[0], *data[1])
    layers = {"RGB": pixels} | others
    write(path, header, {n: np.ascontiguousarray(v[top : bottom + 1, left : right + 1]) for n, v in layers.items()})


def window(left, top, right, bottom):
    return (np.array([left, top], np.int32), np.array([right, bottom], np.int32))


def test_pictures_are_compared_over_the_union_of_their_data_windows_within_the_display_window(tmp_path):
    """A crop by another program is the whole with black around it; the error is the mean over the union."""
    whole, full = np.zeros((8, 10, 3), np.float32), window(0, 0, 9, 7)
    whole[2:5, 3:7] = 0.5
    parts = {"whole": full, "cropped": window(3, 2, 6, 4), "other": window(3, 3, 6, 5)}
    for name, data in parts.items():
        with_windows(tmp_path / f"{name}.exr", whole, full, data)
    images = {name: load_image(tmp_path / f"{name}.exr") for name in parts}
    assert np.array_equal(images["cropped"].pixels, whole)
    # Nothing is hit where there are no pixels.
    with_windows(tmp_path / "ids.exr", whole, full, parts["cropped"], prim=np.ones((8, 10), np.uint32))
    inside = np.pad(np.ones((3, 4), bool), [(2, 3), (3, 3)])
    assert np.array_equal(read_channels(tmp_path / "ids.exr")[0]["prim"], np.where(inside, 1, 2**32 - 1))
    assert compare(images["whole"], images["cropped"]).exit_status == 0
    # Rows 2 to 5 of the columns 3 to 6, where one row of four is black in the other picture.
    result = compare(images["cropped"], images["other"])
    assert result.exit_status == 2
    assert result.numbers["relmse"] == pytest.approx(0.25**2 * 4 / (0.25 + 0.01) / 4)
    assert (result.worst.y, result.worst.reference[0], result.worst.test[0]) == (2, 0.5, 0)
    # What lies outside the display window does not count; the window may begin anywhere.
    moved, wide = np.zeros((12, 14, 3), np.float32), window(2, 2, 11, 9)
    moved[2:10, 2:12] = whole
    with_windows(tmp_path / "moved.exr", moved, wide, window(2, 2, 11, 9))
    moved[:2] = 7
    with_windows(tmp_path / "overscan.exr", moved, wide, window(0, 0, 13, 11))
    a, b = (load_image(tmp_path / f"{name}.exr") for name in ("moved", "overscan"))
    assert np.array_equal(a.pixels, whole)
    assert compare(a, b).exit_status == 0
    message = r"whole.exr. has 10 x 8 .* from x = 0, y = 0.*moved.exr. has 10 x 8 .* from x = 2, y = 2"
    with pytest.raises(RegressionError, match=message):
        compare(images["whole"], a)


def test_layers_and_positions_of_other_programs_are_channels(tmp_path):
    """A position pass has some names of old references' probes, and alpha comes first."""
    factors = {**dict.fromkeys("RGB", 1), "P.X": 1, "P.Y": 2, "N": 3, "A": 4}
    write_channels(tmp_path / "a.exr", {name: factor * PIXELS[..., 0] for name, factor in factors.items()})
    image = load_image(tmp_path / "a.exr")
    assert image.names == ("R", "G", "B", "A", "N", "P.X", "P.Y")
    assert np.array_equal(image.pixels[..., 3:], PIXELS[..., :1] * [4, 3, 1, 2])
    assert image.probe is image.estimate is None


UNUSABLE = {
    "is not a file": lambda path: None,  # noqa: ARG005
    "not an OpenEXR file": lambda path: path.write_bytes(b"P6 4 2 255 "),
    "has 2 parts": lambda path: write(path, [OpenEXR.Part(dict(HEADER), {"RGB": PIXELS}, name) for name in "ab"]),
    "has no channel R, G, B; expected R, G, B, Y": lambda path: write_channels(path, {"Y": PIXELS[..., 0]}),
    "has no channel G; expected R, G, B": lambda path: write_channels(path, channels(G=None)),
    "has no channel variance.B": lambda path: write_channels(path, channels(**{"variance.B": None})),
    "no channel N": lambda path: write_channels(path, channels(N=None)),
    "has pixels without samples .channel N is 0": lambda path: write_channels(path, channels(N=np.zeros((2, 4), int))),
    "without probe_Ns.X, .*probe_P.Y": lambda path: write_channels(path, channels(**{"probe_P.X": PIXELS[..., 0]})),
    "metadata of schema 2; this version reads schema 1": lambda path: write_exr(path, PIXELS, {"schema": 2}),
    "not JSON": lambda path: write(path, {**HEADER, images.METADATA_ATTRIBUTE: "{"}, {"RGB": PIXELS}),
}


@pytest.mark.parametrize(("message", "write"), UNUSABLE.items(), ids=UNUSABLE)
def test_unusable_images_are_errors_that_name_the_file(tmp_path, message, write):
    path = tmp_path / "broken.exr"
    write(path)
    with pytest.raises(RegressionError, match=message) as error:
        load_image(path)
    assert "broken.exr" in str(error.value)
