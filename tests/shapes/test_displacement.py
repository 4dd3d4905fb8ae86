import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from mitsuba_subdivision import Attribute, ControlCage, LimitSurface, upload
from mitsuba_subdivision.cage import named_cages
from mitsuba_subdivision.evaluation.equations import AT_EXTRAORDINARY_POINT
from mitsuba_subdivision.kernels.displacement import Heights
from mitsuba_subdivision.shapes.displacement import TextureHeights
from patches.closed_cages import extraordinary_triangles
from reference.refined_cages import tagged
from scipy import ndimage
from shapes.cages import MIRRORED, RING, SHEARED, bitmap, cube, load
from shapes.scenes import buffer, camera_rays, scene_with, vertices, waves
from shapes.updates import differentiated, moving, update
from shapes.variants import every_ad_variant, every_variant, exact, exact_llvm

# Places and normals in single precision, of a cage of size one; normals take differences of differences.
SINGLE, NORMAL = 1e-6, 2e-5
# Step of central differences: the cube root of the rounding of double precision.
STEP = 6e-6
# Where Newton's method ends in single precision, and what a step of its last size changes there.
HIT, HIT_NORMAL, HIT_DERIVATIVE = 1e-5, 1e-3, 1e-2
# Derivatives of normals are differences of differences over steps so wide.
WIDE, NORMAL_DERIVATIVE = 1e-3, 0.05
# Beside extraordinary vertices, in parameters; and how far normals turn there where the surface is curved.
BESIDE, AROUND = 2.0**-5, 0.04
# No vertex lies on a line between texels, where slopes jump.
RATE, FINE = 5, 24
SCALE = 0.15
IMAGE = np.random.default_rng(7).random((5, 8)).astype(np.float32)
# Transformation of a bitmap's texture coordinates; its three channels, and the weights of their luminance, the height.
TO_UV = np.array([[1.22, -0.34, 0.0], [0.36, 0.89, 0.0], [0.0, 0.0, 1.0]])
CHANNELS, LUMINANCE = np.array([0.5, 1.0, 1.5]), np.array([0.212671, 0.715160, 0.072169])
STRETCHED = np.diag([-1.0, 0.8, 1.2, 1.0])
ADAPTIVE = {"tessellation": "adaptive", "chord_error": 0.03}


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
    "creased islands": lambda: with_heights(cube(), islands=True, creases=RING),
    "valence 5": lambda: with_heights(named_cages.extraordinary(5)),
    "dome": lambda: with_heights(named_cages.extraordinary(7, closed=False)),
    "pyramid": lambda: with_heights(pyramid(), islands=True),
    "loop": lambda: with_heights(extraordinary_triangles(7)),
    "doo_sabin": lambda: with_heights(cube()),
}


def turned():
    return bitmap(IMAGE[..., None] * CHANNELS, to_uv=mi.ScalarTransform3f(TO_UV))


def make(cage, displacement, to_world=None, **parameters):
    placed = {} if to_world is None else {"to_world": mi.ScalarTransform4f(to_world)}
    triangles = {} if "tessellation" in parameters else {"tessellation_rate": RATE}
    displaced = {"displacement": displacement, "displacement_scale": SCALE}
    return load(cage, **{**triangles, **displaced, **placed, **parameters})


def bilinear(uv):
    """Mitsuba's bitmap texture, repeated and turned, in double precision."""
    uv = uv @ TO_UV[:2, :2].T
    # Rows are along v.
    at = (uv * IMAGE.shape[::-1] - 0.5).T[::-1]
    return (CHANNELS @ LUMINANCE) * ndimage.map_coordinates(IMAGE.astype(np.float64), at, order=1, mode="grid-wrap")


def difference(function, corner, uv, axis, step):
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


def locations(cage, rate=RATE, scheme=None):
    surface = LimitSurface(cage, scheme)
    return surface.attribute_table(surface.sampling(rate))[0].locate()


def heights(kind):
    return {"bitmap": turned, "waves": waves}[kind]() if kind != "vertex_height" else kind


@every_variant
@pytest.mark.parametrize(
    ("name", "kind", "to_world"),
    [
        *((name, "vertex_height", SHEARED) for name in ("creased islands", "dome")),
        *((name, "bitmap", MIRRORED) for name in ("valence 5", "pyramid")),
        *(("creased islands", kind, None) for kind in ("bitmap", "waves")),
        *((name, "vertex_height", None) for name in ("loop", "doo_sabin")),
    ],
)
def test_vertices_lie_on_the_displaced_surface_with_its_normals(name, kind, to_world):
    cage, scheme = CAGES[name](), name if name in ("loop", "doo_sabin") else "catmull_clark"
    corner, uv = locations(cage, scheme=scheme)
    p, n = vertices(make(cage, heights(kind), to_world, scheme=scheme))
    truth = Truth(cage, kind, to_world, scheme)
    inside = truth.surface.scheme.domain.inside(uv) > 2 * STEP
    assert inside.sum() > len(uv) / 5
    np.testing.assert_allclose(p[inside], truth.points(corner[inside], uv[inside]), rtol=0, atol=6 * SINGLE)
    np.testing.assert_allclose(n[inside], truth.normals(corner[inside], uv[inside]), rtol=0, atol=NORMAL)


