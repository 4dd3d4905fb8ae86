"""Texture coordinates and attributes at the cage as parameters: what follows them, and gradients by them."""

import gc
import re
import weakref

import drjit as dr
import mitsuba as mi
import mitsuba_subdivision as msub
import numpy as np
import pytest
from mitsuba_subdivision import ControlCage, LimitSurface
from mitsuba_subdivision.cage import named_cages
from mitsuba_subdivision.cage.attributes import Attribute
from mitsuba_subdivision.cage.errors import CageWarning
from mitsuba_subdivision.device_arrays import upload
from mitsuba_subdivision.patches.channel import LinearChannel, SubdividedChannel
from mitsuba_subdivision.shapes.mitsuba_3_9_hook.interaction_hook import hook_problem
from reference.refined_cages import refine_first

every_variant = pytest.mark.usefixtures("variants_all_rgb")
every_array_variant = pytest.mark.usefixtures("variants_array_rgb")
every_ad_variant = pytest.mark.usefixtures("variants_all_ad_rgb")
exact = pytest.mark.skipif(hook_problem() is not None, reason=str(hook_problem()))
shadings = pytest.mark.parametrize("shading", ["vertex", pytest.param("exact", marks=exact)])

# Sums of some tens of terms of order one, in single precision.
SINGLE = 2e-6
# Where a ray meets the surface in single precision, times the slope of attributes there.
HIT = 1e-4
# Sums over some thousand vertices or samples in single precision, relative to the result.
SUM = 1e-5
# Pictures are linear in what is differentiated, so that a difference over a wide step has no other error than rounding.
STEP, DIFFERENCE = 0.02, 1e-4
RESOLUTION = 16
NAMES = {"texcoords": 2, "colour": 3, "weight": 1, "label": 1}
ADAPTIVE = {"tessellation": "adaptive", "chord_error": 0.02}

# The top is two triangles, two sides are joined to an L-shaped hexagon.
MIXED_FACES = [[0, 2, 3, 1], [4, 5, 7], [4, 7, 6], [3, 2, 6, 7], [0, 4, 6, 2], [1, 3, 7, 5, 4, 0]]


def with_attributes(positions, faces, seed, **tags):
    """Random values of every interpolation, with seams; each face is an island of texture coordinates."""
    rng, corners = np.random.default_rng(seed), np.concatenate(faces)
    angles = np.concatenate([2 * np.pi * np.arange(len(face)) / len(face) for face in faces])
    islands = 0.5 + 0.1 * np.stack([np.cos(angles), np.sin(angles)], axis=1) + 0.04 * rng.random((len(corners), 2))
    # Two values for each vertex, of which the first face takes the other.
    rows = np.where(np.arange(len(corners)) < len(faces[0]), corners, corners + len(positions))
    return ControlCage(
        positions,
        faces,
        texcoords=Attribute(islands, "face_varying", np.arange(len(corners))),
        attributes={
            "colour": Attribute(rng.random((len(positions), 3))),
            "weight": Attribute(rng.random((len(positions), 1)), "varying"),
            "label": Attribute(rng.random((2 * len(positions), 1)), "face_varying", rows),
        },
        **tags,
    )


def cube(seed=0):
    given = named_cages.cube()
    creases = [(0, 1, 10), (1, 3, 10), (3, 2, 2.5)]
    return with_attributes(given.positions, given.face_vertices.reshape(-1, 4), seed, creases=creases)


def mixed(seed=0):
    return with_attributes(named_cages.cube().positions, MIXED_FACES, seed)


def triangles(seed=0):
    given = named_cages.cube()
    halves = [half for a, b, c, d in given.face_vertices.reshape(-1, 4).tolist() for half in ([a, b, c], [a, c, d])]
    return with_attributes(given.positions, halves, seed)


CAGES = {
    "cube": (cube, {}),
    "mixed": (mixed, {}),
    "refined": (mixed, {}),
    "loop": (triangles, {"scheme": "loop"}),
    "adaptive": (cube, ADAPTIVE),
    "adaptive mixed": (mixed, ADAPTIVE),
}


