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
    computed,
    derivatives_both_ways,
    kernel_named,
    on_device,
    random_locations,
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
# Errors on cages of a size of about 3. Points are sums of some tens of products; normals, and derivatives relative to
# their length, lose what the eigenbasis is ill-conditioned by, at valence 50 some hundred roundings.
BARS = {
    DOUBLE: {"point": 1e-13, "normal": 1e-11, "derivative": 1e-11},
    # The same in single precision. Measured: 4e-7, 6e-6 and 7e-6, each at valence or face size 50; rounded up.
    SINGLE: {"point": 1e-6, "normal": 1e-5, "derivative": 1e-5},
}
# Some tens of roundings in single precision.
BORDER_NORMAL = 2e-6
# Relative to the cage's size: what single precision cannot tell apart in coordinates of this size.
ONE_POINT = 2.0**-24
# Central differences in double precision: truncation of about the step squared, rounding over the step.
STEP = 1e-6
DIFFERENCES, HIT_DIFFERENCES = 1e-7, 1e-6
# Near extraordinary points, curvature grows beyond bounds, and so do derivatives and what differences leave out.
STEEP = 1e-4
# Relative to the largest: third derivatives are differences over 2^-10 of a piece, of polynomials of some curvature.
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
    for variant, bars in BARS.items():
        assert_same(evaluated(kernel_named(name, variant), *locations), surface.evaluate(*locations), bars)


@pytest.mark.core
@pytest.mark.parametrize("shape", [(0, 0, 0), (1, 0, 0)], ids=["a point", "a curve"])
def test_normals_of_a_collapsed_surface_do_not_turn(shape, np_rng):
    kernel = LimitSurface(cube().with_positions(cube().positions * shape)).on_device(SINGLE)
    samples = evaluated(kernel, *random_locations(surface_named("cube"), np_rng, 20, deepest=1), derivatives=2)
    for derivative in (samples.dn_du, samples.dn_dv):
        np.testing.assert_array_equal(vectors(derivative), 0)


BORDERS = ["sheet without corners", "half disc of 6", "dart", "crease", "corner", "loop sheet", "loop half disc of 6"]


@pytest.mark.core
@pytest.mark.parametrize("name", BORDERS)
def test_normals_at_borders_are_exact_in_single_precision_down_to_the_vertex(name, np_rng):
    surface = surface_named(name)
    elements, cut = surface.patches.elements, surface.patches.topology
    element, uv, corner = random_locations(surface, np_rng, 4000, deepest=22)
    beside = cut.is_border_vertex[cut.face_vertices[elements.face_offsets[element] + corner]] & (uv.max(axis=1) < 0.1)
    locations = element[beside], uv[beside], corner[beside]
    samples, expected = evaluated(kernel_named(name, SINGLE), *locations), surface.evaluate(*locations)
    assert expected.level.max() > 18
    np.testing.assert_allclose(vectors(samples.n), expected.n, rtol=0, atol=BORDER_NORMAL)


@pytest.mark.parametrize("name", ["hexagon", "valence 2", "half disc of 6", "corner", "loop half disc of 6"])
def test_corner_normals_hold_only_at_the_corner(name, np_rng):
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
def test_derivatives_of_normals_equal_the_surfaces(name, np_rng):
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


# Cages of few control points, as the kernels for derivatives by these take long to compile.
SMALL = {
    "control points of its own": ("catmull_clark", torus(3, 3)),
    "polygons": ("catmull_clark", tetrahedron()),
    "border": ("catmull_clark", half_disc(2)),
    "triangles": ("loop", tetrahedron()),
    "doo_sabin": ("doo_sabin", tetrahedron()),
}
# And order of derivatives. Hits and nearest points from where they are: then nothing but rounding is left after more
# steps.
DIFFERENTIATED = [
    *(("evaluate", name, 2) for name in ("polygons", "doo_sabin")),
    *(("evaluate", name, 1) for name in ("control points of its own", "border")),
    *(("intersect", *case) for case in (("triangles", 2), ("border", 1))),
    *(("closest", name, 1) for name in ("control points of its own", "sheet", "half disc of 6")),
]
LIKE_THESE = ("evaluate", "triangles", 2), ("intersect", "polygons", 2), ("closest", "loop sheet", 1)
DIFFERENTIATED += [pytest.param(*case, marks=pytest.mark.long) for case in LIKE_THESE]