def typical(values, expected, part):
    return np.quantile(np.linalg.norm(values - expected, axis=1), part)


@exact_llvm
@pytest.mark.parametrize(
    ("plain", "tags", "kind"),
    [(cube(), {"creases": RING}, "bitmap"), (named_cages.extraordinary(5), {}, "waves")],
    ids=["creases", "extraordinary"],
)
def test_hits_are_on_the_displaced_surface_with_its_normals_and_derivatives(plain, tags, kind):
    # Texture coordinates are parameters of the elements, plus the element's number.
    islands = [np.add([[0, 0], [1, 0], [1, 1], [0, 1]], [face, 0]) for face in range(plain.face_count)]
    cage = tagged(plain, texcoords=Attribute(np.concatenate(islands), "face_varying"), face_varying="all", **tags)
    shape, along = make(cage, heights(kind), STRETCHED, shading="exact", tessellation_rate=FINE), camera_rays(48)
    si = scene_with(shape=shape).ray_intersect(along, int(mi.RayFlags.All | mi.RayFlags.dNSdUV), coherent=True)
    # In one kernel: each of its values alone would have one of its own.
    dr.eval(along, si)
    face = np.floor(np.array(si.uv.x)).astype(int)
    uv = np.stack([np.array(si.uv.x) - face, np.array(si.uv.y)], axis=1)
    # Beside seams triangles go to the mean of both sides' heights, and rays may pass their own side's surface by.
    inside = np.array(si.is_valid()) & (np.minimum(uv, 1 - uv) > 1 / FINE).all(axis=1)
    assert inside.sum() > 300
    corner, uv = cage.topology.face_offsets[face[inside]], uv[inside]
    truth = Truth(cage, kind, STRETCHED)
    o, d = (np.array(vectors).T[inside] for vectors in (along.o, along.d))
    way = truth.points(corner, uv) - o
    on_line = np.linalg.norm(way - (way * d).sum(1, keepdims=True) * d, axis=1) < HIT
    # Some rays pass along outlines, of which each island's rim is one.
    assert on_line.mean() > 0.95
    corner, uv = corner[on_line], uv[on_line]
    met = si.sh_frame.n, si.dp_du, si.dp_dv, si.dn_du, si.dn_dv
    n, *slopes = (np.array(vectors).T[inside][on_line] for vectors in met)
    assert typical(n, truth.normals(corner, uv), 0.99) < HIT_NORMAL
    for axis, (dp, dn) in enumerate(zip(slopes[:2], slopes[2:], strict=True)):
        assert typical(dp, difference(truth.points, corner, uv, axis, STEP), 0.99) < HIT_DERIVATIVE
        # Without lines between texels, at which slopes jump.
        if kind == "waves":
            assert typical(dn, difference(truth.normals, corner, uv, axis, WIDE), 0.95) < NORMAL_DERIVATIVE


@every_variant
@pytest.mark.parametrize(
    ("name", "triangles", "kind", "shading"),
    [
        ("creased islands", {}, "bitmap", "vertex"),
        ("pyramid", ADAPTIVE, "bitmap", "vertex"),
        pytest.param("creased islands", ADAPTIVE, "vertex_height", "exact", marks=exact),
    ],
)
def test_coincident_vertices_stay_coincident(name, triangles, kind, shading):
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


@pytest.mark.core
@every_variant
def test_a_crease_moves_by_the_mean_of_its_sides():
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
    p, n = vertices(load(cage, tessellation_rate=RATE))
    undisplaced = vertices(make(cage, turned(), displacement_scale=0.0))
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


@exact_llvm
def test_interactions_detached_from_shapes_have_no_derivatives_by_heights():
    scene = scene_with(shape=make(CAGES["cube"](), turned(), shading="exact"))
    parameters = mi.traverse(scene)
    keys = [key for key, _ in parameters if key.endswith(("displacement.data", "displacement_scale"))]
    given = [differentiated(parameters, key) for key in keys]
    for more in (0, mi.RayFlags.DetachShape):
        si = scene.ray_intersect(camera_rays(16), int(mi.RayFlags.All | more), coherent=True)
        dr.backward(dr.sum(si.sh_frame.n.x))
        assert [bool(np.any(dr.grad(values))) for values in given] == [not more] * 2
        dr.clear_grad(given)


