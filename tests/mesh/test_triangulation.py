import numpy as np
import pytest
from mitsuba_subdivision.mesh.triangulation import triangle_corners

# Relative; coordinates are of order one.
ROUNDING = 1e-12
ARROW = [[0, 0], [4, -1], [1, 0], [4, 1]]
HORSESHOE = [[0, 2], [0, 0], [2, 0], [2, 2], [1.4, 2], [1.4, 0.6], [0.6, 0.6], [0.6, 2]]
# A cut leads from the outline to the hole, and back.
FRAME = [[-1, -1], [1, -1], [1, 1], [-1, 1], [-1, -1], [-0.4, -0.6], [-0.6, 0.5], [0.5, 0.6], [0.6, -0.4], [-0.4, -0.6]]
SPIRAL = [[np.cos(a) * r, np.sin(a) * r] for r, angles in ((1, 1), (0.8, -1)) for a in np.linspace(0, 6, 30)[::angles]]
CONVEX = [[np.cos(a), np.sin(a)] for a in np.linspace(0, 6, 7)]
SHAPES = {"arrow": ARROW, "horseshoe": HORSESHOE, "frame": FRAME, "spiral": SPIRAL, "convex": CONVEX}


def turned(count, size, seed):
    """Rotations to any direction, and every first corner."""
    rng = np.random.default_rng(seed)
    return [(np.linalg.qr(rng.normal(size=(3, 3)))[0], number % size) for number in range(count)]


@pytest.mark.parametrize("polygon", SHAPES.values(), ids=SHAPES)
@pytest.mark.parametrize("order", [1, -1], ids=["forward", "reversed"])
def test_triangles_of_a_polygon_cover_its_area_once_with_its_orientation(polygon, order):
    flat = np.column_stack([polygon, np.zeros(len(polygon))])[::order]
    one, (x, y, _) = (np.array([len(flat)]), np.arange(len(flat))), flat.T
    area = (x @ np.roll(y, -1) - y @ np.roll(x, -1)) / 2
    for rotation, start in turned(12, len(flat), 0):
        corners, face = triangle_corners(np.roll(flat, start, axis=0) @ rotation.T + 3, *one)
        a, b, c = (np.roll(flat, start, axis=0)[corner] for corner in corners.T)
        areas = np.cross(b - a, c - a)[:, 2] / 2
        # Unsigned areas add up to the polygon's only if no triangle overlaps another, or lies outside.
        np.testing.assert_allclose([areas.sum(), np.abs(areas).sum()], [area, abs(area)], rtol=ROUNDING)
        assert not face.any()


def test_convex_and_degenerate_polygons_are_fans_and_faces_keep_their_order():
    points = np.concatenate([ARROW, CONVEX, np.zeros((5, 2)), HORSESHOE])
    positions = np.column_stack([points, 0.01 * np.sin(7 * points[:, 0])])
    sizes = np.array([4, 7, 5, 8])
    corners, face = triangle_corners(positions, sizes, np.arange(24))
    np.testing.assert_array_equal(face, np.repeat(range(4), sizes - 2))
    fans = [(first, first + i, first + i + 1) for first, size in ((0, 4), (4, 7), (11, 5)) for i in range(1, size - 1)]
    np.testing.assert_array_equal(corners[:10], fans)
