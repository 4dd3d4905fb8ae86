"""Tiles, the parts of patches that have one grid each in an adaptive tessellation, and the frames of their patches.

A tile is a copy of its patch's domain, ``2^depth`` times smaller, with its own rates. Tiles are structured arrays of
`tile_type`. Frames place patches in the elements of a cage, and identify the elements' edges and vertices.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from ..mesh.connectivity import IndexArray, IntArray, Topology
from ..patches import PatchTable
from ..schemes.domain import FloatArray, ParameterDomain

# Length of a patch's side in integer parameters. A side of the smallest tile that is divided, of depth 22, has 64 parts
# and at most 32 segments, see `tile_choice.MOST_TRIANGLES`.
UNIT = 1 << 28
# Length of an edge of an element in the same parts: a patch of a polygon reaches half way along it.
EDGE = 2 * UNIT
# Greatest depth of tiles around extraordinary points: single precision does not resolve smaller ones.
DEEPEST = 24


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

    @cached_property
    def meets_twice(self) -> NDArray[np.bool_]:
        """``(n_f,)`` whether two corners of each whole element are connected more than once.

        Connections are edges, and diagonals of quadrilaterals, of any element.
        """
        t, m = self.topology, self.domain.corner_count
        meets_twice = np.zeros(t.face_count, dtype=bool)
        whole = np.flatnonzero(self.is_whole)
        corners = t.face_offsets[whole] + np.arange(m, dtype=np.int32)[:, None]
        # Each edge once, as one of its half-edges.
        edges = corners[t.edge_half_edge[t.edge[corners]] == corners]
        first, second, twin = edges, t.next[edges], t.twin[edges]
        if m == 4:
            first, second = np.concatenate([first, *corners[:2]]), np.concatenate([second, *corners[2:]])
            twin = np.concatenate([twin, *corners[:2]])
        start, end = t.face_vertices[first].astype(np.int64), t.face_vertices[second]
        pairs = np.minimum(start, end) * t.vertex_count + np.maximum(start, end)
        sorted_pairs = np.sort(pairs)
        duplicates = sorted_pairs[1:][sorted_pairs[1:] == sorted_pairs[:-1]]
        is_duplicate = np.flatnonzero(np.isin(pairs, duplicates) | (start == end))
        meets_twice[t.face[first[is_duplicate]]] = True
        meets_twice[t.face[twin[is_duplicate][twin[is_duplicate] >= 0]]] = True
        return meets_twice & self.is_whole

    def names(
        self,
        corner: IntArray,  # (n,) int: corners at which the patches begin
        points: IndexArray,  # (2, n) int32: points in the patches, in parts of `UNIT`
        # (n_h,) int32: numbers of edges and vertices: `edge` and `vertex` of these frames, to identify the two sides of
        # a crease, or those of a topology, to distinguish them
        edge: IndexArray,
        vertex: IndexArray,
    ) -> tuple[NDArray[np.int64], IndexArray]:
        """Identify points: equal points, on edges and vertices of equal numbers, get equal names and positions.

        A point lies inside a patch, on an edge of its element, at a vertex, or on a spoke of a polygon. A spoke joins
        the midpoint of an edge to the polygon's centre, and separates two patches at its corners. In a topology that is
        cut further than these frames', numbers of vertices may overlap with those of edges, but only vertices have the
        position zero.

        Returns
        -------
        name : (n,) int64
            Name of the vertex, edge, spoke, centre or patch that contains the point; patches from `first_inside` on.
        position : (2, n) int32
            The position in the patch; or the position along the edge or spoke, and zero. In parts of `UNIT`.
        """
        t, (u, v), position = self.topology, points, points.copy()
        on_edge = self.first_inside - t.face_count - 2 * t.half_edge_count
        on_spoke, at_centre = on_edge + t.half_edge_count, on_edge + 2 * t.half_edge_count
        name = self.first_inside + corner.astype(np.int64)
        if self.domain.corner_count == 3:
            sides = [(v, u), (UNIT - u - v, v), (u, UNIT - v)]
        else:
            sides = [(v, u), (UNIT - u, v), (UNIT - v, UNIT - u), (u, UNIT - v)]
        is_whole = self.is_whole[t.face[corner]]
        # Points on edges: their indices, the half-edge, and the position along it.
        edge_points = []
        for side, (distance, along) in enumerate(sides):
            on = np.flatnonzero((distance == 0) & is_whole)
            half_edge = corner[on]
            for _ in range(side):
                half_edge = t.next[half_edge]
            edge_points.append((on, half_edge, 2 * along[on]))
        partial = np.flatnonzero(~is_whole)
        if len(partial):
            u, v, after, before = u[partial], v[partial], corner[partial], t.prev[corner[partial]]
            for across, along, spoke in ((u, v, after), (v, u, before)):
                on = np.flatnonzero(across == UNIT)
                name[partial[on]] = on_spoke + spoke[on].astype(np.int64)
                position[0, partial[on]], position[1, partial[on]] = along[on], 0
            on = np.flatnonzero((u == UNIT) & (v == UNIT))
            name[partial[on]], position[:, partial[on]] = at_centre + t.face[after[on]].astype(np.int64), 0
            for distance, along, half_edge in ((v, u, after), (u, EDGE - v, before)):
                on = np.flatnonzero(distance == 0)
                edge_points.append((partial[on], half_edge[on], along[on]))
        for on, half_edge, along in edge_points:
            name[on], position[1, on] = on_edge + edge[half_edge].astype(np.int64), 0
            position[0, on] = np.where(self.is_backward[half_edge], EDGE - along, along)
        # Vertices, after the edges, as the end of each edge is the beginning of the next one.
        for on, half_edge, along in edge_points:
            begins = np.flatnonzero(along == 0)
            name[on[begins]], position[0, on[begins]] = vertex[half_edge[begins]], 0
        return name, position

    @cached_property
    def first_inside(self) -> int:
        """The first name of points inside patches, after the names of vertices, edges, spokes and centres."""
        t = self.topology
        return max(int(self.vertex.max(initial=-1)), t.vertex_count - 1) + 1 + 2 * t.half_edge_count + t.face_count

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
        lower = np.where(t.twin < 0, half_edge, np.minimum(half_edge, t.twin))
        if patches.scheme.element == "vertex":
            return cls(t, patches.scheme.domain, is_whole, scale, t.edge, t.face_vertices, lower != half_edge, False)
        edge, is_backward = lower, lower != half_edge
        start, border = t.face_vertices, np.flatnonzero(t.twin < 0)
        has_copies = not np.array_equal(control_of_vertex, np.arange(len(control_of_vertex)))
        if has_copies:
            start = control_of_vertex.astype(np.int32)[start]
        # Border edges with the same end points are the two sides of a crease.
        border_start, border_end = start[border].astype(np.int64), start[t.next[border]]
        low, high = np.minimum(border_start, border_end), np.maximum(border_start, border_end)
        pairs = low * (int(control_of_vertex.max()) + 1) + high
        _, first, pair_index = np.unique(pairs, return_index=True, return_inverse=True)
        edge[border] = border[first[pair_index]]
        is_backward[border] = start[border] != start[edge[border]]
        has_copies |= len(first) < len(border)
        return cls(t, patches.scheme.domain, is_whole, scale, edge, start, is_backward, has_copies)


Tiles = NDArray[np.void]


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
    shared = [side for side in range(m) if not is_middle and side in (number, (number - 1) % m)]
    children["sides"] = 0
    children["sides"][:, shared] = -(-tiles["sides"][:, shared] // 2)
    return children


def sizes(tiles: Tiles) -> IndexArray:
    """``(t,)`` side length of each tile in its patch, in parts of `UNIT`."""
    return np.int32(UNIT) >> tiles["depth"]


def corner_points(tiles: Tiles, domain: ParameterDomain) -> IndexArray:
    """``(2, t, m)`` corners of tiles in their patches, in parts of `UNIT`, counter-clockwise from the tile's (0, 0)."""
    steps = domain.corners.T.astype(np.int32)[:, None]
    steps = np.where(tiles["is_flipped"][:, None], 1 - steps, steps)
    corners: IndexArray = (tiles["origin"].T[..., None] + steps) * sizes(tiles)[:, None]
    return corners