@pytest.fixture(params=CAGES)
def cage(request, monkeypatch):
    """Function that makes a cage of random values, and parameters of its shape."""
    if request.param == "refined":
        refine_first(monkeypatch)
    return CAGES[request.param]


def make(cage, **parameters):
    rate = {} if "tessellation" in parameters else {"tessellation_rate": 4}
    return mi.load_dict({"type": "subdivision", **cage.as_properties(mi), **rate, **parameters})


def values_of(cage):
    return {"texcoords": cage.texcoords.values, **{name: each.values for name, each in cage.attributes.items()}}


def assign(parameters, cage):
    for name, values in values_of(cage).items():
        key = f"cage_{name}"
        parameters[key] = upload(type(parameters[key]), values)
    parameters.update()


def buffers(shape):
    parameters = mi.traverse(shape)
    return {name: np.array(parameters[f"vertex_{name}"]).reshape(-1, size) for name, size in NAMES.items()}


def assert_alike(shape, expected):
    for name, values in buffers(expected).items():
        np.testing.assert_allclose(buffers(shape)[name], values, rtol=0, atol=SINGLE, err_msg=name)


# What follows


@every_variant
def test_equal_values_share_their_memory_until_those_of_one_shape_change():
    first, second = (mi.traverse(make(cube())) for _ in range(2))
    for name in NAMES:
        one, other = first[f"cage_{name}"], second[f"cage_{name}"]
        assert not dr.is_jit_v(one) or one.index == other.index
    before = np.array(second["cage_texcoords"])
    dr.scatter(first["cage_texcoords"], 7.0, dr.uint32_array_t(type(first["cage_texcoords"]))(0))
    first.update()
    assert np.array(first["cage_texcoords"])[0] == 7
    np.testing.assert_array_equal(np.array(second["cage_texcoords"]), before)


@shadings
@pytest.mark.usefixtures("variant_llvm_ad_rgb")
@pytest.mark.parametrize("interpolation", ["vertex", "varying"])
@pytest.mark.parametrize("by", ["heat", "texcoords"])
def test_a_frozen_function_sees_new_values(shading, interpolation, by):
    """Dr.Jit went on reading the memory of NumPy that the first values came from."""
    cube, rng = named_cages.cube(), np.random.default_rng(0)
    texcoords, heat = (Attribute(rng.random((8, size)), kind) for size, kind in ((2, "vertex"), (1, interpolation)))
    faces = cube.face_vertices.reshape(-1, 4)
    cage = ControlCage(cube.positions, faces, texcoords=texcoords, attributes={"heat": heat})
    shape = mi.load_dict({"type": "subdivision", **cage.as_properties(mi), "shading": shading})
    scene = mi.load_dict({"type": "scene", "shape": shape})
    parameters, x = mi.traverse(shape), upload(mi.Float, np.linspace(-0.4, 0.4, 9, dtype=np.float32))

    def seen(scene, x):
        si = scene.ray_intersect(mi.Ray3f(mi.Point3f(x, 0.1, 5), mi.Vector3f(0, 0, -1)))
        return si.uv.x if by == "texcoords" else si.shape.eval_attribute_1("vertex_heat", si)

    frozen, before = dr.freeze(seen), None
    for _ in range(3):
        found = np.array(frozen(scene, x))
        np.testing.assert_array_equal(found, np.array(seen(scene, x)))
        assert before is None or not np.array_equal(found, before)
        before = found
        parameters[f"cage_{by}"] = parameters[f"cage_{by}"] * 0.7
        parameters.update()


# Under exact shading, vertices that no seam asks for hold no values; hits are those of test_hits_follow.
@every_variant
@pytest.mark.parametrize(
    ("cage", "shading"),
    [*((name, "vertex") for name in CAGES), *(pytest.param(name, "exact", marks=exact) for name in ("cube", "mixed"))],
    indirect=["cage"],
)
def test_an_update_equals_a_new_shape(cage, shading):
    made, parameters = cage
    shape = make(made(), shading=shading, **parameters)
    assign(mi.traverse(shape), made(1))
    expected = make(made(1), shading=shading, **parameters)
    assert (len(buffers(shape)["texcoords"]) > 0) == (shading == "vertex")
    assert_alike(shape, expected)


