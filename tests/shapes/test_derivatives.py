import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from mitsuba_subdivision import CageWarning, LimitSurface, joined_cage, upload
from patches.closed_cages import cube_with_hexagon, extraordinary_triangles
from reference.refined_cages import refine_first
from shapes.cages import MIRRORED, RING, SHEARED, bitmap, cube, described, load, with_attributes
from shapes.scenes import down, perspective, rays, scene_with
from shapes.updates import MODES, derivative, differentiated, moving
from shapes.variants import every_ad_variant, exact, exact_llvm, llvm

pytestmark = pytest.mark.usefixtures("no_other_scene")
# Over a step of control points: rounding over the step, and what values bend within it, beside the largest derivative.
STEP, DIFFERENCE = 1e-3, 1e-3
# Tangents bend more, and a few rays meet what differences do not follow: tangents beside extraordinary points (a 64th
# of each element there), grazed places, and folds of texture coordinates. Beside a derivative and the median of all.
TANGENTS, MOST_OTHERS = 1e-2, 0.08
# Reverse and forward mode add the same terms in another order.
ORDER = 1e-5
COUNT, RATE = 64, 4
HEIGHTS, SCALE = {"displacement": "vertex_weight", "displacement_scale": 0.15}, "displacement_scale"
X, Y, Z = cube().positions.T
TEXCOORDS = np.stack([0.3 * X + 0.11 * Z, 0.3 * Y + 0.23 * Z], axis=1)
SMOOTH = {"colour": cube().positions * [1, 2, 3], "weight": (0.2 + 0.1 * X * Y - 0.05 * Z)[:, None]}
CAGES = {
    "cube": lambda: with_attributes(cube()),
    "creased": lambda: with_attributes(cube(creases=RING)),
    "mixed": lambda: with_attributes(cube_with_hexagon()),
    "refined": lambda: with_attributes(cube_with_hexagon()),
    "loop": lambda: with_attributes(extraordinary_triangles(7)),
    "doo_sabin": lambda: cube(texcoords=TEXCOORDS, attributes=SMOOTH),
}
PLACED, VALUES = ("control_points", "to_world"), ("cage_texcoords", "cage_colour", "cage_weight", "cage_label")


@pytest.fixture
def named(request, monkeypatch):
    if request.param == "refined":
        refine_first(monkeypatch)
    return CAGES[request.param](), request.param if request.param in ("loop", "doo_sabin") else "catmull_clark"


# What is differentiated together, and parameters of the shape. Of a bitmap, slopes jump along lines between the centres
# of its texels, and rays do not know that the lines move: where points stay on the surface, it does not matter.
IMAGE = np.random.default_rng(7).random((5, 8, 1))
VERTEX = [("cube", (*PLACED, *VALUES), {}), ("loop", ("to_world",), {})]
EXACT = [
    VERTEX[0],
    ("refined", VALUES, {}),
    ("cube", ("displacement.data",), {**HEIGHTS, "displacement": "bitmap"}),
]
# The same parameters alone, or for another scheme.
REPEATED = [
    VERTEX[1],
    *(("cube", (name,), HEIGHTS) for name in (SCALE, "cage_weight")),
    *((scheme, (*PLACED, "cage_texcoords"), {}) for scheme in ("loop", "doo_sabin")),
    ("loop", (*PLACED, *VALUES, SCALE), HEIGHTS),
    ("doo_sabin", ("control_points", SCALE), HEIGHTS),
]


@llvm
@pytest.mark.parametrize(
    ("shading", "named", "by", "parameters"),
    [
        *(("vertex", *case) for case in VERTEX),
        *(pytest.param("exact", *case, marks=exact) for case in EXACT),
        *(pytest.param("exact", *case, marks=[exact, pytest.mark.long]) for case in REPEATED),
    ],
    indirect=["named"],
)
def test_derivatives_of_hits_are_differences(named, by, parameters, shading, np_rng):
    (cage, scheme), has_texels = named, "displacement.data" in by
    given = {**parameters, "displacement": bitmap(IMAGE)} if has_texels else parameters
    to_world = mi.ScalarTransform4f(MIRRORED)
    shape = described(cage, to_world=to_world, tessellation_rate=RATE, shading=shading, scheme=scheme, **given)
    scene, (linear, offset) = scene_with(shape=shape), (MIRRORED[:3, :3], MIRRORED[:3, 3])
    points = LimitSurface(cage, scheme).sample(COUNT, 1).p @ linear.T + offset
    middle = cage.positions.mean(axis=0) @ linear.T + offset
    ray = rays(3 * points - 2 * middle, middle - points + np_rng.normal(0, 0.05, points.shape))
    flags = mi.RayFlags.All | mi.RayFlags.dNSdUV | (mi.RayFlags.FollowShape if has_texels else 0)
    assign = moving(mi.traverse(scene), [f"shape.{name}" for name in by], np_rng)
    factors = np_rng.uniform(0.5, 1, 14).tolist()
    tangents = ["t", "n", "dp_du", "dp_dv"] if shading == "exact" else []
    # Of displaced surfaces, those of normals are differences themselves, and have no derivatives.
    tangents += ["dn_du", "dn_dv"] if tangents and not parameters else []

    def met(step):
        """Of each ray, a sum of values of the surface with other factors, and its tangents."""
        assign(step)
        si = scene.ray_intersect(ray, int(flags), coherent=True)
        values = [*si.p, *si.sh_frame.n, *si.uv, *si.shape.eval_attribute("vertex_colour", si)]
        values += [si.shape.eval_attribute_1(f"vertex_{name}", si) for name in cage.attributes if name != "colour"]
        value = sum(factor * value for factor, value in zip(factors, values, strict=False))
        # Dr.Jit clears the derivatives of what others are computed from.
        others = {name: dr.ravel(1 * getattr(si, name)) for name in tangents}
        dr.eval(value, others, si.is_valid(), si.prim_index)
        return value, others, np.array(si.is_valid()), np.array(si.prim_index)

    def difference(ahead, behind):
        return (np.array(ahead) - np.array(behind)) / (2 * STEP)

    with dr.suspend_grad():
        ahead, behind = (met(mi.Float(sign * STEP)) for sign in (1, -1))
    step, again = dr.opaque(mi.Float, 0), dr.opaque(mi.Float, 0)
    dr.enable_grad(step, again)
    value, _, valid, triangle = met(step)
    # Values of vertex shading have kinks between triangles.
    same = valid & (ahead[-1] == triangle) & (behind[-1] == triangle)
    assert same.mean() > 0.75
    signs = np.where(same, np_rng.choice([-1, 1], COUNT), 0)
    dr.backward(dr.sum(value * upload(mi.Float, signs)))
    value, others, *_ = met(again)
    dr.forward(again)
    forward = np.array(dr.grad(value))
    largest = np.abs(forward[same]).max()
    assert largest > 0.1
    assert dr.grad(step)[0] == pytest.approx(signs @ forward, abs=float(ORDER * np.abs(forward[same]).sum()))
    if has_texels:
        return
    expected = difference(ahead[0], behind[0])
    np.testing.assert_allclose(forward[same], expected[same], rtol=0, atol=DIFFERENCE * largest)
    for name in tangents:
        both = dr.grad(others[name]), difference(ahead[1][name], behind[1][name])
        forward, expected = (np.array(values).reshape(COUNT, -1)[same] for values in both)
        error, size = (np.abs(values).max(axis=1) for values in (forward - expected, expected))
        assert np.mean(error > TANGENTS * (size + (np.median(size) or 1))) <= MOST_OTHERS, name


