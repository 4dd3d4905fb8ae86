"""Traced surfaces, asked by a small stand-in for Mitsuba 3.10, against rays at fine triangles in Mitsuba 3.9."""

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from mitsuba_subdivision import LimitSurface
from mitsuba_subdivision.cage import ControlCage, named_cages
from mitsuba_subdivision.patches import PieceTable
from mitsuba_subdivision.schemes import CatmullClark, SchemeError
from mitsuba_subdivision.schemes.stencil_table import StencilTable
from mitsuba_subdivision.shapes.traced_surface import (
    DETACH_SHAPE,
    FOLLOW_SHAPE,
    NORMAL_PARTIALS,
    make_traced_subdivision,
    primitive_boxes,
    primitive_half_edges,
    require_averages,
    traced_problem,
)
from reference.refined_cages import refine_first

pytestmark = pytest.mark.usefixtures("variant_llvm_ad_rgb")

RATE = 64
RAYS = 4000
# The cages have edges of length 2 at most and bend by a quarter of a turn within one: triangles of the rate are off by
# up to 2e-4, measured along their normal; at a sharp edge, along the other side's.
CHORD = 5e-4
# Rays as near to an outline as the triangles are to the surface may hit either alone: some in ten thousand.
OUTLINE = RAYS // 500
# Some roundings of single precision at the rays' length.
SINGLE = 4e-6
# Where rays turn back, in lengths of their direction: behind the surface, also for the shortest.
TURN = 24
# Some roundings of single precision at that distance, over the sine of a few degrees.
GRAZING = 1e-3


def _cube(faces=None, **tags):
    cube = named_cages.cube()
    return ControlCage(cube.positions, cube.face_vertices.reshape(-1, 4) if faces is None else faces, **tags)


# A crease around a face, of which one edge is semi-sharp, and a sharp vertex.
_SHARP = {"creases": [(4, 5, 10), (5, 7, 10), (7, 6, 2.5), (6, 4, 10)], "corners": [(0, 10)]}
# The top is two triangles, two sides are joined to an L-shaped hexagon.
_MIXED = [[0, 2, 3, 1], [4, 5, 7], [4, 7, 6], [3, 2, 6, 7], [0, 4, 6, 2], [1, 3, 7, 5, 4, 0]]
SURFACES = {
    "cube": (_cube, "catmull_clark"),
    "Doo-Sabin cube": (_cube, "doo_sabin"),
    "tetrahedron": (named_cages.tetrahedron, "loop"),
    "torus": (lambda: named_cages.torus(5, 4), "catmull_clark"),
    "dome": (lambda: named_cages.extraordinary(7, closed=False), "catmull_clark"),
    "open triangles": (lambda: named_cages.extraordinary_triangles(5), "loop"),
    "Doo-Sabin dome": (lambda: named_cages.extraordinary(5, closed=False), "doo_sabin"),
    "creases": (lambda: _cube(**_SHARP), "catmull_clark"),
    "mixed faces": (lambda: _cube(_MIXED), "catmull_clark"),
    "without a face": (lambda: _cube(holes=[1]), "catmull_clark"),
}


@pytest.fixture(params=SURFACES)
def surface(request):
    cage, scheme = SURFACES[request.param]
    return LimitSurface(cage(), scheme)


class ShapeOf310:
    """What is public of Mitsuba 3.10's class of shapes, as far as a traced shape asks it."""

    def __init__(self, props):
        self.props, self.is_initialized = props, False

    def initialize(self):
        self.is_initialized = True

    def traverse(self, callback):
        pass

    def parameters_changed(self, keys):
        pass


