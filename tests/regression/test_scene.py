"""Loading scenes, what is left when that fails, and the environment: processors that add in other orders are named."""

import subprocess
import sys
from pathlib import Path
from unittest.mock import Mock

import mitsuba as mi
import pytest
from mitsuba_subdivision.regression import scene as scenes
from mitsuba_subdivision.regression.scene import load_scene
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
    found = subprocess.run(command, check=False, timeout=120, capture_output=True, text=True)
    assert found.returncode == 0, found.stderr


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


EPYC = """processor\t: 0
vendor_id\t: AuthenticAMD
cpu family\t: {family}
model\t\t: {model}
model name\t: AMD EPYC
flags\t\t: fpu vme

processor\t: 1
model name\t: another one
"""
ARM = """processor\t: 0
BogoMIPS\t: 243.75
CPU implementer\t: 0x41
CPU architecture: 8
CPU part\t: 0xd40

processor\t: 1
"""


def test_processors_of_one_name_are_told_apart_and_those_without_have_numbers():
    assert scenes._first_of(EPYC.format(family=26, model=2)) == "AMD EPYC, cpu family 26, model 2"
    assert scenes._first_of(EPYC.format(family=25, model=1)) == "AMD EPYC, cpu family 25, model 1"
    assert scenes._first_of(ARM) == "CPU implementer 0x41, CPU architecture 8, CPU part 0xd40"
    # A list of another form gives nothing.
    assert scenes._first_of("") == ""
    assert scenes._first_of("no colon\n") == ""


def test_this_processor_has_a_name():
    found = scenes.environment("scalar_rgb")["processor"]
    information = Path("/proc/cpuinfo")
    if information.is_file():
        assert found == scenes._first_of(information.read_text(encoding="utf-8", errors="replace"))
    else:
        assert found
