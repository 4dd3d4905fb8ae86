import numpy as np
import pytest
from kernels.surfaces import aimed, computed, hit, kernel_named, random_locations, surface_named, vectors
from mitsuba_subdivision import LimitSurface
from mitsuba_subdivision.cage.named_cages import cube
from mitsuba_subdivision.device_arrays import upload
from mitsuba_subdivision.kernels import line_intersection
from mitsuba_subdivision.kernels.line_intersection import ON_LINE, ON_NORMAL
from patches.closed_cages import bumpy, extraordinary_triangles

pytestmark = pytest.mark.usefixtures("llvm")

DOUBLE, SINGLE = "llvm_ad_rgb_double", "llvm_ad_rgb"
# Errors of points of a surface of a size of about 3, see test_surface_kernel.
POINT = {DOUBLE: 1e-13, SINGLE: 1e-6}
HIT = ["mixed torus", "sheet", "corner", "chaikin", "loop corner", "doo_sabin mixed torus"]
# How far a hit is from its ray: the last of Newton's steps is below 3e-4 in parameters of a piece, and what is left is
# about its square. In single precision, that and the rounding of rays some units long.
ON_RAY = {DOUBLE: 2e-6, SINGLE: 5e-6}


@pytest.mark.core
@pytest.mark.parametrize(("name", "variant"), [*((name, DOUBLE) for name in HIT), ("loop corner", SINGLE)])
def test_rays_hit_their_target_points(name, variant, np_rng):
    surface, kernel = surface_named(name), kernel_named(name, variant)
    target, o, d, start = aimed(surface, np_rng, 1000)
    hits = hit(kernel, o, d, *start)
    t, p = np.array(hits.t).astype(float), vectors(hits.p)
    met = np.isfinite(t)
    assert met.mean() > 0.99
    assert np.linalg.norm(o + t[:, None] * d - p, axis=1)[met].max() <= ON_RAY[variant]
    # A few rays meet another part of the surface that is as near.
    assert (np.linalg.norm(p - target, axis=1)[met] <= 10 * ON_RAY[variant]).mean() > 0.99
    # The location of a hit is where the point lies.
    np.testing.assert_allclose(vectors(kernel.at(hits.location).p), p, rtol=0, atol=POINT[variant])
    assert surface.scheme.domain.inside(np.array([hits.location.u, hits.location.v]).T).min() >= 0
    if variant == DOUBLE:
        # Half of the points are too far away, along the line.
        lengths = 0.1 * np.linalg.norm(d, axis=1)
        line = (upload(kernel.types.vector3, array) for array in (target - 0.1 * d, d))
        _, kind, _ = computed(kernel.line_hits(*line, hits.location, max_distance=np.median(lengths)))
        assert ((np.array(kind) == ON_LINE) == (lengths < np.median(lengths))).mean() > 0.98


def met_past_a_border(kernel, surface, beyond, turns=0):
    """Points beside a border, and what is met of lines across them; from locations seen from the next corners."""
    types, elements = kernel.types, surface.patches.elements
    edges = np.flatnonzero(elements.twin < 0)
    element = elements.face[edges].astype(int)
    corner = edges - elements.face_offsets[element]
    uv = np.stack([np.full(len(edges), 0.4), np.zeros(len(edges))], axis=1)
    border = surface.evaluate(element, uv, corner)
    out = -border.dp_dv / np.linalg.norm(border.dp_dv, axis=1)[:, None]
    p, d = border.p + beyond * out, border.n + 0.1 * border.dp_du
    u, v = uv[:, 0], uv[:, 1] + 0.03
    for _ in range(turns):
        u, v, corner = v, 1 - u, (corner + 1) % 4
    start = kernel.walk.at(types.indices(element), types.floats(u), types.floats(v), types.indices(corner))
    return p, *computed(kernel.line_hits(upload(types.vector3, p), upload(types.vector3, d), start))


@pytest.mark.core
@pytest.mark.parametrize("variant", [DOUBLE, SINGLE])
@pytest.mark.parametrize("beyond", [1e-5, 1e-3, 1e-2, 5e-2, 1.0])
def test_lines_past_a_border_end_at_the_same_point_from_any_corner(variant, beyond):
    surface, kernel = surface_named("sheet without corners"), kernel_named("sheet without corners", variant)
    p, location, kind, values = met_past_a_border(kernel, surface, beyond)
    assert (np.array(kind) == ON_NORMAL).all()
    there = kernel.at(location)
    np.testing.assert_allclose(vectors(values.value), vectors(there.p), rtol=0, atol=POINT[variant])
    inside = surface.scheme.domain.inside(np.array([location.u, location.v]).T)
    np.testing.assert_allclose(inside, 0, rtol=0, atol=ON_RAY[variant])
    assert np.linalg.norm(vectors(there.p) - p, axis=1).max() <= 1.5 * beyond + ON_RAY[variant]
    for turns in (1, 2, 3):
        _, turned, _, turned_values = met_past_a_border(kernel, surface, beyond, turns)
        np.testing.assert_array_equal(turned.half_edge, location.half_edge)
        np.testing.assert_allclose(vectors(turned_values.value), vectors(values.value), rtol=0, atol=ON_RAY[variant])


