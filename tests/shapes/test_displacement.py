"""Displacement: vertices and hits against the formula in double precision, welded copies, derivatives, errors."""

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from mitsuba_subdivision import CageWarning, ControlCage, LimitSurface
from mitsuba_subdivision.cage import named_cages
from mitsuba_subdivision.cage.attributes import Attribute
from mitsuba_subdivision.device_arrays import upload
from mitsuba_subdivision.shapes.mitsuba_3_9_hook.interaction_hook import hook_problem

every_variant = pytest.mark.usefixtures("variants_all_rgb")
llvm = pytest.mark.usefixtures("variant_llvm_ad_rgb")
exact = pytest.mark.skipif(hook_problem() is not None, reason=str(hook_problem()))

# Places and normals in single precision, of a cage of size one; normals take differences of differences.
SINGLE, NORMAL = 1e-6, 2e-5
# Of central differences in double precision, whose steps are the cube root of its precision.
STEP, DIFFERENCE = 6e-6, 1e-7
# Where Newton's method ends in single precision, and what a step of its last size changes there.
HIT, HIT_NORMAL, HIT_DERIVATIVE = 1e-5, 1e-3, 1e-2
# Derivatives of normals are differences of differences over steps so wide.
WIDE, NORMAL_DERIVATIVE = 1e-3, 0.05
# Of derivatives by central differences of numbers in single precision; of hits, some go elsewhere.
GRADIENT_STEP, GRADIENT, HIT_GRADIENT = 3e-3, 2e-3, 2e-2
# Beside extraordinary vertices, in parameters; and how far normals turn there where the surface is curved.
BESIDE, AROUND = 2.0**-5, 0.04
RATE, FINE = 5, 24
SCALE = 0.15
RING = [(0, 1, 10), (1, 3, 10), (3, 2, 10), (2, 0, 10)]
IMAGE = np.random.default_rng(7).random((5, 8)).astype(np.float32)
TURN = 20.0
MATRIX = np.array([[1.2, 0.3, 0.0, 2.0], [0.0, 0.7, 0.2, -1.0], [0.1, 0.0, 1.5, 0.5], [0, 0, 0, 1]])
MIRROR = np.diag([-1.0, 1.0, 1.0, 1.0]) @ MATRIX


def faces_of(cage):
    return np.split(cage.face_vertices, np.cumsum(cage.face_sizes)[:-1])


def with_heights(cage, *, islands=False, **tags):
    """A cage with the attribute "height", and with texture coordinates: of its vertices, or an island on each face."""
    rng = np.random.default_rng(3)
    if islands:
        angles = [2 * np.pi * np.arange(size) / size for size in cage.face_sizes]
        values = [np.stack([np.cos(a), np.sin(a)], 1) * 0.3 + rng.random(2) for a in angles]
        texcoords = Attribute(np.concatenate(values), "face_varying", np.arange(len(cage.face_vertices)))
    else:
        texcoords = Attribute(cage.positions[:, :2] * [0.3, 0.4] + 0.1 * cage.positions[:, 2:], "vertex")
    height = Attribute(rng.random((cage.vertex_count, 1)), "vertex")
    return ControlCage(cage.positions, faces_of(cage), texcoords=texcoords, attributes={"height": height}, **tags)


CAGES = {
    "cube": lambda: with_heights(named_cages.cube()),
    "islands": lambda: with_heights(named_cages.cube(), islands=True),
    "creases": lambda: with_heights(named_cages.cube(), creases=RING),
    "creased islands": lambda: with_heights(named_cages.cube(), islands=True, creases=RING),
    "valence 5": lambda: with_heights(named_cages.extraordinary(5)),
    "dome": lambda: with_heights(named_cages.extraordinary(7, closed=False)),
    "pyramid": lambda: with_heights(
        ControlCage(
            [[0, 0, 0], [2, 0, 0], [2, 2, 0], [0, 2, 0], [1, 1, 2]],
            [[3, 2, 1, 0], [0, 1, 4], [1, 2, 4], [2, 3, 4], [3, 0, 4]],
        ),
        islands=True,
    ),
}


def bitmap(image=IMAGE, **more):
    to_uv = mi.ScalarTransform3f().rotate(TURN)
    return {"type": "bitmap", "data": upload(mi.TensorXf, image[..., None]), "raw": True, "to_uv": to_uv, **more}


def make(cage, displacement, to_world=None, **parameters):
    placed = {} if to_world is None else {"to_world": mi.ScalarTransform4f(to_world)}
    return mi.load_dict(
        {
            "type": "subdivision",
            **cage.as_properties(mi),
            "tessellation_rate": RATE,
            "displacement": displacement,
            "displacement_scale": SCALE,
            **placed,
            **parameters,
        }
    )


def bilinear(uv, image=IMAGE):
    """Mitsuba's bitmap texture, repeated and turned, in double precision."""
    turn = np.deg2rad(TURN)
    matrix = np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]])
    height, width = image.shape
    x, y = (uv @ matrix.T * [width, height] - 0.5).T
    i, j = np.floor(x).astype(int), np.floor(y).astype(int)
    s, t = x - i, y - j
    at = [[image[(j + b) % height, (i + a) % width].astype(np.float64) for a in (0, 1)] for b in (0, 1)]
    return (1 - t) * ((1 - s) * at[0][0] + s * at[0][1]) + t * ((1 - s) * at[1][0] + s * at[1][1])


