"""The report, read as a page and looked at in a browser."""

import base64
import io
import json
import re
import shutil
import subprocess
from dataclasses import replace
from html.parser import HTMLParser

import numpy as np
import pytest
from images.random_images import random_image, truth
from mitsuba_subdivision.images.compare import compare
from mitsuba_subdivision.images.exr import read_channels
from mitsuba_subdivision.images.panel import relative_panel
from mitsuba_subdivision.images.png import MAPS, colours, png_bytes, srgb
from mitsuba_subdivision.images.report import write_index, write_report

CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")
# Saturated red, which the page itself has nowhere.
SPOT = (0.9, 0.02, 0.02)


@pytest.fixture(scope="module")
def failed():
    """A bright red square that the reference does not have, in an image of grey."""
    rng = np.random.default_rng(3)
    mean = truth()
    mean[8:16, 8:16] = np.array(SPOT) * 2
    return compare(random_image(rng, 400, "reference"), random_image(rng, 8, "test <1>", mean=mean))


class Reader(HTMLParser):
    """Collects titles of panels, rectangles, and what the page would load or run."""

    def __init__(self):
        super().__init__()
        self.tags, self.titles, self.links = [], [], []

    def handle_starttag(self, tag, attrs):
        self.tags.append(tag)
        self.links += [value for name, value in attrs if name in ("href", "src") and not value.startswith("data:")]

    def handle_data(self, data):
        if self.tags and self.tags[-1] == "h2":
            self.titles.append(data)
            self.tags.append("")


def test_the_ends_of_the_scale_are_the_differences_they_say():
    """Half of the pixels are brighter, and half are darker, by as much as the scale reaches."""
    reference = np.ones((4, 4, 3))
    change = np.where(np.arange(4)[:, None, None] < 2, -0.1, 0.1)
    panel = relative_panel("", reference, reference + change, "")
    darkest, brightest = colours(np.array([0.0, 1.0]), panel.colour_map)
    np.testing.assert_array_equal(panel.pixels[:2], np.broadcast_to(darkest, (2, 4, 3)))
    np.testing.assert_array_equal(panel.pixels[2:], np.broadcast_to(brightest, (2, 4, 3)))
    # Differences are relative to the sum of a pixel and a hundredth of the mean.
    assert panel.ends == ("&minus;9.9%", "+9.9%")


def test_the_page_has_every_panel_and_runs_nothing(tmp_path, failed):
    reader = Reader()
    reader.feed(write_report(tmp_path, failed).read_text())
    assert reader.titles == [
        "Reference",
        "Test",
        "Relative difference",
        "Paired difference",
        "z-score",
        "Evidence against noise",
        "FLIP",
        "Angle between normals",
    ]
    assert "script" not in reader.tags
    assert reader.links == ["comparison.json", "maps.exr"]
    assert "rect" in reader.tags


def pictures(page, pattern):
    """Pictures in a page whose element begins with a pattern, as arrays."""
    pyplot = pytest.importorskip("matplotlib.pyplot")
    found = re.findall(rf"{pattern}'data:image/png;base64,([^']*)'", page.read_text())
    return [np.round(255 * pyplot.imread(io.BytesIO(base64.b64decode(each)))[..., :3]) for each in found]


def test_equal_pictures_are_shown_alike_with_white_for_the_brightest(tmp_path, failed):
    reference, test = pictures(write_report(tmp_path, compare(failed.reference, failed.reference)), "<image href=")[:2]
    np.testing.assert_array_equal(reference, test)
    is_brightest = failed.reference.pixels.max(axis=2) >= np.percentile(failed.reference.pixels, 99.5)
    assert (reference[is_brightest].max(axis=1) == 255).all()
    assert reference.min() < 200


def test_legends_run_from_the_colour_of_one_end_to_that_of_the_other(tmp_path, failed):
    bars = pictures(write_report(tmp_path, failed), "<img src=")
    ends = [colours(np.array([0.0, 1.0]), name) for name in MAPS]
    assert bars
    for bar in bars:
        assert any(np.array_equal(bar[0, [0, -1]], each) for each in ends)


def test_the_page_speaks_of_a_worst_pixel_where_there_is_one(tmp_path, failed):
    same = compare(failed.reference, failed.reference)
    for comparison, is_marked in ((failed, True), (same, False)):
        page = write_report(tmp_path, comparison).read_text()
        assert ("Dashed circle: worst pixel" in page) == ("<circle" in page) == is_marked


