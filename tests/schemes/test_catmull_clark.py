import math
from decimal import Decimal

import numpy as np
import pytest
from mitsuba_subdivision.cage.named_cages import extraordinary
from mitsuba_subdivision.mesh.one_ring import one_ring
from mitsuba_subdivision.mesh.signature import Signature
from mitsuba_subdivision.schemes import CatmullClark, Scheme, scheme_named
from mitsuba_subdivision.schemes.domain import IDENTITY
from patches.closed_cages import CLOSED_CAGES, bumpy, polygons
from reference.exact_samples import mesh_of
from reference.rules import RULES

pytestmark = pytest.mark.core

# A stencil has some tens of weights, each with an error of half a unit in its last place.
ROUNDING = 1e-14
EVERY_CLOSED_CAGE = pytest.mark.parametrize("name", CLOSED_CAGES)
SCHEME = CatmullClark()
# A quad, a triangle and a pentagon around a corner, a fan of their own, and a vertex without a face.
OPEN_FACES = [(0, 1, 2, 3), (2, 1, 4), (3, 2, 4, 5, 6), (7, 8, 9)]
OPEN = {
    "mixed": mesh_of(11, OPEN_FACES),
    "one triangle": mesh_of(3, [(0, 1, 2)]),
    "dome": extraordinary(5, closed=False).topology,
}
EVERY_OPEN_MESH = pytest.mark.parametrize("topology", OPEN.values(), ids=OPEN)


def random_points(count, seed=3):
    return np.random.default_rng(seed).standard_normal((count, 3))


def edge_numbers(topology):
    ends = zip(topology.face_vertices.tolist(), topology.face_vertices[topology.next].tolist(), strict=True)
    return {frozenset(pair): int(edge) for pair, edge in zip(ends, topology.edge, strict=True)}


@EVERY_CLOSED_CAGE
def test_refinement_follows_the_rules(name):
    cage = bumpy(CLOSED_CAGES[name]())
    topology, refinement = cage.topology, SCHEME.refine(cage.topology)
    refined = refinement.apply(cage.positions)
    edges = edge_numbers(topology)
    begin = {"vertex": 0, "edge": topology.vertex_count, "face": topology.vertex_count + topology.edge_count}
    faces = polygons(topology)
    keyed, point = RULES["catmull_clark"](
        faces, {i: tuple(map(Decimal, p)) for i, p in enumerate(cage.positions.tolist())}
    )

    def number(key):
        kind, of = key
        return begin[kind] + (edges[of] if kind == "edge" else of)

    assert polygons(refinement.topology) == [tuple(map(number, quad)) for quad in keyed]
    keys = {number(key): key for quad in keyed for key in quad}
    assert sorted(keys) == list(range(len(refined)))
    expected = np.array([point(keys[i]) for i in range(len(refined))], dtype=float)
    np.testing.assert_allclose(refined, expected, rtol=0, atol=ROUNDING)


@EVERY_CLOSED_CAGE
def test_refined_mesh_is_a_closed_manifold_of_quads(name):
    topology = CLOSED_CAGES[name]().topology
    refined = SCHEME.refine(topology).topology
    assert refined.vertex_count == topology.vertex_count + topology.edge_count + topology.face_count
    assert refined.face_count == topology.half_edge_count
    assert refined.edge_count == 2 * topology.edge_count + topology.half_edge_count
    assert (refined.face_sizes == 4).all()
    assert (refined.twin >= 0).all()
    np.testing.assert_array_equal(
        refined.face_vertices[refined.twin], refined.face_vertices[refined.next], "neighbours run opposite ways"
    )
    directed = refined.face_vertices * refined.vertex_count + refined.face_vertices[refined.next]
    assert len(np.unique(directed)) == refined.half_edge_count


@EVERY_CLOSED_CAGE
def test_refinement_keeps_valences_and_makes_faces_into_vertices_of_their_size(name):
    topology = CLOSED_CAGES[name]().topology
    expected = [*topology.vertex_face_count, *[4] * topology.edge_count, *topology.face_sizes]
    np.testing.assert_array_equal(SCHEME.refine(topology).topology.vertex_face_count, expected)


