"""Normals of surfaces that are folded or collapse to curves and points are unit or exactly zero, by every method."""

import drjit as dr
import numpy as np
import pytest
from drjit.llvm.ad import Float
from evaluation.common import evaluate_from
from mitsuba_subdivision import ControlCage, LimitSurface
from mitsuba_subdivision.cage.named_cages import cube
from mitsuba_subdivision.evaluation.equations import AT_EXTRAORDINARY_POINT
from mitsuba_subdivision.kernels.vertex_kernel import VertexKernel
from patches.closed_cages import cube_with_valence_2
from reference.exact_samples import angle, bumpy
from reference.refined_cages import refine_first, tagged

INFINITE = float("inf")
RATE = 4
# Rounding of a unit vector in single precision; what it leaves of a direction where the tangents are a tenth of the
# cage's distance from the origin; and both in double precision.
SINGLE = 1e-6
SINGLE_DIRECTION = 1e-5
SINGLE_PATHS = ("single samples", "kernel")
DOUBLE = 1e-12
EVERY_SIZE = pytest.mark.parametrize("size", [3, 4, 5])
# Flat, and bent so that the rim lies in no plane.
EVERY_BEND = pytest.mark.parametrize("bend", [0.0, 0.3])
# Not parallel to any axis, away from the origin.
TURN = np.linalg.qr(np.random.default_rng(3).standard_normal((3, 3)))[0]
SHIFT = np.array([3.0, 1.0, 5.0])


def rim_points(size, bend):
    turn = 2 * np.pi * np.arange(size) / size
    return np.stack([np.cos(turn), 0.9 * np.sin(turn), bend * np.cos(2 * turn + 0.3)], axis=1)


def pillow(size, bend=0.0, **tags):
    """Two polygons glued back to back."""
    return placed(rim_points(size, bend), [range(size), range(size)[::-1]], **tags)


def lens(size, bend=0.0, **tags):
    """Two fans of triangles glued back to back, whose middles coincide."""
    points = np.concatenate([rim_points(size, bend), [[0.05, 0.02, 0.1 * bend]] * 2])
    rim = [(i, (i + 1) % size) for i in range(size)]
    return placed(points, [(a, b, size) for a, b in rim] + [(b, a, size + 1) for a, b in rim], **tags)


def placed(points, faces, **tags):
    return ControlCage(points @ TURN.T + SHIFT, faces, **tags)


def rim(size, sharpness):
    return [(i, (i + 1) % size, sharpness) for i in range(size)]


def normals_on_every_path(cage, scheme="catmull_clark", rate=RATE):
    """Normals at the vertices of a tessellation, by name of the path; and the table of these."""
    surface = LimitSurface(cage, scheme)
    table = surface.sampling(rate)
    start, uv = table.locations()
    _, kernel = VertexKernel(table, Float)(Float(cage.positions.ravel().astype(np.float32)))
    return {
        "table": table.apply(cage.positions)[1],
        "samples": surface._sampler.evaluate(start, uv).n,
        "single samples": surface._sampler.evaluate(start, uv, dtype=np.float32).n,
        "kernel": kernel.numpy().reshape(-1, 3),
    }, table


def assert_unit_or_zero_alike(normals):
    """Each unit or exactly zero, the same ones on each path, and otherwise equal."""
    zero = (normals["table"] == 0).all(axis=1)
    for path, of_path in normals.items():
        np.testing.assert_array_equal((of_path == 0).all(axis=1), zero, err_msg=path)
        length, direction = (SINGLE, SINGLE_DIRECTION) if path in SINGLE_PATHS else (DOUBLE, DOUBLE)
        assert np.abs(np.linalg.norm(of_path[~zero], axis=1) - 1).max(initial=0) < length
        assert np.abs(of_path - normals["table"]).max() < direction
    return zero


def is_on_rim(table):
    """Vertices of the tessellation that elements of both sides share."""
    top = table.element < (table.element.max() + 1) // 2
    vertices = np.arange(table.vertex_count)
    return np.isin(vertices, table.triangles[top]) & np.isin(vertices, table.triangles[~top])


