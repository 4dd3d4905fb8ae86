"""Displacement: vertices and hits against the formula in double precision, welded copies, derivatives, errors."""

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from mitsuba_subdivision import Attribute, ControlCage, LimitSurface, upload
from mitsuba_subdivision.cage import named_cages
from reference.refined_cages import tagged
from shapes.cages import RING, cube, load
from shapes.scenes import all_directions, perspective, rays, scene_with, vertices, waves
from shapes.updates import differentiated, update
from shapes.variants import every_variant, exact, exact_llvm, llvm, shadings

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
IMAGE = np.random.default_rng(7).random((5, 8)).astype(np.float32)
TURN = 20.0
MATRIX = np.array([[1.2, 0.3, 0.0, 2.0], [0.0, 0.7, 0.2, -1.0], [0.1, 0.0, 1.5, 0.5], [0, 0, 0, 1]])
MIRROR = np.diag([-1.0, 1.0, 1.0, 1.0]) @ MATRIX
STRETCHED = np.diag([-1.0, 0.8, 1.2, 1.0])
TRIANGLES = [{}, {"tessellation": "adaptive", "chord_error": 0.03}]


def with_heights(cage, *, islands=False, **tags):
    """A cage with the attribute "height", and with texture coordinates: of its vertices, or an island on each face."""
    rng = np.random.default_rng(3)
    if islands:
        angles = [2 * np.pi * np.arange(size) / size for size in cage.face_sizes]
        values = [np.stack([np.cos(a), np.sin(a)], 1) * 0.3 + rng.random(2) for a in angles]
        texcoords = Attribute(np.concatenate(values), "face_varying")
    else:
        texcoords = Attribute(cage.positions[:, :2] * [0.3, 0.4] + 0.1 * cage.positions[:, 2:])
    return tagged(cage, texcoords=texcoords, attributes={"height": rng.random((cage.vertex_count, 1))}, **tags)


def pyramid():
    points = [[0, 0, 0], [2, 0, 0], [2, 2, 0], [0, 2, 0], [1, 1, 2]]
    return ControlCage(points, [[3, 2, 1, 0], [0, 1, 4], [1, 2, 4], [2, 3, 4], [3, 0, 4]])


CAGES = {
    "cube": lambda: with_heights(cube()),
    "islands": lambda: with_heights(cube(), islands=True),
    "creases": lambda: with_heights(cube(), creases=RING),
    "creased islands": lambda: with_heights(cube(), islands=True, creases=RING),
    "valence 5": lambda: with_heights(named_cages.extraordinary(5)),
    "dome": lambda: with_heights(named_cages.extraordinary(7, closed=False)),
    "pyramid": lambda: with_heights(pyramid(), islands=True),
    "loop": lambda: with_heights(named_cages.extraordinary_triangles(7)),
    "doo_sabin": lambda: with_heights(cube()),
}
QUADS = tuple(CAGES)[:-2]


def bitmap(image=IMAGE, **more):
    to_uv = mi.ScalarTransform3f().rotate(TURN)
    return {"type": "bitmap", "data": upload(mi.TensorXf, image[..., None]), "raw": True, "to_uv": to_uv, **more}


def make(cage, displacement, to_world=None, **parameters):
    placed = {} if to_world is None else {"to_world": mi.ScalarTransform4f(to_world)}
    triangles = {} if "tessellation" in parameters else {"tessellation_rate": RATE}
    displaced = {"displacement": displacement, "displacement_scale": SCALE}
    return load(cage, **{**triangles, **displaced, **placed, **parameters})


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


def difference(function, corner, uv, axis, step):
    """Of points or normals, by one of the parameters."""
    aside = step * np.eye(2)[axis]
    return (function(corner, uv + aside) - function(corner, uv - aside)) / (2 * step)


