"""Adaptive tessellations have no cracks and no folds, and their vertices lie where they say."""

import warnings
from collections import defaultdict

import numpy as np
import pytest
from fuzz.topologies import random_cage
from kernels.surfaces import SURFACES, surface_named
from mitsuba_subdivision import CageError, CageWarning, ControlCage, LimitSurface, SchemeError
from mitsuba_subdivision.cage.errors import without_warnings
from mitsuba_subdivision.cage.named_cages import cube, torus
from mitsuba_subdivision.tessellation import Criterion, Measure
from mitsuba_subdivision.tessellation.patch_frames import PatchFrames
from mitsuba_subdivision.tessellation.tile_choice import feature_edges
from patches.closed_cages import bumpy
from tessellation.test_attribute_table import CAGES as WITH_SEAMS
from tessellation.test_attribute_table import with_seams

# Parameters are sums of fractions of a power of two; points of some tens of products.
ROUNDING = 1e-12

# Some tiles with one segment only, and many sizes of tiles side by side.
ERRORS = (3e-2, 1e-3)
EVERY_SURFACE = pytest.mark.parametrize("name", SURFACES)
EVERY_ERROR = pytest.mark.parametrize("error", ERRORS)


def table_of(surface, error=1e-3, max_rate=16, measure=Measure.CHORD, **options):
    size = np.linalg.norm(np.ptp(surface.cage.positions, axis=0))
    # Grids are tested at any rates, also at those that are too low.
    with without_warnings():
        return surface.adaptive_sampling(Criterion(measure, error * size, **options), max_rate)


def directed_edges(triangles):
    return np.concatenate([triangles[:, [0, 1]], triangles[:, [1, 2]], triangles[:, [2, 0]]]).astype(np.int64)


def numbered(edges, count):
    return edges[:, 0] * count + edges[:, 1]


@EVERY_SURFACE
@EVERY_ERROR
def test_triangles_have_no_cracks_and_no_folds_and_vertices_where_they_say(name, error):
    surface = surface_named(name)
    table = table_of(surface, error)
    assert_each_edge_inside_has_its_twin(surface, table)
    assert_nothing_is_open_but_the_boundary_of_the_cage(surface, table)
    assert_elements_are_covered(surface, table)
    if error == min(ERRORS):
        assert_vertices_lie_where_triangles_say(surface, table)


def assert_each_edge_inside_has_its_twin(surface, table):
    """No edge occurs twice in a direction, and those without a twin lie on edges of the elements without neighbours."""
    edges = directed_edges(table.triangles)
    keys, twins = (numbered(each, table.vertex_count) for each in (edges, edges[:, ::-1]))
    assert len(np.unique(keys)) == len(keys)
    corner, uv = table.locations()
    lonely = np.unique(edges[~np.isin(twins, keys)])
    t, domain = surface.patches.elements, surface.scheme.domain
    whole = surface.patches.is_whole[t.face[corner[lonely]]]
    on_side = domain.inside(uv[lonely]) <= ROUNDING
    assert on_side.all()
    if (t.twin >= 0).all():
        assert not len(lonely)
    # Seen from their corner, patches that are not whole have the element's edges along u = 0 and v = 0 only.
    assert (uv[lonely[~whole]].min(axis=1, initial=0) <= ROUNDING).all()


def assert_elements_are_covered(surface, table):
    corner, uv = table.grid.triangle_locations
    (a, b), (c, d) = (uv[:, i].T - uv[:, 0].T for i in (1, 2))
    areas = (a * d - b * c) / 2
    assert areas.min() > 0
    t, whole = surface.patches.elements, surface.patches.is_whole
    of_domain = 1.0 if surface.scheme.domain.corner_count == 4 else 0.5
    expected = np.where(whole, of_domain, t.face_sizes) * (t.face_sizes > 0)
    found = np.bincount(table.element, areas, minlength=t.face_count)
    np.testing.assert_allclose(found, expected, rtol=0, atol=ROUNDING * np.maximum(expected, 1).max())
    np.testing.assert_array_equal(t.face[corner], table.element)
    assert (np.diff(table.element.astype(np.int64)) >= 0).all()