class Truth:
    """The displaced surface by its formula, of points and normals in double precision."""

    def __init__(self, cage, kind, to_world=None, scheme=None):
        self.surface = LimitSurface(cage, scheme)
        self.kind = kind
        self.matrix = np.eye(4) if to_world is None else to_world

    def height(self, corner, uv):
        if self.kind == "vertex_height":
            return self.surface.channel("height").evaluate(corner, uv)[:, 0]
        s, t = self.surface.channel("texcoords").evaluate(corner, uv).T
        return np.sin(3 * s) * np.cos(2 * t) if self.kind == "waves" else bilinear(np.stack([s, t], axis=1))

    def points(self, corner, uv):
        found = self.surface._evaluate_from(corner, uv, "stabilized", np.float64)
        moved = found.p + SCALE * self.height(corner, uv)[:, None] * found.n
        return moved @ self.matrix[:3, :3].T + self.matrix[:3, 3]

    def normals(self, corner, uv):
        du, dv = (
            self.points(corner, uv + step) - self.points(corner, uv - step)
            for step in np.array([[[STEP, 0]], [[0, STEP]]])
        )
        n = np.cross(du, dv)
        return n / np.linalg.norm(n, axis=1, keepdims=True) * np.sign(np.linalg.det(self.matrix[:3, :3]))


def vertices(shape):
    parameters = mi.traverse(shape)
    return tuple(np.array(parameters[f"vertex_{name}"]).reshape(-1, 3) for name in ("positions", "normals"))


def locations(cage, rate=RATE, scheme=None):
    surface = LimitSurface(cage, scheme)
    table = surface.sampling(rate)
    return (surface.attribute_table(table).locate or table.locations)()


def heights(kind):
    return kind if kind == "vertex_height" else bitmap()


@every_variant
@pytest.mark.parametrize(
    ("kind", "to_world"),
    [("vertex_height", None), ("bitmap", None), ("vertex_height", MATRIX), ("bitmap", MIRROR)],
    ids=["heights", "bitmap", "heights, sheared", "bitmap, mirrored"],
)
@pytest.mark.parametrize("name", CAGES)
def test_vertices_lie_on_the_displaced_surface_with_its_normals(name, to_world, kind):
    cage = CAGES[name]()
    corner, uv = locations(cage)
    p, n = vertices(make(cage, heights(kind), to_world))
    truth = Truth(cage, kind, to_world)
    inside = (np.minimum(uv, 1 - uv) > STEP).all(axis=1)
    assert inside.sum() > len(uv) / 4
    np.testing.assert_allclose(p[inside], truth.points(corner[inside], uv[inside]), rtol=0, atol=6 * SINGLE)
    np.testing.assert_allclose(n[inside], truth.normals(corner[inside], uv[inside]), rtol=0, atol=NORMAL)


def unit_islands(cage, **tags):
    """A cage of quadrilaterals; its texture coordinates are parameters of the elements, plus the element's number."""
    square = np.array([[0, 0], [1, 0], [1, 1], [0, 1]], dtype=float)
    values = np.concatenate([square + np.array([face, 0]) for face in range(len(cage.face_sizes))])
    texcoords = Attribute(values, "face_varying", np.arange(len(values)))
    return ControlCage(cage.positions, faces_of(cage), texcoords=texcoords, face_varying="all", **tags)


def view(resolution=48, fov=30):
    y, x = (np.indices((resolution, resolution)).reshape(2, -1) + 0.5) / resolution
    to_world = mi.ScalarTransform4f().look_at([2.2, -3.2, 2.0], [0, 0, 0], [0, 0, 1])
    sensor = mi.load_dict({"type": "perspective", "fov": fov, "to_world": to_world})
    return sensor.sample_ray(0, 0.5, mi.Point2f(x, y), mi.Point2f(0.5))[0]


def hits(shape, flags=mi.RayFlags.All):
    rays = view()
    si = mi.load_dict({"type": "scene", "shape": shape}).ray_intersect(rays, int(flags), coherent=True)
    # In one kernel: each of its values alone would have one of its own.
    dr.eval(rays, si)
    return rays, si, np.array(si.is_valid())


def waves():
    """A texture in Python, without a gradient of its own."""

    class Waves(mi.Texture):
        def __init__(self, props):
            mi.Texture.__init__(self, props)

        def eval_1(self, si, active=True):  # noqa: ARG002 - as Mitsuba calls it
            return dr.sin(3 * si.uv.x) * dr.cos(2 * si.uv.y)

    mi.register_texture("waves", Waves)
    return mi.load_dict({"type": "waves"})


