"""The surface on a device is the one that NumPy evaluates, and is differentiated as it is.

`LimitSurface.evaluate` is another path to the same surface: it divides elements where the samples lie, and sums the
equations over eigen-coordinates, where the kernel has a table of polynomials over control points.
"""

from types import SimpleNamespace

import drjit as dr
import numpy as np
import pytest
from kernels.surfaces import (
    SURFACES,
    aimed,
    computed,
    hit,
    kernel_named,
    on_device,
    random_locations,
    rays_of,
    surface_named,
    vectors,
)
from mitsuba_subdivision import LimitSurface
from mitsuba_subdivision.cage.named_cages import cube, extraordinary
from mitsuba_subdivision.device_arrays import upload
from mitsuba_subdivision.evaluation.equations import AT_EXTRAORDINARY_POINT
from mitsuba_subdivision.evaluation.irregular_patch import PIECE_LEVELS
from mitsuba_subdivision.kernels.algebra import AffineMap
from mitsuba_subdivision.kernels.surface_kernel import SurfaceKernel
from mitsuba_subdivision.patches.piece_table import PieceTable
from mitsuba_subdivision.schemes import CatmullClark
from patches.closed_cages import bumpy, tetrahedron, torus
from reference.refined_cages import half_disc, refine_first

pytestmark = pytest.mark.usefixtures("llvm")

DOUBLE, SINGLE = "llvm_ad_rgb_double", "llvm_ad_rgb"
# Of cages of a size of about 3. Points are sums of some tens of products; normals and derivatives relative to their
# length lose what the eigenbasis is ill-conditioned by, at valence 50 some hundred roundings.
BARS = {
    DOUBLE: {"point": 1e-13, "normal": 1e-11, "derivative": 1e-11},
    # The same in single precision. Measured: 4e-7, 6e-6 and 7e-6, each at valence or face size 50; rounded up.
    SINGLE: {"point": 1e-6, "normal": 1e-5, "derivative": 1e-5},
}
# Some tens of roundings in single precision.
BORDER_NORMAL = 2e-6
# Of the cage's size: what single precision cannot tell apart in coordinates of this size.
ONE_POINT = 2.0**-24
# Stam's first term in double precision: what rounding leaves of a sum that should be zero, times 2^5 for level 5.
FIRST_TERM = 1e-11
# Central differences in double precision: truncation of about the step squared, rounding over the step.
STEP = 1e-6
DIFFERENCES = 1e-7
HIT_DIFFERENCES = 1e-6
# Near extraordinary points, curvature grows beyond bounds, and so do derivatives and what differences leave out.
STEEP = 1e-4
# Of the largest: third derivatives are differences over 2^-10 of a piece, of polynomials of some curvature.
THIRD = 1e-5


def evaluated(kernel, *locations, derivatives=1):
    return computed(kernel.evaluate(*on_device(kernel.types, *locations), derivatives=derivatives))


def assert_same(samples, expected, bars):
    """Points, normals and tangents of a kernel are those of the surface."""
    np.testing.assert_allclose(vectors(samples.p), expected.p, rtol=0, atol=bars["point"])
    # At extraordinary points, tangents have arbitrary length.
    has_derivatives = expected.level != AT_EXTRAORDINARY_POINT
    # The cross product of tangents loses as many digits as their angle is small.
    u, v = expected.dp_du, expected.dp_dv
    sine = np.linalg.norm(np.cross(u, v), axis=1) / np.linalg.norm(u, axis=1) / np.linalg.norm(v, axis=1)
    lost = np.linalg.norm(vectors(samples.n) - expected.n, axis=1) * np.where(has_derivatives, sine, 1)
    assert lost.max() <= bars["normal"]
    for one, other in ((samples.dp_du, expected.dp_du), (samples.dp_dv, expected.dp_dv)):
        relative = np.linalg.norm(vectors(one) - other, axis=1) / np.linalg.norm(other, axis=1)
        assert relative[has_derivatives].max() <= bars["derivative"]


