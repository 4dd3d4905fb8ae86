"""Tiles, the parts of patches that an adaptive tessellation has a grid for, and the frames of their patches.

A tile is a copy of its patch's domain, ``2^depth`` times smaller, with rates of its own. Tiles are structured arrays,
of `tile_type`. Frames place patches in the elements of a cage, and identify the elements' edges and vertices.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from ..mesh.connectivity import IndexArray, IntArray, Topology
from ..patches import PatchTable
from ..schemes.domain import FloatArray, ParameterDomain

# Parameters of patches in integers are multiples of this part of a patch: a side of the smallest tile that is divided,
# of a depth of 22, has 64 parts, and at most 32 segments, as tiles have triangles.
UNIT = 1 << 28
# An edge of an element, along which a patch of a polygon reaches half way, in the same parts.
EDGE = 2 * UNIT


@dataclass(frozen=True, eq=False)
class PatchFrames:
    """Placement of patches in the elements of a cage."""

    topology: Topology  # Of the elements
    domain: ParameterDomain
    # (n_f,) bool: whether the patches of each element are the element itself. Others lie at a corner, reach half way
    # along its edges, and to the element's centre.
    is_whole: NDArray[np.bool_]
    scale: FloatArray  # (n_f,) float64: from a patch's parameters to those of its element, seen from the same corner
    # (n_h,) int32: numbers of the edge of each half-edge, and of the vertex where it begins: of both sides of a
    # crease the same
    edge: IndexArray
    vertex: IndexArray
    # (n_h,) bool: whether positions along the edge of a half-edge are counted from its end
    is_backward: NDArray[np.bool_]
    has_copies: bool  # Whether edges or vertices of the topology have the same number

    @cached_property
    def meets_twice(self) -> NDArray[np.bool_]:
        """``(n_f,)`` whether two corners of each whole element are connected by more than one edge.

        The second connection is in another element, by another edge, or in the element itself.
        """
        t, m = self.topology, self.domain.corner_count
        found = np.zeros(t.face_count, dtype=bool)
        whole = np.flatnonzero(self.is_whole)
        corners = t.face_offsets[whole] + np.arange(m, dtype=np.int32)[:, None]
        # An edge once, as one of its half-edges.
        edges = corners[t.edge_half_edge[t.edge[corners]] == corners]
        one, other, twin = edges, t.next[edges], t.twin[edges]
        if m == 4:
            one, other = np.concatenate([one, *corners[:2]]), np.concatenate([other, *corners[2:]])
            twin = np.concatenate([twin, *corners[:2]])
        start, end = t.face_vertices[one].astype(np.int64), t.face_vertices[other]
        pairs = np.minimum(start, end) * t.vertex_count + np.maximum(start, end)
        in_order = np.sort(pairs)
        again = in_order[1:][in_order[1:] == in_order[:-1]]
        is_again = np.flatnonzero(np.isin(pairs, again) | (start == end))
        found[t.face[one[is_again]]] = True
        found[t.face[twin[is_again][twin[is_again] >= 0]]] = True
        return found & self.is_whole

    def names(
        self,
        corner: IntArray,  # (n,) the corners that patches begin at
        points: IndexArray,  # (2, n) int32: of these, in parts of `UNIT`
        edge: IndexArray,  # (n_h,) int32: numbers of edges and vertices, as `edge` and `vertex`
        vertex: IndexArray,
    ) -> tuple[NDArray[np.int64], IndexArray]:
        """Names of points: equal where points are the same, and lie on edges and vertices of equal numbers.

        A point lies inside a patch, on an edge of its element, at the end of one, or on a spoke of a polygon, which
        joins the middle of an edge to the centre: two patches at corners of the polygon meet there. By the numbers of
        these frames, both sides of a crease are the same; by those of a topology, each is by itself. Vertices of one
        that is cut further may have the numbers of edges, but only they have the position zero.

        Returns
        -------
        name : (n,) int64
            Of the vertex, edge, spoke, centre or inside; the last ones from `first_inside` on.
        at : (2, n) int32
            The position inside or, first, along the edge or spoke, in parts of `UNIT`.
        """
        t, (u, v), at = self.topology, points, points.copy()
        on_edge = self.first_inside - t.face_count - 2 * t.half_edge_count
        on_spoke, at_centre = on_edge + t.half_edge_count, on_edge + 2 * t.half_edge_count
        name = self.first_inside + corner.astype(np.int64)
        if self.domain.corner_count == 3:
            sides = [(v, u), (UNIT - u - v, v), (u, UNIT - v)]
        else:
            sides = [(v, u), (UNIT - u, v), (UNIT - v, UNIT - u), (u, UNIT - v)]
        is_whole, found = self.is_whole[t.face[corner]], []
        for number, (distance, along) in enumerate(sides):
            on = np.flatnonzero((distance == 0) & is_whole)
            half_edge = corner[on]
            for _ in range(number):
                half_edge = t.next[half_edge]
            found.append((on, half_edge, 2 * along[on]))
        others = np.flatnonzero(~is_whole)
        if len(others):
            u, v, own, before = u[others], v[others], corner[others], t.prev[corner[others]]
            for beyond, along, spoke in ((u, v, own), (v, u, before)):
                on = np.flatnonzero(beyond == UNIT)
                name[others[on]] = on_spoke + spoke[on].astype(np.int64)
                at[0, others[on]], at[1, others[on]] = along[on], 0
            on = np.flatnonzero((u == UNIT) & (v == UNIT))
            name[others[on]], at[:, others[on]] = at_centre + t.face[own[on]].astype(np.int64), 0
            for distance, position, line in ((v, u, own), (u, EDGE - v, before)):
                on = np.flatnonzero(distance == 0)
                found.append((others[on], line[on], position[on]))
        for on, half_edge, position in found:
            name[on], at[1, on] = on_edge + edge[half_edge].astype(np.int64), 0
            at[0, on] = np.where(self.is_backward[half_edge], EDGE - position, position)
        # The end of each edge is the beginning of the next one.
        for on, half_edge, position in found:
            begins = np.flatnonzero(position == 0)
            name[on[begins]], at[0, on[begins]] = vertex[half_edge[begins]], 0
        return name, at

    @cached_property
    def first_inside(self) -> int:
        """Names of points inside patches begin here, after those of vertices, edges, spokes and centres."""
        t = self.topology
        return max(int(self.vertex.max(initial=-1)), t.vertex_count - 1) + 1 + 2 * t.half_edge_count + t.face_count

    @classmethod
    def of(
        cls,
        patches: PatchTable,
        control_of_vertex: IntArray,  # (n_v,) int64: 0-based control point at each mesh vertex
    ) -> PatchFrames:
        """Frames of a table's patches."""
        t, is_split = patches.elements, patches.refined is not None
        is_whole = patches.is_whole & (not is_split)
        scale = np.where(patches.is_whole & is_split, 0.5, 1.0)
        every = np.arange(t.half_edge_count, dtype=np.int32)
        lower = np.where(t.twin < 0, every, np.minimum(every, t.twin))
        if patches.scheme.element == "vertex":
            return cls(t, patches.scheme.domain, is_whole, scale, t.edge, t.face_vertices, lower != every, False)
        edge, is_backward = lower, lower != every
        start, border = t.face_vertices, np.flatnonzero(t.twin < 0)
        has_copies = not np.array_equal(control_of_vertex, np.arange(len(control_of_vertex)))
        if has_copies:
            start = control_of_vertex.astype(np.int32)[start]
        one, other = start[border].astype(np.int64), start[t.next[border]]
        ends = np.minimum(one, other) * (int(control_of_vertex.max()) + 1) + np.maximum(one, other)
        _, first, same = np.unique(ends, return_index=True, return_inverse=True)
        edge[border] = border[first[same]]
        is_backward[border] = start[border] != start[edge[border]]
        has_copies |= len(first) < len(border)
        return cls(t, patches.scheme.domain, is_whole, scale, edge, start, is_backward, has_copies)


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
