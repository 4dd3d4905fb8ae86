"""Where the shape lies: object space, ``to_world`` as a parameter, and places far from the origin."""

import re

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from mitsuba_subdivision import ControlCage, LimitSurface
from mitsuba_subdivision.cage import named_cages
from mitsuba_subdivision.cage.attributes import Attribute
from mitsuba_subdivision.device_arrays import upload

SINGLE = 2e-6
# Degrees between exact normals and those of float32 sums, wherever the shape is; 3e-5 are measured.
NORMAL_ERROR = 1e-4
RATE = 4


def make(cage, **parameters):
    return mi.load_dict({"type": "subdivision", **cage.as_properties(mi), "tessellation_rate": RATE, **parameters})


def buffer(shape, name):
    return np.array(mi.traverse(shape)[name], dtype=np.float64).reshape(-1, 3)


def largest_angle(normals, expected):
    normals = normals / np.linalg.norm(normals, axis=1, keepdims=True)
    return np.degrees(2 * np.arcsin(np.linalg.norm(normals - expected, axis=1).max() / 2))


def seamed():
    """A cube with a crease ring, and an island of texture coordinates for each face."""
    cube = named_cages.cube()
    islands = np.tile([[0.0, 0], [1, 0], [1, 1], [0, 1]], (6, 1))
    return ControlCage(
        cube.positions,
        cube.face_vertices.reshape(-1, 4),
        creases=[(0, 1, 10), (1, 3, 10), (3, 2, 10), (2, 0, 10)],
        texcoords=Attribute(islands, "face_varying", np.arange(24)),
    )


SHIFT = np.array([1e4, -3e3, 1e3]) + 1 / 3


def transformation(name):
    """Made when a variant is set."""
    return {
        "identity": mi.ScalarTransform4f(),
        "far": mi.ScalarTransform4f().translate(SHIFT.tolist()),
        "turned": mi.ScalarTransform4f().translate([3, 1, 2]).rotate([1, 2, 0], 40).scale([1, 2, 3]),
        "mirrored": mi.ScalarTransform4f().translate([0, 1, 0]).scale([-1, 2, 1]),
    }[name]


def placed(tessellation, transform):
    """Exact points and normals in the world."""
    matrix = np.array(transform.matrix, dtype=np.float64)
    normals = tessellation.normals @ np.linalg.inv(matrix[:3, :3])
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    return tessellation.positions @ matrix[:3, :3].T + matrix[:3, 3], normals


# Far from the origin


@pytest.mark.parametrize("how", ["to_world", "cage", "cage, and back"])
@pytest.mark.usefixtures("variants_all_rgb")
def test_a_far_place_costs_normals_nothing_and_points_no_more_than_a_ply_loses(tmp_path, how):
    cage = named_cages.extraordinary(5)
    tessellation = LimitSurface(cage).tessellate(RATE)
    there = mi.ScalarTransform4f().translate(SHIFT.tolist())
    back = mi.ScalarTransform4f().translate((-SHIFT).tolist())
    moved = cage.with_positions(cage.positions + SHIFT)
    shift = np.zeros(3) if how == "cage, and back" else SHIFT
    shape = {
        "to_world": lambda: make(cage, to_world=there),
        "cage": lambda: make(moved),
        "cage, and back": lambda: make(moved, to_world=back),
    }[how]()
    assert largest_angle(buffer(shape, "vertex_normals"), tessellation.normals) <= NORMAL_ERROR

    tessellation.save(tmp_path / "exact.ply")
    ply = mi.load_dict({"type": "ply", "filename": str(tmp_path / "exact.ply"), "to_world": there})
    lost = np.abs(buffer(ply, "vertex_positions") - tessellation.positions - SHIFT).max()
    # The place of the surface as a whole may be rounded as well.
    assert np.abs(buffer(shape, "vertex_positions") - tessellation.positions - shift).max() <= 2 * lost