@pytest.mark.parametrize(
    "topology", [*(make().topology for make in CLOSED_CAGES.values()), *OPEN.values()], ids=[*CLOSED_CAGES, *OPEN]
)
def test_stencils_sum_to_one_and_are_affine_invariant(topology):
    matrix = SCHEME.refine(topology).stencils.matrix
    assert matrix.shape == (topology.vertex_count + topology.edge_count + topology.face_count, topology.vertex_count)
    np.testing.assert_allclose(matrix.sum(axis=1), 1, rtol=0, atol=ROUNDING)
    points = random_points(topology.vertex_count)
    linear, offset = random_points(3, seed=4), np.array([10.0, -20.0, 30.0])
    np.testing.assert_allclose(
        matrix @ (points @ linear + offset), matrix @ points @ linear + offset, rtol=0, atol=100 * ROUNDING
    )


@EVERY_OPEN_MESH
def test_border_vertices_move_along_the_border_only(topology):
    points = random_points(topology.vertex_count)
    refined = SCHEME.refine(topology).apply(points)
    border = np.flatnonzero(topology.twin < 0)
    ends = np.stack([topology.face_vertices[border], topology.face_vertices[topology.next[border]]], axis=1)
    for vertex in np.unique(ends):
        a, b = ends[(ends == vertex).any(axis=1)].sum(axis=1) - vertex
        expected = (6 * points[vertex] + points[a] + points[b]) / 8
        np.testing.assert_allclose(refined[vertex], expected, rtol=0, atol=ROUNDING)
    midpoints = points[ends].mean(axis=1)
    on_border = refined[topology.vertex_count + topology.edge[border]]
    np.testing.assert_allclose(on_border, midpoints, rtol=0, atol=ROUNDING)


@EVERY_OPEN_MESH
def test_inside_an_open_mesh_the_rules_are_those_of_a_closed_one(topology):
    points = random_points(topology.vertex_count)
    refined = SCHEME.refine(topology).apply(points)
    _, point = RULES["catmull_clark"](
        polygons(topology), {i: tuple(map(Decimal, p)) for i, p in enumerate(points.tolist())}
    )
    expected = {topology.vertex_count + topology.edge_count + f: ("face", f) for f in range(topology.face_count)}
    interior = np.flatnonzero(~topology.is_border_vertex & (topology.vertex_face_count > 0))
    expected |= {int(v): ("vertex", int(v)) for v in interior}
    inner_edges = set(topology.edge[topology.twin >= 0].tolist())
    numbers = edge_numbers(topology).items()
    expected |= {topology.vertex_count + e: ("edge", ends) for ends, e in numbers if e in inner_edges}
    for index, key in expected.items():
        np.testing.assert_allclose(refined[index], np.array(point(key), dtype=float), rtol=0, atol=ROUNDING)


def test_vertex_without_face_stays():
    points = random_points(11)
    np.testing.assert_array_equal(SCHEME.refine(OPEN["mixed"]).apply(points)[10], points[10])


@pytest.mark.parametrize("dtype", [np.float64, np.float32])
@pytest.mark.parametrize("derivatives", [0, 1, 2])
def test_regular_basis_has_the_shape_and_precision_of_its_arguments(dtype, derivatives):
    uv = np.random.default_rng(5).random((7, 2)).astype(dtype)
    basis = SCHEME.regular_basis(uv, derivatives)
    assert basis.dtype == dtype
    assert basis.shape == ((1, 3, 6)[derivatives], 7, 16)
    np.testing.assert_array_equal(basis, SCHEME.regular_basis(uv, 2)[: len(basis)])


def monomial(u, power, order):
    """Derivative of ``u ** power``."""
    return math.perm(power, order) * u ** max(power - order, 0)


def control_values(places, power):
    """Coefficients of ``t ** power`` in uniform cubic B-splines whose control points sit at ``places`` (Marsden)."""
    return [np.ones_like(places), places, places**2 - 1 / 3, places**3 - places][power]


