"""Derivatives of vertices and of what rays meet, by every parameter, against differences."""

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from mitsuba_subdivision import Attribute, LimitSurface, upload
from mitsuba_subdivision.cage import named_cages
from patches.closed_cages import cube_with_hexagon, extraordinary_triangles
from reference.refined_cages import refine_first, tagged
from shapes.cages import RING, bitmap, cube, described, load, with_attributes
from shapes.scenes import perspective, rays, scene_with
from shapes.updates import MODES, derivative, moving, update
from shapes.variants import every_ad_variant, exact, llvm

pytestmark = pytest.mark.usefixtures("no_other_scene")
# Over a step of control points: rounding over the step, and what values bend within it, beside the largest derivative.
STEP, DIFFERENCE = 1e-3, 1e-3
# Reverse and forward mode add the same terms in another order.
ORDER = 1e-5
COUNT, RATE = 64, 4
MATRIX = np.array([[1.2, 0.3, 0.0, 2.0], [0.0, 0.7, 0.2, -1.0], [0.1, 0.0, 1.5, 0.5], [0, 0, 0, 1]])
MIRRORED = np.diag([-1, 1, 1, 1]) @ MATRIX
HEIGHTS, SCALE = {"displacement": "vertex_weight", "displacement_scale": 0.15}, "displacement_scale"
SMOOTH = {"texcoords": cube().positions[:, :2] ** 2, "attributes": {"colour": cube().positions * [1, 2, 3]}}
CAGES = {
    "cube": lambda: with_attributes(cube()),
    "creased": lambda: with_attributes(cube(creases=RING)),
    "valence 3": lambda: with_attributes(named_cages.extraordinary(3)),
    "mixed": lambda: with_attributes(cube_with_hexagon()),
    "loop": lambda: with_attributes(extraordinary_triangles(5)),
    "doo_sabin": lambda: cube(**SMOOTH),
}
PLACED, VALUES = ("control_points", "to_world"), ("cage_texcoords", "cage_colour", "cage_weight", "cage_label")


@pytest.fixture
def cage(request, monkeypatch):
    if request.param == "refined":
        refine_first(monkeypatch)
    return CAGES["mixed" if request.param == "refined" else request.param]()


def options(cage):
    return (
        {"scheme": "loop"} if cage.face_sizes[0] == 3 else {"scheme": "doo_sabin"} if len(cage.attributes) == 1 else {}
    )


# What is differentiated together, and parameters of the shape. Of a bitmap, slopes jump along lines between the centres
# of its texels, and rays do not know that the lines move: where points stay on the surface, it does not matter.
IMAGE = np.random.default_rng(7).random((5, 8, 1))
EXACT = [
    ("cube", PLACED, {}),
    ("mixed", VALUES, {}),
    ("refined", VALUES, {}),
    ("loop", ("to_world",), {}),
    ("doo_sabin", ("control_points",), {}),
    ("cube", (*PLACED, *VALUES, SCALE), HEIGHTS),
    ("cube", (SCALE,), HEIGHTS),
    ("cube", ("cage_weight",), HEIGHTS),
    ("cube", ("displacement.data",), {**HEIGHTS, "displacement": "bitmap"}),
]
VERTEX = [("mixed", (*PLACED, *VALUES), {}), ("loop", ("control_points",), {}), ("cube", ("to_world",), {})]