class Truth:
    """The displaced surface by its formula, of points and normals in double precision."""

    def __init__(self, cage, kind, to_world=None, scheme=None):
        self.surface, self.kind = LimitSurface(cage, scheme), kind
        self.matrix = np.eye(4) if to_world is None else to_world

    def height(self, corner, uv):
        if self.kind == "vertex_height":
            return self.surface.channel("height").evaluate(corner, uv)[:, 0]
        s, t = self.surface.channel("texcoords").evaluate(corner, uv).T
        return np.sin(3 * s) * np.cos(2 * t) if self.kind == "waves" else bilinear(np.stack([s, t], axis=1))

    def points(self, corner, uv):
        samples = self.surface._sampler.evaluate(corner, uv)
        moved = samples.p + SCALE * self.height(corner, uv)[:, None] * samples.n
        return moved @ self.matrix[:3, :3].T + self.matrix[:3, 3]

    def normals(self, corner, uv):
        n = np.cross(*(difference(self.points, corner, uv, axis, STEP) for axis in (0, 1)))
        return n / np.linalg.norm(n, axis=1, keepdims=True) * np.sign(np.linalg.det(self.matrix[:3, :3]))


def assert_alike(shape, expected, atol=0.0):
    for loaded, other in zip(vertices(shape), vertices(expected), strict=True):
        np.testing.assert_allclose(loaded, other, rtol=0, atol=atol)


def locations(cage, rate=RATE, scheme=None):
    surface = LimitSurface(cage, scheme)
    table = surface.sampling(rate)
    return surface.attribute_table(table).layout.locate()


def heights(kind):
    return kind if kind == "vertex_height" else bitmap()


@every_variant
@pytest.mark.parametrize(
    ("name", "kind", "to_world"),
    [
        *((name, kind, matrix) for name in QUADS for kind, matrix in (("vertex_height", MATRIX), ("bitmap", MIRROR))),
        *(("creased islands", kind, None) for kind in ("vertex_height", "bitmap")),
        *((name, "vertex_height", None) for name in ("loop", "doo_sabin")),
    ],
)
def test_vertices_lie_on_the_displaced_surface_with_its_normals(name, kind, to_world):
    cage, scheme = CAGES[name](), "catmull_clark" if name in QUADS else name
    corner, uv = locations(cage, scheme=scheme)
    p, n = vertices(make(cage, heights(kind), to_world, scheme=scheme))
    truth = Truth(cage, kind, to_world, scheme)
    inside = truth.surface.scheme.domain.inside(uv) > 2 * STEP
    assert inside.sum() > (len(uv) / 4 if name in QUADS else 90)
    np.testing.assert_allclose(p[inside], truth.points(corner[inside], uv[inside]), rtol=0, atol=6 * SINGLE)
    np.testing.assert_allclose(n[inside], truth.normals(corner[inside], uv[inside]), rtol=0, atol=NORMAL)


def view(resolution=48, fov=30):
    y, x = (np.indices((resolution, resolution)).reshape(2, -1) + 0.5) / resolution
    sensor = mi.load_dict(perspective({"type": "hdrfilm"}, (2.2, -3.2, 2.0), fov=fov))
    return sensor.sample_ray(0, 0.5, mi.Point2f(x, y), mi.Point2f(0.5))[0]


def hits(shape, flags=mi.RayFlags.All):
    along = view()
    si = scene_with(shape=shape).ray_intersect(along, int(flags), coherent=True)
    # In one kernel: each of its values alone would have one of its own.
    dr.eval(along, si)
    return along, si, np.array(si.is_valid())


def typical(values, expected, part):
    """How far values are off, but for so many."""
    return np.quantile(np.linalg.norm(values - expected, axis=1), part)


