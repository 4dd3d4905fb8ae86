"""Nearest points of a surface: no other point is nearer, and the way to them is along the normal.

Another path to them is a search by evaluation alone: many samples, and finer and finer grids around the nearest one.
"""

import numpy as np
import pytest
from kernels.surfaces import KINDS, grid_locations, surface_named
from mitsuba_subdivision import LimitSurface
from mitsuba_subdivision.cage.named_cages import cube
from mitsuba_subdivision.patches import closest_points
from mitsuba_subdivision.patches.closest_points import BoxTree
from mitsuba_subdivision.patches.nearest_in_piece import TurnedBoxes, nearest_in_pieces
from patches.closed_cages import bumpy, cage_of
from reference.refined_cages import sheet
from scipy.spatial import cKDTree

# Points of each kind: all around, near the surface, on it, and far away.
COUNT = 6
# Rounding of distances, in sizes of the surface: both are sums of some tens of rounded products.
ROUNDED = 1e-13
# Part of a way that is along the tangents, in lengths of the way; and what rounding adds to it.
ALONG_NORMAL = 1e-9
# Difference of parameters: the same steps, but for rounding of sums over other numbers of points.
DESCENT = 1e-12
# Pieces that may hold the nearest point, for points that are far away.
FEW_PIECES = 80
# Samples that a search by evaluation begins with, and how often it is made twice as fine.
SAMPLES, REFINED = 3_000, 8
STEPS = np.stack(np.meshgrid(*[np.linspace(-1, 1, 5)] * 2), axis=-1).reshape(-1, 2)


def points_around(samples, np_rng):
    low, high = samples.p.min(axis=0), samples.p.max(axis=0)
    size = float((high - low).max())
    first, second, third = np_rng.integers(0, len(samples.p), (3, COUNT))
    around = np_rng.uniform(low - 0.3 * size, high + 0.3 * size, (COUNT, 3))
    near = samples.p[first] + np_rng.normal(size=(COUNT, 3)) * 0.02 * size
    above = samples.p[third] + np_rng.normal(size=(COUNT, 1)) * 0.1 * size * samples.n[third]
    far = np_rng.normal(size=(2, 3)) * 30 * size
    return size, np.concatenate([around, near, samples.p[second], above, far])


def distances_by_evaluation(surface, points, samples, start, uv, spacing):
    """Distances to the nearest of many samples, and then of grids around it, in the domain of its patch."""
    distance, nearest = cKDTree(samples.p).query(points)
    start, uv = start[nearest], uv[nearest]
    for _ in range(REFINED):
        locations = np.clip(uv[:, None] + spacing * STEPS, 0, 1)
        if surface.scheme.domain.corner_count == 3:
            locations = np.clip(locations - np.maximum(locations.sum(axis=2, keepdims=True) - 1, 0) / 2, 0, 1)
        samples_near = surface._sampler.evaluate(np.repeat(start, len(STEPS)), locations.reshape(-1, 2))
        away = np.linalg.norm(samples_near.p.reshape(*locations.shape[:2], 3) - points[:, None], axis=2)
        uv = locations[np.arange(len(points)), away.argmin(axis=1)]
        distance, spacing = np.minimum(distance, away.min(axis=1)), spacing / 2
    return distance


def along_tangents(points, nearest):
    """How far ways from nearest points to others are along tangents."""
    away = points - nearest.p
    along = [np.abs((away * du).sum(axis=1)) / np.linalg.norm(du, axis=1) for du in (nearest.dp_du, nearest.dp_dv)]
    return np.maximum(*along)