@llvm
@pytest.mark.parametrize(
    ("shading", "cage", "by", "parameters"),
    [*(("vertex", *case) for case in VERTEX), *(pytest.param("exact", *case, marks=exact) for case in EXACT)],
    indirect=["cage"],
)
def test_derivatives_of_what_rays_meet_are_differences(cage, by, parameters, shading, np_rng):
    has_texels = "displacement.data" in by
    given = {**parameters, "displacement": bitmap(IMAGE)} if has_texels else parameters
    to_world = mi.ScalarTransform4f(MIRRORED)
    shape = described(cage, to_world=to_world, tessellation_rate=RATE, shading=shading, **options(cage), **given)
    scene, (linear, offset) = scene_with(shape=shape), (MIRRORED[:3, :3], MIRRORED[:3, 3])
    points = LimitSurface(cage, options(cage).get("scheme")).sample(COUNT, 1).p @ linear.T + offset
    middle = cage.positions.mean(axis=0) @ linear.T + offset
    ray = rays(3 * points - 2 * middle, middle - points + np_rng.normal(0, 0.05, points.shape))
    flags = mi.RayFlags.All | (mi.RayFlags.FollowShape if has_texels else 0)
    assign = moving(mi.traverse(scene), [f"shape.{name}" for name in by], np_rng)
    factors = np_rng.uniform(0.5, 1, 14).tolist()

    def met(step):
        """Of each ray, a sum of all that is asked of the surface, with other factors."""
        assign(step)
        si = scene.ray_intersect(ray, int(flags), coherent=True)
        values = [*si.p, *si.sh_frame.n, *si.uv, *si.shape.eval_attribute_3("vertex_colour", si)]
        values += [si.shape.eval_attribute_1(f"vertex_{name}", si) for name in cage.attributes if name != "colour"]
        value = sum(factor * value for factor, value in zip(factors, values, strict=False))
        dr.eval(value, si.is_valid(), si.prim_index)
        return value, np.array(si.is_valid()), np.array(si.prim_index)

    with dr.suspend_grad():
        ahead, behind = (met(mi.Float(sign * STEP)) for sign in (1, -1))
    difference = (np.array(ahead[0]) - np.array(behind[0])) / (2 * STEP)
    step, again = dr.opaque(mi.Float, 0), dr.opaque(mi.Float, 0)
    dr.enable_grad(step, again)
    value, valid, triangle = met(step)
    # Values of vertex shading have kinks between triangles.
    same = valid & (ahead[2] == triangle) & (behind[2] == triangle)
    assert same.mean() > 0.8
    signs = np.where(same, np_rng.choice([-1, 1], COUNT), 0)
    dr.backward(dr.sum(value * upload(mi.Float, signs)))
    value, *_ = met(again)
    dr.forward(again)
    forward = np.array(dr.grad(value))
    largest = np.abs(forward[same]).max()
    assert largest > 0.1
    assert dr.grad(step)[0] == pytest.approx(signs @ forward, abs=float(ORDER * np.abs(forward[same]).sum()))
    if not has_texels:
        np.testing.assert_allclose(forward[same], difference[same], rtol=0, atol=DIFFERENCE * largest)


# Of a step in double precision; and of numbers of a vertex in single precision, beside the largest.
SMALL, SINGLE = 1e-5, 1e-5


@pytest.mark.parametrize(
    ("cage", "matrix"),
    [
        *(("creased", matrix) for matrix in (np.eye(4), MIRRORED)),
        ("valence 3", MATRIX),
        *((name, None) for name in ("mixed", "refined", "loop")),
    ],
    indirect=["cage"],
)
@every_ad_variant
def test_derivatives_of_vertices_are_those_of_the_limit_surface(cage, matrix, np_rng):
    is_placed, start = matrix is not None, np.eye(4) if matrix is None else matrix
    values = {"texcoords": cage.texcoords, **cage.attributes}
    given = {"control_points": cage.positions, **{f"cage_{name}": a.values for name, a in values.items()}}
    changes = {name: np_rng.normal(size=value.shape) for name, value in given.items()}
    turn = is_placed * np_rng.normal(size=(4, 4)) * [[1], [1], [1], [0]]

    def exactly(step):
        moved = {name: value + step * changes[name] for name, value in given.items()}
        attributes = {n: Attribute(moved[f"cage_{n}"], a.interpolation, a.indices) for n, a in values.items()}
        tags = {"texcoords": attributes.pop("texcoords"), "creases": cage.tags.creases(cage.topology)}
        other = tagged(cage.with_positions(moved["control_points"]), attributes=attributes, **tags)
        at, matrix = LimitSurface(other, options(cage).get("scheme")).tessellate(RATE), start + step * turn
        n = at.normals @ np.linalg.inv(matrix[:3, :3])
        n /= np.linalg.norm(n, axis=1, keepdims=True)
        p = at.positions @ matrix[:3, :3].T + matrix[:3, 3]
        return {"positions": p, "normals": n, "texcoords": at.texcoords, **at.attributes}

    ahead, behind = exactly(SMALL), exactly(-SMALL)
    expected = {f"vertex_{name}": (ahead[name] - behind[name]).ravel() / (2 * SMALL) for name in ahead}
    shape = load(cage, tessellation_rate=RATE, to_world=mi.ScalarTransform4f(start), **options(cage))
    parameters, (step, again) = mi.traverse(shape), (dr.opaque(mi.Float, 0) for _ in range(2))
    dr.enable_grad(step, again)

    def assign(step):
        moved = {
            name: upload(mi.Float, value) + step * upload(mi.Float, changes[name]) for name, value in given.items()
        }
        if is_placed:
            matrix = mi.Matrix4f(start.tolist()) + step * mi.Matrix4f(turn.tolist())
            moved["to_world"] = mi.AffineTransform4f(matrix)
        update(parameters, moved)

    assign(step)
    dr.forward(step)
    for name, values in expected.items():
        tolerance = SINGLE * np.abs(values).max()
        np.testing.assert_allclose(dr.grad(parameters[name]), values, rtol=0, atol=tolerance, err_msg=name)
    assign(again)
    weights = {name: np_rng.normal(size=values.shape) for name, values in expected.items()}
    dr.backward(sum(dr.dot(parameters[name], upload(mi.Float, weight)) for name, weight in weights.items()))
    assert dr.grad(again)[0] == pytest.approx(
        sum(weights[name] @ expected[name] for name in expected), rel=SINGLE, abs=1e-3
    )


