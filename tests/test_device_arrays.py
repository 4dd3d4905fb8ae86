"""NumPy's values become arrays of Dr.Jit in one place, which copies them."""

import ast
import re
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import drjit as dr
import mitsuba as mi
import mitsuba_subdivision
import numpy as np
import pytest
from mitsuba_subdivision import upload
from mitsuba_subdivision.cage import named_cages
from mitsuba_subdivision.device_arrays import CACHE_LINE, mapped, take_over

ROOT = Path(mitsuba_subdivision.__file__).parent
# Classes of arrays of Dr.Jit and Mitsuba by the last part of their names, and what variables that hold one are called.
ARRAY = re.compile(
    r"(Float|UInt|Int)(32|64)?|Bool|Mask|Tensor\w+|(Point|Vector|Normal|Color)\df|Array\w+|(Scalar)?Matrix\df"
    r"|\w*float_type|\w*kernel_type|_float"
)
# What an expression of NumPy's looks like.
NUMPY = re.compile(r"\bnp\.|\.(ravel|astype|reshape|copy)\(|\.(T|positions|values|array|data|weights)\b")


@pytest.mark.core
@pytest.mark.usefixtures("variants_all")
@pytest.mark.parametrize("shape", [(), (1,), (7,), (5, 3), (2, 3, 4)], ids=str)
def test_tensors_have_the_values_and_the_shape(shape, np_rng):
    for name in ("TensorXf", "TensorXu"):
        values = np_rng.integers(0, 100, shape)
        array = upload(getattr(mi, name), values)
        assert type(array) is getattr(mi, name)
        np.testing.assert_array_equal(np.array(array), values)


@pytest.mark.core
def test_arrays_are_parts_flattened_and_joined(variants_all_ad_rgb, np_rng):  # noqa: ARG001
    one, other = np_rng.random((4, 3)), np_rng.random(5)
    flat = upload(mi.Float, one, other)
    np.testing.assert_array_equal(np.array(flat), np.array(mi.Float([*one.ravel(), *other])))
    np.testing.assert_array_equal(np.array(upload(mi.Point3f, one.T.copy().T)).T, np.array(flat)[:12].reshape(4, 3))
    assert np.array(upload(mi.Bool, [True, False])).tolist() == [True, False]
    assert len(upload(mi.UInt32, [])) == 0


def test_single_numbers_and_vectors_of_scalar_variants(variant_scalar_rgb):  # noqa: ARG001
    assert upload(mi.Float, np.array([0.5])) == 0.5
    assert np.array(upload(mi.Point3f, np.arange(3))).tolist() == [0, 1, 2]


def address(array):
    return array.numpy().ctypes.data


def test_uploads_do_not_use_numpys_memory(variant_llvm_ad_rgb):  # noqa: ARG001
    values = np.arange(20, dtype=np.float32)
    array = upload(mi.Float, values)
    assert address(array) != values.ctypes.data
    # For packets of any size.
    assert address(array) % CACHE_LINE == 0
    table = mapped(mi.Float, values)
    assert address(table) not in (values.ctypes.data, address(array))
    assert address(table) % CACHE_LINE == 0
    values[:] = 7
    for copy in (array, table):
        np.testing.assert_array_equal(np.array(copy), np.arange(20))


def test_uploads_are_complete_for_other_threads(variant_llvm_ad_rgb):  # noqa: ARG001
    """Shapes that are loaded in parallel read tensors that they are given: a pending copy had other numbers."""
    values = np.arange(1 << 16, dtype=np.float32)
    with ThreadPoolExecutor(2) as pool:
        for _ in range(25):
            # A kernel before, which the copy waits for.
            busy = dr.arange(mi.Float, 1 << 18)
            for _ in range(20):
                busy = dr.sin(busy)
            dr.eval(busy)
            assert np.array_equal(pool.submit(upload(mi.Float, values).numpy).result(), values)


def test_arrays_of_users_are_copied_in_place_unless_they_have_derivatives(variant_llvm_ad_rgb):  # noqa: ARG001
    values = np.arange(20, dtype=np.float32)
    mapped = mi.Float(values)
    assert address(mapped) == values.ctypes.data
    take_over(mapped)
    assert address(mapped) != values.ctypes.data
    np.testing.assert_array_equal(np.array(mapped), values)
    dr.enable_grad(mapped)
    before = mapped.index_ad
    take_over(mapped)
    assert mapped.index_ad == before


@pytest.mark.parametrize("shading", ["vertex", "exact"])
def test_assigned_parameters_are_copied(shading, variant_llvm_ad_rgb):  # noqa: ARG001
    cube = named_cages.cube()
    shape = mi.load_dict({"type": "subdivision", **cube.as_properties(mi), "shading": shading})
    parameters, points = mi.traverse(shape), cube.positions.ravel().astype(np.float32)
    parameters["control_points"] = points
    parameters.update()
    assert address(shape.control_points) != points.ctypes.data


def converts(call):
    """Whether a call makes an array of Dr.Jit of one of NumPy's, as far as its text tells."""
    name = call.func.attr if isinstance(call.func, ast.Attribute) else getattr(call.func, "id", "")
    if not ARRAY.fullmatch(name):
        return False
    given = " ".join(map(ast.unparse, call.args))
    return "scalar" not in ast.unparse(call.func) and ".tolist()" not in given and bool(NUMPY.search(given))


@pytest.mark.core
def test_no_other_module_converts():
    """Numbers, and arrays of Dr.Jit, may be converted anywhere."""
    conversions = []
    for module in ROOT.rglob("*.py"):
        calls = (node for node in ast.walk(ast.parse(module.read_text(encoding="utf-8"))) if isinstance(node, ast.Call))
        conversions += [(module.relative_to(ROOT), ast.unparse(call)) for call in calls if converts(call)]
    assert [path for path, _ in conversions if path.name != "device_arrays.py"] == [], conversions
    assert converts(ast.parse("mi.Float(points.ravel())").body[0].value)