@every_variant
def test_traverse_shows_the_values_as_they_were_given(cage):
    made, parameters = cage
    found = mi.traverse(make(made(), **parameters))
    for name, values in values_of(made()).items():
        np.testing.assert_array_equal(np.array(found[f"cage_{name}"]), values.ravel().astype(np.float32))


def hits(shape):
    """What is asked of the surface at some hits: texture coordinates, their directions, attributes."""
    scene, found = mi.load_dict({"type": "scene", "shape": shape}), []
    places, is_jit = np.array([(0.05, 0.11), (0.31, -0.2), (-0.17, 0.27)], dtype=np.float32), dr.is_jit_v(mi.Float)
    origins = np.insert(places, 2, 5, axis=1)
    origins = [upload(mi.Point3f, origins)] if is_jit else origins.tolist()
    for origin in origins:
        si = scene.ray_intersect(mi.Ray3f(origin, [0, 0, -1]))
        each = [si.uv.x, si.uv.y, *si.dp_du, *si.dp_dv]
        if is_jit:
            # In scalar variants they are interpolated between vertices.
            each += [*shape.eval_attribute_3("vertex_colour", si), shape.eval_attribute_1("vertex_weight", si)]
            each.append(shape.eval_attribute_1("vertex_label", si))
        valid = si.is_valid()
        # In one kernel.
        dr.eval(valid, each)
        assert dr.all(valid)
        found += each
    return np.array([np.array(each).ravel() for each in found])


# Vertices of the other cages follow in test_an_update_equals_a_new_shape; hits compile kernels for seconds.
@exact
@every_array_variant
@pytest.mark.parametrize("cage", ["refined", "loop", "adaptive mixed"], indirect=True)
def test_hits_follow(cage):
    made, parameters = cage
    shape = make(made(), shading="exact", **parameters)
    before = hits(shape)
    assign(mi.traverse(shape), made(1))
    expected = hits(make(made(1), shading="exact", **parameters))
    scale = np.maximum(1, np.abs(expected))
    assert (np.abs(hits(shape) - expected) / scale).max() < HIT
    assert (np.abs(before - expected) / scale).max() > 100 * HIT


@every_variant
@shadings
def test_values_stay_when_triangles_are_chosen_anew(shading):
    shape = make(cube(), shading=shading, **ADAPTIVE)
    parameters = mi.traverse(shape)
    count = shape.vertex_count()
    assign(parameters, cube(1))
    parameters["chord_error"] = ADAPTIVE["chord_error"] / 3
    parameters.update()
    assert shape.vertex_count() > count
    assert_alike(shape, make(cube(1), shading=shading, **{**ADAPTIVE, "chord_error": ADAPTIVE["chord_error"] / 3}))
    assign(parameters, cube(2))
    shape.retessellate()
    assert_alike(shape, make(cube(2), shading=shading, **{**ADAPTIVE, "chord_error": ADAPTIVE["chord_error"] / 3}))


@every_variant
def test_what_users_assign_to_vertices_stays_until_the_cage_is_updated():
    shape = make(cube())
    parameters = mi.traverse(shape)
    own = upload(type(parameters["vertex_colour"]), 0.5 * np.array(parameters["vertex_colour"]))
    parameters["vertex_colour"] = own
    parameters["cage_weight"] = parameters["cage_weight"] * 2
    parameters.update()
    parameters["control_points"] = parameters["control_points"] * 2
    parameters.update()
    np.testing.assert_array_equal(np.array(mi.traverse(shape)["vertex_colour"]), np.array(own))
    parameters["cage_colour"] = parameters["cage_colour"] * 1
    parameters.set_dirty("cage_colour")
    parameters.update()
    np.testing.assert_allclose(np.array(mi.traverse(shape)["vertex_colour"]), 2 * np.array(own), atol=SINGLE)


@every_variant
def test_no_weights_are_made_where_no_value_changes(monkeypatch):
    made = []
    for kind in (SubdividedChannel, LinearChannel):
        monkeypatch.setattr(kind, "weights", lambda *_, kind=kind: made.append(kind))
    shape = make(cube())
    parameters = mi.traverse(shape)
    parameters["control_points"] = parameters["control_points"] * 2
    parameters.update()
    assert made == []