@EVERY_SIZE
@EVERY_BEND
@pytest.mark.parametrize("sharpness", [0, 1.5])
def test_two_polygons_back_to_back_have_no_normal_at_the_fold(size, bend, sharpness):
    normals, table = normals_on_every_path(pillow(size, bend, creases=rim(size, sharpness)))
    zero = assert_unit_or_zero_alike(normals)
    assert zero[is_on_rim(table)].all()
    # A refined triangle's rim runs twice around, and its surface turns over within, unless it is held at first.
    assert (size == 3 and not sharpness) or not zero[~is_on_rim(table)].any()


@EVERY_SIZE
@EVERY_BEND
@pytest.mark.parametrize("scheme", ["catmull_clark", "loop", "doo_sabin"])
def test_a_doubled_fan_has_no_normal_at_the_fold_and_is_plane_within(size, bend, scheme):
    normals, table = normals_on_every_path(lens(size, bend), scheme)
    zero = assert_unit_or_zero_alike(normals)
    if scheme == "doo_sabin":
        assert zero.sum() == RATE * size
    else:
        np.testing.assert_array_equal(zero, is_on_rim(table))
    if bend == 0:
        assert np.abs(np.abs(normals["table"][~zero] @ TURN[:, 2]) - 1).max() < DOUBLE


@EVERY_SIZE
@pytest.mark.parametrize("make", [pillow, lens])
def test_each_side_of_a_sharp_rim_has_its_normal(size, make):
    normals, _ = normals_on_every_path(make(size, creases=rim(size, INFINITE)))
    assert not assert_unit_or_zero_alike(normals).any()
    heights = normals["table"] @ TURN[:, 2]
    assert np.abs(np.abs(heights) - 1).max() < DOUBLE
    # As many vertices see the one side as the other.
    assert (heights > 0).sum() == (heights < 0).sum()


@EVERY_SIZE
@EVERY_BEND
def test_lone_sharp_edges_on_a_fold_have_normals_except_at_their_ends(size, bend):
    cage = pillow(size, bend, creases=[(0, 1, INFINITE)])
    assert_unit_or_zero_alike(normals_on_every_path(cage)[0])
    # Face 0 begins with the edge; a quadrilateral's is one piece, another polygon's first half begins at corner 0.
    top = LimitSurface(cage).evaluate(0, [[0.0, 0.0], [0.3, 0.0], [0.3, 0.2], [0.0, 0.2]])
    lengths = np.linalg.norm(top.n, axis=1)
    np.testing.assert_array_equal(lengths == 0, [True, False, False, True])
    np.testing.assert_allclose(lengths[1:3], 1, atol=DOUBLE)
    assert top.level[0] == AT_EXTRAORDINARY_POINT
    for sharpness in (0.5, INFINITE):
        cage = pillow(size, bend, corners=[(0, sharpness)])
        assert_unit_or_zero_alike(normals_on_every_path(cage)[0])
        assert (LimitSurface(cage).evaluate([0, 1], [[0.0, 0.0]], [0, size - 1]).n == 0).all()


@pytest.mark.parametrize("scheme", ["catmull_clark", "loop", "doo_sabin"])
def test_cages_without_area_have_no_normals(scheme):
    for along in (np.zeros(7), np.linspace(-1, 1, 7) ** 3):
        cage = lens(5).with_positions(SHIFT / 3 + along[:, None] * TURN[0])
        assert assert_unit_or_zero_alike(normals_on_every_path(cage, scheme)[0]).all()


@pytest.mark.parametrize("make", [pillow, lens])
def test_folds_of_a_refined_cage_have_no_normal(make, monkeypatch):
    cage = make(6, 0.3)
    refine_first(monkeypatch)
    normals, table = normals_on_every_path(cage)
    assert table.patches.refined is not None
    np.testing.assert_array_equal(assert_unit_or_zero_alike(normals), is_on_rim(table))
    for distance in (0, 1):
        points = np.outer(1 / 3 + distance * np.arange(cage.vertex_count), SHIFT)
        normals, _ = normals_on_every_path(cage.with_positions(points))
        assert assert_unit_or_zero_alike(normals).all()


