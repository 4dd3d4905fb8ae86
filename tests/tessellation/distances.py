"""Distances of an adaptive tessellation's triangles from the limit surface, and of the surface from the triangles."""

import numpy as np

# Places on triangles: the centroid, middles of sides, and a point near each corner.
PLACES = np.array([(2, 2, 2), (3, 3, 0), (0, 3, 3), (3, 0, 3), (4, 1, 1), (1, 4, 1), (1, 1, 4)]) / 6
# Exact distances are computed of so many points at once.
TOGETHER = 32


def distances(surface, table, most_triangles=6000, most_points=120, seed=0):
    """Largest distances measured of triangles from the surface, and of the surface from the triangles.

    Each is measured at seven places on some triangles, and of the surface at the same parameters. The distance from the
    counterpart bounds the distance from all of it, so that exact distances are computed of the furthest points only.
    Where more than ``most_points`` may be further than the largest so far, that many more are chosen by chance.
    """
    positions, _ = table.apply(surface.cage.positions)
    corners, random = positions[table.triangles], np.random.default_rng(seed)
    half_edge, uv = table.grid.triangle_locations
    own = random.permutation(len(corners))[:most_triangles]
    on_triangles = (PLACES @ corners[own]).reshape(-1, 3)
    elements = surface.patches.elements
    element = elements.face[half_edge[own]].astype(np.int64)
    corner = half_edge[own] - elements.face_offsets[element]
    element, corner = (np.repeat(numbers, len(PLACES)) for numbers in (element, corner))
    on_surface = surface.evaluate(element, np.clip((PLACES @ uv[own]).reshape(-1, 2), 0, 1), corner).p
    apart = np.linalg.norm(on_triangles - on_surface, axis=1)
    from_own = distances_of_pairs(on_surface, np.repeat(corners[own], len(PLACES), axis=0))
    return (
        _largest(apart, lambda at: surface.closest_point(on_triangles[at]).distance, most_points, random),
        _largest(from_own, lambda at: distances_to(corners, on_surface[at], from_own[at]), most_points, random),
    )


def _largest(bounds, exact, most, random):
    """Largest of some values, from upper bounds and a function that computes some of them."""
    order, largest, seen = np.argsort(-bounds), 0.0, 0
    while seen < min(most, len(order)) and bounds[order[seen]] > largest:
        largest = max(largest, exact(order[seen : seen + TOGETHER]).max())
        seen += TOGETHER
    rest = random.permutation(order[seen:][bounds[order[seen:]] > largest])[:most]
    return max(largest, exact(rest).max(initial=0)) if len(rest) else largest


def distances_to(corners, points, bounds=np.inf):
    """``(s,)`` distances of points from the nearest of triangles ``(t, 3, 3)``, which are at most some bounds."""
    lower, upper, nearest = corners.min(axis=1), corners.max(axis=1), np.full(len(points), bounds)
    for index, point in enumerate(points):
        from_box = np.linalg.norm(np.maximum(0, np.maximum(lower - point, point - upper)), axis=1)
        near = corners[from_box <= nearest[index]]
        nearest[index] = distances_of_pairs(np.broadcast_to(point, (len(near), 3)), near).min(initial=nearest[index])
    return nearest


def distances_of_pairs(points, corners):
    """``(n,)`` distances of points ``(n, 3)`` each from its triangle ``(n, 3, 3)``."""
    along = np.roll(corners, -1, axis=1) - corners
    offset = points[:, None] - corners
    part = (offset * along).sum(axis=2) / np.maximum((along**2).sum(axis=2), np.finfo(float).tiny)
    from_sides = np.linalg.norm(offset - np.clip(part, 0, 1)[..., None] * along, axis=2).min(axis=1)
    normal = np.cross(along[:, 0], along[:, 1])
    length = np.linalg.norm(normal, axis=1)
    is_above = (np.cross(along, offset) * normal[:, None]).sum(axis=2).min(axis=1) > 0
    across = np.abs((offset[:, 0] * normal).sum(axis=1)) / np.maximum(length, np.finfo(float).tiny)
    return np.where(is_above, across, from_sides)