class SceneOf310:
    """A scene of one traced shape: all rays with all primitives whose boxes they meet."""

    def __init__(self, shape):
        assert shape.is_initialized
        self.shape = shape
        boxes = [shape.bbox(prim_index) for prim_index in range(shape.primitive_count())]
        self.low, self.high = (np.array([getattr(box, side) for box in boxes]) for side in ("min", "max"))

    def preliminary(self, ray):
        o, d, maxt = np.array(ray.o).T, np.array(ray.d).T, np.array(ray.maxt)
        with np.errstate(divide="ignore", invalid="ignore"):
            to_low, to_high = ((side - o[:, None]) / d[:, None] for side in (self.low, self.high))
        enters, leaves = np.minimum(to_low, to_high).max(axis=2), np.maximum(to_low, to_high).min(axis=2)
        number, primitive = np.nonzero((enters <= leaves) & (leaves > 0) & (enters <= maxt[:, None]))
        asked = dr.gather(mi.Ray3f, ray, mi.UInt32(number))
        found = self.shape.ray_intersect_preliminary(asked, mi.UInt32(primitive), mi.Mask(True))
        dr.eval(found)
        t = np.array(found.t)
        np.testing.assert_array_equal(np.array(found.valid), np.isfinite(t))
        np.testing.assert_array_equal(np.array(found.prim_index), primitive)
        # Of each ray's hits the first.
        order = np.lexsort((t, number))
        rays, first = np.unique(number[order], return_index=True)
        nearest, prim_index = np.full(len(o), np.inf), np.zeros(len(o), dtype=np.uint32)
        nearest[rays], prim_index[rays] = t[order][first], primitive[order][first]
        result = dr.zeros(mi.PreliminaryIntersection3f, len(o))
        result.t, result.prim_index = mi.Float(nearest), mi.UInt32(prim_index)
        result.valid = dr.isfinite(result.t)
        return result

    def ray_intersect(self, ray, flags=NORMAL_PARTIALS):
        found = self.preliminary(ray)
        si = self.shape.compute_surface_interaction(ray, found, flags, found.valid)
        # In one kernel: each of its values alone would have one of its own, for each surface.
        dr.eval(si)
        return si


def traced(surface, **parameters):
    given = {**surface.cage.as_properties(mi), "scheme": surface.scheme.name, **parameters}
    props = mi.Properties("traced")
    for name, value in given.items():
        props[name] = value
    return make_traced_subdivision(mi.llvm_ad_rgb, ShapeOf310)(props)


def triangles(surface, **parameters):
    given = {**surface.cage.as_properties(mi), "scheme": surface.scheme.name, **parameters}
    return mi.load_dict({"type": "scene", "shape": {"type": "subdivision", "tessellation_rate": RATE, **given}})


def hits_of_triangles(surface, ray, **parameters):
    si = triangles(surface, **parameters).ray_intersect(ray)
    dr.eval(si)
    return si


def rays_at(cage, rng, count=RAYS):
    """From a sphere around the cage to points in its box; directions of any length."""
    o = rng.normal(size=(count, 3))
    o *= 6 / np.linalg.norm(o, axis=1, keepdims=True)
    to = rng.uniform(cage.positions.min(axis=0), cage.positions.max(axis=0), size=(count, 3))
    d = to - o
    d *= rng.uniform(0.5, 2, size=(count, 1)) / np.linalg.norm(d, axis=1, keepdims=True)
    return mi.Ray3f(mi.Point3f(o.T.astype(np.float32)), mi.Vector3f(d.T.astype(np.float32)))


def normal_distance(found, expected, ray):
    """How far apart hits are, measured along the normal of the expected ones."""
    along = dr.abs(dr.dot(expected.n, ray.d)) * dr.abs(found.t - expected.t)
    return np.array(along)[np.array(found.is_valid() & expected.is_valid())]


def test_mitsuba_of_today_does_not_use_it(monkeypatch):
    assert traced_problem(mi.llvm_ad_rgb) == f"needs Mitsuba 3.10; this is {mi.__version__}"
    with pytest.raises(RuntimeError, match=r"tracing a surface needs Mitsuba 3\.10"):
        make_traced_subdivision(mi.llvm_ad_rgb)
    monkeypatch.setattr(mi, "__version__", "3.10.0")
    assert "another interface" in traced_problem(mi.llvm_ad_rgb)
    assert "backend" in traced_problem(mi.scalar_rgb)


