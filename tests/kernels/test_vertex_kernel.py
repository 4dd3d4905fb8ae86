"""The kernel does what `VertexTable.apply` does, and its derivatives are those of that map."""

import gc
import weakref

import drjit as dr
import numpy as np
import pytest
from mitsuba_subdivision import ControlCage, LimitSurface
from mitsuba_subdivision.cage import named_cages
from mitsuba_subdivision.device_arrays import upload
from mitsuba_subdivision.kernels import VertexKernel
from patches.closed_cages import bumpy

# Float32 sums of up to some tens of terms of order one.
SINGLE = 2e-6
DOUBLE = 1e-13


def tolerance(float_type):
    return DOUBLE if dr.type_v(float_type) == dr.VarType.Float64 else SINGLE


CASES = ["cube", "valence 5", "mixed", "large valence", "torus", "doo_sabin"]


@pytest.fixture(params=CASES)
def surface(request):
    if request.param == "mixed":
        faces = [[0, 2, 3, 1], [4, 5, 7], [4, 7, 6], [3, 2, 6, 7], [0, 4, 6, 2], [1, 3, 7, 5], [0, 1, 5, 4]]
        return LimitSurface(ControlCage(named_cages.cube().positions, faces))
    if request.param in ("torus", "doo_sabin"):
        # Regular patches only.
        return LimitSurface(bumpy(named_cages.torus(5, 4)), "doo_sabin" if request.param == "doo_sabin" else None)
    if request.param == "cube":
        return LimitSurface(named_cages.cube())
    return LimitSurface(named_cages.extraordinary({"valence 5": 5, "large valence": 12}[request.param], closed=False))


@pytest.mark.core
def test_both_sides_of_a_crease_have_the_same_positions(float_type):
    cube = named_cages.cube()
    faces = cube.face_vertices.reshape(-1, 4)
    cage = ControlCage(cube.positions, faces, creases=[(0, 1, 10), (1, 3, 10), (3, 2, 10), (2, 0, 10)])
    table = LimitSurface(cage).sampling(4)
    copies = np.flatnonzero(table.weld_target != np.arange(table.vertex_count))
    # Four vertices, and three samples inside each of four edges.
    assert len(copies) == 16
    positions, normals = (vectors(v) for v in VertexKernel(table, float_type)(upload(float_type, cage.positions)))
    assert np.array_equal(positions[copies], positions[table.weld_target[copies]])
    assert ((normals[copies] * normals[table.weld_target[copies]]).sum(axis=1) < 0.9).all()
    assert np.abs(positions - table.apply(cage.positions)[0]).max() <= tolerance(float_type)


def vectors(flat):
    return np.array(flat).reshape(-1, 3)


def forward_derivatives(kernel, float_type, positions, direction):
    points = upload(float_type, positions)
    dr.enable_grad(points)
    dr.set_grad(points, upload(float_type, direction))
    outputs = kernel(points)
    dr.enqueue(dr.ADMode.Forward, points)
    dr.traverse(dr.ADMode.Forward)
    return [vectors(dr.grad(output)) for output in outputs]


@pytest.mark.core
@pytest.mark.parametrize("rate", [1, 5])
def test_equals_sampling_table(surface, rate, float_type):
    table = surface.sampling(rate)
    positions, normals = VertexKernel(table, float_type)(upload(float_type, surface.cage.positions))
    expected = table.apply(surface.cage.positions)
    np.testing.assert_allclose(vectors(positions), expected[0], atol=tolerance(float_type))
    # Normals lose the digits that cancel in the cross product of two nearly parallel tangents.
    np.testing.assert_allclose(vectors(normals), expected[1], atol=50 * tolerance(float_type))


def test_far_from_the_origin_loses_only_the_rounding_of_points(surface, float_type):
    kernel = VertexKernel(surface.sampling(4), float_type)
    # Exact in float32, like the control points rounded to 2**-10.
    points = np.round(surface.cage.positions * 1024) / 1024
    shift = np.array([1024.0, -2048.0, 512.0])
    near = vectors(kernel(upload(float_type, points))[1])
    far = vectors(kernel(upload(float_type, points + shift))[1])
    np.testing.assert_array_equal(near, far)


def launched(kernel, points):
    with dr.scoped_set_flag(dr.JitFlag.KernelHistory):
        dr.kernel_history_clear()
        dr.eval(kernel(points))
        return [entry for entry in dr.kernel_history() if entry["type"] == dr.KernelType.JIT]


def test_classes_share_kernels(surface, float_type):
    table = surface.sampling(4)
    kernel = VertexKernel(table, float_type)
    # One packs the control points; one each for vertices on planes and on polynomials of the scheme.
    expected = 1 + len(table.polynomials)
    assert len(launched(kernel, upload(float_type, surface.cage.positions))) == expected


