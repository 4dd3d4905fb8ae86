"""`shading="auto"`: exact where that works and costs no more, in every other place as without it."""

import mitsuba as mi
import numpy as np
import pytest
from mitsuba_subdivision.cage import named_cages
from mitsuba_subdivision.shapes.mitsuba_3_9_hook import interaction_hook
from mitsuba_subdivision.shapes.mitsuba_3_9_hook.interaction_hook import exact_shading_problem, hook_problem


def _made(**parameters):
    shape = {"type": "subdivision", **named_cages.cube().as_properties(mi), "tessellation_rate": 2, **parameters}
    return mi.load_dict(shape)


def _variant():
    return getattr(mi, mi.variant())


def _shading(shape):
    (line,) = [line for line in str(shape).splitlines() if "shading = " in line]
    return line.strip(" ,").removeprefix("shading = ")


@pytest.mark.usefixtures("variants_all_rgb")
def test_a_shape_says_what_became_of_it():
    problem = exact_shading_problem(_variant())
    expected = "exact" if problem is None else "vertex"
    assert (expected == "exact") == (not mi.variant().startswith("scalar") and hook_problem() is None)
    automatic, given = _made(shading="auto"), _made(shading=expected)
    assert _shading(automatic) == _shading(given) == expected
    assert mi.traverse(automatic).keys() == mi.traverse(given).keys()
    assert _shading(_made(shading="auto", face_normals=True)) == _shading(_made()) == "vertex"


@pytest.mark.usefixtures("variant_scalar_rgb")
def test_scalar_variants_have_a_reason_of_their_own():
    assert exact_shading_problem(_variant()) == "exact shading needs a variant of llvm or cuda"
    with pytest.raises(Exception, match='shading: "exact" in a scalar variant; expected "vertex", "auto"'):
        _made(shading="exact")


@pytest.mark.usefixtures("variant_llvm_ad_rgb")
def test_without_the_hook_it_is_normals_of_vertices(monkeypatch):
    monkeypatch.setattr(interaction_hook, "hook_problem", lambda: "needs another computer")
    assert exact_shading_problem(_variant()) == "exact shading needs another computer"
    automatic = _made(shading="auto")
    assert _shading(automatic) == "vertex"
    buffers = [np.array(mi.traverse(shape)["vertex_normals"]) for shape in (automatic, _made())]
    np.testing.assert_array_equal(*buffers)


@pytest.mark.usefixtures("variant_llvm_ad_rgb")
def test_a_trial_that_fails_is_a_reason(monkeypatch):
    def fail(*_):
        raise RuntimeError("needs the virtual functions of Mitsuba 3.9")

    monkeypatch.setattr(interaction_hook, "hook_problem", lambda: None)
    monkeypatch.setattr(interaction_hook, "interaction_hook", fail)
    interaction_hook._trial_problem.cache_clear()
    assert exact_shading_problem(_variant()) == "exact shading needs the virtual functions of Mitsuba 3.9"
    interaction_hook._trial_problem.cache_clear()


@pytest.mark.usefixtures("variant_scalar_rgb")
def test_other_names_are_refused():
    with pytest.raises(Exception, match='"shading" is "automatic"; expected one of vertex, exact, auto'):
        _made(shading="automatic")
