"""Boxes near points: those that a test of all pairs finds, and few nodes to look at."""

import numpy as np
import pytest
from mitsuba_subdivision.patches import closest_points
from mitsuba_subdivision.patches.closest_points import BoxTree

pytestmark = pytest.mark.core


@pytest.mark.parametrize("most", [closest_points.MOST_PAIRS, 10])
def test_near_boxes_are_those_no_further_than_asked(most, np_rng, monkeypatch):
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


def test_boxes_of_a_grid_have_parents_that_are_cubes(np_rng):
    lower = np.indices((8, 8, 8)).reshape(3, -1).T.astype(float)[np_rng.permutation(512)]
    levels = BoxTree.build(lower, lower + 1).levels
    for (low, high), side in zip(levels, (1, 2, 4), strict=True):
        np.testing.assert_array_equal(high - low, side)