@pytest.mark.parametrize("depth", [7, 8, 11, 14, 15])
@pytest.mark.parametrize(
    ("cage", "scheme"),
    [(cube(), "catmull_clark"), (bumpy(cube()), "catmull_clark"), (extraordinary_triangles(3), "loop")],
)
def test_rays_meet_points_next_to_extraordinary_ones_in_single_precision(cage, scheme, depth, np_rng):
    """There, steps of Newton's that rounding makes are long, and tolerances shrink below the rounding of points."""
    surface = LimitSurface(cage, scheme)
    kernel, t = surface.on_device(SINGLE), surface.patches.elements
    half_edge = np_rng.choice(np.flatnonzero(np.bincount(cage.face_vertices)[cage.face_vertices] == 3), 500)
    element = t.face[half_edge].astype(np.int64)
    corner, uv = half_edge - t.face_offsets[element], np_rng.random((500, 2)) * 2.0**-depth
    target = surface.evaluate(element, uv, corner)
    hits = hit(kernel, target.p + 0.1 * target.n, -target.n, element, uv, corner)
    assert np.isfinite(np.array(hits.t)).mean() > 0.98
    start = np.clip(uv + np_rng.uniform(-0.02, 0.02, uv.shape), 0, 1)
    d = -target.n + np_rng.uniform(-0.5, 0.5, (500, 3))
    hits = hit(kernel, target.p - 2 * d, d, element, start, corner)
    met = np.isfinite(np.array(hits.t))
    # A few wander between pieces until they are given up.
    assert met.mean() > 0.97
    np.testing.assert_allclose(vectors(hits.p)[met], target.p[met], rtol=0, atol=10 * ON_RAY[SINGLE])


@pytest.mark.core
@pytest.mark.parametrize("variant", [DOUBLE, SINGLE])
def test_rays_past_a_convex_surface_meet_nothing(variant, np_rng):
    surface = LimitSurface(cube())
    kernel = surface.on_device(variant)
    element, uv, corner = random_locations(surface, np_rng, 500, deepest=4)
    s = surface.evaluate(element, uv, corner)
    along = np_rng.normal(size=(500, 2, 1))
    d = along[:, 0] * s.dp_du + along[:, 1] * s.dp_dv
    d /= np.linalg.norm(d, axis=1)[:, None]
    for height, are_met in ((0.05, False), (-0.05, True)):
        hits = hit(kernel, s.p + height * s.n - 2 * d, d, element, uv, corner)
        met = np.isfinite(np.array(hits.t))
        assert np.isfinite(vectors(hits.p)).all()
        assert np.isfinite(vectors(hits.n)).all()
        # Grazing rays may be given up.
        assert met.mean() > 0.9 if are_met else not met.any()


@pytest.mark.core
def test_rays_from_far_away_hit_as_exactly_as_from_nearby():
    """Their origins and directions are exact, and so is the point of the ray that is nearest to the start."""
    surface, kernel = surface_named("mixed torus"), kernel_named("mixed torus", DOUBLE)
    uv, d = np.array([[0.25, 0.375]]), np.array([[1.0, -1.0, 1.0]])
    target = np.round(surface.evaluate([5], uv).p * 1024) / 1024
    near, far = (hit(kernel, target - t * d, d, np.array([5]), uv + 0.03, np.array([0])) for t in (1.0, 2.0**33))
    assert np.isfinite(np.array(near.t)).all()
    np.testing.assert_allclose(vectors(far.p), vectors(near.p), rtol=0, atol=1e-9)


@pytest.mark.core
@pytest.mark.parametrize("rounds", [1, 2, 3])
def test_locations_match_points_for_any_number_of_rounds(monkeypatch, np_rng, rounds):
    surface, kernel = surface_named("mixed torus"), kernel_named("mixed torus", DOUBLE)
    types = kernel.types
    monkeypatch.setattr(line_intersection, "ROUNDS", rounds)
    samples = surface.sample(12, 2)
    u, v = np.clip(samples.uv + np_rng.uniform(-0.1, 0.1, (12, 2)), 0.01, 0.49).T
    place = types.indices(samples.element), types.floats(u), types.floats(v), types.indices(samples.corner)
    start = kernel.walk.at(*place)
    lines = upload(types.vector3, samples.p), upload(types.vector3, samples.n)
    location, kind, values = computed(kernel.line_hits(*lines, start))
    are_hit = np.array(kind) == ON_LINE
    assert are_hit.any()
    again = vectors(kernel.at(location).p)
    np.testing.assert_allclose(again[are_hit], vectors(values.value)[are_hit], rtol=0, atol=ON_RAY[DOUBLE])
