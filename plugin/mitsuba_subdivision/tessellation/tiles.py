"""Tiles, the parts of patches that have one grid each in an adaptive tessellation, and the lines along which they meet.

A tile is a copy of its patch's domain, ``2^depth`` times smaller, with its own rates. Tiles are structured arrays of
`tile_type`. Frames place patches in the elements of a cage.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..mesh import ragged
from ..mesh.connectivity import IndexArray, IntArray, Topology
from ..patches import PatchTable
from ..schemes.domain import FloatArray, ParameterDomain

# Greatest depth of tiles around extraordinary points: single precision does not resolve smaller ones.
DEEPEST = 24

Tiles = NDArray[np.void]


@dataclass(frozen=True, eq=False)
class PatchFrames:
    """Placement of patches in the elements of a cage."""

    topology: Topology  # Of the elements
    domain: ParameterDomain
    # (n_f,) bool: whether each element is a single patch. The patches of other elements lie at a corner and reach half
    # way along its edges, and to the element's centre.
    is_whole: NDArray[np.bool_]
    scale: FloatArray  # (n_f,) float64: factor from a patch's parameters to its element's, starting at the same corner
    # (n_h,) int32: numbers of the edge of each half-edge and of the vertex at which it begins, equal on both sides of a
    # crease
    edge: IndexArray
    vertex: IndexArray
    # (n_h,) bool: whether positions along the edge of a half-edge are counted from the half-edge's end
    is_backward: NDArray[np.bool_]
    has_copies: bool  # Whether several edges or vertices of the topology have the same number

    @classmethod
    def of(
        cls,
        patches: PatchTable,
        control_of_vertex: IntArray,  # (n_v,) int64: 0-based control point at each mesh vertex
    ) -> PatchFrames:
        """The frames of a table's patches."""
        t, is_split = patches.elements, patches.refined is not None
        is_whole = patches.is_whole & (not is_split)
        scale = np.where(patches.is_whole & is_split, 0.5, 1.0)
        half_edge = np.arange(t.half_edge_count, dtype=np.int32)
        edge = np.where(t.twin < 0, half_edge, np.minimum(half_edge, t.twin))
        is_backward = edge != half_edge
        start, border, has_copies = t.face_vertices, np.flatnonzero(t.twin < 0), False
        if patches.scheme.element == "face":
            has_copies = not np.array_equal(control_of_vertex, np.arange(len(control_of_vertex)))
            if has_copies:
                start = control_of_vertex.astype(np.int32)[start]
            # Border edges with the same end points are the two sides of a crease.
            ends = np.stack([start[border], start[t.next[border]]]).astype(np.int64)
            pairs = ends.min(axis=0) * (int(control_of_vertex.max()) + 1) + ends.max(axis=0)
            _, first, pair_index = np.unique(pairs, return_index=True, return_inverse=True)
            edge[border] = border[first[pair_index]]
            is_backward[border] = start[border] != start[edge[border]]
            has_copies |= len(first) < len(border)
        return cls(t, patches.scheme.domain, is_whole, scale, edge, start, is_backward, has_copies)


def tile_type(corner_count: int) -> np.dtype[np.void]:
    """The structured type of tiles over a domain with ``corner_count`` corners."""
    return np.dtype(
        [
            # Corner of the element at which the tile's patch begins, a half-edge of `PatchTable.elements`
            ("corner", np.int32),
            ("depth", np.int32),
            # Least u and v of the tile in its patch's domain, in units of ``2^-depth``
            ("origin", np.int32, 2),
            # Whether the tile's parameters run backwards, as in the middle child of a triangle. Its corner (0, 0) is
            # then at ``origin + 1``.
            ("is_flipped", np.bool_),
            # Halvings from an edge of the patch to a side of the tile; around extraordinary points, from an edge of a
            # ring
            ("halvings", np.int32),
            # Segments along u and v; equal over triangles
            ("rates", np.int32, 2),
            # Least segments on each side that lies on a feature edge, see `feature_edges`; 0 elsewhere
            ("sides", np.int32, corner_count),
        ]
    )


def whole_patches(corners: IntArray, is_feature: NDArray[np.bool_]) -> Tiles:
    """A tile for each patch that begins at ``corners``; ``is_feature``, ``(t, m)``, marks sides on feature edges."""
    tiles = np.zeros(len(corners), dtype=tile_type(is_feature.shape[1]))
    tiles["corner"], tiles["rates"], tiles["sides"] = corners, 1, is_feature
    return tiles