@exact
@llvm
@pytest.mark.parametrize(
    ("name", "to_world", "kind"),
    [
        ("cube", None, "bitmap"),
        ("creases", MIRROR, "bitmap"),
        ("extraordinary", None, "bitmap"),
        ("cube", MIRROR, "waves"),
        ("torus", None, "waves"),
        ("extraordinary", MIRROR, "waves"),
    ],
)
def test_hits_are_on_the_displaced_surface_with_its_normals_and_derivatives(name, to_world, kind):
    plain = {
        "cube": named_cages.cube,
        "creases": named_cages.cube,
        "torus": lambda: named_cages.torus(6, 5),
        "extraordinary": lambda: named_cages.extraordinary(5),
    }[name]()
    cage = unit_islands(plain, **({"creases": RING} if name == "creases" else {}))
    matrix = np.eye(4) if to_world is None else np.diag([-1.0, 1, 1, 1]) @ np.diag([1.0, 0.8, 1.2, 1])
    texture = bitmap() if kind == "bitmap" else waves()
    shape = make(cage, texture, matrix, shading="exact", tessellation_rate=FINE)
    rays, si, valid = hits(shape, mi.RayFlags.All | mi.RayFlags.dNSdUV)
    face = np.floor(np.array(si.uv.x)).astype(int)
    uv = np.stack([np.array(si.uv.x) - face, np.array(si.uv.y)], axis=1)
    # Beside seams triangles go to the mean of both sides' heights, and rays may pass their own side's surface by.
    inside = valid & (np.minimum(uv, 1 - uv) > 1 / FINE).all(axis=1)
    corner, uv = cage.topology.face_offsets[face[inside]], uv[inside]
    truth = Truth(cage, kind, matrix)
    o, d, n, dp_du, dp_dv, dn_du, dn_dv = (
        np.array(each).T[inside] for each in (rays.o, rays.d, si.sh_frame.n, si.dp_du, si.dp_dv, si.dn_du, si.dn_dv)
    )
    way = truth.points(corner, uv) - o
    off = np.linalg.norm(way - (way * d).sum(1, keepdims=True) * d, axis=1)
    on_line = off < HIT
    assert inside.sum() > 300
    # Some rays pass along outlines, of which each island's rim is one.
    assert on_line.mean() > 0.95
    corner, uv = corner[on_line], uv[on_line]
    assert np.quantile(np.linalg.norm(n[on_line] - truth.normals(corner, uv), axis=1), 0.99) < HIT_NORMAL
    for found, step in ((dp_du, [STEP, 0]), (dp_dv, [0, STEP])):
        expected = (truth.points(corner, uv + step) - truth.points(corner, uv - step)) / (2 * STEP)
        assert np.quantile(np.linalg.norm(found[on_line] - expected, axis=1), 0.99) < HIT_DERIVATIVE
    if kind == "waves":
        # Without lines between texels, at which slopes jump.
        for found, step in ((dn_du, [WIDE, 0]), (dn_dv, [0, WIDE])):
            expected = (truth.normals(corner, uv + step) - truth.normals(corner, uv - step)) / (2 * WIDE)
            assert np.quantile(np.linalg.norm(found[on_line] - expected, axis=1), 0.95) < NORMAL_DERIVATIVE


def from_inside(resolution=64):
    """Rays in all directions from the middle."""
    z, a = np.meshgrid(np.linspace(-0.999, 0.999, resolution), np.linspace(0, 2 * np.pi, resolution))
    d = np.stack([np.sqrt(1 - z**2) * np.cos(a), np.sqrt(1 - z**2) * np.sin(a), z]).reshape(3, -1)
    return mi.Ray3f(mi.Point3f(0), mi.Vector3f(d))


@every_variant
@pytest.mark.parametrize(
    ("kind", "shading"), [pytest.param("vertex_height", "exact", marks=exact), ("bitmap", "vertex")]
)
@pytest.mark.parametrize("triangles", [{"tessellation_rate": RATE}, {"tessellation": "adaptive", "chord_error": 0.03}])
@pytest.mark.parametrize("name", ["islands", "creases", "creased islands", "pyramid"])
def test_vertices_in_one_place_stay_in_one_place_bit_by_bit(name, triangles, kind, shading):
    cage = CAGES[name]()
    displaced = {**cage.as_properties(mi), "type": "subdivision", **triangles, "shading": shading}
    shape = mi.load_dict({**displaced, "displacement": heights(kind), "displacement_scale": SCALE})
    parameters = mi.traverse(shape)
    after = np.array(parameters["vertex_positions"]).reshape(-1, 3)
    parameters["displacement_scale"] = [0.0]
    parameters.update()
    before = np.array(parameters["vertex_positions"]).reshape(-1, 3)
    _, place = np.unique(before, axis=0, return_inverse=True)
    _, moved = np.unique(after, axis=0, return_inverse=True)
    assert place.max() < len(before) - 1 or shading == "exact"
    # The same vertices fall together before and after.
    pairs = np.unique(np.stack([place.ravel(), moved.ravel()], axis=1), axis=0)
    assert len(pairs) == place.max() + 1 == moved.max() + 1


@llvm
@pytest.mark.parametrize("shading", ["vertex", pytest.param("exact", marks=exact)])
def test_no_ray_escapes_through_a_closed_displaced_surface(shading):
    shape = make(CAGES["creased islands"](), bitmap(), shading=shading, tessellation_rate=9)
    rays = from_inside(512)
    assert dr.all(mi.load_dict({"type": "scene", "shape": shape}).ray_test(rays))


