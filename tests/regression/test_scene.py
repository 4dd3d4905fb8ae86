"""Loading scenes, the environment, and images in parts: the same command gives the same image."""

import subprocess
import sys
from unittest.mock import Mock

import mitsuba as mi
import numpy as np
import pytest
from mitsuba_subdivision.regression import scene as scenes
from mitsuba_subdivision.regression.scene import LEAST_PART_SPP, PART_SAMPLES, load_scene, parts_of, render_image
from regression.defects import SCENES

SCRIPT = """
import sys
import mitsuba_subdivision
import mitsuba as mi
import numpy as np
from mitsuba_subdivision.regression.scene import load_scene

mi.set_variant("llvm_ad_rgb")
errors = []
for _ in range(3):
    try:
        load_scene(sys.argv[1], {"resolution": 16, "evaluator": "none"}, None)
    except Exception as error:
        errors.append(error)
assert len(errors) == 3
scene = load_scene(sys.argv[1], {"resolution": 16}, None).scene
for seed in range(3):
    assert np.isfinite(np.array(mi.render(scene, spp=4, seed=seed))).all()
"""


def test_rendering_works_after_errors_that_are_kept(variant_llvm_ad_rgb):  # noqa: ARG001 - skips where there is no LLVM
    command = [sys.executable, "-c", SCRIPT, str(SCENES / "valence3.xml")]
    result = subprocess.run(command, check=False, timeout=120, capture_output=True, text=True)
    assert result.returncode == 0, result.stderr


@pytest.mark.usefixtures("variant_scalar_rgb")
def test_instances_load_in_order(monkeypatch):
    """At once, they have kernels of their own in every process."""
    monkeypatch.setattr(mi.parser, "instantiate", instantiate := Mock(wraps=mi.parser.instantiate))
    group = {"type": "shapegroup", "ball": {"type": "sphere"}}
    placed = {"type": "instance", "group": {"type": "ref", "id": "group"}}
    scene = {"type": "scene", "sensor": {"type": "perspective"}, "group": group}
    load_scene(scene)
    load_scene({**scene, "placed": placed})
    assert [call.args[0].parallel for call in instantiate.call_args_list] == [True, False]


EPYC = "processor\t: 0\nvendor_id\t: AMD\ncpu family\t: 26\nmodel\t\t: 2\nmodel name\t: EPYC\nflags\t\t: fpu vme\n"
ARM = "processor\t: 0\nBogoMIPS\t: 243.75\nCPU implementer\t: 0x41\nCPU architecture: 8\nCPU part\t: 0xd40\n"


def test_processors_of_one_name_are_told_apart_and_those_without_have_numbers():
    """By what systems say of their first one, which cannot be had of others here."""
    another = "\nprocessor\t: 1\nmodel name\t: another one\n"
    assert scenes._first_of(EPYC + another) == "EPYC, cpu family 26, model 2"
    assert scenes._first_of(ARM + another) == "CPU implementer 0x41, CPU architecture 8, CPU part 0xd40"
    # A list of another form gives nothing.
    assert scenes._first_of("") == scenes._first_of("no colon\n") == ""
    assert scenes.environment("scalar_rgb")["processor"]


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
