"""In which variants a test runs, with which shading, or in a process of its own."""

import subprocess
import sys

import pytest
from mitsuba_subdivision.shapes.interaction_hook import hook_problem

every_variant = pytest.mark.usefixtures("variants_all_rgb")
every_array_variant = pytest.mark.usefixtures("variants_array_rgb")
every_ad_variant = pytest.mark.usefixtures("variants_all_ad_rgb")
llvm = pytest.mark.usefixtures("variant_llvm_ad_rgb")
scalar = pytest.mark.usefixtures("variant_scalar_rgb")
exact = pytest.mark.skipif(hook_problem() is not None, reason=str(hook_problem()))
shadings = pytest.mark.parametrize("shading", ["vertex", pytest.param("exact", marks=exact)])
mirrors = pytest.mark.parametrize("mirror", [1, -1])


def exact_llvm(test):
    return exact(llvm(test))


def printed(code):
    """What a program prints, in a process of its own, which may crash; a warning is an error."""
    command = [sys.executable, "-W", "error", "-c", code]
    done = subprocess.run(command, capture_output=True, text=True, timeout=120, check=False)
    assert done.returncode == 0, done.stderr
    return done.stdout