@pytest.mark.core
@every_variant
def test_a_crease_moves_by_the_mean_of_its_sides():
    sharp = [
        (a, b, 10)
        for a, b in [(0, 1), (1, 3), (3, 2), (2, 0), (4, 5), (5, 7), (7, 6), (6, 4), (0, 4), (1, 5), (2, 6), (3, 7)]
    ]
    cube = named_cages.cube()
    flat = ControlCage(
        cube.positions, faces_of(cube), creases=sharp, attributes={"one": Attribute(np.ones((8, 1)), "vertex")}
    )
    (p, n), (before, _) = vertices(make(flat, "vertex_one")), vertices(make(flat, "vertex_one", displacement_scale=0.0))
    on_side = np.abs(before) > np.abs(cube.positions).max() - SINGLE
    sides = on_side.sum(axis=1, keepdims=True)
    # By the whole height on faces, by halves along edges, by thirds at corners.
    assert set(sides.ravel()) == {1, 2, 3}
    np.testing.assert_allclose(np.abs(p) - np.abs(before), SCALE / sides * on_side, rtol=0, atol=SINGLE)
    np.testing.assert_allclose(np.abs(n).max(axis=1), 1, rtol=0, atol=SINGLE)


@every_variant
def test_no_height_moves_nothing():
    cage = CAGES["creased islands"]()
    plain = mi.load_dict({"type": "subdivision", **cage.as_properties(mi), "tessellation_rate": RATE})
    p, n = vertices(make(cage, bitmap(), displacement_scale=0.0))
    np.testing.assert_array_equal(p, vertices(plain)[0])
    np.testing.assert_allclose(n, vertices(plain)[1], rtol=0, atol=SINGLE)


@every_variant
@pytest.mark.parametrize("flip", [False, True])
def test_flipped_normals_move_the_surface_the_same_way(flip):
    cage = CAGES["cube"]()
    p, _ = vertices(make(cage, "vertex_height", flip_normals=flip))
    np.testing.assert_array_equal(p, vertices(make(cage, "vertex_height"))[0])


@pytest.mark.usefixtures("no_other_scene")
@every_variant
def test_nothing_moves_where_there_is_no_normal():
    # Two faces glued back to back: the surface is folded along the border between them.
    points = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]], dtype=float)
    heights = {"one": Attribute(np.ones((4, 1)), "vertex")}
    cage = ControlCage(points, [[0, 1, 2, 3], [3, 2, 1, 0]], attributes=heights)
    p, n = vertices(make(cage, "vertex_one", tessellation_rate=4))
    folded = ~n.any(axis=1)
    assert folded.sum() == 16
    np.testing.assert_array_equal(p[folded, 2], 0)
    np.testing.assert_allclose(np.abs(p[~folded, 2]), SCALE, rtol=0, atol=SINGLE)


PARAMETERS = ["control_points", "to_world", "displacement.data", "displacement_scale"]


def moving(parameters, by, rng, along=None):
    """Function that moves a parameter along a direction by so many steps."""
    is_matrix = by.endswith("to_world")
    start = parameters[by].matrix if is_matrix else parameters[by]
    start = dr.opaque(start)
    if along is None:
        along = rng.normal(size=np.array(start).shape)
    if is_matrix:
        along[3] = 0
    along = type(start)(along.tolist()) if is_matrix else upload(type(start), along)

    def assign(step):
        value = start + along * step
        parameters[by] = mi.AffineTransform4f(value) if is_matrix else value
        parameters.update()

    return assign


def derivatives(assign, loss):
    """Of a loss, backward and forward, and by central differences."""
    found = []
    for is_forward in (False, True):
        step = mi.Float(0)
        dr.enable_grad(step)
        assign(step)
        value = loss()
        if is_forward:
            dr.forward(step)
        else:
            dr.backward(value)
        found.append(np.array(dr.grad(value if is_forward else step)).ravel()[0])
    ends = []
    with dr.suspend_grad():
        for step in (GRADIENT_STEP, -GRADIENT_STEP):
            assign(mi.Float(step))
            ends.append(np.array(loss()).ravel()[0])
    return *found, (ends[0] - ends[1]) / (2 * GRADIENT_STEP)


@llvm
@pytest.mark.parametrize("of", ["positions", "normals"])
@pytest.mark.parametrize("by", PARAMETERS)
@pytest.mark.parametrize("name", ["creased islands", "valence 5"])
def test_derivatives_of_vertices_are_central_differences(name, by, of, np_rng):
    parameters = mi.traverse(make(CAGES[name](), bitmap(), MATRIX))
    size = dr.width(parameters[f"vertex_{of}"])
    weights = upload(mi.Float, np_rng.normal(size=size).astype(np.float32) / np.sqrt(size))
    backward, forward, difference = derivatives(
        moving(parameters, by, np_rng), lambda: dr.sum(weights * parameters[f"vertex_{of}"])
    )
    assert backward == pytest.approx(difference, abs=GRADIENT)
    assert forward == pytest.approx(backward, abs=1e-2 * GRADIENT)