@exact_llvm
@pytest.mark.parametrize(
    ("plain", "tags", "matrix", "kind"),
    [
        (cube(), {}, np.eye(4), "bitmap"),
        (cube(), {"creases": RING}, STRETCHED, "bitmap"),
        (named_cages.extraordinary(5), {}, np.eye(4), "bitmap"),
        (cube(), {}, STRETCHED, "waves"),
        (named_cages.torus(6, 5), {}, np.eye(4), "waves"),
        (named_cages.extraordinary(5), {}, STRETCHED, "waves"),
    ],
    ids=["cube", "creases", "extraordinary", "cube, waves", "torus, waves", "extraordinary, waves"],
)
def test_hits_are_on_the_displaced_surface_with_its_normals_and_derivatives(plain, tags, matrix, kind):
    # Texture coordinates are parameters of the elements, plus the element's number.
    islands = [np.add([[0, 0], [1, 0], [1, 1], [0, 1]], [face, 0]) for face in range(plain.face_count)]
    cage = tagged(plain, texcoords=Attribute(np.concatenate(islands), "face_varying"), face_varying="all", **tags)
    texture = bitmap() if kind == "bitmap" else waves()
    shape = make(cage, texture, matrix, shading="exact", tessellation_rate=FINE)
    along, si, valid = hits(shape, mi.RayFlags.All | mi.RayFlags.dNSdUV)
    face = np.floor(np.array(si.uv.x)).astype(int)
    uv = np.stack([np.array(si.uv.x) - face, np.array(si.uv.y)], axis=1)
    # Beside seams triangles go to the mean of both sides' heights, and rays may pass their own side's surface by.
    inside = valid & (np.minimum(uv, 1 - uv) > 1 / FINE).all(axis=1)
    assert inside.sum() > 300
    corner, uv = cage.topology.face_offsets[face[inside]], uv[inside]
    truth = Truth(cage, kind, matrix)
    o, d = (np.array(vectors).T[inside] for vectors in (along.o, along.d))
    way = truth.points(corner, uv) - o
    on_line = np.linalg.norm(way - (way * d).sum(1, keepdims=True) * d, axis=1) < HIT
    # Some rays pass along outlines, of which each island's rim is one.
    assert on_line.mean() > 0.95
    corner, uv = corner[on_line], uv[on_line]
    n, *slopes = (
        np.array(vectors).T[inside][on_line] for vectors in (si.sh_frame.n, si.dp_du, si.dp_dv, si.dn_du, si.dn_dv)
    )
    assert typical(n, truth.normals(corner, uv), 0.99) < HIT_NORMAL
    for axis, (dp, dn) in enumerate(zip(slopes[:2], slopes[2:], strict=True)):
        assert typical(dp, difference(truth.points, corner, uv, axis, STEP), 0.99) < HIT_DERIVATIVE
        # Without lines between texels, at which slopes jump.
        if kind == "waves":
            assert typical(dn, difference(truth.normals, corner, uv, axis, WIDE), 0.95) < NORMAL_DERIVATIVE


@every_variant
@pytest.mark.parametrize(
    ("kind", "shading"), [pytest.param("vertex_height", "exact", marks=exact), ("bitmap", "vertex")]
)
@pytest.mark.parametrize("triangles", TRIANGLES, ids=["even", "adaptive"])
@pytest.mark.parametrize("name", ["islands", "creases", "creased islands", "pyramid"])
def test_vertices_in_one_place_stay_in_one_place_bit_by_bit(name, triangles, kind, shading):
    shape = make(CAGES[name](), heights(kind), shading=shading, **triangles)
    after, _ = vertices(shape)
    update(shape, displacement_scale=[0.0])
    before, _ = vertices(shape)
    _, place = np.unique(before, axis=0, return_inverse=True)
    _, moved = np.unique(after, axis=0, return_inverse=True)
    assert place.max() < len(before) - 1 or shading == "exact"
    # The same vertices fall together before and after.
    pairs = np.unique(np.stack([place.ravel(), moved.ravel()], axis=1), axis=0)
    assert len(pairs) == place.max() + 1 == moved.max() + 1


@llvm
@shadings
def test_no_ray_escapes_through_a_closed_displaced_surface(shading):
    shape = make(CAGES["creased islands"](), bitmap(), shading=shading, tessellation_rate=9)
    outwards = all_directions()
    assert dr.all(scene_with(shape=shape).ray_test(rays(0 * outwards, outwards)))


