import base64
import io
import json
import re
from dataclasses import replace

import numpy as np
import pytest
from matplotlib.figure import Figure
from matplotlib.image import imread
from matplotlib.patches import Rectangle
from mitsuba_subdivision.regression import report
from mitsuba_subdivision.regression.compare import compare
from mitsuba_subdivision.regression.image import Image, read_channels
from mitsuba_subdivision.regression.report import srgb, write_index, write_report
from regression.random_images import random_image, truth

# Saturated red, which is nowhere else on the page.
SPOT = (0.9, 0.02, 0.02)


@pytest.fixture(scope="module")
def failed():
    """A bright red square that the reference does not have, in an image of grey."""
    rng, mean = np.random.default_rng(3), truth()
    mean[8:16, 8:16] = np.array(SPOT) * 2
    return compare(random_image(rng, 400, "reference"), random_image(rng, 8, "test <1>", mean=mean))


@pytest.fixture(scope="module")
def same(failed):
    return compare(failed.reference, failed.reference)


@pytest.fixture(scope="module")
def reports(same, failed, tmp_path_factory):
    """Of both, in folders of one that had none before: the page, and its figure as matplotlib has it."""
    folder, figures, save = tmp_path_factory.mktemp("reports"), [], Figure.savefig
    assert write_index(folder) is None
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Figure, "savefig", lambda figure, *_, **__: figures.append(figure))
        pages = [write_report(folder / "a", same, "unchanged")]
        patch.setattr(Figure, "savefig", lambda *given, **more: figures.append(given[0]) or save(*given, **more))
        pages.append(write_report(folder / "b", failed, "changed <2>"))
    return list(zip(pages, map(by_title, figures), strict=True))


@pytest.fixture(scope="module")
def page(reports):
    return reports[1][0]


def by_title(figure):
    return {axes.get_title(loc="left"): axes for axes in figure.axes if axes.get_title(loc="left")}


def drawn(comparison, monkeypatch):
    figures = []
    monkeypatch.setattr(Figure, "savefig", lambda figure, *_, **__: figures.append(figure))
    report._panels(comparison)
    return by_title(figures[0])


def test_the_page_has_one_picture_no_scripts_and_escaped_names(page):
    text = page.read_text()
    assert re.findall(r"<(script|img)\b", text) == ["img"]
    assert re.findall(r"""\b(?:href|src)=["']?(?!data:)([^"' >]+)""", text) == ["comparison.json", "maps.exr"]
    assert "test &lt;1&gt;" in text
    assert text.count("changed &lt;2&gt;") == 2
    numbers = json.loads((page.parent / "comparison.json").read_text())
    assert numbers["status"] == "fail"
    assert numbers["tiers"]["tile"]["failing"]
    channels, *_ = read_channels(page.parent / "maps.exr")
    assert np.abs(channels["z"][8:16, 8:16]).mean() > 5 * np.abs(channels["z"][20:, 20:]).mean()
    index = write_index(page.parent.parent).read_text()
    assert index.index("changed &lt;2&gt;") < index.index("unchanged")
    assert 'href="b/index.html"' in index


PANELS = ["Reference", "Test", "Relative difference", "Angle between normals", "Paired difference", "z-score"]
PANELS += ["Evidence against noise", "FLIP"]


def test_the_ends_of_the_scale_state_their_differences(monkeypatch):
    """Half of the pixels are brighter, and half are darker, by as much as the scale reaches."""
    grey = np.ones((4, 4, 3))
    change = np.where(np.arange(4)[:, None, None] < 2, -0.1, 0.1)
    (picture,) = drawn(compare(Image("a", grey), Image("b", grey + change)), monkeypatch)["Relative difference"].images
    # Differences are relative to the sum of a pixel and a hundredth of the mean.
    np.testing.assert_allclose(picture.get_clim(), np.array([-0.1, 0.1]) / 1.01)
    np.testing.assert_allclose(np.unique(picture.get_array()), picture.get_clim())


def test_reports_show_equal_pictures_alike_and_circle_the_worst_pixel(failed, reports):
    panels = reports[0][1]
    reference, test = (panels[name].images[0].get_array() for name in ("Reference", "Test"))
    np.testing.assert_array_equal(reference, test)
    is_brightest = failed.reference.pixels.max(axis=2) >= np.percentile(failed.reference.pixels, 99.5)
    assert (np.round(255 * reference[is_brightest].max(axis=1)) == 255).all()
    assert reference.min() < 0.8
    for (page, panels), centre in zip(reports, ([], [(failed.worst.x, failed.worst.y)]), strict=True):
        assert [patch.center for patch in panels["Reference"].patches] == centre
        assert ("Dashed circle: worst pixel" in page.read_text()) == bool(centre)


def test_the_picture_has_every_panel_with_its_colours_and_outlines(failed, reports):
    panels = reports[1][1]
    assert list(panels) == PANELS
    evidence, angle = (panels[name].images[0] for name in ("Evidence against noise", "Angle between normals"))
    assert evidence.get_clim() == (0, failed.tier("tile").maps["evidence"].max())
    np.testing.assert_allclose(angle.norm([1e-5, 1e-2, 10]), [0, 0.5, 1])
    np.testing.assert_allclose(angle.to_rgba(np.ma.masked_invalid([np.nan]))[0], [0.55, 0.55, 0.55, 1])
    tiles = {(x["x"] - 0.5, x["y"] - 0.5, x["width"], x["height"]) for x in failed.tier("tile").numbers["failing"]}
    for name, expected in (("z-score", tiles), ("Evidence against noise", tiles), ("FLIP", set())):
        boxes = [patch for patch in panels[name].patches if isinstance(patch, Rectangle)]
        assert {(*box.get_xy(), box.get_width(), box.get_height()) for box in boxes} == expected


def test_alpha_and_layers_have_panels_of_their_names(monkeypatch):
    a, b = (Image("a", np.full((4, 4, 5), value), names=("R", "G", "B", "A", "nn.X")) for value in (0.5, 0.6))
    panels = drawn(compare(a, b), monkeypatch)
    np.testing.assert_allclose([panels[f"Difference of {name}"].images[0].get_array() for name in ("A", "nn.X")], 0.1)


def test_non_finite_pixels_are_magenta_in_the_report(failed, monkeypatch):
    pixels = failed.test.pixels.copy()
    pixels[2, 2] = np.nan
    panels = drawn(compare(failed.reference, replace(failed.test, pixels=pixels)), monkeypatch)
    assert list(panels) == ["Reference", "Test"]
    assert "not finite in magenta" in panels["Test"].get_xlabel()
    codes = srgb(np.array([[[0.0, 0.5, 2.0]], [[np.nan, 0, 0]]]))
    np.testing.assert_array_equal(np.round(255 * codes), [[[0, 188, 255]], [[255, 0, 255]]])


def test_the_picture_shows_the_difference(page):
    (data,) = re.findall(r"src=[\"']?data:image/png;base64,([^\"' >]+)", page.read_text())
    pixels = imread(io.BytesIO(base64.b64decode(data)))[..., :3]
    _, columns = np.nonzero((pixels[..., 0] > 0.8) & (pixels[..., 1:] < 0.45).all(axis=2))
    # In the second of four columns, a quarter of the test's side.
    side = pixels.shape[1] / 4
    assert len(columns) > 0.5 * (0.8 * side / 4) ** 2
    assert 1 < np.median(columns) / side < 2
