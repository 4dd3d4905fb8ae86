"""Pictures denoised by Open Image Denoise."""

import sys

import numpy as np
import pytest
from mitsuba_subdivision import render_denoised, studio_scene
from mitsuba_subdivision.__main__ import main
from mitsuba_subdivision.cage.named_cages import cube
from mitsuba_subdivision.regression.image import load_image
from mitsuba_subdivision.regression.scene import BOX, load_scene, render_pixels

SIZE = (48, 36)
# Of the error by as many samples, at most: measured 0.34.
LEFT = 0.6


@pytest.fixture
def model(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    cube().save("cube.obj")
    return "cube.obj"


@pytest.mark.usefixtures("variant_scalar_rgb")
def test_denoising_removes_noise(model):
    pytest.importorskip("mitsuba_oidn")
    scene = studio_scene(model, size=SIZE, rate=2)
    expected, noisy = (render_pixels(load_scene(scene, None, BOX).scene, seed, spp) for seed, spp in ((1, 128), (2, 8)))
    result = render_denoised(scene, 8, 2)
    assert result.shape == expected.shape
    np.testing.assert_array_equal(result[..., 3:], noisy[..., 3:])
    error, before = (np.sqrt(np.mean((image - expected)[..., :3] ** 2)) for image in (result, noisy))
    assert error < LEFT * before


@pytest.mark.usefixtures("model")
def test_denoised_pictures_are_no_references(capsys):
    pytest.importorskip("mitsuba_oidn")
    words = ["--size", "20x15", "--spp", "4", "--rate", "2", "-m", "scalar_rgb", "--denoise"]
    assert main(["render", "cube.obj", "-o", "a.exr", *words]) == 0
    assert load_image("a.exr").metadata["denoised"]
    assert main(["compare", "a.exr", "a.exr"]) == 3
    assert '"a.exr" is denoised, which removes what is compared; expected one as rendered' in capsys.readouterr().err


def test_a_missing_denoiser_names_the_extra(model, capsys, monkeypatch):
    monkeypatch.setitem(sys.modules, "mitsuba_oidn", None)
    assert main(["render", model, "-o", "a.png", "--denoise"]) == 1
    assert 'pip install "mitsuba-subdivision[denoise]"' in capsys.readouterr().err