# Of derivatives by central differences of numbers in single precision.
DISPLACED_STEP, DISPLACED = 3e-3, 1e-3


@llvm
@pytest.mark.parametrize("by", ["displacement.data", "cage_weight"])
@pytest.mark.parametrize("cage", ["creased", "valence 3"], indirect=True)
def test_derivatives_of_displaced_vertices_are_central_differences(cage, by, np_rng):
    heights = {**HEIGHTS, "displacement": bitmap(IMAGE)} if by == "displacement.data" else HEIGHTS
    parameters = mi.traverse(load(cage, tessellation_rate=RATE, to_world=mi.ScalarTransform4f(MATRIX), **heights))
    size = dr.width(parameters["vertex_positions"])
    weights = [upload(mi.Float, np_rng.normal(size=size) / np.sqrt(size)) for _ in range(2)]
    assign = moving(parameters, [*PLACED, SCALE, by], np_rng)

    def loss():
        positions, normals = (parameters[f"vertex_{name}"] for name in ("positions", "normals"))
        return dr.dot(weights[0], positions) + dr.dot(weights[1], normals)

    backward, forward, difference = (derivative(mode, assign, loss, DISPLACED_STEP) for mode in MODES)
    assert backward == pytest.approx(difference, abs=DISPLACED)
    assert forward == pytest.approx(backward, abs=1e-2 * DISPLACED)


def shown(by):
    """A material that shows an attribute, or by texture coordinates a bitmap that is linear over the islands."""
    ramp = bitmap(np.array([[[0.1], [0.9]], [[0.4], [0.6]]]), wrap_mode="clamp")
    reflectance = ramp if by == "cage_texcoords" else {"type": "mesh_attribute", "name": by.replace("cage_", "vertex_")}
    return {"type": "diffuse", "reflectance": reflectance}


# Pictures are linear in what is differentiated, so that a difference over a wide step has no other error than rounding.
WIDE, LINEAR = 0.02, 1e-4


@every_ad_variant
@pytest.mark.parametrize(
    ("cage", "by", "shading"),
    [
        ("creased", "cage_label", "vertex"),
        pytest.param("mixed", "cage_texcoords", "exact", marks=exact),
        pytest.param("refined", "cage_colour", "exact", marks=exact),
    ],
    indirect=["cage"],
)
def test_derivatives_of_pictures_are_central_differences(cage, by, shading, np_rng):
    # Directions that a BSDF samples turn with the texture coordinates, and may meet the shape or not.
    seen = {"integrator": {"type": "direct", "bsdf_samples": 0}, "sky": {"type": "constant"}}
    seen["sensor"] = perspective(16, [2.5, -3, 2], fov=30)
    scene = scene_with(**seen, shape=described(cage, shading=shading, bsdf=shown(by), tessellation_rate=RATE))
    parameters, factors = mi.traverse(scene), upload(mi.TensorXf, np_rng.random((16, 16, 3)))
    assign = moving(parameters, f"shape.{by}", np_rng)

    def derivative_by(mode):
        # The samples of derivatives are those of the pictures that differ.
        seed = 2 if mode == "difference" else 1

        def loss():
            return dr.sum(mi.render(scene, parameters, spp=4, seed=seed, seed_grad=seed + 1) * factors, axis=None)

        return derivative(mode, assign, loss, WIDE)

    backward, forward, difference = map(derivative_by, MODES)
    assert abs(difference) > 100 * LINEAR
    assert backward == pytest.approx(difference, abs=LINEAR * max(1, abs(difference)))
    assert forward == pytest.approx(backward, abs=0.1 * LINEAR * max(1, abs(difference)))