@pytest.mark.core
@every_variant
def test_a_crease_moves_by_the_mean_of_its_sides():
    # All edges.
    sharp = [(a, a + bit, 10) for bit in (1, 2, 4) for a in range(8) if not a & bit]
    flat = cube(creases=sharp, attributes={"one": np.ones((8, 1))})
    (p, n), (before, _) = vertices(make(flat, "vertex_one")), vertices(make(flat, "vertex_one", displacement_scale=0.0))
    on_side = np.abs(before) > np.abs(flat.positions).max() - SINGLE
    sides = on_side.sum(axis=1, keepdims=True)
    # By the whole height on faces, by halves along edges, by thirds at corners.
    assert set(sides.ravel()) == {1, 2, 3}
    np.testing.assert_allclose(np.abs(p) - np.abs(before), SCALE / sides * on_side, rtol=0, atol=SINGLE)
    np.testing.assert_allclose(np.abs(n).max(axis=1), 1, rtol=0, atol=SINGLE)


@every_variant
def test_flipped_normals_move_the_surface_the_same_way_and_no_height_nothing():
    cage = CAGES["creased islands"]()
    flipped, plain = (make(CAGES["cube"](), "vertex_height", flip_normals=flip) for flip in (True, False))
    np.testing.assert_array_equal(vertices(flipped)[0], vertices(plain)[0])
    (p, n), undisplaced = (
        vertices(load(cage, tessellation_rate=RATE)),
        vertices(make(cage, bitmap(), displacement_scale=0.0)),
    )
    np.testing.assert_array_equal(undisplaced[0], p)
    np.testing.assert_allclose(undisplaced[1], n, rtol=0, atol=SINGLE)


@pytest.mark.usefixtures("no_other_scene")
@every_variant
def test_nothing_moves_where_there_is_no_normal():
    # Two faces glued back to back: the surface is folded along the border between them.
    points = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]], dtype=float)
    cage = ControlCage(points, [[0, 1, 2, 3], [3, 2, 1, 0]], attributes={"one": np.ones((4, 1))})
    p, n = vertices(make(cage, "vertex_one", tessellation_rate=4))
    folded = ~n.any(axis=1)
    assert folded.sum() == 16
    np.testing.assert_array_equal(p[folded, 2], 0)
    np.testing.assert_allclose(np.abs(p[~folded, 2]), SCALE, rtol=0, atol=SINGLE)


def key_of(parameters, by):
    return next(key for key in parameters.keys() if key.endswith(by))  # noqa: SIM118 - it iterates over pairs


@exact_llvm
@pytest.mark.parametrize("by", ["displacement.data", "displacement_scale"])
def test_interactions_detached_from_shapes_have_no_derivatives_by_heights(by):
    scene = scene_with(shape=make(CAGES["cube"](), bitmap(), shading="exact"))
    parameters = mi.traverse(scene)
    given, gradients = differentiated(parameters, key_of(parameters, by)), []
    for more in (0, mi.RayFlags.DetachShape):
        si = scene.ray_intersect(view(16), int(mi.RayFlags.All | more), coherent=True)
        dr.backward(dr.sum(si.sh_frame.n.x))
        gradients.append(np.abs(np.array(dr.grad(given))).sum())
        dr.clear_grad(given)
    assert gradients[0] > 0
    assert gradients[1] == 0


@exact_llvm
@pytest.mark.parametrize("refused", ["to_world", "control_points", "cage_height"])
def test_an_update_that_is_refused_changes_nothing_else(refused):
    """Rays met another surface than that of the triangles."""
    shape = make(CAGES["cube"](), "vertex_height", shading="exact")
    before, displacement = vertices(shape), shape._exact.kernel.displacement
    scale, height = np.array(displacement.scale), np.array(displacement.channel.values.flat)
    wrong = {
        "to_world": mi.AffineTransform4f(mi.Matrix4f(np.diag([1.0, 1, 0, 1]))),
        "control_points": np.full(24, np.nan),
        "cage_height": np.full(8, np.nan),
    }
    moved = {"cage_height": 1 + height, "to_world": mi.ScalarTransform4f().translate([1, 0, 0])}
    given = {"displacement_scale": 0.5, **moved, refused: wrong[refused]}
    with pytest.raises(ValueError, match=f'parameter "{refused}"'):
        update(shape, given)
    np.testing.assert_array_equal(displacement.scale, scale)
    np.testing.assert_array_equal(displacement.channel.values.flat, height)
    np.testing.assert_array_equal(vertices(shape)[0], before[0])


