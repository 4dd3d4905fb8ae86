"""Tiles: the parts of patches that an adaptive tessellation has a grid for, each with rates of its own.

A tile is a copy of its patch's domain, ``2^depth`` times smaller. Tiles are structured arrays, of `tile_type`.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ..mesh.connectivity import IndexArray, IntArray
from ..schemes.domain import ParameterDomain
from .patch_frames import UNIT

# Rings around extraordinary points are at most so deep: single precision tells nothing nearer apart.
DEEPEST = 24

Tiles = NDArray[np.void]


def tile_type(corner_count: int) -> np.dtype[np.void]:
    """What a tile over a domain of so many corners consists of."""
    return np.dtype(
        [
            # Corner of its element that a tile's patch begins at, a half-edge of `PatchTable.elements`
            ("corner", np.int32),
            ("depth", np.int32),
            # Where the tile lies in its patch's domain: its least u and v, in units of ``2^-depth``
            ("origin", np.int32, 2),
            # Whether its parameters run backwards, as those of the middle copies of triangles do. Its corner (0, 0) is
            # then at ``origin + 1``.
            ("is_flipped", np.bool_),
            # How often an edge of the patch is halved to a tile's side; around extraordinary points, an edge of a ring
            ("halvings", np.int32),
            # Segments along u and v; over triangles both are the same
            ("rates", np.int32, 2),
            # Least segments on each side that lies on a feature edge, see `feature_edges`; 0 elsewhere
            ("sides", np.int32, corner_count),
        ]
    )


def whole_patches(corners: IntArray, is_feature: NDArray[np.bool_]) -> Tiles:
    """One tile for each patch that begins at these corners, of which some sides ``(t, m)`` lie on feature edges."""
    found = np.zeros(len(corners), dtype=tile_type(is_feature.shape[1]))
    found["corner"], found["rates"], found["sides"] = corners, 1, is_feature
    return found


def child(tiles: Tiles, number: int, domain: ParameterDomain) -> Tiles:
    """One of the four copies of each tile, in the order of `ParameterDomain.children`."""
    found, m = tiles.copy(), domain.corner_count
    is_middle = m == 3 and number == 3
    # Where the copy begins, in units of half a tile, from the tile's corner (0, 0).
    step = np.array([0, 0] if is_middle else domain.corners[number], dtype=np.int32)
    found["origin"] = 2 * tiles["origin"] + np.where(tiles["is_flipped"][:, None], 1 - step, step)
    found["depth"] += 1
    found["halvings"] += 1
    found["is_flipped"] ^= is_middle
    # A copy at a corner shares the sides that meet there.
    shared = [side for side in range(m) if not is_middle and side in (number, (number - 1) % m)]
    found["sides"] = 0
    found["sides"][:, shared] = -(-tiles["sides"][:, shared] // 2)
    return found


def sizes(tiles: Tiles) -> IndexArray:
    """``(t,)`` length of each tile's sides in its patch, in parts of `UNIT`."""
    return np.int32(UNIT) >> tiles["depth"]


def corner_points(tiles: Tiles, domain: ParameterDomain) -> IndexArray:
    """``(2, t, m)`` corners in their patches, in parts of `UNIT`, counter-clockwise from the tile's (0, 0)."""
    steps = domain.corners.T.astype(np.int32)[:, None]
    steps = np.where(tiles["is_flipped"][:, None], 1 - steps, steps)
    found: IndexArray = (tiles["origin"].T[..., None] + steps) * sizes(tiles)[:, None]
    return found