@pytest.mark.usefixtures("variants_all_rgb")
def test_control_points_of_a_far_cage_keep_their_digits_where_they_stay():
    cage = named_cages.extraordinary(5)
    shape = make(cage.with_positions(cage.positions + SHIFT))
    normals = buffer(shape, "vertex_normals")
    parameters = mi.traverse(shape)
    given = np.array(parameters["control_points"])
    given[0] += 0.5
    parameters["control_points"] = upload(type(parameters["control_points"]), given)
    parameters.update()
    moved = cage.positions + SHIFT
    moved[0, 0] = given[0]
    expected = LimitSurface(cage.with_positions(moved)).tessellate(RATE)
    assert largest_angle(buffer(shape, "vertex_normals"), expected.normals) <= NORMAL_ERROR
    assert np.abs(buffer(shape, "vertex_normals") - normals).max() > 0.1
    given[0] = np.float32(cage.positions[0, 0] + SHIFT[0])
    parameters["control_points"] = upload(type(parameters["control_points"]), given)
    parameters.update()
    np.testing.assert_array_equal(buffer(shape, "vertex_normals"), normals)


@pytest.mark.core
@pytest.mark.parametrize("shading", ["vertex", "exact"])
@pytest.mark.parametrize("mode", ["backward", "forward"])
@pytest.mark.usefixtures("variant_llvm_ad_rgb")
def test_derivatives_by_control_points_are_the_same_far_away(shading, mode):
    """Coordinates that stay as they are loaded had none, so that no fit moved a far cage."""
    found = []
    for shift in (0, SHIFT):
        cage = named_cages.extraordinary(5)
        shape = make(cage.with_positions(cage.positions + shift), shading=shading)
        parameters = mi.traverse(shape)
        points = parameters["control_points"]
        dr.enable_grad(points)
        parameters.update()
        weights = dr.linspace(mi.Float, -1, 1, len(parameters["vertex_positions"]))
        if mode == "backward":
            dr.backward(dr.sum(parameters["vertex_positions"] * weights))
            found.append(np.array(dr.grad(points)))
        else:
            dr.set_grad(points, dr.linspace(mi.Float, -1, 1, len(points)))
            found.append(np.array(dr.forward_to(parameters["vertex_positions"])))
    assert np.abs(found[0]).max() > 0.1
    np.testing.assert_allclose(found[1], found[0], rtol=0, atol=10 * SINGLE * np.abs(found[0]).max())


# As a parameter


@pytest.mark.parametrize("name", ["far", "turned", "mirrored"])
@pytest.mark.parametrize("cage", [named_cages.extraordinary(3), seamed()], ids=["smooth", "seamed"])
@pytest.mark.usefixtures("variants_all_rgb")
def test_an_update_of_to_world_is_a_new_shape(monkeypatch, cage, name):
    shape = make(cage)
    parameters = mi.traverse(shape)
    parameters["to_world"] = transformation(name)
    with monkeypatch.context() as patched:
        # Weights are not made again.
        patched.setattr("mitsuba_subdivision.tessellation.uniform_table", None)
        parameters.update()
    expected = make(cage, to_world=transformation(name))
    for each in ("vertex_positions", "vertex_normals", "faces"):
        np.testing.assert_array_equal(buffer(shape, each), buffer(expected, each))
    positions, normals = placed(LimitSurface(cage).tessellate(RATE), transformation(name))
    # A unit in the last place of the largest coordinate.
    np.testing.assert_allclose(
        buffer(shape, "vertex_positions"), positions, rtol=0, atol=max(10 * SINGLE, 2**-10 * (name == "far"))
    )
    assert largest_angle(buffer(shape, "vertex_normals"), normals) <= NORMAL_ERROR
    assert dr.allclose(shape.bbox().max, expected.bbox().max)
    parameters["to_world"] = mi.ScalarTransform4f()
    parameters.update()
    for each in ("vertex_positions", "vertex_normals", "faces"):
        np.testing.assert_array_equal(buffer(shape, each), buffer(make(cage), each))


@pytest.mark.usefixtures("variants_all_rgb")
def test_the_middle_of_a_far_cage_is_turned_with_it():
    cage = named_cages.cube()
    cage, transform = cage.with_positions(cage.positions + SHIFT), transformation("turned")
    shape = make(cage, to_world=transform)
    p, n = placed(LimitSurface(cage).tessellate(RATE), transform)
    np.testing.assert_allclose(buffer(shape, "vertex_positions"), p, atol=SINGLE * np.abs(p).max())
    assert largest_angle(buffer(shape, "vertex_normals"), n) <= NORMAL_ERROR