@exact_llvm
@pytest.mark.parametrize("refused", ["to_world", "control_points", "cage_height"])
def test_refused_updates_change_nothing_until_corrected(refused):
    """Rays met another surface than that of the triangles, whose faces and normals were out of step."""
    scene, other = (scene_with(shape=make(CAGES["cube"](), "vertex_height", shading="exact")) for _ in range(2))
    points, along = 2 * cube().positions.ravel(), camera_rays(8)
    given = {"cage_height": np.linspace(0, 1, 8), "control_points": points, "displacement_scale": 0.5}
    given["to_world"] = mi.ScalarTransform4f().scale([-1, 1, 1])
    wrong = mi.AffineTransform4f(mi.Matrix4f(np.diag([1.0, 1, 0, 1])))
    wrong = {"to_world": wrong, "control_points": points * np.nan, "cage_height": np.full(8, np.nan)}

    def seen(scene):
        (shape,) = scene.shapes()
        return [np.array(scene.ray_intersect(along).n), buffer(shape, "vertex_positions"), buffer(shape, "faces")]

    def assert_seen(expected):
        for now, before in zip(seen(scene), expected, strict=True):
            np.testing.assert_array_equal(now, before)

    before, parameters = seen(scene), mi.traverse(scene.shapes()[0])
    with pytest.raises(ValueError, match=f'parameter "{refused}"'):
        update(parameters, {**given, refused: wrong[refused]})
    assert_seen(before)
    update(parameters, {refused: given[refused]})
    update(other.shapes()[0], given)
    assert_seen(seen(other))


@every_variant
@pytest.mark.parametrize(
    ("valence", "scale", "beside", "off"),
    [*((valence, 1, BESIDE, AROUND) for valence in (3, 6, 9)), (5, [1, 1, 0], 2 * STEP, 1e-3)],
)
def test_normals_are_continuous_at_extraordinary_vertices(valence, scale, beside, off):
    """Curvature, which the normal there does without, turns it a little; in a plane, it is the limit."""
    plain = named_cages.extraordinary(valence, closed=scale == 1)
    cage = with_heights(plain.with_positions(plain.positions * scale))
    (corner, uv), truth = locations(cage), Truth(cage, "vertex_height")
    at = np.flatnonzero((uv == 0).all(axis=1))
    at = at[truth.surface._sampler.evaluate(corner[at], uv[at]).level == AT_EXTRAORDINARY_POINT]
    t, turns = truth.surface.patches.elements, [corner[at]]
    for _ in range(valence - 1):
        turns.append(t.twin[t.prev[turns[-1]]])
    of_valence = (t.twin[t.prev[turns[-1]]] == turns[0]) & np.all([turn != turns[0] for turn in turns[1:]], axis=0)
    around = sum(truth.normals(turn[of_valence], np.full((of_valence.sum(), 2), beside)) for turn in turns)
    around /= np.linalg.norm(around, axis=1, keepdims=True)
    assert of_valence.any()
    _, n = vertices(make(cage, "vertex_height"))
    assert np.linalg.norm(n[at][of_valence] - around, axis=1).max() < off


@every_variant
def test_normals_at_ends_of_seams_are_undisplaced_at_extraordinary_vertices():
    cage = CAGES["islands"]()
    p, n = vertices(load(cage, tessellation_rate=RATE))
    corners = np.linalg.norm(p - LimitSurface(cage).evaluate(0, [[0, 0]]).p, axis=1) < SINGLE
    assert (corners & (locations(cage)[1] == 0).all(axis=1)).sum() == 3
    np.testing.assert_allclose(vertices(make(cage, turned()))[1][corners], n[corners], rtol=0, atol=SINGLE)


@every_variant
def test_a_cage_far_from_the_origin_has_the_same_normals():
    cage = CAGES["valence 5"]()
    near, far = (make(cage.with_positions(cage.positions + shift), "vertex_height") for shift in (0, 1000))
    (p, n), (q, m) = vertices(near), vertices(far)
    np.testing.assert_allclose(n, m, rtol=0, atol=NORMAL)
    # Units in the last place of a thousand.
    np.testing.assert_allclose(p + 1000, q, rtol=0, atol=2e-4)


TEXELS = IMAGE[:4, :7, None]
# Second differences over a texel, of values that single precision rounds.
SECOND = 1e-3
# Offset of texture coordinates, several texels.
SLIDE = 0.02


def heights_of(texture):
    return TextureHeights(getattr(mi, mi.variant()), mi.load_dict(texture) if isinstance(texture, dict) else texture)


def arrays(*values):
    kind = mi.Float if dr.is_jit_v(mi.Float) else dr.scalar.ArrayXf64
    return [upload(kind, value) for value in values]


def attached_slopes(heights, s, t):
    """Derivatives by s and by t, as the chain rule gives them for parameters that are s and t."""
    zeros, ones = arrays(np.zeros(len(s)), np.ones(len(s)))
    return heights([s, t], [ones, zeros], [zeros, ones])[1:]


