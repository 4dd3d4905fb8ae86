"""Texture coordinates and attributes at the cage as parameters: what follows them, and gradients by them."""

import drjit as dr
import mitsuba as mi
import mitsuba_subdivision as msub
import numpy as np
import pytest
from mitsuba_subdivision import Attribute, ControlCage, LimitSurface, upload
from mitsuba_subdivision.cage import named_cages
from mitsuba_subdivision.patches.channel import Channel
from reference.refined_cages import refine_first, tagged
from shapes.cages import MIXED_FACES, cube, load
from shapes.scenes import SINGLE, buffer, down, perspective, rays, scene_with
from shapes.updates import MODES, assign_cage, derivative, differentiated, update
from shapes.variants import every_ad_variant, every_array_variant, every_variant, exact, llvm, shadings

# Where a ray meets the surface in single precision, times the slope of attributes there.
HIT = 1e-4
# Sums over some thousand vertices or samples in single precision, relative to the result.
SUM = 1e-5
# Pictures are linear in what is differentiated, so that a difference over a wide step has no other error than rounding.
STEP, DIFFERENCE = 0.02, 1e-4
RESOLUTION = 16
NAMES = {"texcoords": 2, "colour": 3, "weight": 1, "label": 1}
ADAPTIVE = {"tessellation": "adaptive", "chord_error": 0.02}
FINER = {"tessellation": "adaptive", "chord_error": 0.02 / 3}


def with_attributes(cage, seed, **tags):
    """Random values of every interpolation, with seams; each face is an island of texture coordinates."""
    rng, corners, count = np.random.default_rng(seed), cage.face_vertices, cage.vertex_count
    angles = np.concatenate([2 * np.pi * np.arange(size) / size for size in cage.face_sizes])
    islands = 0.5 + 0.1 * np.stack([np.cos(angles), np.sin(angles)], axis=1) + 0.04 * rng.random((len(corners), 2))
    # Two values for each vertex, of which the first face takes the other.
    rows = corners + count * (np.arange(len(corners)) >= cage.face_sizes[0])
    attributes = {
        "colour": Attribute(rng.random((count, 3))),
        "weight": Attribute(rng.random((count, 1)), "varying"),
        "label": Attribute(rng.random((2 * count, 1)), "face_varying", rows),
    }
    return tagged(cage, texcoords=Attribute(islands, "face_varying"), attributes=attributes, **tags)


def creased(seed=0):
    return with_attributes(cube(), seed, creases=[(0, 1, 10), (1, 3, 10), (3, 2, 2.5)])


def mixed(seed=0):
    return with_attributes(ControlCage(cube().positions, MIXED_FACES), seed)


def triangles(seed=0):
    quads = cube().face_vertices.reshape(-1, 4)
    return with_attributes(ControlCage(cube().positions, quads[:, [0, 1, 2, 0, 2, 3]].reshape(-1, 3)), seed)


CAGES = {
    "cube": (creased, {}),
    "mixed": (mixed, {}),
    "refined": (mixed, {}),
    "loop": (triangles, {"scheme": "loop"}),
    "adaptive": (creased, ADAPTIVE),
    "adaptive mixed": (mixed, ADAPTIVE),
}


@pytest.fixture(params=CAGES)
def cage(request, monkeypatch):
    """Function that makes a cage of random values, and parameters of its shape."""
    if request.param == "refined":
        refine_first(monkeypatch)
    return CAGES[request.param]


def make(cage, **parameters):
    return load(cage, **({} if "tessellation" in parameters else {"tessellation_rate": 4}), **parameters)


def assert_alike(shape, expected):
    for name in (f"vertex_{name}" for name in NAMES):
        np.testing.assert_allclose(buffer(shape, name), buffer(expected, name), rtol=0, atol=SINGLE, err_msg=name)


@shadings
@llvm
@pytest.mark.parametrize("interpolation", ["vertex", "varying"])
@pytest.mark.parametrize("by", ["heat", "texcoords"])
def test_a_frozen_function_sees_new_values(shading, interpolation, by):
    """Dr.Jit went on reading the memory of NumPy that the first values came from."""
    rng = np.random.default_rng(0)
    texcoords, heat = (Attribute(rng.random((8, size)), kind) for size, kind in ((2, "vertex"), (1, interpolation)))
    shape = load(cube(texcoords=texcoords, attributes={"heat": heat}), shading=shading)
    scene = scene_with(shape=shape)
    parameters, x = mi.traverse(shape), upload(mi.Float, np.linspace(-0.4, 0.4, 9, dtype=np.float32))

    def seen(scene, x):
        si = scene.ray_intersect(down(x, 0.1))
        return si.uv.x if by == "texcoords" else si.shape.eval_attribute_1("vertex_heat", si)

    frozen, before = dr.freeze(seen), None
    for _ in range(3):
        now = np.array(frozen(scene, x))
        np.testing.assert_array_equal(now, np.array(seen(scene, x)))
        assert before is None or not np.array_equal(now, before)
        before = now
        update(parameters, {f"cage_{by}": parameters[f"cage_{by}"] * 0.7})