@pytest.mark.parametrize("cage", [named_cages.extraordinary(3), seamed()], ids=["smooth", "seamed"])
@pytest.mark.usefixtures("variants_all_rgb")
def test_other_evaluators_are_placed_as_well(cage):
    options = {"evaluator": "stam", "sample_offset": 1e-3}
    shape, transform = make(cage, **options), transformation("mirrored")
    parameters = mi.traverse(shape)
    parameters["to_world"] = transform
    parameters.update()
    expected = make(cage, to_world=transform, **options)
    for each in ("vertex_positions", "vertex_normals", "faces"):
        np.testing.assert_array_equal(buffer(shape, each), buffer(expected, each))
    exact = LimitSurface(cage).tessellate(RATE, sample_offset=1e-3)
    positions, normals = placed(exact, transform)
    np.testing.assert_allclose(buffer(shape, "vertex_positions"), positions, atol=1e-3)
    # Away from extraordinary points, where Stam's form is right.
    assert np.median(np.linalg.norm(buffer(shape, "vertex_normals") - normals, axis=1)) <= 1e-5


@pytest.mark.usefixtures("variants_all_rgb")
def test_a_refused_update_leaves_faces_and_normals_in_step():
    shape = make(named_cages.cube())
    parameters = mi.traverse(shape)
    points = np.array(parameters["control_points"])
    parameters["control_points"] = upload(type(parameters["control_points"]), points * np.nan)
    parameters["to_world"] = transformation("mirrored")
    with pytest.raises(ValueError, match="finite"):
        parameters.update()
    parameters["control_points"] = upload(type(parameters["control_points"]), points)
    parameters.update()
    expected = make(named_cages.cube(), to_world=transformation("mirrored"))
    for each in ("vertex_positions", "vertex_normals", "faces"):
        np.testing.assert_array_equal(buffer(shape, each), buffer(expected, each))


@pytest.mark.usefixtures("variants_all_rgb")
def test_rays_meet_the_outside_after_a_reflection():
    shape = make(named_cages.cube())
    scene = mi.load_dict({"type": "scene", "shape": shape})
    parameters = mi.traverse(scene)
    for scale in ([-1, 1, 1], [-1, -1, 1], [1, 1, 1]):
        parameters["shape.to_world"] = mi.ScalarTransform4f().translate([0, 0, 7]).scale(scale)
        parameters.update()
        si = scene.ray_intersect(mi.Ray3f([0.1, 0.2, 20], [0, 0, -1]))
        assert dr.all(si.is_valid() & (si.n.z > 0.9) & (si.sh_frame.n.z > 0.9)), scale
        assert dr.allclose(si.p.z, 7.8, atol=0.1)


@pytest.mark.usefixtures("variants_all_rgb")
def test_control_points_are_in_object_space():
    cage = named_cages.cube()
    shape = make(cage, to_world=mi.ScalarTransform4f().translate([3, 0, 0]).scale(2))
    np.testing.assert_allclose(buffer(shape, "control_points"), cage.positions, atol=SINGLE)
    parameters = mi.traverse(shape)
    positions = buffer(shape, "vertex_positions")
    parameters["control_points"] = parameters["control_points"] * 2
    parameters.update()
    np.testing.assert_allclose(buffer(shape, "vertex_positions") - [3, 0, 0], 2 * (positions - [3, 0, 0]), atol=SINGLE)


@pytest.mark.usefixtures("variants_all_rgb")
def test_to_world_is_of_the_type_that_mitsubas_shapes_have():
    ours, theirs = mi.traverse(make(named_cages.cube())), mi.traverse(mi.load_dict({"type": "rectangle"}))
    assert type(ours["to_world"]) is type(theirs["to_world"])
    assert ours.flags("to_world") == theirs.flags("to_world")


@pytest.mark.parametrize(
    ("value", "message"),
    [
        (lambda: mi.ScalarTransform4f().scale([1, 0, 1]), "has the determinant 0.0; expected an invertible matrix"),
        (lambda: np.diag([np.inf, 1, 1, 1]), "has the determinant inf; expected an invertible matrix"),
        (lambda: 2 * np.eye(4), "has the last row (0.0, 0.0, 0.0, 2.0); expected (0, 0, 0, 1)"),
    ],
)
@pytest.mark.usefixtures("variants_all_rgb")
def test_an_impossible_to_world_is_an_error_and_changes_nothing(value, message):
    shape = make(named_cages.cube())
    before = buffer(shape, "vertex_positions")
    parameters = mi.traverse(shape)
    parameters["to_world"] = type(parameters["to_world"])(value())
    with pytest.raises(ValueError, match=re.escape(f'parameter "to_world" {message}')):
        parameters.update()
    np.testing.assert_array_equal(buffer(shape, "vertex_positions"), before)