def test_the_first_hit_is_that_of_fine_triangles_and_lies_on_the_surface(surface, np_rng):
    ray = rays_at(surface.cage, np_rng)
    found, expected = SceneOf310(traced(surface)).ray_intersect(ray), hits_of_triangles(surface, ray)
    hits, expected_hits = np.array(found.is_valid()), np.array(expected.is_valid())
    assert expected_hits.sum() > RAYS // 20
    assert (~expected_hits).sum() > RAYS // 20
    assert (hits != expected_hits).sum() <= OUTLINE
    assert (normal_distance(found, expected, ray) > CHORD).sum() <= OUTLINE
    # Normals on the same side, but for hits of the other side of an edge.
    same = np.array(dr.dot(found.n, expected.n))[hits & expected_hits]
    assert (same < 0.9).mean() < 0.01
    _assert_on_ray_and_surface(surface, found, ray)


def _assert_on_ray_and_surface(surface, found, ray):
    hit = np.flatnonzero(np.array(found.is_valid()))
    np.testing.assert_allclose(np.array(found.p)[:, hit], np.array(ray(found.t))[:, hit], rtol=0, atol=SINGLE * 6)
    patches = surface.patches
    half_edge = primitive_half_edges(patches)[np.array(found.prim_index)[hit]]
    element = patches.elements.face_of(half_edge)
    uv = np.clip(np.array(found.uv, dtype=np.float64).T[hit], 0, 1)
    # Where rounding has put parameters outside of a triangle.
    uv /= np.maximum(uv.sum(axis=1, keepdims=True), 1) if surface.scheme.domain.corner_count == 3 else 1
    samples = surface.evaluate(element, uv, half_edge - patches.elements.face_offsets[element])
    np.testing.assert_allclose(np.array(found.p).T[hit], samples.p, rtol=0, atol=SINGLE)
    has_normal = (np.array(found.n).T[hit] * samples.n).sum(axis=1)
    assert np.quantile(has_normal, 0.001) > 1 - 1e-5


@pytest.mark.parametrize("name", ["cube", "tetrahedron"])
def test_of_two_hits_in_an_element_the_first_counts(name, np_rng):
    surface = LimitSurface(SURFACES[name][0](), SURFACES[name][1])
    ray = rays_at(surface.cage, np_rng, 10 * RAYS)
    found, expected = SceneOf310(traced(surface)).ray_intersect(ray), hits_of_triangles(surface, ray)
    # Triangles lie inside a convex surface, so that rays meet it before them.
    missed = np.array(expected.is_valid() & ~found.is_valid())
    later = np.array(expected.is_valid() & found.is_valid() & (found.t > expected.t + SINGLE * 6))
    assert missed.sum() + later.sum() == 0


def test_an_interaction_is_at_the_distance_that_it_is_asked_for(np_rng):
    shape = traced(LimitSurface(named_cages.tetrahedron(), "loop"))
    scene, ray = SceneOf310(shape), rays_at(named_cages.tetrahedron(), np_rng)
    back = mi.Ray3f(ray(TURN), -ray.d)
    first, last = scene.preliminary(ray), scene.preliminary(back)
    twice = np.array(first.valid & last.valid & (first.prim_index == last.prim_index))
    assert twice.sum() > RAYS // 100
    first.t = TURN - last.t
    found = shape.compute_surface_interaction(ray, first, 0, first.valid)
    np.testing.assert_allclose(np.array(found.t)[twice], TURN - np.array(last.t)[twice], rtol=0, atol=GRAZING)


def test_rays_that_go_on_pass_a_closed_surface_an_even_number_of_times(np_rng):
    surface = LimitSurface(named_cages.torus(5, 4))
    scene, mesh = SceneOf310(traced(surface)), triangles(surface)
    ray = rays_at(surface.cage, np_rng)
    own, other, before = ray, mi.Ray3f(ray), None
    for is_entry in (True, False, True, False):
        found, expected = scene.ray_intersect(own), mesh.ray_intersect(other)
        dr.eval(expected)
        hits, expected_hits = np.array(found.is_valid()), np.array(expected.is_valid())
        assert (hits != expected_hits).sum() <= OUTLINE
        assert ((np.array(dr.dot(found.n, ray.d)) < 0) != is_entry)[hits].sum() <= OUTLINE
        assert is_entry or (hits != before).sum() <= OUTLINE
        before = hits
        own, other = found.spawn_ray(ray.d), expected.spawn_ray(ray.d)
        own.maxt, other.maxt = (dr.select(each.is_valid(), dr.inf, 0) for each in (found, expected))
        dr.eval(own, other)