@every_variant
def test_attributes_that_a_mesh_has_no_place_for_are_no_parameters():
    given = named_cages.cube()
    attributes = {"pair": np.ones((8, 2)), "colour": np.ones((8, 3))}
    cage = ControlCage(given.positions, given.face_vertices.reshape(-1, 4), attributes=attributes)
    with pytest.warns(CageWarning, match='attribute "pair" has 2 numbers per value and is left out'):
        shape = make(cage)
    found = {key for key in mi.traverse(shape).keys() if key.startswith("cage_")}  # noqa: SIM118 - it iterates over pairs
    assert found == {"cage_colour"}


@pytest.mark.parametrize(
    ("values", "message"),
    [
        (np.ones(23), 'parameter "cage_colour": 23 numbers; expected 24, 3 for each of 8 values at the cage'),
        (
            np.where(np.arange(24) > 21, np.inf, 1),
            'parameter "cage_colour": number 22 is not finite; expected finite numbers (2 such in all)',
        ),
    ],
)
@every_variant
def test_errors_say_what_was_expected(values, message):
    shape = make(cube())
    parameters = mi.traverse(shape)
    if not dr.is_jit_v(mi.Float) and len(values) != len(parameters["cage_colour"]):
        pytest.skip("Mitsuba compares the values before it assigns them")
    parameters["cage_colour"] = upload(type(parameters["cage_colour"]), values)
    with pytest.raises(ValueError, match=re.escape(message)):
        parameters.update()


# Gradients


def weights_of(cage, name, scheme):
    """Of an attribute's values in those at the tessellation's vertices: what unit vectors become."""
    given = cage.texcoords if name == "texcoords" else cage.attributes[name]
    unit = Attribute(np.eye(len(given.values)), given.interpolation, given.indices)
    surface = LimitSurface(
        ControlCage.from_arrays(
            cage.positions,
            cage.face_sizes,
            cage.face_vertices,
            creases=cage.tags.creases(cage.topology),
            texcoords=cage.texcoords,
            attributes={**cage.attributes, "unit": unit},
        ),
        scheme,
    )
    return surface.tessellate(4).attributes["unit"]


@pytest.mark.usefixtures("no_other_scene")
@every_ad_variant
@pytest.mark.parametrize("cage", ["cube", "mixed", "refined", "loop"], indirect=True)
def test_gradients_of_sums_over_vertices_are_column_sums_of_weights(cage, np_rng):
    made, options = cage
    parameters = mi.traverse(make(made(), **options))
    for name in NAMES:
        dr.enable_grad(parameters[f"cage_{name}"])
        parameters.set_dirty(f"cage_{name}")
    parameters.update()
    loss, expected = mi.Float(0), {}
    for name, size in NAMES.items():
        weights = weights_of(made(), name, options.get("scheme"))
        factors = np_rng.random((len(weights), size)).astype(np.float32)
        loss += dr.sum(parameters[f"vertex_{name}"] * upload(mi.Float, factors))
        expected[name] = weights.T @ factors
    dr.backward(loss)
    # In one kernel.
    found = {name: dr.grad(parameters[f"cage_{name}"]) for name in NAMES}
    dr.eval(found)
    for name, values in expected.items():
        shaped = np.array(found[name]).reshape(values.shape)
        np.testing.assert_allclose(shaped, values, rtol=0, atol=SUM * values.max(), err_msg=name)


def ramp():
    """A bitmap that is linear over the islands: gradients of texture coordinates are its slopes."""
    texels = np.array([[[0.1], [0.9]], [[0.4], [0.6]]], dtype=np.float32)
    return {"type": "bitmap", "data": upload(mi.TensorXf, texels), "raw": True, "wrap_mode": "clamp"}


