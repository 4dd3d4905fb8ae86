"""Where the shape lies: object space, ``to_world`` as a parameter, and places far from the origin."""

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from mitsuba_subdivision import LimitSurface, upload
from mitsuba_subdivision.cage import named_cages
from shapes.cages import ISLANDS, RING, cube, load
from shapes.scenes import SINGLE, buffer, down, scene_with, vertices
from shapes.updates import update
from shapes.variants import every_variant, llvm, shadings

# Degrees between exact normals and those of float32 sums, wherever the shape is; 3e-5 are measured.
NORMAL_ERROR = 1e-4
RATE = 4
# With a ring of creases, and an island of texture coordinates for each face.
SEAMED = cube(creases=RING, texcoords=ISLANDS)
cages = pytest.mark.parametrize("cage", [named_cages.extraordinary(3), SEAMED], ids=["smooth", "seamed"])


def make(cage, **parameters):
    return load(cage, tessellation_rate=RATE, **parameters)


def assert_alike(shape, expected):
    for name in ("vertex_positions", "vertex_normals", "faces"):
        np.testing.assert_array_equal(buffer(shape, name), buffer(expected, name))


def largest_angle(normals, expected):
    normals = np.asarray(normals, dtype=np.float64)
    normals = normals / np.linalg.norm(normals, axis=1, keepdims=True)
    return np.degrees(2 * np.arcsin(np.linalg.norm(normals - expected, axis=1).max() / 2))


SHIFT = np.array([1e4, -3e3, 1e3]) + 1 / 3


def transformation(name):
    """Made when a variant is set."""
    turned = mi.ScalarTransform4f().translate([3, 1, 2]).rotate([1, 2, 0], 40)
    return {
        "identity": mi.ScalarTransform4f(),
        "far": mi.ScalarTransform4f().translate(SHIFT.tolist()),
        "turned": turned.scale([1, 2, 3]),
        "mirrored": turned.scale([-1, 2, 3]),
    }[name]


def matrix_of(transform):
    return np.array(transform.matrix, dtype=np.float64)


def placed(cage, matrix, **options):
    """Exact points and normals in the world."""
    tessellation = LimitSurface(cage).tessellate(RATE, **options)
    matrix = matrix if isinstance(matrix, np.ndarray) else matrix_of(matrix)
    normals = tessellation.normals @ np.linalg.inv(matrix[:3, :3])
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    return tessellation.positions @ matrix[:3, :3].T + matrix[:3, 3], normals


@pytest.mark.parametrize("how", ["to_world", "cage", "cage, and back", "cage, turned"])
@every_variant
def test_a_far_place_costs_normals_nothing_and_points_no_more_than_a_ply_loses(tmp_path, how):
    cage = named_cages.extraordinary(5)
    there, back = (mi.ScalarTransform4f().translate((sign * SHIFT).tolist()) for sign in (1, -1))
    moved = cage.with_positions(cage.positions + SHIFT)
    given, to_world = {
        "to_world": (cage, there),
        "cage": (moved, mi.ScalarTransform4f()),
        "cage, and back": (moved, back),
        "cage, turned": (moved, transformation("turned")),
    }[how]
    (p, n), (positions, normals) = vertices(make(given, to_world=to_world)), placed(given, to_world)
    assert largest_angle(n, normals) <= NORMAL_ERROR
    tessellation = LimitSurface(cage).tessellate(RATE)
    tessellation.save(tmp_path / "exact.ply")
    ply = mi.load_dict({"type": "ply", "filename": str(tmp_path / "exact.ply"), "to_world": there})
    lost = np.abs(buffer(ply, "vertex_positions").astype(np.float64) - tessellation.positions - SHIFT).max()
    # The place of the surface as a whole may be rounded as well. Turned, it is larger.
    lost *= np.linalg.norm(matrix_of(to_world)[:3, :3], 2)
    assert np.abs(p.astype(np.float64) - positions).max() <= 2 * lost