@pytest.mark.parametrize("name", [*KINDS, "rook", "hexagon", "loop valence 50"])
def test_no_point_is_nearer_and_vectors_to_nearest_points_are_along_the_normal(name, np_rng):
    surface = surface_named(name)
    segments = max(3, round((SAMPLES / len(grid_locations(surface, 1)[0]) * 4) ** 0.5))
    start, uv = grid_locations(surface, segments)
    samples = surface._sampler.evaluate(start, uv)
    size, points = points_around(samples, np_rng)
    nearest = surface.closest_point(points)
    others = distances_by_evaluation(surface, points, samples, start, uv, 1 / segments)
    # Rounding counts in sizes of the coordinates.
    rounded = ROUNDED * (size + np.abs(points).max(axis=1))
    assert (nearest.distance <= others + rounded).all()
    # Most minima that the other search finds are the same.
    assert np.median(others - nearest.distance) <= 1e-5 * size
    there = surface.evaluate(nearest.element, nearest.uv, nearest.corner)
    np.testing.assert_array_equal(nearest.p, there.p)
    np.testing.assert_array_equal(nearest.n, there.n)
    np.testing.assert_array_equal(nearest.distance, np.linalg.norm(points - nearest.p, axis=1))
    inside = surface.scheme.domain.inside(nearest.uv) > 1e-9
    assert inside.sum() > len(points) / 4
    assert (along_tangents(points, there) <= ALONG_NORMAL * nearest.distance + rounded)[inside].all()


@pytest.mark.core
@pytest.mark.parametrize("scheme", ["catmull_clark", "loop", "doo_sabin"])
def test_ways_cross_edges_of_elements_along_the_normal(scheme, np_rng):
    """Points above edges between elements, where either element's part of the surface ends."""
    surface = LimitSurface(bumpy(cage_of(scheme, "torus")), scheme)
    count = 100
    element, along = np_rng.integers(0, surface.patches.elements.face_count, count), np_rng.random(count)
    edge = surface.evaluate(element, np.stack([along, 0 * along], axis=1))
    points = edge.p + 0.01 * edge.n
    nearest = surface.closest_point(points)
    there = surface.evaluate(nearest.element, nearest.uv, nearest.corner)
    np.testing.assert_allclose(nearest.p, edge.p, rtol=0, atol=1e-9)
    assert (along_tangents(points, there) <= ALONG_NORMAL * nearest.distance).all()


@pytest.mark.core
def test_nearest_points_of_a_flat_sheet_are_projections():
    surface = LimitSurface(sheet(4, 3))
    points = np.array([[1.3, 2.2, 5.0], [2, 1, -1], [-1, 1.25, 1], [5, 4, 2], [0.5, -3, 0]])
    nearest = surface.closest_point(points)
    np.testing.assert_allclose(nearest.p, np.clip(points, 0, [4, 3, 0]), rtol=0, atol=1e-14)
    np.testing.assert_allclose(nearest.n, [[0, 0, 1]] * 5, rtol=0, atol=1e-14)


HIGH = pytest.param("valence 50", marks=pytest.mark.long)


@pytest.mark.parametrize("name", ["valence 3", HIGH, "dart", "loop valence 3", "doo_sabin mixed torus"])
def test_points_above_places_at_and_next_to_extraordinary_ones(name, np_rng):
    surface, deep = surface_named(name), np.repeat([2.0**-8, 2.0**-40, 0], 2)[:, None]
    domain = surface.scheme.domain
    uv = deep * (np_rng.dirichlet(np.ones(domain.corner_count), len(deep)) @ domain.corners)
    element = 0 if surface.scheme.element == "face" else int(np.argmax(surface.patches.elements.face_sizes != 4))
    samples = surface.evaluate(element, uv)
    heights = np.repeat([0.0, 1e-9, 1e-3], len(uv))
    points = np.tile(samples.p, (3, 1)) + heights[:, None] * np.tile(samples.n, (3, 1))
    assert (surface.closest_point(points).distance <= heights + ROUNDED).all()


def points_of_pieces(pieces, which, uv):
    return np.einsum("sb,sbx->sx", pieces.basis.values(uv), pieces.coefficients[which]) + pieces.origins[which]


def test_distances_that_count_as_convex_are_at_most_the_mean_in_the_middle(np_rng):
    """Between random pairs of points in a piece, where its box says that squared distances from a point are convex."""
    pieces, count = surface_named("rook")._surface_pieces.regular, 5000
    which, boxes = np_rng.integers(0, len(pieces), count), TurnedBoxes.around(pieces)
    beside = np_rng.normal(size=(count, 3)) * np_rng.uniform(0, 0.5, (count, 1))
    points = boxes.points[which] + np.linalg.norm(boxes.halves[which], axis=1)[:, None] * beside
    near, _, away = boxes.near(points, which, np.full(count, np.inf))
    is_convex = boxes.are_convex(away, which[near])
    assert 0 < np.count_nonzero(is_convex) < count
    one, other = np_rng.random((2, count, 2))
    places = [points_of_pieces(pieces, which, uv) for uv in (one, other, (one + other) / 2)]
    first, second, middle = (((p - points) ** 2).sum(axis=1)[near] for p in places)
    assert (middle <= (1 + ROUNDED) * (first + second) / 2)[is_convex].all()