def test_hits_beyond_the_end_of_a_ray_do_not_count(np_rng):
    surface = LimitSurface(_cube())
    scene, ray = SceneOf310(traced(surface)), rays_at(surface.cage, np_rng)
    t = scene.preliminary(ray).t
    # Of rays that end halfway between their two hits, and before the first.
    for share, hits in ((0.999, False), (1.001, True)):
        short = mi.Ray3f(ray)
        short.maxt = dr.select(dr.isfinite(t), t * share, dr.inf)
        valid = np.array(scene.preliminary(short).valid)
        np.testing.assert_array_equal(valid, np.isfinite(np.array(t)) & hits)


# Each with and without, in two kernels rather than four: every surface is compiled for itself.
@pytest.mark.parametrize(("scale", "flips"), [((1, 2, 0.5), True), ((1, 1, -1), False)])
def test_placements_and_flipped_normals(np_rng, scale, flips):
    surface = LimitSurface(named_cages.extraordinary(5))
    to_world = mi.ScalarTransform4f().translate([0.3, -0.2, 0.1]).rotate([1, 2, 3], 40).scale(scale)
    parameters = {"to_world": to_world, "flip_normals": flips}
    ray = rays_at(surface.cage, np_rng)
    found = SceneOf310(traced(surface, **parameters)).ray_intersect(ray)
    expected = hits_of_triangles(surface, ray, **parameters)
    assert (np.array(found.is_valid()) != np.array(expected.is_valid())).sum() <= OUTLINE
    assert (normal_distance(found, expected, ray) > CHORD).sum() <= OUTLINE
    both = np.array(found.is_valid() & expected.is_valid())
    assert np.quantile(np.array(dr.dot(found.n, expected.sh_frame.n))[both], 0.01) > 0.99


def test_boxes_hold_the_surface(surface, np_rng):
    patches = surface.patches
    table = PieceTable.build(patches, surface.cage.cut_mesh.vertex, surface.cage.vertex_count)
    _assert_boxes_hold(surface, primitive_boxes(table, surface.cage.positions), np_rng)


def test_boxes_hold_the_surface_of_a_cage_that_is_refined_once(np_rng, monkeypatch):
    refine_first(monkeypatch)
    cage = named_cages.torus(5, 4)
    # Else the box of one quarter of an element holds the others, as their one-rings overlap.
    far = cage.positions.copy()
    far[0] *= 100
    surface = LimitSurface(cage.with_positions(far))
    assert surface.patches.refined is not None
    table = PieceTable.build(surface.patches, surface.cage.cut_mesh.vertex, surface.cage.vertex_count)
    _assert_boxes_hold(surface, primitive_boxes(table, surface.cage.positions), np_rng)


def _assert_boxes_hold(surface, boxes, rng, count=200):
    half_edge, elements = primitive_half_edges(surface.patches), surface.patches.elements
    assert len(boxes) == len(half_edge)
    uv = rng.uniform(size=(count, 2))
    if surface.scheme.domain.corner_count == 3:
        uv = np.where(uv.sum(axis=1, keepdims=True) > 1, 1 - uv, uv)
    uv = np.concatenate([uv, surface.scheme.domain.corners])
    element = elements.face_of(half_edge)
    corner = half_edge - elements.face_offsets[element]
    p = surface.evaluate(element[:, None], uv, corner[:, None]).p.reshape(len(half_edge), -1, 3)
    assert (p >= boxes[:, None, 0] - 1e-12).all()
    assert (p <= boxes[:, None, 1] + 1e-12).all()
    # Else boxes of the whole cage would do.
    whole = surface.cage.positions
    assert (boxes[:, 0] >= whole.min(axis=0)).all()
    assert (boxes[:, 1] <= whole.max(axis=0)).all()


def test_boxes_of_a_fine_cage_are_those_of_the_faces_around():
    surface = LimitSurface(named_cages.torus(24, 16))
    table = PieceTable.build(surface.patches, surface.cage.cut_mesh.vertex, surface.cage.vertex_count)
    sizes = np.ptp(primitive_boxes(table, surface.cage.positions), axis=1)
    # Three faces along each side, of the outermost ones.
    assert sizes.max() < 3 * np.hypot(2 * np.pi * 3 / 24, 2 * np.pi / 16)