# Under exact shading, vertices that no seam asks for hold no values; hits are those of test_hits_follow.
@every_variant
@pytest.mark.parametrize(
    ("cage", "shading"),
    [*((name, "vertex") for name in CAGES), *(pytest.param(name, "exact", marks=exact) for name in ("cube", "mixed"))],
    indirect=["cage"],
)
def test_values_are_shown_as_they_were_given_and_an_update_of_them_equals_a_new_shape(cage, shading):
    made, parameters = cage
    shape = make(made(), shading=shading, **parameters)
    shown = mi.traverse(shape)
    for name, values in {"texcoords": made().texcoords, **made().attributes}.items():
        np.testing.assert_array_equal(np.array(shown[f"cage_{name}"]), values.values.ravel().astype(np.float32))
    assign_cage(shape, made(1))
    assert (len(buffer(shape, "vertex_texcoords")) > 0) == (shading == "vertex")
    assert_alike(shape, make(made(1), shading=shading, **parameters))


def hits(shape):
    """What is asked of the surface at some hits: texture coordinates, their directions, attributes."""
    si = scene_with(shape=shape).ray_intersect(down([0.05, 0.31, -0.17], [0.11, -0.2, 0.27]))
    attributes = *shape.eval_attribute_3("vertex_colour", si), shape.eval_attribute_1("vertex_weight", si)
    values = [si.uv.x, si.uv.y, *si.dp_du, *si.dp_dv, *attributes, shape.eval_attribute_1("vertex_label", si)]
    valid = si.is_valid()
    # In one kernel.
    dr.eval(valid, values)
    assert dr.all(valid)
    return np.array([np.array(value) for value in values])


# Vertices of the other cages follow in the test above by updates; hits compile kernels for seconds.
@exact
@every_array_variant
@pytest.mark.parametrize("cage", ["refined", "loop", "adaptive mixed"], indirect=True)
def test_hits_follow(cage):
    made, parameters = cage
    shape = make(made(), shading="exact", **parameters)
    before = hits(shape)
    assign_cage(shape, made(1))
    expected = hits(make(made(1), shading="exact", **parameters))
    scale = np.maximum(1, np.abs(expected))
    assert (np.abs(hits(shape) - expected) / scale).max() < HIT
    assert (np.abs(before - expected) / scale).max() > 100 * HIT


@every_variant
@shadings
def test_values_stay_when_triangles_are_chosen_anew(shading):
    shape = make(creased(), shading=shading, **ADAPTIVE)
    parameters, count = mi.traverse(shape), shape.vertex_count()
    assign_cage(shape, creased(1))
    update(parameters, chord_error=FINER["chord_error"])
    assert shape.vertex_count() > count
    assert_alike(shape, make(creased(1), shading=shading, **FINER))
    assign_cage(shape, creased(2))
    shape.retessellate()
    assert_alike(shape, make(creased(2), shading=shading, **FINER))


@every_variant
def test_what_users_assign_to_vertices_stays_until_the_cage_is_updated_for_which_alone_weights_are_made(monkeypatch):
    shape = make(creased())
    parameters = mi.traverse(shape)
    assigned = upload(type(parameters["vertex_colour"]), 0.5 * np.array(parameters["vertex_colour"]))
    update(parameters, vertex_colour=assigned, cage_weight=parameters["cage_weight"] * 2)
    with monkeypatch.context() as patched:
        patched.setattr(Channel, "weights", None)
        update(parameters, control_points=parameters["control_points"] * 2)
        update(make(creased()), control_points=parameters["control_points"])
    np.testing.assert_array_equal(np.array(mi.traverse(shape)["vertex_colour"]), np.array(assigned))
    parameters["cage_colour"] = parameters["cage_colour"] * 1
    parameters.set_dirty("cage_colour")
    parameters.update()
    np.testing.assert_allclose(np.array(mi.traverse(shape)["vertex_colour"]), 2 * np.array(assigned), atol=SINGLE)


# Gradients