def test_bounds_around_extraordinary_points_move_with_them():
    cage = surface_named("mixed torus").cage
    here, there = (LimitSurface(cage.with_positions(cage.positions + away))._surface_pieces.tips for away in (0, 64))
    for one, other in zip(here, there, strict=True):
        np.testing.assert_allclose(one.reach(2), other.reach(2), rtol=1e-9)


def test_descents_end_at_local_minima_independent_of_the_unit_and_other_points(np_rng):
    """From anywhere in a piece, also where the distance is not convex."""
    cage, count = surface_named("mixed torus").cage, 600
    pieces = LimitSurface(cage)._surface_pieces.regular
    points, which, begin = np_rng.normal(size=(count, 3)) * 3, np.arange(count) % len(pieces), np_rng.random((count, 2))
    uv, squared, slope = nearest_in_pieces(pieces, which, points, begin, 1.0)
    # Nothing within a small step is nearer.
    for step in 1e-4 * STEPS:
        p = points_of_pieces(pieces, which, np.clip(uv + step, 0, 1))
        assert (((p - points) ** 2).sum(axis=1) >= (1 - ROUNDED) * squared).all()
    # By powers of two all products are scaled exactly.
    unit = 2.0**-20
    scaled = LimitSurface(cage.with_positions(unit * cage.positions))._surface_pieces.regular
    np.testing.assert_array_equal(nearest_in_pieces(scaled, which, unit * points, begin, unit)[0], uv)
    # Some take shorter steps where others have taken theirs.
    parts = [nearest_in_pieces(pieces, which[at], points[at], begin[at], 1.0) for at in np.split(np.arange(count), 100)]
    np.testing.assert_allclose(uv, np.concatenate([places for places, _, _ in parts]), rtol=0, atol=DESCENT)
    np.testing.assert_allclose(slope, np.concatenate([slopes for _, _, slopes in parts]), rtol=0, atol=DESCENT)


def test_no_points_have_no_nearest_ones():
    assert LimitSurface(cube()).closest_point(np.empty((0, 3))).p.shape == (0, 3)


@pytest.mark.parametrize("name", ["rook", "semi-sharp ring", "loop mixed torus"])
def test_far_points_are_compared_with_few_pieces(name, np_rng, monkeypatch):
    surface, counts, near = surface_named(name), [], BoxTree.near

    def counted(tree, points, squared_distance):
        pairs = near(tree, points, squared_distance)
        counts.append(len(pairs[0]) / len(points))
        return pairs

    monkeypatch.setattr(BoxTree, "near", counted)
    surface.closest_point(100 * np_rng.normal(size=(50, 3)))
    assert np.mean(counts) < FEW_PIECES


@pytest.mark.core
@pytest.mark.parametrize("most", [closest_points.MOST_PAIRS, 10])
def test_near_boxes_lie_within_the_distance(most, np_rng, monkeypatch):
    """In whole numbers, so that some are exactly as far."""
    monkeypatch.setattr(closest_points, "MOST_PAIRS", most)
    lower = np_rng.integers(0, 20, (300, 3)).astype(float)
    upper, points = lower + np_rng.integers(0, 5, (300, 3)), np_rng.integers(-5, 30, (40, 3)).astype(float)
    squared = np_rng.integers(0, 6, 40).astype(float) ** 2
    point, box = BoxTree.build(lower, upper).near(points, squared)
    gaps = np.linalg.norm(np.maximum(0, np.maximum(lower - points[:, None], points[:, None] - upper)), axis=2) ** 2
    assert (np.abs(gaps - squared[:, None]) < 0.5).any()
    expected = np.argwhere(gaps.round() <= squared[:, None])
    assert sorted(np.stack([point, box], axis=1).tolist()) == expected.tolist()