def assert_vertices_lie_where_triangles_say(surface, table):
    positions, normals = table.apply(surface.cage.positions)
    size = np.abs(positions).max()
    corner, uv = table.grid.triangle_locations
    for i in range(3):
        seen = surface._evaluate_from(corner.astype(np.int64), uv[:, i], "stabilized", np.float64)
        np.testing.assert_allclose(positions[table.triangles[:, i]], seen.p, rtol=0, atol=ROUNDING * size)
    found = surface._evaluate_from(*table.locations(), "stabilized", np.float64)
    np.testing.assert_allclose(normals, found.n, rtol=0, atol=ROUNDING / 1e-3)
    np.testing.assert_array_equal(positions, positions[table.weld_target])
    assert np.array_equal(np.unique(table.triangles), np.arange(table.vertex_count))


def assert_nothing_is_open_but_the_boundary_of_the_cage(surface, table):
    """With copies along creases joined, nothing is open on a closed cage."""
    edges = table.weld_target[directed_edges(table.triangles)]
    keys, twins = (numbered(each, table.vertex_count) for each in (edges, edges[:, ::-1]))
    open_edges = edges[~np.isin(twins, keys)]
    t = surface.cage.topology
    is_closed = bool((t.twin >= 0).all()) and not surface.cage.is_hole.any()
    if surface.scheme.element == "face" and is_closed:
        assert not len(open_edges)


@pytest.mark.parametrize(("scheme", "cage"), WITH_SEAMS.values(), ids=WITH_SEAMS.keys())
def test_attributes_are_exact_on_both_sides_of_seams(scheme, cage, np_rng):
    surface = LimitSurface(with_seams(bumpy(cage), np_rng), scheme)
    table = table_of(surface)
    found = surface.attribute_table(table)
    assert found.surface_vertex is not None
    np.testing.assert_array_equal(found.surface_vertex[found.triangles], table.triangles)
    corner, uv = table.grid.triangle_locations
    first = surface.patches.elements.face_offsets[table.element]
    for name, values in found.values.items():
        for i in range(3):
            expected = surface.evaluate_attribute(name, table.element, uv[:, i], corner - first)
            np.testing.assert_allclose(values[found.triangles[:, i]], expected, rtol=0, atol=ROUNDING)


def test_the_same_cage_has_the_same_triangles():
    surfaces = [LimitSurface(bumpy(torus(5, 4))) for _ in range(2)]
    first, second = (table_of(surface) for surface in surfaces)
    np.testing.assert_array_equal(first.triangles, second.triangles)
    np.testing.assert_array_equal(
        first.apply(surfaces[0].cage.positions)[0], second.apply(surfaces[1].cage.positions)[0]
    )


def with_a_diagonal_twice():
    """Two faces that have two opposite vertices in common, and no edge; eight faces between them."""
    points = [(0, 0, 1.5), (1, 0, 0), (0, 0, -1.5), (0.7, 1, 0), (-0.7, 1, 0), (-1, 0, 0)]
    faces = [(1, 2, 3, 0), (4, 2, 5, 0)]
    for gap, aside in (((0, 3, 2, 4), 0.3), ((0, 5, 2, 1), -0.3)):
        first, corners = len(points), np.array([points[vertex] for vertex in gap])
        points += [tuple(point) for point in (corners + corners.mean(axis=0)) / 2 + [0, aside, 0]]
        faces += [(gap[i], gap[(i + 1) % 4], first + (i + 1) % 4, first + i) for i in range(4)]
        faces.append((first, first + 1, first + 2, first + 3))
    return ControlCage(np.array(points, dtype=float), faces)