def picture_of(cage, name, **parameters):
    """A scene whose shape shows an attribute, or a bitmap by its texture coordinates."""
    reflectance = ramp() if name == "texcoords" else {"type": "mesh_attribute", "name": f"vertex_{name}"}
    films = {"type": "hdrfilm", "width": RESOLUTION, "height": RESOLUTION, "rfilter": {"type": "box"}}
    views = [[2.5, -3, 2], [-2, 3, 2.5]]
    sensors = {
        f"view_{view}": {
            "type": "perspective",
            "fov": 30,
            "to_world": mi.ScalarTransform4f().look_at(origin, [0, 0, 0], [0, 0, 1]),
            "film": films,
        }
        for view, origin in enumerate(views)
    }
    shape = make(cage, bsdf={"type": "diffuse", "reflectance": reflectance}, **parameters)
    # Directions that a BSDF samples turn with the texture coordinates, and may meet the shape or not.
    integrator = {"type": "direct", "bsdf_samples": 0}
    return mi.load_dict(
        {"type": "scene", "integrator": integrator, **sensors, "sky": {"type": "constant"}, "shape": shape}
    )


def derivatives(assign, loss):
    """Of a loss: backward, forward, and by central differences.

    Parameters
    ----------
    assign : callable
        Assigns parameters some steps away.
    loss : callable
        Takes two seeds, of values and of their derivatives.
    """
    found = []
    for is_forward in (False, True):
        step = mi.Float(0)
        dr.enable_grad(step)
        assign(step)
        value = loss(1, 2)
        if is_forward:
            dr.forward(step)
        else:
            dr.backward(value)
        found.append(float(np.array(dr.grad(value if is_forward else step)).ravel()[0]))
    ends = []
    for side in (1, -1):
        assign(mi.Float(side * STEP))
        ends.append(float(np.array(loss(2, 3)).ravel()[0]))
    return *found, (ends[0] - ends[1]) / (2 * STEP)


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
    [pytest.param(*each, marks=[exact] if each[1] == "exact" else []) for each in RENDERS],
    indirect=["cage"],
)
def test_gradients_of_renders_are_central_differences(cage, name, shading, np_rng):
    made, options = cage
    scene = picture_of(made(), name, shading=shading, **options)
    parameters, key = mi.traverse(scene), f"shape.cage_{name}"
    start = mi.Float(parameters[key])
    along = upload(mi.Float, np_rng.normal(size=dr.width(start)))
    factors = upload(mi.TensorXf, np_rng.random((RESOLUTION, RESOLUTION, 3)))

    def assign(step):
        parameters[key] = start + step * along
        parameters.update()

    def loss(seed, seed_grad):
        return dr.sum(mi.render(scene, parameters, spp=4, seed=seed, seed_grad=seed_grad) * factors, axis=None)

    backward, forward, difference = derivatives(assign, loss)
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
    start = mi.Float(parameters[key])

    def gradient(how):
        values = mi.Float(dr.detach(start))
        dr.enable_grad(values)
        parameters[key] = values
        parameters.update()
        if how == "sum":
            dr.backward(msub.loss_of_views(scene, parameters, loss_of, spp=4))
        for view in range(2 if how == "once" else 0):
            dr.backward(loss_of(mi.render(scene, parameters, sensor=view, spp=4, seed=view)))
        return np.array(dr.grad(values))

    expected = gradient("sum")
    assert np.abs(expected).max() > 0
    np.testing.assert_allclose(gradient("once"), expected, rtol=0, atol=SUM * np.abs(expected).max())


@every_ad_variant
def test_gradients_that_end_at_the_values_are_told_of():
    scene = picture_of(cube(), "colour")
    parameters, key = mi.traverse(scene), "shape.cage_colour"
    factor = dr.opaque(mi.Float, 1)
    dr.enable_grad(factor)
    parameters[key] = parameters[key] * factor
    parameters.update()

    def differentiate():
        dr.backward(loss_of(mi.render(scene, parameters, spp=4)))
        return dr.grad(factor)[0]

    first = differentiate()
    assert first > 0
    with pytest.warns(CageWarning, match=r"control cage: gradients came to cage_colour a second time since the last"):
        assert differentiate() == first


@every_ad_variant
def test_control_points_and_colours_have_gradients_together():
    scene = picture_of(cube(), "colour")
    parameters = mi.traverse(scene)
    keys = ["shape.control_points", "shape.cage_colour"]
    found = []
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
        found.append([np.array(dr.grad(parameters[key])) for key in chosen])
    for alone, together in zip(found[0] + found[1], found[2], strict=True):
        assert np.abs(alone).max() > 0
        np.testing.assert_allclose(together, alone, rtol=0, atol=10 * SUM * np.abs(alone).max())


