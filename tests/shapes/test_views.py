import gc
import weakref

import drjit as dr
import mitsuba as mi
import mitsuba_subdivision as msub
import numpy as np
import pytest
from mitsuba_subdivision import CageWarning
from patches.closed_cages import cube_with_hexagon
from shapes.cages import ISLANDS, RING, bitmap, cube, described, load, with_attributes
from shapes.scenes import buffer, perspective, scene_with
from shapes.updates import differentiated, update
from shapes.variants import every_ad_variant, exact

pytestmark = every_ad_variant

KEY = "shape.control_points"
VIEWS = 2
# Sums of the same terms of float32 in another order.
ROUNDING = 1e-5
# A cube whose vertices have copies: for normals along a crease, and for texture coordinates along seams.
SEAMED = cube(texcoords=ISLANDS, creases=RING)


def views_of(integrator, cage=None, **parameters):
    eyes = [[4 * np.cos(2 * view), 2, 4 * np.sin(2 * view)] for view in range(VIEWS)]
    sensors = {f"view_{view}": perspective(16, eye, up=[0, 1, 0]) for view, eye in enumerate(eyes)}
    if isinstance(integrator, str):
        # Nothing here has shadows, whose derivatives would take seconds.
        integrator = {"type": integrator, **({"sppi": 0} if integrator.endswith("_projective") else {})}
    seen = {"integrator": integrator, **sensors, "sky": {"type": "constant"}}
    return scene_with(**seen, shape=described(cage or cube(), **parameters))


def loss_of(image, _view=0):
    return dr.mean(dr.square(image), axis=None)


def loss_at(scene, parameters, view):
    return loss_of(mi.render(scene, parameters, sensor=view, spp=4, seed=view))


def gradient_by(scene, how, kept=False):
    """Gradient of all views' losses by the control points: updated before each view, once for all, or of their sum."""
    parameters = mi.traverse(scene)
    if kept:
        parameters.keep([KEY])
    if how == "optimiser":
        optimiser = mi.ad.SGD(lr=1, params={KEY: dr.detach(parameters[KEY])})
        parameters.update(optimiser)
        points = optimiser[KEY]
    else:
        points = differentiated(parameters, KEY)
    if how == "sum":
        dr.backward(msub.loss_of_views(scene, parameters, loss_of, spp=4))
        return np.array(dr.grad(points))
    for view in range(VIEWS):
        if how == "updates":
            parameters.set_dirty(KEY)
            parameters.update()
        dr.backward(loss_at(scene, parameters, view))
    return np.array(dr.grad(points))


ONCE, KEPT = ("once",), ("once", True)


@pytest.mark.parametrize(
    ("integrator", "shading", "cases"),
    [
        ("prb", "vertex", [ONCE, KEPT, ("sum",), ("sum", True), ("optimiser",)]),
        ("direct_projective", "vertex", [KEPT]),
        pytest.param("direct", "exact", [ONCE], marks=exact),
    ],
)
def test_each_view_has_the_same_gradients_by_any_call(integrator, shading, cases):
    to_world = mi.ScalarTransform4f().translate([0.1, 0, 0])
    scene = views_of(integrator, shading=shading, to_world=to_world)
    expected = gradient_by(scene, "updates")
    assert np.abs(expected).max() > 0
    for case in cases:
        gradient = gradient_by(scene, *case)
        assert np.linalg.norm(gradient - expected) <= ROUNDING * np.linalg.norm(expected), case


COLOURED = cube(texcoords=ISLANDS, attributes={"colour": cube().positions + 0.6})
COLOUR = {"bsdf": {"type": "diffuse", "reflectance": {"type": "mesh_attribute", "name": "vertex_colour"}}}
POINTS, SCALE = "control_points", "displacement_scale"


def texels():
    return bitmap(np.eye(4)[..., None])