def child(tiles: Tiles, number: int, domain: ParameterDomain) -> Tiles:
    """Child ``number`` of each tile, in the order of `ParameterDomain.children`."""
    children, m = tiles.copy(), domain.corner_count
    is_middle = m == 3 and number == 3
    # Origin of the child relative to the tile's corner (0, 0), in units of half a tile.
    step = np.array([0, 0] if is_middle else domain.corners[number], dtype=np.int32)
    children["origin"] = 2 * tiles["origin"] + np.where(tiles["is_flipped"][:, None], 1 - step, step)
    children["depth"] += 1
    children["halvings"] += 1
    children["is_flipped"] ^= is_middle
    # A child at a corner shares the sides that meet there.
    shared = [] if is_middle else [number, (number - 1) % m]
    children["sides"] = 0
    children["sides"][:, shared] = -(-tiles["sides"][:, shared] // 2)
    return children


def in_patch(tiles: Tiles, tile: IntArray, uv: FloatArray) -> FloatArray:
    """``(2, n)`` parameters in patches, from the tile of each point and its parameters ``(2, n)`` there."""
    parameters = np.where(tiles["is_flipped"][tile], 1 - uv, uv)
    parameters += tiles["origin"].T[:, tile]
    parameters *= np.ldexp(1.0, -tiles["depth"])[tile]
    return parameters


def half_edges_around(frames: PatchFrames, corner: IntArray) -> list[IntArray]:
    """The half-edges around elements, in order from ``corner`` on, as many as the domain has corners."""
    around = [corner]
    for _ in range(1, frames.domain.corner_count):
        around.append(frames.topology.next[around[-1]])
    return around


def vertices_at_corners(tiles: Tiles, frames: PatchFrames) -> IndexArray:
    """``(m, t)`` half-edge that begins at the vertex of the elements at each corner of tiles; -1 at other corners."""
    corner, depth = tiles["corner"], tiles["depth"]
    is_whole = frames.is_whole[frames.topology.face[corner]]
    half_edges = np.full((frames.domain.corner_count, len(tiles)), -1, dtype=np.int32)
    for number, half_edge in enumerate(half_edges_around(frames, corner)):
        # Origin of the tile at this corner of the patch.
        u, v = (int(end) * ((1 << depth) - 1) for end in frames.domain.corners[number])
        is_there = (tiles["origin"][:, 0] == u) & (tiles["origin"][:, 1] == v) & ~tiles["is_flipped"]
        # Patches of polygons begin at the only vertex that they have.
        is_there &= is_whole | (number == 0)
        half_edges[number, is_there] = half_edge[is_there]
    return half_edges


class Sides(NamedTuple):
    """The lines on which sides of tiles lie: edges of elements, spokes of polygons, and lines inside patches.

    A spoke joins the midpoint of an edge to the polygon's centre, and separates two patches at its corners. Arrays have
    an entry for each side, tile by tile.
    """

    half_edge: IntArray  # (m t,) int32: half-edge of the element on whose edge the side lies, or -1
    line: IntArray  # (m t,) int32: number of any other line, from ``n_h`` on
    # (m t,) int32: positions on the line at which the side begins and ends, in parts of ``2^-bits`` of a patch's side
    begin: IntArray
    end: IntArray
    bits: int

    def points(self, edge: IndexArray, side: IntArray | slice, position: IntArray) -> NDArray[np.int64]:
        """``(n,)`` sort keys of positions on lines, equal for equal points on edges with equal numbers ``edge``."""
        line = np.where(self.half_edge >= 0, edge[self.half_edge], self.line)
        # Edges are two sides of patches long.
        return np.left_shift(line, self.bits + 2, dtype=np.int64)[side] | position


def sides_of(tiles: Tiles, frames: PatchFrames, bits: int) -> Sides:
    """Find the lines of the sides of tiles, whose positions ``bits`` are enough for."""
    t, m, unit = frames.topology, frames.domain.corner_count, 1 << bits
    corner, flipped, is_whole = tiles["corner"], tiles["is_flipped"], frames.is_whole[t.face[tiles["corner"]]]
    steps = frames.domain.corners.T.astype(np.int32)[..., None]
    points = tiles["origin"].T[:, None] + np.where(flipped, 1 - steps, steps)
    points <<= bits - tiles["depth"]
    # Lines inside a patch run along u, along v or, in triangles, along the diagonal.
    side, along = np.arange(m), np.array([0, 1, 1] if m == 3 else [0, 1, 0, 1])
    begin, end = points[along, side], np.roll(points, -1, axis=1)[along, side]
    level = points[[1, 0, 0] if m == 3 else 1 - along, side]
    if m == 3:
        level[1] += begin[1]
    on_border = level == np.array([0, unit, 0] if m == 3 else [0, unit, unit, 0])[:, None]
    # The patch of a polygon's corner has parts of the edges that begin and end there, and of both spokes from these.
    around = np.stack(half_edges_around(frames, corner))
    around[2:] = np.where(is_whole, around[2:], t.prev[corner])
    around[1] = np.where(is_whole, around[1], corner)
    on_edge = on_border & (is_whole | (side % 3 == 0)[:, None])
    is_backward = on_edge & (frames.is_backward[around] != (side >= 2)[:, None])
    begin, end = (np.where(is_backward, 2 * unit - at, at) for at in np.stack([begin, end]) << (on_edge & is_whole))
    line, inside = t.half_edge_count + around, ~on_border
    names = 3 * np.broadcast_to(corner, inside.shape)[inside].astype(np.int64)
    names += np.broadcast_to((side if m == 3 else side % 2)[:, None], inside.shape)[inside]
    line[inside] = 2 * t.half_edge_count + ranked(names << bits + 1 | level[inside])[0]
    half_edge, line, begin, end = (column.T.ravel() for column in (np.where(on_edge, around, -1), line, begin, end))
    return Sides(half_edge, line, begin, end, bits)


def ranked(keys: IntArray) -> tuple[IndexArray, IndexArray]:
    """Rank integers from 0 on, equal ones alike. Returns the ranks, and the first index of each rank."""
    order, begins = ragged.sorted_order(keys)
    number = np.empty(len(keys), dtype=np.int32)
    number[order] = np.cumsum(begins, dtype=np.int32) - 1
    return number, order[begins]
