import drjit as dr
import numpy as np
import pytest
from kernels.surfaces import HOLES, kernel_named, surface_named, vectors
from mitsuba_subdivision.kernels.locations import Location, TriangleLocations

pytestmark = [pytest.mark.core, pytest.mark.usefixtures("llvm")]

SURFACES = ["hexagon", "valence 2", "crease", "holes", "non-manifold", "loop corner", "doo_sabin mixed torus"]
TRIANGULATED = ["torus", "hexagon", "valence 2", "mixed torus", "half disc of 6", "boundary none", "holes", *HOLES]
TRIANGULATED += ["loop corner", "loop mixed torus", "doo_sabin mixed torus", "doo_sabin sheet"]
# Rounding of parameters after some sums and products.
ROUNDING = 1e-14
# How far beyond an edge parameters are. Of points of a surface of a size of about 3 there; where parameters are
# rounded, points move along by some units of that.
BEYOND, POINT, CHANGED = 1e-3, 1e-13, 1e-12


def kernel_of(name):
    return surface_named(name), kernel_named(name, "llvm_ad_rgb_double")


def beside(domain, side, t, depth):
    """Parameters at a depth inside of a side, negative for outside, and at t along it."""
    corners = domain.corners
    begin, end = corners[side], corners[(side + 1) % len(corners)]
    inward = np.array([-(end - begin)[1], (end - begin)[0]])
    # So that lines of the same depth are parallel in the parameters from every corner.
    inward = inward if len(corners) == 4 else corners[side - 1] - begin
    return begin + t[:, None] * (end - begin) + depth * inward


def locations(types, half_edge, uv):
    return Location(types.indices(half_edge), types.floats(uv[:, 0]), types.floats(uv[:, 1]))


def carried(kernel, location):
    location = kernel.walk.carried(location)
    dr.eval(location)
    return np.array(location.half_edge), np.array([location.u, location.v]).T


def every_side(surface, rng):
    """Half-edges, parameters seen from them beyond each side, and whether there is a neighbour."""
    t, domain = surface.patches.elements, surface.scheme.domain
    is_whole, every = surface.patches.is_whole[t.face], np.arange(t.half_edge_count)
    for side in range(domain.corner_count):
        edge = every
        for _ in range(side):
            edge = t.next[edge]
        # A polygon's corner has half of each of its two edges, and other corners beyond its other sides.
        own = np.where(side == 0, every, t.prev[every])
        has_neighbour = np.where(is_whole, t.twin[edge], np.where(side in (0, 3), t.twin[own], 0)) >= 0
        # Away from the middle, where polygons' corners meet.
        along = rng.uniform(0.05, 0.45, t.half_edge_count) + 0.5 * rng.integers(0, 2, t.half_edge_count)
        yield side, every, along, has_neighbour


@pytest.mark.parametrize("name", SURFACES)
def test_moves_across_an_edge_keep_points_and_are_reversible_or_end_at_the_border(name, np_rng):
    """Beyond an edge by as much as inside of it: reflected there, it leads back to the reflected place here."""
    surface, kernel = kernel_of(name)
    domain, elements, seen = surface.scheme.domain, surface.patches.elements, 0
    for side, half_edge, along, has_neighbour in every_side(surface, np_rng):
        on_edge = beside(domain, side, along, 0)
        # So little beyond that the point is the same but for rounding.
        reached, uv = carried(kernel, locations(kernel.types, half_edge, beside(domain, side, along, -1e-15)))
        left = (reached != half_edge) | (np.abs(uv - on_edge).max(axis=1) > BEYOND)
        both = (half_edge, on_edge), (reached, uv)
        here, there = (vectors(kernel.at(locations(kernel.types, h, np.clip(x, 0, 1))).p) for h, x in both)
        np.testing.assert_allclose(here, there, rtol=0, atol=POINT)
        assert not left[~has_neighbour].any()
        seen += np.count_nonzero(left)

        inside, outside = (beside(domain, side, along, depth) for depth in (BEYOND, -BEYOND))
        stayed, unchanged = carried(kernel, locations(kernel.types, half_edge, inside))
        np.testing.assert_array_equal(stayed, half_edge)
        np.testing.assert_array_equal(unchanged, inside)
        reached, uv = carried(kernel, locations(kernel.types, half_edge, outside))
        assert domain.inside(uv).min() >= 0
        at_border = ~has_neighbour
        np.testing.assert_array_equal(reached[at_border], half_edge[at_border])
        assert np.abs(uv - outside)[at_border].max(initial=0) <= 2 * BEYOND
        assert np.abs(domain.inside(uv[at_border])).max(initial=0) <= ROUNDING
        # The side of the neighbour that it has come in by is the nearest; the place as far beyond that side.
        sides = np.array([beside(domain, k, np.zeros(1), 0)[0] for k in range(domain.corner_count)])
        normals = np.array([beside(domain, k, np.zeros(1), 1)[0] for k in range(domain.corner_count)]) - sides
        depths = np.stack(domain.edge_distances(*uv.T), axis=1)
        entered = depths.argmin(axis=1)
        back = uv - 2 * depths[np.arange(len(uv)), entered][:, None] * normals[entered]
        again, there = carried(kernel, locations(kernel.types, reached, back))
        here, expected = (as_seen_from_first(surface, h, x) for h, x in ((again, there), (half_edge, inside)))
        kept = has_neighbour & (elements.face[reached] != elements.face[half_edge])
        np.testing.assert_array_equal(here[0][kept], expected[0][kept])
        np.testing.assert_allclose(here[1][kept], expected[1][kept], rtol=0, atol=10 * ROUNDING)
    assert seen > 0