@pytest.mark.parametrize(
    ("names", "displacement", "shading"),
    [
        ((POINTS, "cage_colour", "cage_texcoords"), None, "vertex"),
        ((POINTS, "cage_colour", "cage_weight", SCALE), "vertex_weight", "vertex"),
        ((POINTS, "displacement.data", SCALE), "bitmap", "vertex"),
        pytest.param((POINTS, "cage_colour", "cage_texcoords"), None, "exact", marks=exact),
    ],
)
def test_gradients_of_views_add_up(names, displacement, shading):
    heights = {} if displacement is None else {"displacement": displacement, SCALE: 0.1}
    if displacement == "bitmap":
        heights["displacement"] = texels()
    # All that a ray meets: kernels of light take longer to compile.
    integrator = {"type": "aov", "aovs": "normals:sh_normal,colours:albedo,texcoords:uv"}
    scene = views_of(integrator, with_attributes(cube_with_hexagon()), shading=shading, **COLOUR, **heights)
    parameters, alone = mi.traverse(scene), {}
    keys = [f"shape.{name}" for name in names]
    for key in keys:
        values = differentiated(parameters, key)
        dr.backward(msub.loss_of_views(scene, parameters, loss_of, spp=4))
        alone[key] = np.array(dr.grad(values)).ravel()
        update(parameters, {key: dr.detach(values)})
    together = {key: type(parameters[key])(dr.detach(parameters[key])) for key in keys}
    dr.enable_grad(together)
    update(parameters, together)
    for view in range(VIEWS):
        dr.backward(loss_at(scene, parameters, view))
    for key, expected in alone.items():
        largest = np.abs(expected).max()
        assert largest > 0
        gradient = np.array(dr.grad(together[key])).ravel()
        np.testing.assert_allclose(gradient, expected, rtol=0, atol=10 * ROUNDING * largest, err_msg=key)


@exact
@pytest.mark.parametrize("shading", ["vertex", "exact"])
def test_gradients_of_hits_by_displacing_values_add_up(shading):
    scene = views_of("direct", with_attributes(cube()), displacement="vertex_weight", shading=shading)
    weights, gradients = differentiated(mi.traverse(scene), "shape.cage_weight"), []
    for _ in range(4):
        dr.backward(dr.sum(scene.ray_intersect(mi.Ray3f([0, -5, 0.1], [0, 1, 0])).p))
        gradients.append(np.array(dr.grad(weights)))
    np.testing.assert_allclose(gradients, np.outer([1, 2, 3, 4], gradients[0]), rtol=ROUNDING)


def test_parameters_that_move_by_turns_lose_no_gradients():
    scene = views_of("direct", with_attributes(cube()), displacement="vertex_weight")
    parameters, size = mi.traverse(scene), dr.opaque(mi.Float, 1)
    dr.enable_grad(size)
    for key in ("shape.cage_weight", KEY) * 2:
        start = mi.Float(parameters[key])
        update(parameters, {key: start * size})
        dr.backward(loss_at(scene, parameters, 0))
        assert dr.grad(size)[0] != 0
        dr.set_grad(size, 0)
        update(parameters, {key: start})


def test_assigned_vertices_stay_when_gradients_pass():
    scene, key = views_of("prb"), "shape.vertex_positions"
    parameters = mi.traverse(scene)
    points, attached = differentiated(parameters, KEY), mi.Float(parameters[key])
    update(parameters, {key: dr.detach(attached) * 2})
    dr.backward(dr.sum(attached))
    assert np.abs(np.array(dr.grad(points))).max() > 0
    assert not dr.grad_enabled(mi.traverse(scene)[key])
    np.testing.assert_array_equal(parameters[key], dr.detach(attached) * 2)


@pytest.mark.parametrize(
    ("name", "displacement", "told"),
    [
        (POINTS, None, "control_points or to_world"),
        ("to_world", None, "control_points or to_world"),
        ("cage_colour", None, "cage_colour"),
        ("displacement.data", texels, "control_points, to_world or heights"),
        (SCALE, texels, "control_points, to_world or heights"),
    ],
)
def test_lost_gradients_warn(name, displacement, told):
    key, heights = f"shape.{name}", {"displacement": displacement()} if displacement else {}
    scene = views_of("prb", COLOURED, **COLOUR, **heights)
    parameters, size = mi.traverse(scene), dr.opaque(mi.Float, 1)
    start = type(parameters[key])(parameters[key])
    dr.enable_grad(size)
    if key.endswith("data"):
        # What is assigned without a computation keeps its gradients.
        dr.enable_grad(parameters[f"shape.{SCALE}"])

    def assign():
        update(parameters, {key: mi.AffineTransform4f().scale(size) if key.endswith("to_world") else start * size})

    def differentiate(view):
        dr.backward(loss_at(scene, parameters, view))
        return dr.grad(size)[0]

    assign()
    first = differentiate(0)
    assert first != 0
    with pytest.warns(CageWarning, match=f"control cage: gradients reached {told} a second time since the last"):
        assert differentiate(1) == first
    assign()
    second = differentiate(1)
    assert second != first
    assign()
    dr.set_grad(size, 0)
    dr.backward(msub.loss_of_views(scene, parameters, loss_of, [0, 1], spp=4))
    assert dr.grad(size)[0] == pytest.approx(second, rel=1e-4)