# Step and relative error of central differences of sums over vertices in single precision.
VERTEX_STEP, VERTEX_DIFFERENCE = 3e-3, 1e-3


@every_ad_variant
@pytest.mark.parametrize(
    ("named", "by", "displacement"),
    [
        *((name, (*PLACED, *VALUES), None) for name in ("creased", "refined", "loop")),
        ("creased", (*PLACED, SCALE, "cage_weight"), "vertex_weight"),
        ("creased", (*PLACED, SCALE, "displacement.data"), "bitmap"),
    ],
    indirect=["named"],
)
@pytest.mark.parametrize("matrix", [SHEARED, MIRRORED], ids=["sheared", "mirrored"])
def test_derivatives_of_vertices_are_central_differences(named, by, displacement, matrix, np_rng):
    """Those of points and normals alone are in tests/gradients/test_vertices.py, in double precision."""
    (cage, scheme), heights = named, {}
    if displacement:
        heights = {**HEIGHTS, "displacement": bitmap(IMAGE) if displacement == "bitmap" else displacement}
    parameters = mi.traverse(load(cage, scheme=scheme, to_world=mi.ScalarTransform4f(matrix), **heights))
    buffers = [f"vertex_{name}" for name in ("positions", "normals", "texcoords", *cage.attributes)]
    sizes = {name: dr.width(parameters[name]) for name in buffers}
    weights = {name: upload(mi.Float, np_rng.normal(size=size) / np.sqrt(size)) for name, size in sizes.items()}
    assign = moving(parameters, by, np_rng)

    def loss():
        return sum(dr.dot(weights[name], parameters[name]) for name in buffers)

    backward, forward, difference = (derivative(mode, assign, loss, VERTEX_STEP) for mode in MODES)
    assert abs(difference) > 100 * VERTEX_DIFFERENCE
    assert backward == pytest.approx(difference, abs=VERTEX_DIFFERENCE)
    assert forward == pytest.approx(backward, abs=1e-2 * VERTEX_DIFFERENCE)


@exact_llvm
def test_derivatives_enabled_after_the_last_update_warn_once():
    scene = scene_with(shape=described(cube(), shading="exact"))
    dr.enable_grad(mi.traverse(scene)["shape.control_points"])
    with pytest.warns(CageWarning, match=r"expected params\.update\(\)"):
        scene.ray_intersect(down())
    scene.ray_intersect(down())


@exact_llvm
def test_a_joined_cage_has_the_picture_and_the_gradients_of_its_cages():
    cages = [
        cage.with_positions(cage.positions + offset) for cage, offset in ((cube(), -1.2), (cube(creases=RING), 1.2))
    ]
    pictures, gradients = [], []
    for parts in (cages, [joined_cage(cages)]):
        shapes = {f"shape_{number}": described(part, shading="exact") for number, part in enumerate(parts)}
        sensor = perspective(32, (6, -9, 7), fov=30)
        scene = scene_with(**shapes, sensor=sensor, light={"type": "constant"}, integrator={"type": "prb"})
        parameters = mi.traverse(scene)
        points = [differentiated(parameters, f"{name}.control_points") for name in shapes]
        picture = mi.render(scene, parameters, spp=4, seed=1)
        dr.backward(dr.mean(dr.square(picture), axis=None))
        pictures.append(picture.numpy())
        gradients.append(np.concatenate([np.array(dr.grad(values)) for values in points]))
    assert pictures[0].std() > 0.1
    np.testing.assert_allclose(*pictures, rtol=0, atol=ORDER)
    np.testing.assert_allclose(*gradients, rtol=0, atol=ORDER * np.abs(gradients[0]).max())