@pytest.mark.core
@pytest.mark.parametrize("name", SURFACES)
def test_points_tangents_and_normals_are_the_surfaces(name, np_rng):
    surface = surface_named(name)
    locations = random_locations(surface, np_rng, 1500)
    locations[1][:100] = 0
    expected = surface.evaluate(*locations)
    for variant, bars in BARS.items():
        assert_same(evaluated(kernel_named(name, variant), *locations), expected, bars)


@pytest.mark.core
@pytest.mark.parametrize("shape", [(0, 0, 0), (1, 0, 0)], ids=["a point", "a curve"])
def test_normals_of_a_collapsed_surface_do_not_turn(shape, np_rng):
    kernel = LimitSurface(cube().with_positions(cube().positions * shape)).on_device(SINGLE)
    locations = random_locations(surface_named("cube"), np_rng, 20, deepest=1)
    samples = evaluated(kernel, *locations, derivatives=2)
    for derivative in (samples.dn_du, samples.dn_dv):
        np.testing.assert_array_equal(vectors(derivative), 0)


BORDERS = ["sheet without corners", "half disc of 6", "dart", "crease", "corner", "loop sheet", "loop half disc of 6"]


@pytest.mark.core
@pytest.mark.parametrize("name", BORDERS)
def test_normals_at_borders_are_exact_in_single_precision_down_to_the_vertex(name, np_rng):
    """Where the derivatives become parallel, level by level."""
    surface = surface_named(name)
    elements, cut = surface.patches.elements, surface.patches.topology
    element, uv, corner = random_locations(surface, np_rng, 4000, deepest=22)
    beside = cut.is_border_vertex[cut.face_vertices[elements.face_offsets[element] + corner]] & (uv.max(axis=1) < 0.1)
    locations = element[beside], uv[beside], corner[beside]
    samples, expected = evaluated(kernel_named(name, SINGLE), *locations), surface.evaluate(*locations)
    assert expected.level.max() > 18
    np.testing.assert_allclose(vectors(samples.n), expected.n, rtol=0, atol=BORDER_NORMAL)


@pytest.mark.parametrize("name", ["hexagon", "valence 2", "half disc of 6", "corner", "loop half disc of 6"])
def test_normals_are_those_of_corners_only_where_points_are(name, np_rng):
    """Next to a corner whose normal is a convention, or a slow limit, exact normals differ from it at every level.

    Kernels have the corner's own normal where the point is the corner in single precision, and only there.
    """
    surface = surface_named(name)
    element, uv, corner = random_locations(surface, np_rng, 8000)
    uv = (uv * 2.0 ** -np_rng.uniform(0, 100, (8000, 1))).astype(np.float32).astype(float)
    samples = evaluated(kernel_named(name, SINGLE), element, uv, corner)
    expected, at_corner = surface.evaluate(element, uv, corner), surface.evaluate(element, 0 * uv, corner)
    differs = np.linalg.norm(vectors(samples.n) - expected.n, axis=1) > BARS[SINGLE]["normal"]
    assert differs.any()
    np.testing.assert_allclose(vectors(samples.n)[differs], at_corner.n[differs], rtol=0, atol=BORDER_NORMAL)
    size = np.ptp(surface.cage.positions, axis=0).max()
    assert np.linalg.norm(expected.p - at_corner.p, axis=1)[differs].max() <= ONE_POINT * size
    np.testing.assert_allclose(vectors(samples.p), expected.p, rtol=0, atol=BARS[SINGLE]["point"])