@every_variant
def test_control_points_of_a_far_cage_keep_their_digits_where_they_stay():
    cage = named_cages.extraordinary(5)
    shape = make(cage.with_positions(cage.positions + SHIFT))
    normals, parameters = buffer(shape, "vertex_normals"), mi.traverse(shape)
    kind, given = type(parameters["control_points"]), np.array(parameters["control_points"])
    given[0] += 0.5
    update(parameters, control_points=upload(kind, given))
    moved = cage.positions + SHIFT
    moved[0, 0] = given[0]
    expected = LimitSurface(cage.with_positions(moved)).tessellate(RATE)
    assert largest_angle(buffer(shape, "vertex_normals"), expected.normals) <= NORMAL_ERROR
    assert np.abs(buffer(shape, "vertex_normals") - normals).max() > 0.1
    given[0] = np.float32(cage.positions[0, 0] + SHIFT[0])
    update(parameters, control_points=upload(kind, given))
    np.testing.assert_array_equal(buffer(shape, "vertex_normals"), normals)


@pytest.mark.core
@shadings
@pytest.mark.parametrize("mode", ["backward", "forward"])
@llvm
def test_derivatives_by_control_points_are_the_same_far_away(shading, mode):
    """Coordinates that stay as they are loaded had none, so that no fit moved a far cage."""
    derivatives, cage = [], named_cages.extraordinary(5)
    for shift in (0, SHIFT):
        parameters = mi.traverse(make(cage.with_positions(cage.positions + shift), shading=shading))
        points = parameters["control_points"]
        dr.enable_grad(points)
        parameters.update()
        weights = dr.linspace(mi.Float, -1, 1, len(parameters["vertex_positions"]))
        if mode == "backward":
            dr.backward(dr.sum(parameters["vertex_positions"] * weights))
            derivatives.append(np.array(dr.grad(points)))
        else:
            dr.set_grad(points, dr.linspace(mi.Float, -1, 1, len(points)))
            derivatives.append(np.array(dr.forward_to(parameters["vertex_positions"])))
    assert np.abs(derivatives[0]).max() > 0.1
    np.testing.assert_allclose(derivatives[1], derivatives[0], rtol=0, atol=10 * SINGLE * np.abs(derivatives[0]).max())


@cages
@every_variant
def test_other_evaluators_are_placed_as_well(cage):
    options, to_world = {"evaluator": "stam", "sample_offset": 1e-3}, transformation("mirrored")
    shape = make(cage, **options)
    update(shape, to_world=to_world)
    assert_alike(shape, make(cage, to_world=to_world, **options))
    positions, normals = placed(cage, to_world, sample_offset=1e-3)
    p, n = vertices(shape)
    np.testing.assert_allclose(p, positions, atol=1e-3)
    # Away from extraordinary points, where Stam's form is right.
    assert np.median(np.linalg.norm(n - normals, axis=1)) <= 1e-5


@every_variant
def test_a_refused_update_leaves_faces_and_normals_in_step():
    shape, to_world = make(cube()), transformation("mirrored")
    parameters = mi.traverse(shape)
    kind, points = type(parameters["control_points"]), np.array(parameters["control_points"])
    with pytest.raises(ValueError, match="finite"):
        update(parameters, control_points=upload(kind, points * np.nan), to_world=to_world)
    update(parameters, control_points=upload(kind, points))
    assert_alike(shape, make(cube(), to_world=to_world))


@every_variant
def test_rays_meet_the_outside_after_a_reflection():
    scene = scene_with(shape=make(cube()))
    parameters = mi.traverse(scene)
    for scale in ([-1, 1, 1], [-1, -1, 1], [1, 1, 1]):
        update(parameters, {"shape.to_world": mi.ScalarTransform4f().translate([0, 0, 7]).scale(scale)})
        si = scene.ray_intersect(down(z=20))
        assert dr.all(si.is_valid() & (si.n.z > 0.9) & (si.sh_frame.n.z > 0.9)), scale
        assert dr.allclose(si.p.z, 7.8, atol=0.1)


@every_variant
def test_control_points_are_in_object_space_and_to_world_is_of_the_type_that_mitsubas_shapes_have():
    shape = make(cube(), to_world=mi.ScalarTransform4f().translate([3, 0, 0]).scale(2))
    np.testing.assert_allclose(buffer(shape, "control_points"), cube().positions, atol=SINGLE)
    before = buffer(shape, "vertex_positions") - [3, 0, 0]
    shown, expected = mi.traverse(shape), mi.traverse(mi.load_dict({"type": "rectangle"}))
    assert type(shown["to_world"]) is type(expected["to_world"])
    assert shown.flags("to_world") == expected.flags("to_world")
    update(shown, control_points=shown["control_points"] * 2)
    np.testing.assert_allclose(buffer(shape, "vertex_positions") - [3, 0, 0], 2 * before, atol=SINGLE)