@pytest.mark.usefixtures("no_other_scene", "variants_all_ad_rgb")
@pytest.mark.parametrize("cage", ["cube", "mixed", "refined", "loop"], indirect=True)
def test_gradients_of_sums_over_vertices_are_column_sums_of_weights(cage, np_rng):
    made, options = cage
    parameters = mi.traverse(make(made(), **options))
    for name in NAMES:
        dr.enable_grad(parameters[f"cage_{name}"])
        parameters.set_dirty(f"cage_{name}")
    parameters.update()
    loss, expected = mi.Float(0), {}
    cage = made()
    creases = cage.tags.creases(cage.topology)
    for name, size in NAMES.items():
        # What unit vectors become: the weights of an attribute's values in those at the vertices.
        given = cage.texcoords if name == "texcoords" else cage.attributes[name]
        unit = {"unit": Attribute(np.eye(len(given.values)), given.interpolation, given.indices)}
        units = tagged(cage, creases=creases, texcoords=cage.texcoords, attributes=cage.attributes | unit)
        weights = LimitSurface(units, options.get("scheme")).tessellate(4).attributes["unit"]
        factors = np_rng.random((len(weights), size)).astype(np.float32)
        loss += dr.sum(parameters[f"vertex_{name}"] * upload(mi.Float, factors))
        expected[name] = weights.T @ factors
    dr.backward(loss)
    # In one kernel.
    gradients = {name: dr.grad(parameters[f"cage_{name}"]) for name in NAMES}
    dr.eval(gradients)
    for name, values in expected.items():
        shaped = np.array(gradients[name]).reshape(values.shape)
        np.testing.assert_allclose(shaped, values, rtol=0, atol=SUM * values.max(), err_msg=name)


def ramp():
    """A bitmap that is linear over the islands: gradients of texture coordinates are its slopes."""
    texels = np.array([[[0.1], [0.9]], [[0.4], [0.6]]], dtype=np.float32)
    return {"type": "bitmap", "data": upload(mi.TensorXf, texels), "raw": True, "wrap_mode": "clamp"}


def picture_of(cage, name, **parameters):
    """A scene whose shape shows an attribute, or a bitmap by its texture coordinates."""
    reflectance = ramp() if name == "texcoords" else {"type": "mesh_attribute", "name": f"vertex_{name}"}
    shape = make(cage, bsdf={"type": "diffuse", "reflectance": reflectance}, **parameters)
    eyes = {"view_0": [2.5, -3, 2], "view_1": [-2, 3, 2.5]}
    sensors = {view: perspective(RESOLUTION, eye, fov=30) for view, eye in eyes.items()}
    # Directions that a BSDF samples turn with the texture coordinates, and may meet the shape or not.
    integrator, sky = {"type": "direct", "bsdf_samples": 0}, {"type": "constant"}
    return scene_with(integrator=integrator, **sensors, sky=sky, shape=shape)


# Where weights make what hits look up: of linear interpolation over polygons, and of cages that are refined once.
RENDERS = [
    *(("cube", "vertex", name) for name in ("texcoords", "weight")),
    ("adaptive", "vertex", "label"),
    ("loop", "vertex", "colour"),
    *(("mixed", "exact", name) for name in NAMES),
    ("refined", "exact", "colour"),
]


@every_ad_variant
@pytest.mark.parametrize(
    ("cage", "shading", "name"),
    [pytest.param(*case, marks=[exact] if case[1] == "exact" else []) for case in RENDERS],
    indirect=["cage"],
)
def test_gradients_of_renders_are_central_differences(cage, name, shading, np_rng):
    made, options = cage
    scene = picture_of(made(), name, shading=shading, **options)
    parameters, key = mi.traverse(scene), f"shape.cage_{name}"
    start = mi.Float(parameters[key])
    along = upload(mi.Float, np_rng.normal(size=dr.width(start)))
    factors = upload(mi.TensorXf, np_rng.random((RESOLUTION, RESOLUTION, 3)))

    def derivative_by(mode):
        # The samples of derivatives are those of the pictures that differ.
        seed = 2 if mode == "difference" else 1

        def loss():
            return dr.sum(mi.render(scene, parameters, spp=4, seed=seed, seed_grad=seed + 1) * factors, axis=None)

        return derivative(mode, lambda step: update(parameters, {key: start + step * along}), loss, STEP)

    backward, forward, difference = map(derivative_by, MODES)
    scale = max(1, abs(difference))
    assert abs(difference) > 100 * DIFFERENCE
    assert backward == pytest.approx(difference, abs=DIFFERENCE * scale)
    assert forward == pytest.approx(backward, abs=SUM * scale)


def loss_of(image, _view=0):
    return dr.mean(dr.square(image), axis=None)