@pytest.mark.core
@pytest.mark.parametrize("name", ["hexagon", "valence 50", "sheet", "loop corner", "doo_sabin mixed torus"])
def test_derivatives_of_normals_are_those_of_the_surface(name, np_rng):
    surface = surface_named(name)
    locations = random_locations(surface, np_rng, 500, deepest=4)
    samples = evaluated(kernel_named(name, DOUBLE), *locations, derivatives=2)
    s = surface.evaluate(*locations, derivatives=2)
    area = np.linalg.norm(np.cross(s.dp_du, s.dp_dv), axis=1)[:, None]
    for derivative, of_u, of_v in ((samples.dn_du, s.d2p_duu, s.d2p_duv), (samples.dn_dv, s.d2p_duv, s.d2p_dvv)):
        change = (np.cross(of_u, s.dp_dv) + np.cross(s.dp_du, of_v)) / area
        across = change - s.n * (change * s.n).sum(axis=1)[:, None]
        scale = np.abs(across).max(axis=1) + np.linalg.norm(of_u, axis=1) / np.linalg.norm(s.dp_du, axis=1)
        assert (np.abs(vectors(derivative) - across).max(axis=1) / scale).max() <= BARS[DOUBLE]["derivative"]


def test_a_cage_refined_once_has_the_same_surface(monkeypatch, np_rng):
    surface = surface_named("mixed torus")
    refine_first(monkeypatch)
    refined = LimitSurface(surface.cage)
    assert refined.patches.refined is not None
    locations = random_locations(surface, np_rng, 500)
    # On the lines between quarters, too.
    locations[1][:20, 0] = 0.5
    samples, expected = evaluated(refined.on_device(DOUBLE), *locations), surface.evaluate(*locations)
    assert_same(samples, expected, BARS[DOUBLE])
    np.testing.assert_allclose(vectors(samples.n), expected.n, rtol=0, atol=BARS[DOUBLE]["normal"])


@pytest.mark.parametrize("levels", [0, PIECE_LEVELS - 1])
@pytest.mark.parametrize("name", ["valence 50", "corner", "chaikin", "loop half disc of 6", "doo_sabin mixed torus"])
def test_levels_of_tips_are_the_same_surface_as_pieces_and_as_sums(name, levels, np_rng):
    surface = surface_named(name)
    locations = random_locations(surface, np_rng, 600)
    locations[1][:60] = 0
    rows = surface.cage.cut_mesh.vertex, surface.cage.vertex_count
    kernel = SurfaceKernel(PieceTable.build(surface.patches, *rows, levels), dr.llvm.ad.Float64)
    kernel.set_control_points(upload(dr.llvm.ad.Float64, surface.cage.positions))
    assert_same(evaluated(kernel, *locations), surface.evaluate(*locations), BARS[DOUBLE])


def test_a_scheme_of_a_user_is_evaluated(np_rng):
    class OfAUser(CatmullClark):
        name = "of a user"

    known = surface_named("hexagon")
    locations = random_locations(known, np_rng, 200)
    samples = evaluated(LimitSurface(known.cage, OfAUser()).on_device(DOUBLE), *locations)
    assert_same(samples, known.evaluate(*locations), BARS[DOUBLE])


# Stam's form


def test_stams_form_is_the_same_but_for_rounding_which_takes_its_normals_in_single_precision(np_rng):
    surface = surface_named("valence 3")
    locations = random_locations(surface, np_rng, 500, deepest=5)
    expected = surface.evaluate(*locations)
    for variant, bar in ((DOUBLE, FIRST_TERM), (SINGLE, 1e-4)):
        samples = evaluated(kernel_named("valence 3", variant, "stam"), *locations)
        np.testing.assert_allclose(vectors(samples.n), expected.n, rtol=0, atol=bar)

    uv = np.ldexp(np.random.default_rng(1).random((200, 2)) / 2 + 0.25, -18).astype(np.float32).astype(float)
    element = np.zeros(200, dtype=int)
    expected, lost = surface.evaluate(element, uv), {}
    for evaluator in ("stam", "stabilized"):
        samples = evaluated(kernel_named("valence 3", SINGLE, evaluator), element, uv, 0 * element)
        lost[evaluator] = np.linalg.norm(vectors(samples.n) - expected.n, axis=1)
    assert np.median(lost["stam"]) > 1e-3
    assert lost["stabilized"].max() < 1e-6


