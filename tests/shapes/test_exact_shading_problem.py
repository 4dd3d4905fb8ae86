"""`shading="auto"`: exact where that works and costs no more, in every other place as without it."""

import mitsuba as mi
import numpy as np
import pytest
from mitsuba_subdivision.shapes.mitsuba_3_9_hook import interaction_hook
from mitsuba_subdivision.shapes.mitsuba_3_9_hook.interaction_hook import exact_shading_problem, hook_problem
from shapes.cages import cube, load
from shapes.scenes import vertices
from shapes.variants import every_variant, llvm, scalar


def problem():
    return exact_shading_problem(getattr(mi, mi.variant()))


def shading_of(shape):
    (line,) = [line for line in str(shape).splitlines() if "shading = " in line]
    return line.strip(" ,").removeprefix("shading = ")


@every_variant
def test_a_shape_says_what_became_of_it():
    expected = "exact" if problem() is None else "vertex"
    assert (expected == "exact") == (not mi.variant().startswith("scalar") and hook_problem() is None)
    automatic, given = (load(cube(), shading=shading) for shading in ("auto", expected))
    assert shading_of(automatic) == shading_of(given) == expected
    assert mi.traverse(automatic).keys() == mi.traverse(given).keys()
    assert shading_of(load(cube(), shading="auto", face_normals=True)) == shading_of(load(cube())) == "vertex"


@scalar
def test_scalar_variants_have_a_reason_of_their_own():
    assert problem() == "exact shading needs a variant of llvm or cuda"
    with pytest.raises(Exception, match='shading: "exact" in a scalar variant; expected "vertex", "auto"'):
        load(cube(), shading="exact")


@llvm
def test_without_the_hook_it_is_normals_of_vertices(monkeypatch):
    monkeypatch.setattr(interaction_hook, "hook_problem", lambda: "needs another computer")
    assert problem() == "exact shading needs another computer"
    automatic = load(cube(), shading="auto")
    assert shading_of(automatic) == "vertex"
    np.testing.assert_array_equal(vertices(automatic), vertices(load(cube())))


@llvm
def test_a_trial_that_fails_is_a_reason(monkeypatch):
    def fail(*_):
        raise RuntimeError("needs the virtual functions of Mitsuba 3.9")

    monkeypatch.setattr(interaction_hook, "hook_problem", lambda: None)
    monkeypatch.setattr(interaction_hook, "interaction_hook", fail)
    interaction_hook._trial_problem.cache_clear()
    assert problem() == "exact shading needs the virtual functions of Mitsuba 3.9"
    interaction_hook._trial_problem.cache_clear()
