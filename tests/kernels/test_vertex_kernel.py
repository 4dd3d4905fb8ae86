"""The kernel does what `VertexTable.apply` does; its derivatives are tested in `gradients`."""

import gc
import weakref

import drjit as dr
import numpy as np
import pytest
from mitsuba_subdivision import LimitSurface
from mitsuba_subdivision.cage import named_cages
from mitsuba_subdivision.device_arrays import upload
from mitsuba_subdivision.kernels.array_types import ArrayTypes
from mitsuba_subdivision.kernels.vertex_kernel import UnitNormal, VertexKernel
from patches.closed_cages import bumpy, mixed_torus, torus
from reference.refined_cages import refine_first
from shapes.cages import RING, cube

CASES = {
    "cube": lambda: LimitSurface(named_cages.cube()),
    "large valence": lambda: LimitSurface(named_cages.extraordinary(12, closed=False)),
    # Regular patches only.
    "torus": lambda: LimitSurface(bumpy(torus(5, 4))),
    "doo_sabin": lambda: LimitSurface(bumpy(torus(5, 4)), "doo_sabin"),
    # Vertices on creases have copies.
    "creased": lambda: LimitSurface(cube(creases=RING)),
    "refined once": lambda: LimitSurface(bumpy(mixed_torus(), size=0.05)),
}

# Threads add in no fixed order.
ORDER_OF_SUMS = 1e-5


@pytest.fixture(params=CASES)
def surface(request, monkeypatch):
    if request.param == "refined once":
        refine_first(monkeypatch)
    return CASES[request.param]()


def vectors(flat):
    return np.array(flat).reshape(-1, 3)


@pytest.mark.core
@pytest.mark.parametrize("rate", [1, 5])
def test_equals_sampling_table(surface, rate, float_type, rounding):
    table = surface.sampling(rate)
    positions, normals = VertexKernel(table, float_type)(upload(float_type, surface.cage.positions))
    expected, p = table.apply(surface.cage.positions), vectors(positions)
    np.testing.assert_array_equal(p, p[table.weld_target])
    np.testing.assert_allclose(p, expected[0], atol=rounding)
    # Normals lose the digits that cancel in the cross product of two nearly parallel tangents.
    np.testing.assert_allclose(vectors(normals), expected[1], atol=50 * rounding)


def test_gradients_recorded_in_one_thread_run_in_many(surface, float_type, np_rng):
    """Earlier, the second run wrote beyond its array."""
    table, threads = surface.sampling(5), dr.thread_count()
    kernel, points = VertexKernel(table, float_type), upload(float_type, surface.cage.positions)
    # Arguments of the gradients by points and by normals
    arguments = points, *(upload(float_type, part) for part in np_rng.standard_normal((2, 3 * table.vertex_count)))
    try:
        dr.set_thread_count(1)
        expected = np.array(kernel.gradient(*arguments))
        dr.set_thread_count(max(threads, 2))
        gradients = [np.array(kernel.gradient(*arguments)) for _ in range(20)]
    finally:
        dr.set_thread_count(threads)
    np.testing.assert_allclose(gradients, [expected] * 20, atol=ORDER_OF_SUMS * np.abs(expected).max())


def test_normals_depend_on_neither_the_origin_nor_the_scale(surface, float_type, rounding):
    def normals(rate, points):
        return vectors(VertexKernel(surface.sampling(rate), float_type)(upload(float_type, points))[1])

    if surface.patches.refined is not None:
        pytest.skip("refined control points are rounded")
    # Exact in float32, like the control points rounded to 2**-10.
    points = np.round(surface.cage.positions * 1024) / 1024
    np.testing.assert_array_equal(normals(4, points), normals(4, points + np.array([1024.0, -2048.0, 512.0])))
    for scale in (1e-12, 1e12):
        scaled = normals(3, scale * surface.cage.positions)
        np.testing.assert_allclose(scaled, normals(3, surface.cage.positions), atol=50 * rounding)


def launched(kernel, points):
    """The kernels that run, by what they are compiled from."""
    with dr.scoped_set_flag(dr.JitFlag.KernelHistory):
        dr.kernel_history_clear()
        dr.eval(kernel(points))
        return tuple(entry["hash"] for entry in dr.kernel_history() if entry["type"] == dr.KernelType.JIT)


def test_classes_share_kernels_for_any_alignment_of_arrays(surface, float_type):
    """Dr.Jit takes NumPy's memory as it lies; else shapes of the same kind would be compiled again and again."""
    points = upload(float_type, surface.cage.positions)
    compiled, kept = set(), []
    for count in range(5):
        # What lies between them moves the arrays of the next table.
        table = surface.sampling(4)
        kept.append([np.empty(40 * count, dtype=np.uint8), VertexKernel(table, float_type)])
        compiled.add(launched(kept[-1][1], points))
    (hashes,) = compiled
    # One packs the control points; one each for vertices on planes and on polynomials of the scheme. Others refine
    # control points and weld copies of vertices, where there are any.
    assert len(hashes) == 1 + len(table.polynomials) + (table.patches.refined is not None) + bool(table.copies.size)


def test_missing_points_are_an_error(float_type):
    kernel = VertexKernel(LimitSurface(named_cages.cube()).sampling(2), float_type)
    with pytest.raises(ValueError, match="21 coordinates; expected 24, x, y, z of 8 control points"):
        kernel(dr.zeros(float_type, 21))


@pytest.mark.core
@pytest.mark.parametrize("longer", [-2, 0])
def test_parallel_tangents_have_no_normal_and_no_derivatives(float_type, longer):
    vector3 = ArrayTypes(float_type).vector3
    du = vector3(1, 2, 4)
    normal = UnitNormal(du, longer * du, 0, du)
    for vector in (normal.value, normal.forward(vector3(1, 0, 0), vector3(0, 1, 0)), *normal.backward(du)):
        np.testing.assert_array_equal(np.array(vector), 0)


def test_kernels_let_go_of_the_table(surface, float_type):
    # The collector looks at what is new only.
    gc.freeze()
    table = surface.sampling(3)
    kept = [table, *table.polynomials, *(part.patch for part in table.polynomials)]
    seen = [weakref.ref(value) for value in kept]
    kernel = VertexKernel(table, float_type)
    del table, kept
    gc.collect()
    gc.unfreeze()
    assert [reference() for reference in seen] == [None] * len(seen)
    dr.eval(kernel(upload(float_type, surface.cage.positions)))