@exact
@llvm
@pytest.mark.parametrize("by", ["control_points", "to_world", "displacement_scale", "cage_height"])
def test_derivatives_of_normals_at_hits_are_central_differences(by, np_rng):
    # Slopes of the attribute are smooth. Those of a bitmap jump along lines between its texels' centres, and what rays
    # meet does not know that the lines move.
    scene = mi.load_dict({"type": "scene", "shape": make(CAGES["cube"](), "vertex_height", shading="exact")})
    parameters = mi.traverse(scene)
    rays = view(32, fov=12)
    weights = upload(mi.Normal3f, (np_rng.normal(size=(3, 32 * 32)).astype(np.float32) / 32).T)

    def loss():
        si = scene.ray_intersect(rays, int(mi.RayFlags.All), coherent=True)
        return dr.sum(dr.dot(weights, si.sh_frame.n))

    key = next(key for key in parameters.keys() if key.endswith(by))  # noqa: SIM118 - it iterates over pairs
    backward, forward, difference = derivatives(moving(parameters, key, np_rng), loss)
    assert backward == pytest.approx(difference, abs=HIT_GRADIENT)
    assert forward == pytest.approx(backward, abs=1e-3)


@exact
@llvm
def test_derivatives_of_normals_at_hits_reach_a_bitmap(np_rng):
    scene = mi.load_dict({"type": "scene", "shape": make(CAGES["cube"](), bitmap(), shading="exact")})
    parameters = mi.traverse(scene)
    rays = view(32, fov=12)
    weights = upload(mi.Normal3f, (np_rng.normal(size=(3, 32 * 32)).astype(np.float32) / 32).T)

    def loss():
        # Where points stay on the surface, it does not matter to derivatives that slopes jump between texels.
        flags = mi.RayFlags.All | mi.RayFlags.FollowShape
        return dr.sum(dr.dot(weights, scene.ray_intersect(rays, int(flags), coherent=True).sh_frame.n))

    key = next(key for key in parameters.keys() if key.endswith("data"))  # noqa: SIM118 - it iterates over pairs
    backward, forward, _ = derivatives(moving(parameters, key, np_rng), loss)
    assert abs(backward) > GRADIENT
    assert forward == pytest.approx(backward, abs=1e-2 * GRADIENT)


@llvm
@pytest.mark.parametrize("by", ["displacement.data", "displacement_scale", "control_points"])
def test_each_of_two_losses_after_one_update_has_its_gradient(by, np_rng):
    parameters = mi.traverse(make(CAGES["creased islands"](), bitmap()))
    dr.enable_grad(parameters[by])
    parameters.set_dirty(by)
    parameters.update()
    size = dr.width(parameters["vertex_positions"])
    weights = [upload(mi.Float, np_rng.normal(size=size)) for _ in range(2)]
    for name in ("positions", "normals"):
        found = []
        for weight in [*weights, weights[0] + weights[1]]:
            dr.backward(dr.sum(weight * parameters[f"vertex_{name}"]))
            found.append(np.array(dr.grad(parameters[by])).ravel())
            dr.clear_grad(parameters[by])
        assert np.abs(found[0]).max() > 0
        np.testing.assert_allclose(found[0] + found[1], found[2], rtol=0, atol=1e-4 * np.abs(found[2]).max())


@llvm
@pytest.mark.parametrize("by", ["displacement.data", "displacement_scale"])
def test_gradients_that_cannot_go_on_from_heights_are_warned_of(by):
    parameters = mi.traverse(make(CAGES["cube"](), bitmap()))
    factor = mi.Float(1)
    dr.enable_grad(factor)
    parameters[by] = parameters[by] * factor
    parameters.update()
    dr.backward(dr.sum(parameters["vertex_positions"]))
    assert factor.grad[0] != 0
    with pytest.warns(CageWarning, match="gradients came to control_points, to_world or heights a second time"):
        dr.backward(dr.sum(parameters["vertex_positions"]))


@exact
@llvm
@pytest.mark.parametrize("by", ["displacement.data", "displacement_scale"])
def test_interactions_detached_from_shapes_have_no_derivatives_by_heights(by):
    scene = mi.load_dict({"type": "scene", "shape": make(CAGES["cube"](), bitmap(), shading="exact")})
    parameters = mi.traverse(scene)
    key = next(key for key in parameters.keys() if key.endswith(by))  # noqa: SIM118 - it iterates over pairs
    dr.enable_grad(parameters[key])
    parameters.set_dirty(key)
    parameters.update()
    gradients = []
    for more in (0, mi.RayFlags.DetachShape):
        si = scene.ray_intersect(view(16), int(mi.RayFlags.All | more), coherent=True)
        dr.backward(dr.sum(si.sh_frame.n.x))
        gradients.append(np.abs(np.array(dr.grad(parameters[key]))).sum())
        dr.clear_grad(parameters[key])
    assert gradients[0] > 0
    assert gradients[1] == 0