@every_ad_variant
@shadings
@pytest.mark.parametrize("name", ["texcoords", "colour", "weight"])
def test_each_view_has_its_gradients_after_one_update(name, shading):
    # Of mixed faces, weights make what hits look up.
    scene = picture_of(mixed(), name, shading=shading)
    parameters, key = mi.traverse(scene), f"shape.cage_{name}"
    values = differentiated(parameters, key)
    dr.backward(msub.loss_of_views(scene, parameters, loss_of, spp=4))
    expected = np.array(dr.grad(values))
    assert np.abs(expected).max() > 0
    values = differentiated(parameters, key)
    for view in range(2):
        dr.backward(loss_of(mi.render(scene, parameters, sensor=view, spp=4, seed=view)))
    np.testing.assert_allclose(np.array(dr.grad(values)), expected, rtol=0, atol=SUM * np.abs(expected).max())


@every_ad_variant
def test_control_points_and_colours_have_gradients_together():
    scene = picture_of(creased(), "colour")
    parameters, keys = mi.traverse(scene), ["shape.control_points", "shape.cage_colour"]
    gradients = []
    for chosen in ([keys[0]], [keys[1]], keys):
        for key in keys:
            values = mi.Float(dr.detach(parameters[key]))
            dr.set_grad_enabled(values, key in chosen)
            parameters[key] = values
            parameters.set_dirty(key)
        parameters.update()
        # Twice, so that both are renewed.
        for _ in range(2):
            dr.backward(loss_of(mi.render(scene, parameters, spp=4)))
        gradients.append([np.array(dr.grad(parameters[key])) for key in chosen])
    for alone, together in zip(gradients[0] + gradients[1], gradients[2], strict=True):
        assert np.abs(alone).max() > 0
        np.testing.assert_allclose(together, alone, rtol=0, atol=10 * SUM * np.abs(alone).max())


# Differences of values at hits over this step, in single precision, beside the largest: rounding over the step, and
# what values bend within it.
MOVED, MOVED_DIFFERENCE = 1e-3, 2e-3


@pytest.mark.parametrize("by", ["control_points", "to_world"])
@pytest.mark.parametrize("scheme", ["catmull_clark", "loop", "doo_sabin"])
@shadings
@llvm
def test_gradients_of_attributes_follow_the_hit(shading, scheme, by, np_rng):
    """Under exact shading they left out that it moves: a surface moving along its colours had a gradient of zero."""
    cage = named_cages.extraordinary_triangles(5) if scheme == "loop" else cube()
    weights = np.linspace(0, 1, cage.vertex_count)[:, None]
    cage = tagged(cage, attributes={"weight": weights, "colour": np.hstack([weights, 1 - weights, weights**2])})
    shape = make(cage, scheme=scheme, shading=shading)
    scene = scene_with(shape=shape)
    parameters, by = mi.traverse(scene), f"{shape.id()}.{by}"
    inside = LimitSurface(cage, scheme).sample(64, 1)
    targets = cage.positions.mean(axis=0) + 0.9 * (inside.p - cage.positions.mean(axis=0))
    ray = rays(inside.p + inside.n, targets - inside.p - inside.n)
    moves, given = np_rng.normal(size=len(cage.positions) * 3), type(parameters[by])(parameters[by])

    def values(step):
        if by.endswith("control_points"):
            moved = given + step * upload(mi.Float, moves)
        else:
            moved = mi.AffineTransform4f().translate([0.3 * step, step, -0.5 * step]) @ given
        update(parameters, {by: moved})
        si = scene.ray_intersect(ray)
        weight, is_valid = si.shape.eval_attribute_1("vertex_weight", si), si.is_valid()
        dr.eval(weight, is_valid, si.prim_index)
        return weight, is_valid, si.prim_index

    ahead, behind = (values(mi.Float(sign * MOVED)) for sign in (1, -1))
    differences = (np.array(ahead[0]) - np.array(behind[0])) / (2 * MOVED)
    step = mi.Float(0)
    dr.enable_grad(step)
    weight, is_valid, triangle = values(step)
    # Values of vertex shading have kinks between triangles.
    same = np.all([np.array(end[2]) == np.array(triangle) for end in (ahead, behind)], axis=0) & np.array(is_valid)
    assert same.mean() > 0.5
    differences = differences[same]
    tolerance = MOVED_DIFFERENCE * np.abs(differences).max()
    # The mean over the same rays as the differences.
    signs = np.where(same, np_rng.choice([-1, 1], 64), 0)
    dr.backward(dr.sum(weight * upload(mi.Float, signs)), flags=dr.ADFlag.ClearNone)
    backward = np.array(dr.grad(step)) / same.sum()
    np.testing.assert_allclose(backward, (differences * signs[same]).mean(), rtol=0, atol=tolerance)
    weight, _, _ = values(step)
    dr.set_grad(step, 1)
    np.testing.assert_allclose(np.array(dr.forward_to(weight))[same], differences, rtol=0, atol=tolerance)