@pytest.mark.parametrize(("kind", "name", "order"), DIFFERENTIATED)
def test_derivatives_are_differences_and_the_same_both_ways(kind, name, order, np_rng):
    """By control points, and by parameters, rays or points: hits stay on their rays, and nearest points near."""
    surface = LimitSurface(bumpy(SMALL[name][1]), SMALL[name][0]) if name in SMALL else surface_named(name)
    kernel, count = surface.on_device(DOUBLE), 80
    types = kernel.types
    element, uv, corner = random_locations(surface, np_rng, count, deepest=6 if kind == "evaluate" else 4)
    # Away from lines between pieces, across which third derivatives jump, and from extraordinary points, beside which
    # hits leave second derivatives out.
    is_middle = np.arange(count) < count / 2
    uv[is_middle] = 0.3 + 0.1 * np.abs(uv - np.round(uv))[is_middle]
    s, others = surface.evaluate(element, uv, corner), [uv]
    if kind == "intersect":
        d = s.n + np_rng.uniform(-0.3, 0.3, s.n.shape)
        others = [s.p - d, d]
    elif kind == "closest":
        size = np.ptp(s.p, axis=0).max()
        beyond = 0.3 * size * np_rng.normal(size=s.p.shape) * ~is_middle[:, None]
        others = [s.p + 0.1 * size * np_rng.normal(size=(count, 1)) * s.n + beyond]
        nearest = surface.closest_point(others[0])
        element, uv, corner = nearest.element, nearest.uv, nearest.corner
    place, values = on_device(types, element, uv, corner), [surface.cage.positions, *others]
    ways = [np_rng.normal(size=value.shape) for value in values]
    tangents, curvature = {"dp_du", "dp_dv"}, {"dn_du", "dn_dv"} if order == 2 else set()
    more = {"evaluate": [*tangents, *curvature], "intersect": ["t", *tangents, *curvature], "closest": ["distance"]}
    names = ["p", "n", *sorted(more[kind])]
    only_in_middle = curvature | (tangents if kind == "intersect" else set())

    def outputs_of(points, *others):
        kernel.set_control_points(points)
        if kind == "evaluate":
            s = kernel.evaluate(place[0], *others, place[2], derivatives=order)
        elif kind == "intersect":
            s = kernel.intersect(SimpleNamespace(o=others[0], d=others[1]), *place, derivatives=order)
        else:
            s = kernel.closest(*others, *place)
        return [getattr(s, name) for name in names]

    def moved(step):
        at = (upload(vector, value + step * way) for vector, value, way in zip(vectors_of, values, ways, strict=True))
        return [np.array(output).T for output in computed(outputs_of(*at))]

    vectors_of = [types.vector2 if value.shape[1] == 2 else types.vector3 for value in values]
    differences = [(a - b) / (2 * STEP) for a, b in zip(moved(STEP), moved(-STEP), strict=True)]
    inputs = [upload(vector, value) for vector, value in zip(vectors_of, values, strict=True)]
    changes = [upload(vector, way) for vector, way in zip(vectors_of, ways, strict=True)]
    forward = derivatives_both_ways(outputs_of, inputs, changes, np_rng, BARS[DOUBLE]["point"])
    is_hit = np.isfinite(moved(0)[names.index("t")]) if kind == "intersect" else np.full(count, True)
    assert is_hit.mean() > 0.95
    for field, derivative, difference in zip(names, forward, differences, strict=True):
        kept = is_hit & is_middle if field in only_in_middle else is_hit
        largest = np.abs(difference[kept]).max()
        assert largest > 0.1
        rtol, atol = (STEEP, HIT_DIFFERENCES) if kind == "intersect" else (DIFFERENCES, DIFFERENCES)
        atol = (THIRD if field in curvature else atol) * max(1, largest)
        np.testing.assert_allclose(derivative[kept], difference[kept], rtol, atol, err_msg=field)


def test_placed_normals_turn_with_the_placed_surface(np_rng):
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


def test_control_points_and_places_have_any_natural_form_but_no_other_number():
    kernel, moved = LimitSurface(cube()).on_device(SINGLE), bumpy(cube())
    p, expected = moved.positions, LimitSurface(moved).evaluate(1, [[0.3, 0.4]], 2)
    tensor, point = upload(dr.llvm.ad.TensorXf, p), upload(kernel.types.vector3, p)
    for form in [p, p.ravel(), p.astype(np.float32).tolist(), tensor, point, kernel.types.floats(p.ravel())]:
        kernel.set_control_points(cube().positions)
        kernel.set_control_points(form)
        assert_same(kernel.evaluate(1, [0.3, 0.4], 2), expected, BARS[SINGLE])
    with pytest.raises(ValueError, match="21 coordinates; expected 24, x, y, z of 8 control points"):
        kernel.set_control_points(dr.zeros(kernel.types.float, 21))


ARRAYS_ONLY = "expected one of Mitsuba's for arrays, which begin with llvm or cuda"


def test_surfaces_have_the_precision_of_their_variant_and_unknown_ones_are_errors():
    for cage in (torus(5, 4), extraordinary(5)):
        surface = LimitSurface(cage)
        assert surface.on_device(SINGLE).types.float is dr.llvm.ad.Float
        assert surface.on_device(DOUBLE).types.float is dr.llvm.ad.Float64
        assert surface.on_device("llvm_rgb").types.float is dr.llvm.Float
    for name in ("opencl_rgb", "scalar_rgb"):
        with pytest.raises(ValueError, match=f'variant "{name}"; {ARRAYS_ONLY}'):
            surface.on_device(name)