def test_kernels_do_not_depend_on_where_arrays_lie(surface, float_type):
    """Dr.Jit takes NumPy's memory as it lies; else shapes of the same kind would be compiled again and again."""
    points = upload(float_type, surface.cage.positions)
    found, kept = set(), []
    for count in range(5):
        # What lies between them moves the arrays of the next table.
        kept.append([np.empty(40 * count, dtype=np.uint8), VertexKernel(surface.sampling(3), float_type)])
        found.add(tuple(kernel["hash"] for kernel in launched(kept[-1][1], points)))
    assert len(found) == 1


def test_values_are_the_same_with_and_without_derivatives(surface, float_type):
    kernel = VertexKernel(surface.sampling(3), float_type)
    points = upload(float_type, surface.cage.positions)
    without = kernel(points)
    dr.enable_grad(points)
    for one, other in zip(without, kernel(points), strict=True):
        np.testing.assert_allclose(np.array(one), np.array(dr.detach(other)), rtol=0, atol=tolerance(float_type))


def test_forward_and_backward_derivatives_agree(surface, float_type, np_rng):
    kernel = VertexKernel(surface.sampling(3), float_type)
    flat = surface.cage.positions.ravel()
    direction = np_rng.normal(size=flat.size)
    forward = forward_derivatives(kernel, float_type, surface.cage.positions, direction)
    seeds = [np_rng.normal(size=f.shape) for f in forward]

    points = upload(float_type, flat)
    dr.enable_grad(points)
    positions, normals = kernel(points)
    dr.backward(dr.dot(positions, upload(float_type, seeds[0])) + dr.dot(normals, upload(float_type, seeds[1])))
    backward = np.array(dr.grad(points))

    expected = sum((f * s).sum() for f, s in zip(forward, seeds, strict=True))
    scale = sum(np.abs(f * s).sum() for f, s in zip(forward, seeds, strict=True))
    assert abs(backward @ direction - expected) < 20 * tolerance(float_type) * scale


@pytest.mark.core
def test_derivatives_equal_finite_differences(surface, float_type, np_rng):
    table = surface.sampling(3)
    direction = np_rng.normal(size=surface.cage.positions.shape)
    step = 1e-5
    ahead, behind = (table.apply(surface.cage.positions + side * step * direction) for side in (1, -1))

    found = forward_derivatives(VertexKernel(table, float_type), float_type, surface.cage.positions, direction)
    for derivative, a, b in zip(found, ahead, behind, strict=True):
        expected = (a - b) / (2 * step)
        # Central differences in float64: truncation of order step**2, rounding of order 1e-16 / step.
        np.testing.assert_allclose(derivative, expected, atol=1e-4 * np.abs(expected).max())


def test_collapsed_patches_have_zero_normals_and_finite_derivatives(float_type):
    cage = named_cages.cube()
    kernel, points = VertexKernel(LimitSurface(cage).sampling(2), float_type), dr.zeros(float_type, 24)
    dr.enable_grad(points)
    positions, normals = kernel(points)
    dr.backward(dr.sum(positions) + dr.sum(normals))
    assert np.all(np.array(normals) == 0)
    assert np.isfinite(np.array(dr.grad(points))).all()


@pytest.mark.parametrize("scale", [1e-12, 1e12])
def test_normals_do_not_depend_on_scale(surface, float_type, scale):
    kernel = VertexKernel(surface.sampling(3), float_type)
    normals = vectors(kernel(upload(float_type, surface.cage.positions))[1])
    scaled = vectors(kernel(upload(float_type, scale * surface.cage.positions))[1])
    np.testing.assert_allclose(scaled, normals, atol=50 * tolerance(float_type))


def test_wrong_number_of_control_points_is_an_error(float_type):
    kernel = VertexKernel(LimitSurface(named_cages.cube()).sampling(2), float_type)
    with pytest.raises(ValueError, match="21 coordinates; expected 24, x, y, z of 8 control points"):
        kernel(dr.zeros(float_type, 21))


def test_kernels_let_go_of_the_table(surface, float_type):
    """What they need is on the device."""
    # The collector looks at what is new only.
    gc.freeze()
    table = surface.sampling(3)
    kept = [table, *table.polynomials, *(part.patch for part in table.polynomials)]
    seen = [weakref.ref(found) for found in kept]
    kernel = VertexKernel(table, float_type)
    del table, kept
    gc.collect()
    gc.unfreeze()
    assert [found() for found in seen] == [None] * len(seen)
    dr.eval(kernel(upload(float_type, surface.cage.positions)))