@every_variant
def test_updates_of_heights_and_scale_move_the_surface():
    cage = CAGES["islands"]()
    shape = make(cage, bitmap())
    parameters = mi.traverse(shape)
    other = 1 - IMAGE[..., None]
    parameters["displacement.data"] = upload(mi.TensorXf, other)
    parameters.update()
    for found, expected in zip(vertices(shape), vertices(make(cage, bitmap(other[..., 0]))), strict=True):
        np.testing.assert_array_equal(found, expected)
    parameters["displacement_scale"] = 0.4
    parameters.update()
    expected = vertices(make(cage, bitmap(other[..., 0]), displacement_scale=0.4))
    for found, each in zip(vertices(shape), expected, strict=True):
        np.testing.assert_allclose(found, each, rtol=0, atol=SINGLE)
    parameters["displacement_scale"] = np.nan
    with pytest.raises(
        ValueError, match=r'parameter "displacement_scale": \[nan\] was given; expected a finite number'
    ):
        parameters.update()


@exact
@llvm
@pytest.mark.parametrize("refused", ["to_world", "control_points", "cage_height"])
def test_an_update_that_is_refused_changes_nothing_else(refused):
    """Rays met another surface than that of the triangles."""
    shape = make(CAGES["cube"](), "vertex_height", shading="exact")
    parameters, before = mi.traverse(shape), vertices(shape)
    displacement = shape._exact.kernel.displacement
    scale, height = np.array(displacement.scale), np.array(displacement.channel.values.flat)
    given = {
        "displacement_scale": 0.5,
        "cage_height": 1 + np.array(parameters["cage_height"]),
        "to_world": mi.ScalarTransform4f().translate([1, 0, 0]),
    }
    given |= {
        "to_world": {"to_world": mi.AffineTransform4f(mi.Matrix4f(np.diag([1.0, 1, 0, 1])))},
        "control_points": {"control_points": np.full(24, np.nan)},
        "cage_height": {"cage_height": np.full(8, np.nan)},
    }[refused]
    for name, value in given.items():
        parameters[name] = value
    with pytest.raises(ValueError, match=f'parameter "{refused}"'):
        parameters.update()
    np.testing.assert_array_equal(displacement.scale, scale)
    np.testing.assert_array_equal(displacement.channel.values.flat, height)
    for found, expected in zip(vertices(shape), before, strict=True):
        np.testing.assert_array_equal(found, expected)


def other_values(cage):
    """The cage with heights and texture coordinates of its own elsewhere."""
    changed = {"height": 1 - cage.attributes["height"].values, "texcoords": 0.9 * cage.texcoords.values + 0.1}
    new = {
        name: Attribute(changed[name], given.interpolation, given.indices)
        for name, given in {**cage.attributes, "texcoords": cage.texcoords}.items()
    }
    texcoords = new.pop("texcoords")
    return ControlCage(
        cage.positions, faces_of(cage), texcoords=texcoords, attributes=new, creases=cage.tags.creases(cage.topology)
    )


def assign_cage(shape, cage):
    parameters = mi.traverse(shape)
    for name, given in {**cage.attributes, "texcoords": cage.texcoords}.items():
        parameters[f"cage_{name}"] = upload(type(parameters[f"cage_{name}"]), given.values)
    parameters.update()


@every_variant
@pytest.mark.parametrize("kind", ["vertex_height", "bitmap"])
@pytest.mark.parametrize("triangles", [{}, {"tessellation": "adaptive", "chord_error": 0.03}], ids=["even", "adaptive"])
def test_the_surface_follows_what_heights_depend_on(kind, triangles):
    cage = CAGES["creased islands"]()

    def made(cage):
        given = {"displacement": heights(kind), "displacement_scale": SCALE}
        rate = triangles or {"tessellation_rate": RATE}
        return mi.load_dict({"type": "subdivision", **cage.as_properties(mi), **given, **rate})

    shape, before = made(cage), vertices(made(cage))
    assign_cage(shape, other_values(cage))
    if triangles:
        # The new heights ask for other triangles.
        shape.retessellate()
    expected = vertices(made(other_values(cage)))
    for found, each in zip(vertices(shape), expected, strict=True):
        np.testing.assert_allclose(found, each, rtol=0, atol=NORMAL)
    assert len(before[0]) != len(expected[0]) or np.abs(before[0] - expected[0]).max() > 0.01


@every_variant
@pytest.mark.parametrize("triangles", [{}, {"tessellation": "adaptive", "chord_error": 0.03}], ids=["even", "adaptive"])
def test_a_texture_of_one_value_displaces_as_a_bitmap_of_that_value(triangles):
    cage = {"type": "subdivision", **CAGES["cube"]().as_properties(mi), "displacement_scale": SCALE, **triangles}
    one, other = (
        mi.load_dict({**cage, "displacement": given})
        for given in ({"type": "uniform", "value": 0.3}, bitmap(np.full_like(IMAGE, 0.3)))
    )
    for found, expected in zip(vertices(one), vertices(other), strict=True):
        np.testing.assert_allclose(found, expected, rtol=0, atol=NORMAL)