def two_triangles():
    """Back to back; they meet along both edges of each corner."""
    return ControlCage([[0, 0, 0], [1, 0, 0], [0, 1, 0]], [[0, 1, 2], [2, 1, 0]])


def with_a_diagonal_on_the_border():
    """A face of which two opposite vertices are the ends of an edge on the border."""
    points = [(0, 0, 1), (1, 0, 0), (0, 0, -1), (0, 1, 0), (-1, 0.3, -1), (-1, 1, 0), (-1, 0.3, 1)]
    return ControlCage(points, [[1, 2, 3, 0], [3, 2, 4, 5], [0, 3, 5, 6], [4, 2, 0, 6], [5, 4, 6]])


def test_an_edge_on_the_border_meets_a_diagonal():
    cage = with_a_diagonal_on_the_border()
    surface = LimitSurface(cage)
    table = table_of(surface, 100, 1)
    edges = directed_edges(table.triangles)
    keys, twins = (numbered(each, table.vertex_count) for each in (edges, edges[:, ::-1]))
    assert len(np.unique(keys)) == len(keys)
    # All edges have two triangles, but for the three that the border has at least.
    assert len(np.setdiff1d(keys, twins)) >= 3
    assert_elements_are_covered(surface, table)


@pytest.mark.parametrize(("cage", "scheme"), [(with_a_diagonal_twice(), "catmull_clark"), (two_triangles(), "loop")])
def test_elements_that_meet_twice_have_no_edge_twice(cage, scheme):
    """The diagonals of two patches would be one edge, with four triangles; so would cuts across their corners."""
    surface = LimitSurface(cage, scheme)
    table = table_of(surface, 100, 1)
    edges = directed_edges(table.triangles)
    keys, twins = (np.sort(numbered(each, table.vertex_count)) for each in (edges, edges[:, ::-1]))
    assert (np.diff(keys) > 0).all()
    np.testing.assert_array_equal(keys, twins)
    assert len(np.unique(np.sort(table.triangles, axis=1), axis=0)) == len(table.triangles)
    assert_elements_are_covered(surface, table)
    assert_vertices_lie_where_triangles_say(surface, table)


# Random cages of whole elements, of which some meet twice: of three corners, and of four.
MEETING_TWICE = (82, 115, 19, 114, 468)


@pytest.mark.parametrize("seed", MEETING_TWICE)
def test_elements_meet_twice_if_something_else_connects_two_of_their_corners(seed):
    """Every edge of the mesh connects its ends once, and so does every diagonal of an element of four corners."""
    with without_warnings():
        surface = LimitSurface(*random_cage(np.random.default_rng(seed)))
    frames, t = PatchFrames.of(surface.patches, surface.cage.cut_mesh.vertex), surface.patches.elements
    connections, of_face = defaultdict(set), defaultdict(set)
    for half_edge, face in enumerate(t.face[np.arange(t.half_edge_count)]):
        following = t.next[half_edge]
        ways = [(("edge", t.edge[half_edge]), following)]
        if t.face_sizes[face] == 4:
            opposite = t.next[following]
            ways.append((("diagonal", min(half_edge, opposite)), opposite))
        for way, end in ways:
            ends = frozenset(t.face_vertices[[half_edge, end]])
            connections[ends].add(way)
            of_face[face].add(ends)
    expected = [any(len(ends) == 1 or len(connections[ends]) > 1 for ends in of_face[face]) for face in of_face]
    np.testing.assert_array_equal(frames.meets_twice, expected)
    assert frames.is_whole.all()
    assert any(expected)


def test_a_surface_may_be_a_curve():
    cage = cube()
    surface = LimitSurface(cage.with_positions(cage.positions * [1, 0, 0]))
    table = table_of(surface)
    assert table.grid.tiles["rates"].min() >= 1
    assert_elements_are_covered(surface, table)


