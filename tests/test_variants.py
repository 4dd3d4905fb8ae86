"""Functions that ask for Mitsuba take its module with a variant set, a variant's module, or a variant's name."""

import importlib.util
import inspect

import mitsuba as mi
import mitsuba_subdivision as msub
import numpy as np
import pytest

VARIANT = "llvm_ad_rgb"
STAGE = """#usda 1.0
def Mesh "quad" {
    int[] faceVertexCounts = [4]
    int[] faceVertexIndices = [0, 1, 2, 3]
    point3f[] points = [(0, 0, 0), (1, 0, 0), (1, 1, 0), (0, 1, 0)]
}
"""
QUAD = msub.ControlCage([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]], [[0, 1, 2, 3]])


def usd_scene(given, folder):
    path = folder / "quad.usda"
    path.write_text(STAGE)
    return msub.usd_scene(path, given)


# What each function makes of a variant, so that it can be compared.
FUNCTIONS = {
    "ControlCage.as_properties": lambda given, _: {key: str(value) for key, value in QUAD.as_properties(given).items()},
    "LimitSurface.on_device": lambda given, _: msub.LimitSurface(QUAD).on_device(given).types.float,
    "register_variant": lambda given, _: msub.register_variant(given),
    "usd_scene": lambda given, folder: {key: str(value) for key, value in usd_scene(given, folder).items()},
}
EVERY_FUNCTION = pytest.mark.parametrize("name", FUNCTIONS)


def made(name, given, folder):
    if name == "usd_scene" and importlib.util.find_spec("pxr") is None:
        pytest.skip("USD is not installed")
    return FUNCTIONS[name](given, folder)


def test_these_are_all_public_functions_that_ask_for_mitsuba():
    result = set()
    for name in msub.__all__:
        public = getattr(msub, name)
        members = {name: public}
        if inspect.isclass(public):
            members = {
                f"{name}.{member}": value for member, value in vars(public).items() if not member.startswith("_")
            }
        for member, value in members.items():
            function = getattr(value, "__func__", value)
            if not inspect.isfunction(function):
                continue
            if {"mi", "variant", "float_type"} & {*inspect.signature(function).parameters}:
                result.add(member)
    assert result == {*FUNCTIONS}


@pytest.mark.usefixtures("variant_llvm_ad_rgb")
@EVERY_FUNCTION
def test_a_variant_is_a_module_or_a_name(tmp_path, name):
    expected = made(name, mi, tmp_path)
    assert made(name, VARIANT, tmp_path) == expected
    assert made(name, mi.llvm_ad_rgb, tmp_path) == expected


NO_VARIANT = r"expected the module mitsuba with a variant set, .* or its name, \"llvm_ad"


@EVERY_FUNCTION
@pytest.mark.parametrize(
    ("given", "message"),
    [
        *((given, NO_VARIANT) for given in (None, 3, np, object())),
        (mi, "no variant is set; expected the module mitsuba with a variant set"),
        ("opencl_rgb", 'variant "opencl_rgb"; expected one of'),
    ],
)
def test_anything_else_is_an_error_that_says_what_was_expected(monkeypatch, tmp_path, name, given, message):
    if given is mi:
        monkeypatch.setattr(mi, "variant", lambda: None)
    with pytest.raises(ValueError, match=message):
        made(name, given, tmp_path)