@pytest.mark.parametrize("turn", [0, 90])
@every_ad_variant
def test_bitmap_slopes_follow_texture_coordinates(turn):
    """Of a bitmap of texels of a quadratic function, whose differences over a texel are its second derivatives."""
    height, width = 9, 16
    y, x = np.meshgrid((np.arange(height) + 0.5) / height, (np.arange(width) + 0.5) / width, indexing="ij")
    image = (0.5 * x**2 - 0.75 * x * y + 0.2 * y**2)[:, :, None].astype(np.float32)
    to_uv = mi.ScalarTransform3f().rotate(turn).scale([0.5, 1.0])
    heights = heights_of(bitmap(image, to_uv=to_uv, wrap_mode="clamp"))
    a = np.array(to_uv.matrix).reshape(3, 3)
    # Texels that are far enough from the sides.
    inside = np.linalg.inv(a) @ np.concatenate([np.random.default_rng(3).uniform(0.2, 0.8, (2, 40)), np.ones((1, 40))])
    expected = a[:2, :2].T @ [[1, -0.75], [-0.75, 0.4]] @ a[:2, :2]
    for axis in range(2):
        given = arrays(*inside[:2])
        dr.enable_grad(given[axis])
        by_axis = []
        for slope in attached_slopes(heights, *given):
            dr.set_grad(given[axis], 1)
            by_axis.append(np.array(dr.forward_to(slope, flags=dr.ADFlag.ClearInterior)))
        np.testing.assert_allclose(by_axis, np.repeat(expected[:, axis, None], 40, axis=1), rtol=0, atol=SECOND)
    steps = attached_slopes(heights_of(bitmap(TEXELS, filter_type="nearest")), *arrays(*inside[:2]))
    assert not np.any([np.array(slope) for slope in steps])


@every_variant
def test_height_ranges_cover_textures_and_attributes():
    # At texels' centres a texture has their luminances, and beyond the picture no others.
    colours = heights_of(bitmap(np.random.default_rng(8).random((3, 5, 3)).astype(np.float32)))
    s, t = (grid.ravel() for grid in np.meshgrid((np.arange(5) + 0.5) / 5, (np.arange(3) + 0.5) / 3))
    values, more = (np.array(colours.height(arrays(s + shift, t))) for shift in (0, 0.1))
    assert colours.range() == pytest.approx((values.min(), values.max()), abs=1e-6)
    assert values.min() <= more.min() < more.max() <= values.max()
    assert heights_of(waves()).range()[1] == pytest.approx(1, abs=1e-3)
    for texture, expected in (
        (bitmap(TEXELS), (TEXELS.min(), TEXELS.max())),
        ({"type": "uniform", "value": 0.25}, (0.25, 0.25)),
        ({"type": "checkerboard"}, (0.2, 0.4)),
    ):
        assert heights_of(texture).range() == pytest.approx(expected)
    cage = cube(attributes={"height": np.linspace(-1, 2, 8)[:, None]})
    assert Heights().range(LimitSurface(cage).channel("height")) == (-1, 2)


@every_variant
def test_unsupported_textures_of_heights_are_refused():
    with pytest.raises(ValueError, match=r'kind "MeshAttribute" was given; expected the name of the attribute itself'):
        heights_of({"type": "mesh_attribute", "name": "vertex_height"})


@every_ad_variant
def test_normals_turn_when_texture_coordinates_slide_over_a_bitmap(np_rng):
    """They did not, but for the products of both coordinates: slopes of bitmaps are constant along a texel."""
    x, y, z = cube().positions.T
    cage = cube(texcoords=np.stack([0.3 * x + 0.11 * z + 0.5, 0.3 * y + 0.23 * z + 0.5], axis=1))
    t, s = np.meshgrid(*[(np.arange(256) + 0.5) / 256] * 2, indexing="ij")
    image = bitmap((np.sin(4 * np.pi * s) * np.cos(2 * np.pi * t))[:, :, None].astype(np.float32))
    parameters = mi.traverse(load(cage, displacement=image, displacement_scale=0.02))
    assign, step = moving(parameters, "cage_texcoords", np_rng), dr.opaque(mi.Float, 0)

    def normals(step):
        assign(step)
        # Dr.Jit clears the derivatives of what others are computed from.
        return 1 * parameters["vertex_normals"]

    dr.enable_grad(step)
    sliding = normals(step)
    dr.set_grad(step, 1)
    derivative = np.array(dr.forward_to(sliding))
    # Over some texels, as slopes jump from one to the next.
    expected = (np.array(normals(SLIDE)) - np.array(normals(-SLIDE))) / (2 * SLIDE)
    assert np.abs(derivative - expected).mean() < 0.2 * np.abs(expected).mean()