@every_variant
@pytest.mark.parametrize("triangles", TRIANGLES, ids=["even", "adaptive"])
def test_a_texture_of_one_value_displaces_as_a_bitmap_of_that_value(triangles):
    textures = {"type": "uniform", "value": 0.3}, bitmap(np.full_like(IMAGE, 0.3))
    assert_alike(*(make(CAGES["cube"](), texture, **triangles) for texture in textures), NORMAL)


def extraordinary(truth, corner, uv):
    """Which locations lie at extraordinary vertices."""
    at = np.flatnonzero((uv == 0).all(axis=1))
    return at[truth.surface._sampler.evaluate(corner[at], uv[at]).level == -1]


@every_variant
@pytest.mark.parametrize("valence", [3, 5, 6, 9])
def test_normals_at_extraordinary_vertices_go_with_those_around_them(valence):
    cage = with_heights(named_cages.extraordinary(valence))
    corner, uv = locations(cage)
    truth = Truth(cage, "vertex_height")
    at = extraordinary(truth, corner, uv)
    t = truth.surface.patches.elements
    turns = [corner[at]]
    for _ in range(valence - 1):
        turns.append(t.twin[t.prev[turns[-1]]])
    of_valence = (t.twin[t.prev[turns[-1]]] == turns[0]) & np.all([turn != turns[0] for turn in turns[1:]], axis=0)
    around = sum(truth.normals(turn[of_valence], np.full((of_valence.sum(), 2), BESIDE)) for turn in turns)
    around /= np.linalg.norm(around, axis=1, keepdims=True)
    assert of_valence.any()
    # Curvature, which the normal there does without, turns it a little.
    _, n = vertices(make(cage, "vertex_height"))
    assert np.linalg.norm(n[at][of_valence] - around, axis=1).max() < AROUND


@every_variant
def test_normals_where_seams_end_at_extraordinary_vertices_are_those_of_the_limit_surface():
    cage = CAGES["islands"]()
    p, n = vertices(load(cage, tessellation_rate=RATE))
    corners = np.linalg.norm(p - LimitSurface(cage).evaluate(0, [[0, 0]]).p, axis=1) < SINGLE
    assert (corners & (locations(cage)[1] == 0).all(axis=1)).sum() == 3
    np.testing.assert_allclose(vertices(make(cage, bitmap()))[1][corners], n[corners], rtol=0, atol=SINGLE)


@every_variant
def test_normals_at_extraordinary_vertices_of_a_plane_are_limits():
    dome = named_cages.extraordinary(5, closed=False)
    flat = with_heights(dome.with_positions(dome.positions * [1, 1, 0]))
    corner, uv = locations(flat)
    truth = Truth(flat, "vertex_height")
    at = extraordinary(truth, corner, uv)
    near = truth.normals(corner[at], np.full((len(at), 2), 2 * STEP))
    np.testing.assert_allclose(vertices(make(flat, "vertex_height"))[1][at], near, rtol=0, atol=1e-3)


@every_variant
def test_a_cage_far_from_the_origin_has_the_same_normals():
    cage = CAGES["valence 5"]()
    near, far = (make(cage.with_positions(cage.positions + shift), "vertex_height") for shift in (0, 1000))
    (p, n), (q, m) = vertices(near), vertices(far)
    np.testing.assert_allclose(n, m, rtol=0, atol=NORMAL)
    # Units in the last place of a thousand.
    np.testing.assert_allclose(p + 1000, q, rtol=0, atol=2e-4)