def as_seen_from_first(surface, half_edge, uv):
    """Places in whole elements as seen from their first corners, so that they can be compared."""
    elements, domain = surface.patches.elements, surface.scheme.domain
    face = elements.face[half_edge]
    turns = np.where(surface.patches.is_whole[face], half_edge - elements.face_offsets[face], 0)
    turned = np.array([domain.rotation(int(turn))(place) for turn, place in zip(turns, uv, strict=True)])
    return half_edge - turns, turned


def triangles_of(name, rate):
    table = surface_named(name).sampling(rate)
    return kernel_of(name), table, TriangleLocations(table, kernel_of(name)[1].walk)


@pytest.mark.parametrize("name", TRIANGULATED)
# Even and odd: at odd rates, triangles reach from one corner of a polygon into the next.
@pytest.mark.parametrize("rate", [1, 3, 4])
def test_corners_of_triangles_are_vertices(name, rate):
    (surface, kernel), table, locations = triangles_of(name, rate)
    types, expected = kernel.types, table.apply(surface.cage.positions)[0]
    count = len(table.triangles)
    triangle = np.repeat(np.arange(count), 3)
    b1, b2 = (np.tile(weights, count).astype(float) for weights in ((0, 1, 0), (0, 0, 1)))
    corners = locations(types.indices(triangle), types.floats(b1), types.floats(b2))
    dr.eval(corners)
    np.testing.assert_array_equal(surface.patches.elements.face[np.array(corners.half_edge)], table.element[triangle])
    np.testing.assert_allclose(vectors(kernel.at(corners).p), expected[table.triangles.ravel()], rtol=0, atol=POINT)


@pytest.mark.parametrize("name", TRIANGULATED)
@pytest.mark.parametrize("rate", [2, 5])
def test_neighbouring_triangles_share_the_points_of_their_edge(name, rate, np_rng):
    """Within an element and across: those on either side of a crease have vertices of their own."""
    (surface, kernel), table, locations = triangles_of(name, rate)
    types, triangles = kernel.types, table.triangles.astype(np.int64)
    edges = {}
    for triangle, corners in enumerate(triangles.tolist()):
        for k in range(3):
            edges[corners[k], corners[(k + 1) % 3]] = triangle, k
    pairs = [(edges[a, b], edges[b, a]) for a, b in edges if a < b and (b, a) in edges]
    along, sides = np_rng.random(len(pairs)), []
    for number, share in ((0, along), (1, 1 - along)):
        triangle, k = np.array([pair[number] for pair in pairs]).T
        weights = np.zeros((len(pairs), 3))
        weights[np.arange(len(pairs)), k], weights[np.arange(len(pairs)), (k + 1) % 3] = 1 - share, share
        on_edges = locations(types.indices(triangle), types.floats(weights[:, 1]), types.floats(weights[:, 2]))
        dr.eval(on_edges)
        assert surface.scheme.domain.inside(np.array([on_edges.u, on_edges.v]).T).min() >= 0
        sides.append(vectors(kernel.at(on_edges).p))
    np.testing.assert_allclose(*sides, rtol=0, atol=CHANGED)