def test_the_end_of_a_sharp_edge_in_a_vertex_of_two_faces_has_no_normal():
    """One direction turns over at every refinement, and so does the normal."""
    cage = bumpy(cube_with_valence_2(), 1)
    t, around = cage.topology, np.flatnonzero(cage.face_vertices == 8)
    surface = LimitSurface(tagged(cage, creases=[(8, t.face_vertices[t.next[around[0]]], INFINITE)]))
    assert (evaluate_from(surface, around, [[0.0, 0.0]]).n == 0).all()
    first, second, third = evaluate_from(surface, around[:1], np.ldexp([[1.5, 1.2]], [[-200], [-201], [-202]])).n
    assert first @ second < -0.99
    assert first @ third > 0.99


@pytest.mark.parametrize("thickness", [1e-1, 1e-3, 1e-5, 1e-7])
def test_thin_cages_have_their_normals(thickness):
    """Tangents of very different lengths are exact along axes, and with digits enough along others."""
    scaling = np.array([1, thickness, 1])
    for cage in (bumpy(cube(), 2), tagged(bumpy(cube(), 2), creases=[(0, 1, INFINITE)])):
        expected = LimitSurface(cage).tessellate(RATE).normals / scaling
        expected /= np.linalg.norm(expected, axis=1, keepdims=True)
        normals, _ = normals_on_every_path(cage.with_positions(cage.positions * scaling))
        assert not assert_unit_or_zero_alike(normals).any()
        assert angle(normals["table"], expected).max() < 1e-9
    turned = cage.with_positions((cage.positions * scaling) @ TURN.T)
    assert angle(LimitSurface(turned).tessellate(RATE).normals, expected @ TURN.T).max() < 1e-13 / thickness


@pytest.mark.parametrize("size", [1e-12, 1e12])
def test_results_do_not_depend_on_the_size_of_a_cage(size):
    for cage in (pillow(5, 0.3), bumpy(cube(), 2)):
        normals, _ = normals_on_every_path(cage)
        scaled, _ = normals_on_every_path(cage.with_positions(size * cage.positions))
        for path, of_path in normals.items():
            np.testing.assert_array_equal((of_path == 0).all(axis=1), (scaled[path] == 0).all(axis=1), err_msg=path)
            assert np.abs(of_path - scaled[path]).max() < (SINGLE_DIRECTION if path in SINGLE_PATHS else DOUBLE)


@pytest.mark.parametrize("make", [pillow, lens])
def test_gradients_are_finite_and_zero_where_there_is_no_normal(make):
    cage = make(5, 0.3)
    table = LimitSurface(cage).sampling(RATE)
    points = Float(cage.positions.ravel().astype(np.float32))
    zero = (VertexKernel(table, Float)(points)[1].numpy().reshape(-1, 3) == 0).all(axis=1)
    assert zero.any()
    for wanted, is_nothing in ((zero, True), (~zero, False)):
        dr.enable_grad(points)
        dr.set_grad(points, 0)
        _, normals = VertexKernel(table, Float)(points)
        dr.backward(dr.sum(normals * Float(np.repeat(wanted, 3).astype(np.float32) * np.arange(1, 1 + 3 * len(zero)))))
        gradient = dr.grad(points).numpy()
        assert np.isfinite(gradient).all()
        assert (np.abs(gradient).max() == 0) == is_nothing
    dr.set_grad(points, 1)
    _, normals = VertexKernel(table, Float)(points)
    dr.forward_to(normals)
    change = dr.grad(normals).numpy().reshape(-1, 3)
    assert np.isfinite(change).all()
    assert (change[zero] == 0).all()


def test_curvature_is_not_a_number_where_there_is_no_normal():
    samples = LimitSurface(pillow(4)).evaluate(0, [[0.25, 0.0], [0.25, 0.5]], derivatives=2)
    for curvature in (samples.gaussian_curvature, samples.mean_curvature):
        np.testing.assert_array_equal(np.isnan(curvature), [True, False])
