"""Where tiles lie, in integers, and on which lines their sides do: edges of elements, spokes of polygons, lines inside.

A spoke joins the middle of a polygon's edge to its centre: two patches at corners of the polygon meet there.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..mesh.connectivity import IndexArray, IntArray, Topology
from ..schemes.domain import ParameterDomain
from .patch_frames import PatchFrames
from .tiles import DEEPEST, UNIT, Tiles

# An edge of an element, along which a patch of a polygon reaches half way, in the same parts.
EDGE = 2 * UNIT
# Bits of how often an edge is halved.
HALVINGS = 5


def tile_corners(tiles: Tiles, domain: ParameterDomain) -> IndexArray:
    """``(2, t, m)`` corners of tiles in their patches, in parts of `UNIT`, counter-clockwise from the tile's (0, 0)."""
    size = tiles.size[:, None]
    found = []
    for origin, steps in zip(tiles.origin.T, domain.corners.astype(np.int32).T, strict=True):
        found.append(origin.astype(np.int32)[:, None] + np.where(tiles.is_flipped[:, None], 1 - steps, steps))
        found[-1] *= size
    return np.stack(found)


def at_vertices(marked: NDArray[np.bool_], tiles: Tiles, frames: PatchFrames) -> NDArray[np.bool_]:
    """``(t, m)`` whether corners of tiles lie at half-edges' beginnings that are marked, ``(n_h,)``: at vertices."""
    t, domain = frames.topology, frames.domain
    found = np.zeros((len(tiles), domain.corner_count), dtype=bool)
    is_whole, half_edge = frames.is_whole[t.face[tiles.corner]], tiles.corner
    for number, corner in enumerate(domain.corners.astype(np.int32) * UNIT):
        near = np.flatnonzero(marked[half_edge] & (is_whole | (number == 0)))
        u, v = tile_corners(tiles[near], domain)
        found[near] |= (u == corner[0]) & (v == corner[1])
        half_edge = t.next[half_edge]
    return found


@dataclass(frozen=True, eq=False)
class SidePoints:
    """Points on one side of their patches."""

    on: IndexArray  # (n,) int32: which of them lie there
    edge: IntArray  # (n,) int32: half-edge of the element along that side; for a spoke, in whose middle it begins
    at: IntArray  # (n,) int32: position along the half-edge, or along the spoke
    is_spoke: bool


def points_on_sides(frames: PatchFrames, corner: IntArray, points: IndexArray) -> list[SidePoints]:
    """Of points ``(2, n)`` of the patches that begin at corners, those that lie on the patches' sides, side by side."""
    t = frames.topology
    u, v = points
    is_whole = frames.is_whole[t.face[corner]]
    # How far from each side, and how far along it.
    if frames.domain.corner_count == 3:
        sides = [(v, u), (UNIT - u - v, v), (u, UNIT - v)]
    else:
        sides = [(v, u), (UNIT - u, v), (UNIT - v, UNIT - u), (u, UNIT - v)]
    found, edge = [], corner
    for number, (distance, along) in enumerate(sides):
        on = np.flatnonzero(distance == 0).astype(np.int32)
        whole, other = on[is_whole[on]], on[~is_whole[on]]
        found.append(SidePoints(whole, edge[whole], 2 * along[whole], is_spoke=False))
        edge = t.next[edge]
        if len(other):
            half_edge, at, is_spoke = _of_patch_at_corner(t, number, corner[other], along[other])
            found.append(SidePoints(other, half_edge, at, is_spoke))
    return found


def _of_patch_at_corner(t: Topology, side: int, corner: IntArray, along: IntArray) -> tuple[IntArray, IntArray, bool]:
    """Where places on a side of patches at corners lie: half-edges, positions along these or their spokes, and which.

    The sides are half an edge, two spokes that join the middles of edges to the centre, and half an edge.
    """
    half_edge = corner if side < 2 else t.prev[corner]
    return half_edge, (along, along, UNIT - along, UNIT + along)[side], side in (1, 2)


class SideLines(NamedTuple):
    """On which lines the sides of tiles lie, and where; side by side of each tile."""

    line: IntArray  # (n,) int64
    low: IndexArray  # (n,) int32: from where on along the line
    halvings: IndexArray  # (n,) int32: how often `EDGE` is halved to their length
    is_backward: NDArray[np.bool_]  # (n,) bool: whether they lead towards lower positions
    half_edge: IndexArray  # (n,) int32: of an element, along which they lie; -1 elsewhere


def side_lines(tiles: Tiles, frames: PatchFrames) -> SideLines:
    """Find the lines of some tiles' sides."""
    t, m, flipped = frames.topology, frames.domain.corner_count, tiles.is_flipped
    size = tiles.size
    u, v = (origin.astype(np.int32) * size for origin in tiles.origin.T)
    far_u, far_v, diagonal = u + size, v + size, u + v + size
    # Lines inside patches, whose levels are below `UNIT`, are numbered by their direction and patch, after edges and
    # spokes.
    shape = len(tiles), m
    line, half_edge = np.empty(shape, dtype=np.int64), np.full(shape, -1, dtype=np.int32)
    low, halvings = (np.empty(shape, dtype=np.int32) for _ in range(2))
    is_backward = np.empty(shape, dtype=bool)
    halvings[:] = tiles.depth[:, None] + 1
    is_whole, edge = frames.is_whole[t.face[tiles.corner]], tiles.corner
    borders: list[tuple[IntArray, IntArray, IntArray, IntArray, bool]]
    if m == 3:
        # At which level, from where on, how far from the patch's side, and how far along it.
        sides = [
            (np.where(flipped, far_v, v), u, v, u),
            (diagonal, v, UNIT - diagonal, v),
            (np.where(flipped, far_u, u), v, u, UNIT - far_v),
        ]
    else:
        sides = [
            (v, u, v, u),
            (far_u, v, UNIT - far_u, v),
            (far_v, u, UNIT - far_v, UNIT - far_u),
            (u, v, u, UNIT - far_v),
        ]
    for side, (own_level, own_low, distance, along) in enumerate(sides):
        axis = side if m == 3 else side % 2
        line[:, side] = (tiles.corner.astype(np.int64) + (2 + axis) * t.half_edge_count) << DEEPEST | own_level
        low[:, side] = own_low
        is_backward[:, side] = flipped ^ (side == 2 or (m == 4 and side == 3))
        on = np.flatnonzero((distance == 0) & ~flipped)
        whole, other = on[is_whole[on]], on[~is_whole[on]]
        borders = [(whole, edge[whole], 2 * along[whole], 2 * size[whole], False)]
        if len(other):
            own, at, is_spoke = _of_patch_at_corner(t, side, tiles.corner[other], along[other])
            # That position of the side's two ends which is less.
            borders.append((other, own, at - size[other] if side == 2 else at, size[other], is_spoke))
        for at, own, begin, own_length, is_spoke in borders:
            if is_spoke:
                line[at, side] = (own.astype(np.int64) + t.half_edge_count) << DEEPEST
                low[at, side] = begin
                is_backward[at, side] = side == 2
            else:
                backward = frames.is_backward[own]
                line[at, side] = frames.edge[own].astype(np.int64) << DEEPEST
                half_edge[at, side] = own
                low[at, side] = np.where(backward, EDGE - begin - own_length, begin)
                is_backward[at, side] = backward
        halvings[whole, side] -= 1
        edge = t.next[edge]
    return SideLines(line.ravel(), low.ravel(), halvings.ravel(), is_backward.ravel(), half_edge.ravel())
