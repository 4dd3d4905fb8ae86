"""Loading scenes, and what is left when that fails."""

import subprocess
import sys

import mitsuba as mi
import pytest
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
    instantiate, is_parallel = mi.parser.instantiate, []
    monkeypatch.setattr(
        mi.parser,
        "instantiate",
        lambda config, state: is_parallel.append(config.parallel) or instantiate(config, state),
    )
    group = {"type": "shapegroup", "ball": {"type": "sphere"}}
    placed = {"type": "instance", "group": {"type": "ref", "id": "group"}}
    scene = {"type": "scene", "sensor": {"type": "perspective"}, "group": group}
    load_scene(scene)
    load_scene({**scene, "placed": placed})
    assert is_parallel == [True, False]
