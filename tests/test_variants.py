"""Functions that ask for Mitsuba take its module with a variant set, a variant's module, or a variant's name."""

import importlib.util
import inspect
from pathlib import Path

import mitsuba as mi
import mitsuba_subdivision as msub
import numpy as np
import pytest

VARIANT = "llvm_ad_rgb"
STAGE = Path(__file__).parent / "data" / "quads.usda"
QUAD = msub.ControlCage([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]], [[0, 1, 2, 3]])


# What each function makes of a variant, so that it can be compared.
FUNCTIONS = {
    "ControlCage.as_properties": lambda given: {key: str(value) for key, value in QUAD.as_properties(given).items()},
    "LimitSurface.on_device": lambda given: msub.LimitSurface(QUAD).on_device(given).types.float,
    "register_variant": msub.register_variant,
    "usd_scene": lambda given: {key: str(value) for key, value in msub.usd_scene(STAGE, given).items()},
}
EVERY_FUNCTION = pytest.mark.parametrize("name", FUNCTIONS)


def made(name, given):
    if name == "usd_scene" and importlib.util.find_spec("pxr") is None:
        pytest.skip("USD is not installed")
    return FUNCTIONS[name](given)


def test_all_public_functions_with_a_variant_are_tested():
    public = {name: getattr(msub, name) for name in msub.__all__}
    for name, cls in [(name, value) for name, value in public.items() if inspect.isclass(value)]:
        methods = {member: value for member, value in vars(cls).items() if not member.startswith("_")}
        public |= {f"{name}.{member}": getattr(value, "__func__", value) for member, value in methods.items()}
    functions = {name: inspect.signature(value) for name, value in public.items() if inspect.isfunction(value)}
    asked = {"mi", "variant", "float_type"}
    assert {name for name, signature in functions.items() if asked & {*signature.parameters}} == {*FUNCTIONS}


@pytest.mark.usefixtures("variant_llvm_ad_rgb")
@EVERY_FUNCTION
def test_a_variant_is_a_module_or_a_name(name):
    expected = made(name, mi)
    assert made(name, VARIANT) == expected
    assert made(name, mi.llvm_ad_rgb) == expected


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
def test_other_arguments_are_errors_that_state_the_expected_ones(monkeypatch, name, given, message):
    if given is mi:
        monkeypatch.setattr(mi, "variant", lambda: None)
    with pytest.raises(ValueError, match=message):
        made(name, given)
