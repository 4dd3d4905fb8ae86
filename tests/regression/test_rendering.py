"""Images in parts: the same command gives the same image, and other seeds give others."""

from unittest.mock import Mock

import mitsuba as mi
import numpy as np
import pytest
from mitsuba_subdivision.regression import scene as scenes
from mitsuba_subdivision.regression.scene import LEAST_PART_SPP, PART_SAMPLES, load_scene, parts_of, render_image
from regression.defects import SCENES

SIZE = 8


@pytest.fixture
def loaded(variants_all_rgb):  # noqa: ARG001
    return load_scene(SCENES / "valence3.xml", {"resolution": SIZE}, "box")


@pytest.mark.core
@pytest.mark.parametrize("size", [(1, 1), (64, 64), (512, 512), (1920, 1080), (10000, 10000)])
@pytest.mark.parametrize("spp", [1, 16, 17, 100, 1000, 16384])
def test_parts_have_all_samples_and_no_part_is_small_or_much_too_large(size, spp):
    parts = parts_of(spp, size)
    assert sum(parts) == spp
    assert max(parts) - min(parts) <= 1
    assert len(parts) == 1 or min(parts) >= LEAST_PART_SPP
    assert max(parts) < 2 * max(LEAST_PART_SPP, PART_SAMPLES // (size[0] * size[1])) + 1


def test_small_images_are_one_render_of_mitsuba(loaded):
    expected = np.array(mi.render(loaded.scene, spp=4, seed=3))
    np.testing.assert_array_equal(render_image(loaded, 4, 3), expected)


def seeds_and_samples(render):
    return [(call.kwargs["seed"], call.kwargs["spp"]) for call in render.call_args_list]


def test_images_in_parts_are_means_of_other_samples(loaded, monkeypatch):
    monkeypatch.setattr(scenes, "PART_SAMPLES", LEAST_PART_SPP * SIZE**2)
    monkeypatch.setattr(mi, "render", counted := Mock(wraps=mi.render))
    first, again, other = (render_image(loaded, 2 * LEAST_PART_SPP + 1, seed) for seed in (0, 0, 1))
    assert seeds_and_samples(counted) == [(0, 16), (1, 17), (0, 16), (1, 17), (2, 16), (3, 17)]
    np.testing.assert_array_equal(first, again)
    assert not np.array_equal(first, other)
    parts = [np.array(counted(loaded.scene, seed=i, spp=16 + i), dtype=np.float64) for i in range(2)]
    np.testing.assert_array_equal(first, ((16 * parts[0] + 17 * parts[1]) / 33).astype(np.float32))


@pytest.mark.usefixtures("variant_scalar_rgb")
def test_samplers_that_spread_samples_over_the_whole_keep_it(monkeypatch):
    monkeypatch.setattr(scenes, "PART_SAMPLES", 1)
    loaded = load_scene(SCENES / "human.xml", None, "box")
    monkeypatch.setattr(mi, "render", counted := Mock(return_value=np.zeros((1, 1, 3))))
    render_image(loaded, 64)
    assert seeds_and_samples(counted) == [(0, 64)]