@pytest.mark.parametrize(("dtype", "tolerance"), [(np.float64, 1e-14), (np.float32, 5e-6)])
@pytest.mark.parametrize("a", range(4))
@pytest.mark.parametrize("b", range(4))
def test_regular_basis_reproduces_bicubics_and_their_derivatives(a, b, dtype, tolerance):
    u, v = uv = np.random.default_rng(6).random((2, 50))
    i, j = SCHEME.regular_lattice.T
    values = SCHEME.regular_basis(uv.T.astype(dtype), 2) @ (control_values(i, a) * control_values(j, b)).astype(dtype)
    orders = [(0, 0), (1, 0), (0, 1), (2, 0), (1, 1), (0, 2)]
    expected = [monomial(u, a, m) * monomial(v, b, n) for m, n in orders]
    # Control values reach 36; so does the rounding of their sum.
    np.testing.assert_allclose(values, expected, rtol=0, atol=36 * tolerance)


def test_regular_basis_is_exact_at_tiny_parameters():
    # The slope of the basis at the knot is exactly 0 and 1/2; weights near it must not lose the parameter.
    tiny = 2.0**-50
    value = SCHEME.regular_basis(np.array([[tiny, 0.0]]), 1)
    row = value.reshape(3, 4, 4)
    np.testing.assert_allclose(row[0, :, 3], np.array([1, 4, 1, 0]) / 6 * tiny**3 / 6, rtol=1e-15)
    np.testing.assert_allclose(row[1, :, 3], np.array([1, 4, 1, 0]) / 6 * tiny**2 / 2, rtol=1e-15)
    np.testing.assert_allclose(row[1, 1, 1], -2 * tiny * 4 / 6, rtol=1e-15)


def regular_place():
    """Local mesh of a regular one-ring and, for each of its vertices, the place in the lattice."""
    ring = one_ring(Signature("face", ((4,) * 4,) * 4))
    place = {0: (0.0, 0.0), 1: (1.0, 0.0), 2: (1.0, 1.0), 3: (0.0, 1.0)}
    faces = polygons(ring.topology)
    while len(place) < ring.vertex_count:
        for face in faces:
            for k in range(4):
                a, b, c, d = (face[(k + i) % 4] for i in range(4))
                if a in place and b in place:
                    along = np.subtract(place[b], place[a])
                    left = np.array([-along[1], along[0]])
                    place.setdefault(c, tuple(place[b] + left))
                    place.setdefault(d, tuple(place[a] + left))
    return ring.topology, np.array([place[i] for i in range(ring.vertex_count)])


def walk(topology, half_edge):
    """Half-edges of the face from this one on."""
    walked = [half_edge]
    while topology.next[walked[-1]] != half_edge:
        walked.append(topology.next[walked[-1]])
    return walked


@pytest.mark.parametrize("corner", range(4))
def test_children_of_a_quad_lie_where_their_maps_say(corner):
    topology, place = regular_place()
    refinement = SCHEME.refine(topology)
    refined, fine_place = refinement.topology, refinement.apply(place)
    parts = SCHEME.children(topology, refined, corner)
    assert [affine for affine, _ in parts] == list(SCHEME.domain.children)
    for affine, half_edge in parts:
        expected = SCHEME.domain.rotation(corner)(affine.inverse()(SCHEME.domain.corners))
        found = fine_place[refined.face_vertices[walk(refined, half_edge)]]
        np.testing.assert_array_equal(found, expected)


@EVERY_CLOSED_CAGE
def test_corner_of_another_polygon_becomes_one_quad(name):
    topology = CLOSED_CAGES[name]().topology
    refined = SCHEME.refine(topology).topology
    for half_edge in np.flatnonzero(topology.face_sizes[topology.face] != 4):
        ((affine, child),) = SCHEME.children(topology, refined, half_edge)
        assert affine is IDENTITY
        corner, following, centre, before = polygons(refined)[refined.face[child]]
        assert refined.face_vertices[child] == corner == topology.face_vertices[half_edge]
        assert following == topology.vertex_count + topology.edge[half_edge]
        assert before == topology.vertex_count + topology.edge[topology.prev[half_edge]]
        assert centre == topology.vertex_count + topology.edge_count + topology.face[half_edge]


def test_is_a_scheme_found_by_name():
    found = scheme_named("catmull_clark")
    assert isinstance(found, CatmullClark)
    assert isinstance(found, Scheme)
    assert (found.element, found.regular_face_size, found.regular_valence) == ("face", 4, 4)