@exact
@llvm
@pytest.mark.parametrize("kind", ["vertex_height", "bitmap"])
def test_hits_follow_what_heights_depend_on(kind):
    cage = CAGES["cube"]()
    shape = make(cage, heights(kind), shading="exact")
    assign_cage(shape, other_values(cage))
    expected = make(other_values(cage), heights(kind), shading="exact")
    (_, found, valid), (_, at, others) = hits(shape), hits(expected)
    np.testing.assert_array_equal(valid, others)
    assert valid.sum() > 100
    off = np.linalg.norm(np.array(found.sh_frame.n - at.sh_frame.n)[:, valid], axis=0)
    # A few rays along outlines meet the surface elsewhere.
    assert np.quantile(off, 0.99) < HIT_NORMAL


@llvm
@pytest.mark.parametrize("of", ["positions", "normals"])
@pytest.mark.parametrize("name", ["creased islands", "valence 5"])
def test_derivatives_of_vertices_by_heights_at_the_cage_are_central_differences(name, of, np_rng):
    parameters = mi.traverse(make(CAGES[name](), "vertex_height", MATRIX))
    size = dr.width(parameters[f"vertex_{of}"])
    weights = upload(mi.Float, np_rng.normal(size=size).astype(np.float32) / np.sqrt(size))
    backward, forward, difference = derivatives(
        moving(parameters, "cage_height", np_rng), lambda: dr.sum(weights * parameters[f"vertex_{of}"])
    )
    assert backward == pytest.approx(difference, abs=GRADIENT)
    assert forward == pytest.approx(backward, abs=1e-2 * GRADIENT)


@llvm
@pytest.mark.parametrize("shading", ["vertex", pytest.param("exact", marks=exact)])
def test_each_of_two_losses_has_its_gradient_by_heights_at_the_cage(shading, np_rng):
    parameters = mi.traverse(make(CAGES["creased islands"](), "vertex_height", shading=shading))
    dr.enable_grad(parameters["cage_height"])
    parameters.set_dirty("cage_height")
    parameters.update()
    size = dr.width(parameters["vertex_positions"])
    weights = [upload(mi.Float, np_rng.normal(size=size)) for _ in range(2)]
    found = []
    for weight in [*weights, weights[0] + weights[1]]:
        dr.backward(dr.sum(weight * parameters["vertex_positions"]))
        found.append(np.array(dr.grad(parameters["cage_height"])))
        dr.clear_grad(parameters["cage_height"])
    assert np.abs(found[0]).max() > 0
    np.testing.assert_allclose(found[0] + found[1], found[2], rtol=0, atol=1e-4 * np.abs(found[2]).max())


@every_variant
@pytest.mark.parametrize("valence", [3, 5, 6, 9])
def test_normals_at_extraordinary_vertices_go_with_those_around_them(valence):
    cage = with_heights(named_cages.extraordinary(valence))
    corner, uv = locations(cage)
    _, n = vertices(make(cage, "vertex_height"))
    truth = Truth(cage, "vertex_height")
    at = np.flatnonzero((uv == 0).all(axis=1))
    level = truth.surface._evaluate_from(corner[at], uv[at], "stabilized", np.float64).level
    at = at[level == -1]
    t = truth.surface.patches.elements
    turns = [corner[at]]
    for _ in range(valence - 1):
        turns.append(t.twin[t.prev[turns[-1]]])
    of_valence = (t.twin[t.prev[turns[-1]]] == turns[0]) & np.all([turn != turns[0] for turn in turns[1:]], axis=0)
    around = sum(truth.normals(turn[of_valence], np.full((of_valence.sum(), 2), BESIDE)) for turn in turns)
    around /= np.linalg.norm(around, axis=1, keepdims=True)
    assert of_valence.any()
    # Curvature, which the normal there does without, turns it a little.
    assert np.linalg.norm(n[at][of_valence] - around, axis=1).max() < AROUND


@every_variant
def test_normals_where_seams_end_at_extraordinary_vertices_are_those_of_the_limit_surface():
    cage = CAGES["islands"]()
    plain = mi.load_dict({"type": "subdivision", **cage.as_properties(mi), "tessellation_rate": RATE})
    at = (locations(cage)[1] == 0).all(axis=1)
    corners = np.linalg.norm(vertices(plain)[0] - LimitSurface(cage).evaluate(0, [[0, 0]]).p, axis=1) < SINGLE
    assert (corners & at).sum() == 3
    np.testing.assert_allclose(
        vertices(make(cage, bitmap()))[1][corners], vertices(plain)[1][corners], rtol=0, atol=SINGLE
    )


@every_variant
def test_normals_at_extraordinary_vertices_of_a_plane_are_limits():
    dome = named_cages.extraordinary(5, closed=False)
    flat = with_heights(ControlCage(dome.positions * [1, 1, 0], faces_of(dome)))
    corner, uv = locations(flat)
    _, n = vertices(make(flat, "vertex_height"))
    truth = Truth(flat, "vertex_height")
    at = np.flatnonzero((uv == 0).all(axis=1))
    level = truth.surface._evaluate_from(corner[at], uv[at], "stabilized", np.float64).level
    at = at[level == -1]
    near = truth.normals(corner[at], np.full((len(at), 2), 2 * STEP))
    np.testing.assert_allclose(n[at], near, rtol=0, atol=1e-3)