# Derivatives by control points and parameters

# Of few control points each, as the kernels for derivatives by these take long to compile.
SMALL = {
    "control points of its own": ("catmull_clark", torus(3, 3)),
    "polygons": ("catmull_clark", tetrahedron()),
    "border": ("catmull_clark", half_disc(2)),
    "triangles": ("loop", tetrahedron()),
    "doo_sabin": ("doo_sabin", tetrahedron()),
}


def small_surface(name):
    scheme, cage = SMALL[name]
    return LimitSurface(bumpy(cage), scheme)


def forward(outputs, inputs, changes):
    """Changes of outputs, from those of inputs."""
    for value, change in zip(inputs, changes, strict=True):
        dr.set_grad(value, change)
    dr.enqueue(dr.ADMode.Forward, *inputs)
    dr.traverse(dr.ADMode.Forward, flags=dr.ADFlag.ClearNone)
    return [np.array(gradient).T for gradient in computed([dr.grad(output) for output in outputs])]


def assert_differentiated(outputs_of, inputs, changes, differences, rng, kept=..., rtol=0, atol=DIFFERENCES):
    """Derivatives are these differences, and those of reverse mode are of the same linear map."""
    dr.enable_grad(inputs)
    forwards = forward(outputs_of(), inputs, changes)
    for one, other in zip(forwards, differences, strict=True):
        assert np.abs(one).max() > 0.1
        scale = max(1, np.abs(other[kept]).max())
        np.testing.assert_allclose(one[kept], other[kept], rtol=rtol, atol=atol * scale)
    seeds = [rng.normal(size=derivative.shape) for derivative in forwards]
    dr.clear_grad(inputs)
    outputs = outputs_of()
    for output, seed in zip(outputs, seeds, strict=True):
        dr.set_grad(output, upload(type(output), seed))
    dr.enqueue(dr.ADMode.Backward, *outputs)
    dr.traverse(dr.ADMode.Backward)
    gradients = computed([dr.grad(value) for value in inputs])
    products = np.concatenate([(f * s).ravel() for f, s in zip(forwards, seeds, strict=True)])
    product = sum((np.array(c) * np.array(g)).sum() for c, g in zip(changes, gradients, strict=True))
    assert abs(product - products.sum()) <= BARS[DOUBLE]["point"] * np.abs(products).sum()


@pytest.mark.parametrize("by", ["points", "parameters", "rays"])
def test_derivatives_of_derivatives_of_normals_are_differences(by, np_rng):
    """Those by parameters, which also follow rays, are differences over a thousandth of a piece themselves."""
    surface = small_surface("polygons")
    kernel = surface.on_device(DOUBLE)
    types, positions = kernel.types, surface.cage.positions
    element, uv, corner = random_locations(surface, np_rng, 40, deepest=3)
    # Away from lines between pieces, across which third derivatives jump.
    uv = 0.3 + 0.1 * np.abs(uv - np.round(uv))
    s = surface.evaluate(element, uv, corner)
    o, d = s.p - s.n, s.n + np_rng.uniform(-0.3, 0.3, s.n.shape)
    values = {"points": positions, "parameters": uv, "rays": o}
    direction = types.floats(np_rng.normal(size=values[by].size))

    def samples_at(step):
        flat = {name: types.floats(value.ravel()) for name, value in values.items()}
        flat[by] = flat[by] + step * direction
        p, w, origin = flat.values()
        kernel.set_control_points(p)
        place = types.indices(element), dr.unravel(types.vector2, w), types.indices(corner)
        if by != "rays":
            return kernel.evaluate(*place, derivatives=2)
        ray = SimpleNamespace(o=dr.unravel(types.vector3, origin), d=upload(types.vector3, d))
        return kernel.intersect(ray, *place, derivatives=2)

    step = types.floats(0)
    dr.enable_grad(step)
    at = samples_at(step)
    (change,) = forward([at.dn_du + 2 * at.dn_dv], [step], [types.floats(1)])
    ends = [
        vectors(end.dn_du + 2 * end.dn_dv) for end in (samples_at(types.floats(STEP)), samples_at(types.floats(-STEP)))
    ]
    difference = (ends[0] - ends[1]) / (2 * STEP)
    assert np.abs(difference).max() > 0.1
    np.testing.assert_allclose(change, difference, rtol=0, atol=THIRD * np.abs(difference).max())