def test_losses_of_views_add_up():
    scene = views_of("prb")
    parameters, seen = mi.traverse(scene), []

    def loss(image, view):
        seen.append(view)
        return (view + 1) * loss_of(image)

    total = msub.loss_of_views(scene, parameters, loss, [1, 0], seed=5, spp=4)
    images = [mi.render(scene, parameters, sensor=s, seed=10 + view, spp=4) for view, s in enumerate([1, 0])]
    assert seen == [0, 1]
    assert dr.allclose(total, loss_of(images[0]) + 2 * loss_of(images[1]))
    with pytest.raises(ValueError, match="no views: expected a scene with sensors"):
        msub.loss_of_views(mi.load_dict({"type": "scene"}), parameters, loss)


@pytest.mark.parametrize(
    ("given", "seen", "shading"),
    [
        ("control_points", "vertex_normals", "vertex"),
        pytest.param("control_points", "shading_coefficients", "exact", marks=exact),
        ("cage_colour", "vertex_colour", "vertex"),
        pytest.param("cage_colour", "vertex_colour", "exact", marks=exact),
    ],
)
def test_derivatives_do_not_keep_shapes_alive(given, seen, shading):
    variables, shape = dr.whos_ad(as_string=True).count("\n"), load(COLOURED, shading=shading)
    parameters = mi.traverse(shape)
    differentiated(parameters, given)
    dr.backward(dr.sum(parameters[seen]))
    alive = weakref.ref(shape)
    del shape, parameters
    gc.collect()
    assert alive() is None
    assert dr.whos_ad(as_string=True).count("\n") <= variables


@pytest.mark.parametrize(
    ("key", "with_it", "adaptive"),
    [
        ("control_points", [{"to_world": [mirror, 1, 1]} for mirror in (1, 1, -1)], {}),
        ("control_points", [{"max_edge": 0.4}], {"tessellation": "adaptive", "max_edge": 0.5}),
        ("vertex_positions", [{}], {}),
    ],
)
def test_edges_between_copies_of_vertices_are_no_outlines(key, with_it, adaptive):
    shape = load(SEAMED, **adaptive)
    parameters = mi.traverse(shape)
    for others in with_it:
        for name, value in others.items():
            parameters[name] = mi.ScalarTransform4f().scale(value) if name == "to_world" else value
        differentiated(parameters, key)
        faces, positions = buffer(shape, "faces").ravel(), buffer(shape, "vertex_positions")
        edges = np.arange(len(faces))
        following = edges + np.where(edges % 3 == 2, -2, 1)
        opposite = np.array(shape.opposite_dedge(dr.arange(mi.UInt32, len(faces))))
        assert opposite.max() < len(faces)
        np.testing.assert_array_equal(opposite[opposite], edges)
        # Both have the same ends.
        np.testing.assert_array_equal(positions[faces], positions[faces[following[opposite]]])
        assert shape.vertex_count() == len(np.unique(faces)) > len(np.unique(positions, axis=0))


# Gradients of outlines are in tests/gradients/test_outlines.py.
def test_a_user_may_assign_other_triangles():
    shape = load(SEAMED, tessellation_rate=2)
    parameters = mi.traverse(shape)
    points, whole = differentiated(parameters, "control_points"), np.array(parameters["faces"])
    update(parameters, faces=mi.UInt32(whole[: len(whole) // 2]))
    assert shape.face_count() == len(whole) // 6
    update(parameters, control_points=points * 2)
    opposite = np.array(shape.opposite_dedge(dr.arange(mi.UInt32, len(whole) // 2)))
    assert (opposite == 2**32 - 1).any()
    assert opposite[opposite != 2**32 - 1].max() < len(whole) // 2


def test_surface_area_keeps_derivatives():
    shape, size = load(SEAMED), dr.opaque(mi.Float, 1)
    parameters, before = mi.traverse(shape), shape.surface_area()[0]
    dr.enable_grad(size)
    update(parameters, control_points=mi.Float(parameters["control_points"]) * size)
    area = shape.surface_area()
    dr.backward(area)
    assert area[0] == before
    assert dr.grad(size)[0] == pytest.approx(2 * before, rel=1e-5)
    # Of a surface that has collapsed, derivatives are finite.
    flat = dr.detach(parameters["control_points"]) * mi.Float([1, 0, 0] * 8)
    dr.enable_grad(flat)
    update(parameters, control_points=flat)
    area = shape.surface_area()
    dr.backward(area)
    assert area[0] == 0
    assert dr.all(dr.isfinite(dr.grad(flat)))