@pytest.mark.parametrize("seed", range(30))
def test_any_cage_has_an_adaptive_tessellation(seed):
    """Without cracks wherever the uniform one has none, whatever the cage: not manifold, folded, cut or collapsed."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", CageWarning)
        try:
            surface = LimitSurface(*random_cage(np.random.default_rng(seed)))
        except (CageError, SchemeError) as refused:
            pytest.skip(str(refused))
    table = table_of(surface, (1, 0.1, 0.01)[seed % 3], 1 + seed % 8)
    assert_elements_are_covered(surface, table)
    assert_vertices_lie_where_triangles_say(surface, table)
    tables = table, surface.sampling(3)
    keys = [np.sort(numbered(directed_edges(each.triangles), each.vertex_count)) for each in tables]
    is_unique, is_expected = ((np.diff(own) > 0).all() for own in keys)
    assert is_unique or not is_expected
    if (surface.patches.elements.twin >= 0).all():
        edges = directed_edges(table.triangles)[:, ::-1]
        np.testing.assert_array_equal(keys[0], np.sort(numbered(edges, table.vertex_count)))


def faces_back_to_back(points, size):
    """A polygon twice, in opposite directions, which meet along the middle; flat, as a sheet of paper folded once."""
    return ControlCage(np.insert(np.array(points, dtype=float), 2, 0, axis=1), [range(size), range(size)[::-1]])


FOLDED = {
    "convex": faces_back_to_back([(0, 0), (1, 0), (1.4, 1), (0, 1)], 4),
    "concave": faces_back_to_back([(0, 0), (1, 0.8), (2, 0), (1, 2)], 4),
    "foldover": ControlCage(
        np.array([(-2, -4, 0), (2, -4, 0), (4, 0, 0), (2, 4, 0), (-2, 4, 0), (-4, 0, 0)]) / 4,
        [(0, 1, 2, 3, 4, 5), (5, 4, 3), (5, 1, 0)],
    ),
}


@pytest.mark.parametrize(("cage", "is_folded"), [(cube(), False), (FOLDED["convex"], True)], ids=["cube", "folded"])
def test_edges_are_features_where_faces_lie_back_to_back(cage, is_folded):
    """Not where they are at right angles."""
    surface = LimitSurface(cage)
    vertex = surface.cage.cut_mesh.vertex
    frames, criterion = PatchFrames.of(surface.patches, vertex), Criterion(Measure.CHORD, 1e-3)
    assert (feature_edges(surface.patches, frames, cage.positions[vertex], criterion) == is_folded).all()


def distance_to_triangles(points, corners):
    """``(s,)`` distances in a plane of points ``(s, 2)`` from the nearest of triangles ``(t, 3, 2)``."""
    origin, along = corners[None], (np.roll(corners, -1, axis=1) - corners)[None]
    offset = points[:, None, None] - origin
    part = (offset * along).sum(axis=-1) / np.maximum((along**2).sum(axis=-1), np.finfo(float).tiny)
    from_sides = np.linalg.norm(offset - np.clip(part, 0, 1)[..., None] * along, axis=-1).min(axis=2)
    side = along[..., 0] * offset[..., 1] - along[..., 1] * offset[..., 0]
    is_inside = (side > 0).all(axis=2) | (side < 0).all(axis=2)
    return np.where(is_inside, 0, from_sides).min(axis=1)


@pytest.mark.parametrize("name", FOLDED)
def test_a_surface_folded_in_its_plane_is_covered(name):
    """All heights are equal, and still the surface's points are as near to the triangles as the limit says."""
    surface, error = LimitSurface(FOLDED[name]), 1e-3
    table, dense = table_of(surface, error, 1024), surface.sampling(12)
    corners = table.apply(surface.cage.positions)[0][table.triangles][..., :2]
    reached = distance_to_triangles(dense.apply(surface.cage.positions)[0][:, :2], corners).max()
    size = np.linalg.norm(np.ptp(surface.cage.positions, axis=0))
    assert reached <= error * size * (1 + ROUNDING)