@pytest.mark.parametrize("name", SMALL)
def test_derivatives_by_control_points_are_differences_and_the_same_both_ways(name, np_rng):
    surface = small_surface(name)
    kernel = surface.on_device(DOUBLE)
    locations = random_locations(surface, np_rng, 60, deepest=10)
    positions, direction = surface.cage.positions, np_rng.normal(size=surface.cage.positions.shape)

    def moved(step):
        s = LimitSurface(surface.cage.with_positions(positions + step * direction), surface.scheme).evaluate(*locations)
        return s.p, s.n, s.dp_du

    differences = [(a - b) / (2 * STEP) for a, b in zip(moved(STEP), moved(-STEP), strict=True)]
    points = kernel.types.floats(positions.ravel())

    def outputs():
        kernel.set_control_points(points)
        samples = kernel.evaluate(*on_device(kernel.types, *locations))
        return samples.p, samples.n, samples.dp_du

    assert_differentiated(outputs, [points], [kernel.types.floats(direction.ravel())], differences, np_rng)


@pytest.mark.parametrize("name", ["polygons", "triangles"])
def test_derivatives_by_parameters_are_tangents_and_those_of_tangents_and_normals(name, np_rng):
    """At the deeper levels of tips, too, where those by hits leave second derivatives out."""
    surface = small_surface(name)
    kernel = surface.on_device(DOUBLE)
    location = random_locations(surface, np_rng, 200, deepest=6)
    element, uv, corner = on_device(kernel.types, *location)
    expected = surface.evaluate(*location, derivatives=2)
    for axis, second in enumerate(((expected.d2p_duu, expected.d2p_duv), (expected.d2p_duv, expected.d2p_dvv))):
        own = kernel.types.vector2(uv)
        dr.enable_grad(own)
        one, two = (kernel.evaluate(element, own, corner, derivatives=order) for order in (1, 2))
        changes = forward([two.p, two.n, one.dp_du, one.dp_dv], [own], [kernel.types.vector2(1 - axis, axis)])
        first = (two.dp_du, two.dn_du) if axis == 0 else (two.dp_dv, two.dn_dv)
        for change, derivative in zip(changes, (*map(vectors, first), *second), strict=True):
            scale = np.linalg.norm(derivative, axis=1).max()
            np.testing.assert_allclose(change, derivative, rtol=0, atol=BARS[DOUBLE]["derivative"] * scale)


def test_placed_normals_turn_as_the_placed_surface_does(np_rng):
    kernel, matrix = kernel_named("mixed torus", DOUBLE), np.eye(4)
    matrix[:3] = np_rng.normal(size=(3, 4))
    to_world = AffineMap.of(kernel.types.matrix4(matrix.tolist()))
    there_and_back = to_world.inverse_point(to_world.point(kernel.types.vector3(1, 2, 3)))
    np.testing.assert_allclose(vectors(there_and_back), [[1, 2, 3]], rtol=0, atol=10 * BARS[DOUBLE]["point"])

    def at(u, v):
        return kernel.evaluate(3, (u, v), derivatives=2).placed(to_world)

    samples, step = at(0.3, 0.2), 1e-5
    for turn, du, dv in ((samples.dn_du, step, 0), (samples.dn_dv, 0, step)):
        ahead, behind = (vectors(at(0.3 + side * du, 0.2 + side * dv).n) for side in (1, -1))
        difference = (ahead - behind) / (2 * step)
        np.testing.assert_allclose(vectors(turn), difference, rtol=0, atol=1e-8 * np.abs(difference).max())


