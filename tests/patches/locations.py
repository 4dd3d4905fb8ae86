"""Locations all over a surface."""

import numpy as np


def grid_locations(surface, segments):
    """A grid of parameters on every patch, and the corner of an element that each is seen from."""
    elements, domain = surface.patches.elements, surface.scheme.domain
    j, i = np.indices((segments + 1, segments + 1)).reshape(2, -1)
    inside = i + j <= segments if domain.corner_count == 3 else np.full(len(i), True)
    uv = np.stack([i, j], axis=1)[inside] / segments
    corner = np.arange(elements.half_edge_count)
    is_first = corner == elements.face_offsets[elements.face[corner]]
    starts = corner[is_first | ~surface.patches.is_whole[elements.face[corner]]]
    return np.repeat(starts, len(uv)), np.tile(uv, (len(starts), 1))