ERRORS = {
    "an unknown attribute": (
        {"displacement": "vertex_bumps"},
        r'no attribute "vertex_bumps"; expected one of "vertex_height", or a texture',
    ),
    "an attribute by its own name": (
        {"displacement": "height"},
        r'no attribute "height"; expected one of "vertex_height", or a texture',
    ),
    "an attribute of colours": (
        {"displacement": "vertex_colour"},
        r"3 numbers per value; expected an attribute of one",
    ),
    "a number": ({"displacement": 0.5}, r'"displacement" is 0.5; expected a texture, or the name of an attribute'),
    "a BSDF": (
        {"displacement": {"type": "diffuse"}},
        r'"displacement" is SmoothDiffuse; expected a texture, or the name',
    ),
    "a scale alone": ({"displacement_scale": 0.5}, r'"displacement_scale" needs "displacement"'),
    "a scale that is no number": (
        {"displacement": "vertex_height", "displacement_scale": "high"},
        r'"displacement_scale" is \'high\'; expected a number',
    ),
    "an infinite scale": (
        {"displacement": "vertex_height", "displacement_scale": float("inf")},
        r'"displacement_scale" is inf; expected a finite number',
    ),
    "Stam's form": (
        {"displacement": "vertex_height", "evaluator": "stam", "sample_offset": 0.1},
        r'"displacement" and "evaluator" contradict each other',
    ),
    "an offset": (
        {"displacement": "vertex_height", "sample_offset": 0.1},
        r'"displacement" and "sample_offset" contradict each other',
    ),
}


@every_variant
@pytest.mark.parametrize("name", ERRORS)
def test_errors_say_what_was_expected(name):
    parameters, message = ERRORS[name]
    plain = named_cages.cube()
    attributes = {"height": Attribute(np.ones((8, 1)), "vertex"), "colour": Attribute(np.ones((8, 3)), "vertex")}
    cage = ControlCage(plain.positions, faces_of(plain), attributes=attributes)
    with pytest.raises((ValueError, RuntimeError), match=message):
        mi.load_dict({"type": "subdivision", **cage.as_properties(mi), **parameters})


@every_variant
def test_a_texture_needs_texture_coordinates():
    with pytest.raises(RuntimeError, match=r'parameter "displacement": a texture was given, and .* no texture coord'):
        make(named_cages.cube(), bitmap())


@pytest.mark.threads
@every_variant
def test_scenes_in_xml_have_displacement_too(tmp_path):
    cage = CAGES["islands"]()
    cage = ControlCage(cage.positions, faces_of(cage), texcoords=cage.texcoords)
    cage.save(tmp_path / "cage.obj")
    mi.util.write_bitmap(str(tmp_path / "heights.exr"), IMAGE[..., None], write_async=False)
    text = f"""<scene version="3.0.0"><shape type="subdivision">
        <string name="filename" value="{tmp_path / "cage.obj"}"/>
        <integer name="tessellation_rate" value="{RATE}"/>
        <texture type="bitmap" name="displacement">
            <string name="filename" value="{tmp_path / "heights.exr"}"/><boolean name="raw" value="true"/>
            <transform name="to_uv"><rotate value="0, 0, 1" angle="{TURN}"/></transform>
        </texture>
        <float name="displacement_scale" value="{SCALE}"/>
    </shape></scene>"""
    shape = mi.load_string(text).shapes()[0]
    p, _ = vertices(shape)
    np.testing.assert_allclose(p, vertices(make(cage, bitmap()))[0], rtol=0, atol=2 * SINGLE)


@llvm
@pytest.mark.parametrize("scheme", ["loop", "doo_sabin"])
def test_surfaces_of_other_schemes_are_displaced(scheme):
    plain = named_cages.extraordinary_triangles(7) if scheme == "loop" else named_cages.cube()
    cage = with_heights(plain)
    corner, uv = locations(cage, scheme=scheme)
    p, n = vertices(make(cage, "vertex_height", scheme=scheme))
    truth = Truth(cage, "vertex_height", scheme=scheme)
    inside = truth.surface.scheme.domain.inside(uv) > 2 * STEP
    assert inside.sum() > 90
    np.testing.assert_allclose(p[inside], truth.points(corner[inside], uv[inside]), rtol=0, atol=6 * SINGLE)
    np.testing.assert_allclose(n[inside], truth.normals(corner[inside], uv[inside]), rtol=0, atol=NORMAL)


@every_variant
def test_a_cage_far_from_the_origin_has_the_same_normals():
    cage = CAGES["valence 5"]()
    far = ControlCage(cage.positions + 1000, faces_of(cage), texcoords=cage.texcoords, attributes=cage.attributes)
    (p, n), (q, m) = (vertices(make(each, "vertex_height")) for each in (cage, far))
    np.testing.assert_allclose(n, m, rtol=0, atol=NORMAL)
    # Units in the last place of a thousand.
    np.testing.assert_allclose(p + 1000, q, rtol=0, atol=2e-4)