@every_ad_variant
@shadings
def test_derivatives_do_not_keep_shapes_alive(shading):
    shape = make(cube(), shading=shading)
    parameters = mi.traverse(shape)
    dr.enable_grad(parameters["cage_colour"])
    parameters.set_dirty("cage_colour")
    parameters.update()
    dr.backward(dr.sum(parameters["vertex_colour"]))
    alive = weakref.ref(shape)
    del shape, parameters
    gc.collect()
    assert alive() is None


# Differences of values at hits over this step, in single precision, beside the largest: rounding over the step, and
# what values bend within it.
MOVED, MOVED_DIFFERENCE = 1e-3, 2e-3


def grown_colours(scheme):
    cage = named_cages.extraordinary_triangles(5) if scheme == "loop" else named_cages.cube()
    weights = np.linspace(0, 1, len(cage.positions))[:, None]
    return ControlCage(
        cage.positions,
        np.split(cage.face_vertices, np.cumsum(cage.face_sizes)[:-1]),
        attributes={"weight": Attribute(weights), "colour": Attribute(np.hstack([weights, 1 - weights, weights**2]))},
    )


@pytest.mark.parametrize("mode", ["forward", "backward"])
@pytest.mark.parametrize("by", ["control_points", "to_world"])
@pytest.mark.parametrize("scheme", ["catmull_clark", "loop", "doo_sabin"])
@shadings
@pytest.mark.usefixtures("variant_llvm_ad_rgb")
def test_gradients_of_attributes_follow_the_hit(shading, scheme, by, mode, np_rng):
    """Under exact shading they left out that it moves: a surface moving along its colours had a gradient of zero."""
    cage = grown_colours(scheme)
    shape = make(cage, scheme=scheme, tessellation_rate=4, shading=shading)
    scene = mi.load_dict({"type": "scene", "shape": shape})
    parameters, by = mi.traverse(scene), f"{shape.id()}.{by}"
    inside = LimitSurface(cage, scheme).sample(64, 1)
    targets = cage.positions.mean(axis=0) + 0.9 * (inside.p - cage.positions.mean(axis=0))
    o, d = inside.p + inside.n, targets - inside.p - inside.n
    ray = mi.Ray3f(msub.upload(mi.Point3f, o.T), msub.upload(mi.Vector3f, d.T))
    moves, given = np_rng.normal(size=len(cage.positions) * 3), type(parameters[by])(parameters[by])

    def values(step):
        if by.endswith("control_points"):
            parameters[by] = given + step * msub.upload(mi.Float, moves)
        else:
            parameters[by] = mi.AffineTransform4f().translate([0.3 * step, step, -0.5 * step]) @ given
        parameters.update()
        si = scene.ray_intersect(ray)
        found, is_valid = si.shape.eval_attribute_1("vertex_weight", si), si.is_valid()
        dr.eval(found, is_valid, si.prim_index)
        return found, is_valid, si.prim_index

    ahead, behind = (values(mi.Float(sign * MOVED)) for sign in (1, -1))
    differences = (np.array(ahead[0]) - np.array(behind[0])) / (2 * MOVED)
    step = mi.Float(0)
    dr.enable_grad(step)
    found, is_valid, triangle = values(step)
    # Values of vertex shading have kinks between triangles.
    same = np.all([np.array(each[2]) == np.array(triangle) for each in (ahead, behind)], axis=0) & np.array(is_valid)
    assert same.mean() > 0.5
    if mode == "forward":
        dr.set_grad(step, 1)
        derivative = np.array(dr.forward_to(found))
    else:
        weights, kept = np.where(same, np_rng.choice([-1, 1], 64), 0), same
        dr.backward(dr.sum(found * msub.upload(mi.Float, weights)))
        derivative = np.array(dr.grad(step))
    tolerance = MOVED_DIFFERENCE * np.abs(differences[same]).max()
    if mode == "backward":
        # Of the same rays as the differences.
        derivative, same = derivative / same.sum(), [0]
        differences = (differences * weights)[kept].sum(keepdims=True) / kept.sum()
    np.testing.assert_allclose(derivative[same], differences[same], rtol=0, atol=tolerance)