def test_schemes_with_negative_weights_are_refused():
    class Overshooting(CatmullClark):
        def refine(self, topology):
            refinement = super().refine(topology)
            rows = refinement.stencils.matrix.copy()
            rows.data *= 1.1
            rows.data[rows.indptr[:-1]] *= -1
            return refinement._replace(stencils=StencilTable.from_matrix(rows))

    require_averages(LimitSurface(_cube()))
    surface = LimitSurface(_cube())
    object.__setattr__(surface, "scheme", Overshooting())
    with pytest.raises(SchemeError, match=r"has the weight -.* expected none below 0"):
        require_averages(surface)


def test_intersections_can_be_traced_without_evaluating_anything(np_rng):
    shape = traced(LimitSurface(_cube(**_SHARP)))
    ray = rays_at(named_cages.cube(), np_rng, 100)
    primitive = mi.UInt32(np.arange(100) % shape.primitive_count())
    expected = shape.ray_intersect_preliminary(ray, primitive, mi.Mask(True))
    dr.eval(ray, primitive, expected)

    def traced_once(ray, primitive):
        found = shape.ray_intersect_preliminary(ray, primitive, mi.Mask(True))
        return found.t, found.prim_uv

    # Functions that a symbolic call traces may read arrays, but neither evaluate nor write.
    with dr.scoped_set_flag(dr.JitFlag.SymbolicCalls, True):
        t, uv = dr.switch(mi.UInt32(np.zeros(100)), [traced_once, traced_once], ray, primitive, mode="symbolic")
    np.testing.assert_array_equal(np.array(t), np.array(expected.t))
    np.testing.assert_array_equal(np.array(uv), np.array(expected.prim_uv))


@pytest.mark.parametrize("flags", [0, FOLLOW_SHAPE, DETACH_SHAPE])
def test_hits_move_with_the_control_points(flags):
    shape = traced(LimitSurface(_cube()))
    ray = mi.Ray3f(mi.Point3f(0.3, 0.2, -5), mi.Vector3f(0, 0, 2))
    shift, velocity = mi.Float(0), np.array([1.0, -0.5, 2.0])
    dr.enable_grad(shift)
    shape.control_points = dr.ravel(dr.unravel(mi.Point3f, shape.control_points) + mi.Vector3f(velocity) * shift)
    shape.parameters_changed(["control_points"])
    si = SceneOf310(shape).ray_intersect(ray, flags)
    n = np.array(dr.detach(si.n)).ravel()
    # Copies, as derivatives of what others are computed from are forgotten.
    t, p = si.t + 0, si.p + 0
    dr.forward(shift)
    of_t, of_p = np.array(dr.grad(t)), np.array(dr.grad(p)).ravel()
    if flags == DETACH_SHAPE:
        expected = np.zeros(3)
    elif flags == FOLLOW_SHAPE:
        expected = velocity
    else:
        # On the ray, and in the tangent plane as it moves.
        expected = np.array([0, 0, velocity @ n / n[2]])
    np.testing.assert_allclose(of_p, expected, rtol=0, atol=1e-5)
    np.testing.assert_allclose(of_t, expected[2] / 2, rtol=0, atol=1e-5)


def test_moved_control_points_have_moved_boxes_and_hits(np_rng):
    surface = LimitSurface(named_cages.extraordinary(5))
    shape, ray = traced(surface), rays_at(surface.cage, np_rng)
    t = np.array(SceneOf310(shape).preliminary(ray).t)
    shape.control_points = shape.control_points + 0.5
    shape.parameters_changed(["control_points"])
    moved = mi.Ray3f(ray.o + 0.5, ray.d)
    np.testing.assert_allclose(np.array(SceneOf310(shape).preliminary(moved).t), t, rtol=0, atol=1e-3)
    shape.control_points = shape.control_points * np.nan
    with pytest.raises(ValueError, match="control_points"):
        shape.parameters_changed(["control_points"])