@pytest.mark.parametrize("name", ["polygons", "border", "triangles"])
def test_derivatives_of_hits_are_differences_and_the_same_both_ways(name, np_rng):
    """By control points, and by the rays' origins and directions: points stay on their rays."""
    surface = small_surface(name)
    kernel = surface.on_device(DOUBLE)
    types, vector3 = kernel.types, kernel.types.vector3
    _, o, d, start = aimed(surface, np_rng, 80, near=0.02)
    # From where they meet the surface: then nothing but rounding is left after three more steps.
    at = hit(kernel, o, d, *start).location
    half_edge, first = np.array(at.half_edge), surface.patches.elements.face_offsets
    element = np.searchsorted(first, half_edge, side="right") - 1
    locations = on_device(types, element, np.array([at.u, at.v]).T, half_edge - first[element])
    values = surface.cage.positions, o, d
    directions = [np_rng.normal(size=value.shape) for value in values]

    def met(step):
        points, *ray = (value + step * direction for value, direction in zip(values, directions, strict=True))
        kernel.set_control_points(types.floats(points.ravel()))
        hits = computed(kernel.intersect(rays_of(types, *ray), *locations))
        return vectors(hits.p), vectors(hits.n), np.array(hits.t)

    differences = [(a - b) / (2 * STEP) for a, b in zip(met(STEP), met(-STEP), strict=True)]
    is_hit = np.isfinite(met(0)[2])
    assert is_hit.mean() > 0.95
    inputs = [types.floats(values[0].ravel()), upload(vector3, o), upload(vector3, d)]

    def outputs():
        kernel.set_control_points(inputs[0])
        hits = kernel.intersect(SimpleNamespace(o=inputs[1], d=inputs[2]), *locations)
        return hits.p, hits.n, hits.t

    changes = [types.floats(directions[0].ravel()), *(upload(vector3, direction) for direction in directions[1:])]
    assert_differentiated(outputs, inputs, changes, differences, np_rng, is_hit, STEEP, HIT_DIFFERENCES)


# What can be wrong


def test_control_points_and_places_have_any_natural_form_but_no_other_number():
    kernel, moved = LimitSurface(cube()).on_device(SINGLE), bumpy(cube())
    p, expected = moved.positions, LimitSurface(moved).evaluate(1, [[0.3, 0.4]], 2)
    tensor, point = upload(dr.llvm.ad.TensorXf, p), upload(kernel.types.vector3, p)
    forms = [p, p.ravel(), p.astype(np.float32).tolist(), tensor, point, kernel.types.floats(p.ravel())]
    for form in forms:
        kernel.set_control_points(cube().positions)
        kernel.set_control_points(form)
        assert_same(kernel.evaluate(1, [0.3, 0.4], 2), expected, BARS[SINGLE])
    with pytest.raises(ValueError, match="21 coordinates; expected 24, x, y, z of 8 control points"):
        kernel.set_control_points(dr.zeros(kernel.types.float, 21))


ARRAYS_ONLY = "expected one of Mitsuba's for arrays, which begin with llvm or cuda"


def test_surfaces_have_the_precision_of_their_variant_and_unknown_ones_and_evaluators_are_errors():
    for cage in (torus(5, 4), extraordinary(5)):
        surface = LimitSurface(cage)
        assert surface.on_device(SINGLE).types.float is dr.llvm.ad.Float
        assert surface.on_device(DOUBLE).types.float is dr.llvm.ad.Float64
        assert surface.on_device("llvm_rgb").types.float is dr.llvm.Float
    for arguments, message in (
        (["opencl_rgb"], f'variant "opencl_rgb"; {ARRAYS_ONLY}'),
        (["scalar_rgb"], f'variant "scalar_rgb"; {ARRAYS_ONLY}'),
        ([SINGLE, "power"], 'evaluator "power"; expected "stabilized" or "stam" on a device'),
    ):
        with pytest.raises(ValueError, match=message):
            surface.on_device(*arguments)