@pytest.mark.parametrize("values", [[np.nan], [np.inf, -np.inf, np.nan, np.nan]])
@pytest.mark.usefixtures("variants_all_rgb")
def test_control_points_that_are_not_finite_are_an_error_and_change_nothing(values):
    shape = make(named_cages.cube())
    before = buffer(shape, "vertex_positions")
    parameters = mi.traverse(shape)
    given = np.array(parameters["control_points"])
    given[7 : 7 + len(values)] = values
    parameters["control_points"] = upload(type(parameters["control_points"]), given)
    count = {1: "1 such vertex", 4: "2 such vertices"}[len(values)]
    message = f'parameter "control_points": vertex 2 has the coordinates {tuple(given[6:9].tolist())}; expected finite'
    with pytest.raises(ValueError, match=rf"{re.escape(message)} numbers \({count} in all\)"):
        parameters.update()
    np.testing.assert_array_equal(buffer(shape, "vertex_positions"), before)


# Derivatives


@pytest.mark.usefixtures("no_other_scene")
@pytest.mark.parametrize("name", ["none", "identity", "turned", "mirrored"])
@pytest.mark.parametrize("cage", [named_cages.extraordinary(3), seamed()], ids=["smooth", "seamed"])
@pytest.mark.usefixtures("variants_all_ad_rgb")
def test_derivatives_by_to_world_and_control_points_are_differences(np_rng, cage, name):
    shape, transform = make(cage), transformation("identity" if name == "none" else name)
    parameters = mi.traverse(shape)
    points = np.array(parameters["control_points"])
    change, turn = np_rng.normal(size=points.shape), np_rng.normal(size=(4, 4)) * [[1], [1], [1], [0]]
    turn *= name != "none"
    tessellation = LimitSurface(cage).tessellate(RATE)
    weights = np_rng.normal(size=(2, *tessellation.positions.shape))

    def exact(step):
        moved = LimitSurface(cage.with_positions(cage.positions + step * change.reshape(-1, 3))).tessellate(RATE)
        matrix = np.array(transform.matrix, dtype=np.float64) + step * turn
        found = moved.positions @ matrix[:3, :3].T + matrix[:3, 3], moved.normals @ np.linalg.inv(matrix[:3, :3])
        return (weights * [found[0], found[1] / np.linalg.norm(found[1], axis=1, keepdims=True)]).sum()

    step = 1e-5
    expected = (exact(step) - exact(-step)) / (2 * step)

    def loss(parameter):
        parameters["control_points"] = upload(mi.Float, points) + parameter * upload(mi.Float, change)
        if name != "none":
            matrix = dr.detach(mi.AffineTransform4f(transform).matrix) + parameter * mi.Matrix4f(turn.tolist())
            parameters["to_world"] = mi.AffineTransform4f(matrix)
        parameters.update()
        names = ("vertex_positions", "vertex_normals")
        return sum(dr.dot(parameters[n], upload(mi.Float, w)) for n, w in zip(names, weights, strict=True))

    for derivative in ("forward", "backward"):
        # As a constant, Dr.Jit would widen it.
        parameter = dr.opaque(mi.Float, 0)
        dr.enable_grad(parameter)
        value = loss(parameter)
        if derivative == "forward":
            dr.forward(parameter)
            found = dr.grad(value)[0]
        else:
            dr.backward(value)
            found = dr.grad(parameter)[0]
        # Sums of some hundred terms of float32.
        assert found == pytest.approx(expected, rel=1e-4, abs=1e-3), derivative


@pytest.mark.usefixtures("variants_all_ad_rgb")
def test_gradients_by_to_world_alone():
    shape = make(named_cages.cube())
    parameters = mi.traverse(shape)
    shift = mi.Float(2)
    dr.enable_grad(shift)
    parameters["to_world"] = mi.AffineTransform4f().translate([shift, 0, 0])
    parameters.update()
    assert shape.parameters_grad_enabled()
    dr.backward(dr.sum(dr.unravel(mi.Point3f, mi.traverse(shape)["vertex_positions"]).x))
    assert dr.allclose(dr.grad(shift), shape.vertex_count())