def test_the_circle_is_around_the_middle_of_the_worst_pixel(tmp_path, failed):
    centres = re.findall(r"<circle cx=(\S+) cy=(\S+) ", write_report(tmp_path, failed).read_text())
    assert {(float(x), float(y)) for x, y in centres} == {(failed.worst.x + 0.5, failed.worst.y + 0.5)}


def test_no_outline_of_a_tile_is_below_one_of_a_larger_tile(tmp_path, failed):
    sides = [(8, 4, 1), (16, 16, -3), (16, 4, 2), (12, 16, 4), (16, 16, 2)]
    tiles = [{"x": 0, "y": 0, "width": width, "height": height, "channel": "R", "z": z} for width, height, z in sides]
    numbers = {**failed.tier("tile").numbers, "failing": tiles}
    results = [replace(each, numbers=numbers) if each.name == "tile" else each for each in failed.tiers]
    page = write_report(tmp_path, replace(failed, tiers=results)).read_text()
    figure = next(each for each in page.split("<figure>") if "<h2>z-score" in each)
    shown = [tuple(map(int, each)) for each in re.findall(r"<rect x=0 y=0 width=(\d+) height=(\d+)>", figure)]
    assert shown == [(16, 16), (12, 16), (16, 4), (8, 4)]
    # Of two channels of one tile, the one that is further from noise.
    assert "16 &times; 16, R, z = -3.0" in figure


def test_names_are_escaped(tmp_path, failed):
    assert "test &lt;1&gt;" in write_report(tmp_path, failed).read_text()


def test_numbers_and_maps_lie_beside_it(tmp_path, failed):
    write_report(tmp_path, failed)
    numbers = json.loads((tmp_path / "comparison.json").read_text())
    assert numbers["status"] == "fail"
    assert numbers["tiers"]["tile"]["failing"]
    channels, _ = read_channels(tmp_path / "maps.exr")
    assert np.abs(channels["z"][8:16, 8:16]).mean() > 5 * np.abs(channels["z"][20:, 20:]).mean()


def test_images_that_are_not_finite_have_a_page(tmp_path, failed):
    pixels = failed.test.pixels.copy()
    pixels[2, 2] = np.nan
    page = write_report(tmp_path, compare(failed.reference, replace(failed.test, pixels=pixels)))
    assert "not finite in magenta" in page.read_text()


def test_the_index_lists_failures_first(tmp_path, failed):
    assert write_index(tmp_path) is None
    write_report(tmp_path / "a", compare(failed.reference, failed.reference), "unchanged")
    write_report(tmp_path / "b", failed, "changed")
    text = write_index(tmp_path).read_text()
    assert text.index("changed") < text.index("unchanged")
    assert 'href="b/index.html"' in text


def test_png_colours():
    assert (
        colours(np.array([0.0, 0.5, 1.0, 7.0]), "RdBu_r")[[0, 1, 3]] == [[5, 48, 97], [247] * 3, [103, 0, 31]]
    ).all()
    assert (srgb(np.array([[[0.0, 0.5, 2.0]], [[np.nan, 0, 0]]])) == [[[0, 188, 255]], [[255, 0, 255]]]).all()


def test_png_files_are_read_by_others(tmp_path):
    pyplot = pytest.importorskip("matplotlib.pyplot")
    pixels = np.random.default_rng(0).integers(0, 256, (5, 7, 3), dtype=np.uint8)
    (tmp_path / "a.png").write_bytes(png_bytes(pixels))
    assert np.array_equal(np.round(255 * pyplot.imread(tmp_path / "a.png")[..., :3]), pixels)


@pytest.mark.skipif(CHROMIUM is None, reason="no Chromium")
def test_a_browser_shows_the_difference(tmp_path, failed):
    pyplot = pytest.importorskip("matplotlib.pyplot")
    page = write_report(tmp_path, failed)
    shot = tmp_path / "page.png"
    command = [CHROMIUM, "--headless", "--no-sandbox", "--disable-gpu", "--window-size=1240,1400"]
    command += [f"--user-data-dir={tmp_path / 'profile'}", f"--screenshot={shot}", page.as_uri()]
    subprocess.run(command, check=True, capture_output=True, timeout=60)
    pixels = pyplot.imread(shot)[..., :3]
    # Panels of 270 pixels in four columns: the square, a quarter of the test's side, is there once.
    red = (pixels[..., 0] > 0.8) & (pixels[..., 1:] < 0.45).all(axis=2)
    rows, columns = np.nonzero(red)
    assert len(rows) > 0.5 * (270 / 4) ** 2
    # In the second of four columns.
    assert 300 < np.median(columns) < 620
    # The page fits: nothing but white at its right border.
    assert (pixels[:, -10:] == 1).all()
