"""One-rings of elements: a local mesh for each signature, and its vertices in the cage.

The faces around the corners of the element are glued where they are the same face. A one-ring is *unfolded*: a vertex
of a small cage may occur several times as different vertices of the local mesh. Stencils over an unfolded ring are
still correct, because the weights of equal vertices add up.

Scans have hundreds of signatures, so the rings of many are glued side by side, as one mesh.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import chain, pairwise

import numpy as np
from numpy.typing import NDArray

from . import ragged
from .connectivity import IndexArray, IntArray, SemiSharpness, Topology
from .manifold import fan_labels
from .signature import Fan, Signature

# Number of one-rings that are kept for later calls.
MOST_RINGS = 4096
_RINGS: dict[Signature, OneRing] = {}


def surroundings(topology: Topology) -> tuple[IndexArray, IndexArray]:
    """The vertices around each vertex of a mesh, face by face counter-clockwise, in one array.

    The last vertex of each face is left out: it is the first one of the following face. Around an inner vertex the
    faces come twice, so that all of them follow any of the first ones. Returns ``(n_h,)`` for each half-edge the index
    in the array at which its face begins, around its first vertex; and the array.
    """
    t = topology
    is_open, ordered = t.open_fan_start >= 0, list[IntArray]()
    first, kinds = np.where(is_open, t.open_fan_start, t.vertex_half_edge), 2 * t.vertex_face_count + is_open
    for kind in np.flatnonzero(np.bincount(kinds)[2:]).tolist():
        fans = [first[kinds == kind + 2]]
        for _ in range(kind // 2):
            fans.append(t.turn.take(fans[-1]))
        ordered.append(np.stack(fans if kind % 2 else 2 * fans, axis=1).ravel())
    half_edge = np.concatenate(ordered)
    row = ragged.first_indices(half_edge, t.half_edge_count)
    if t.common_size:
        count = t.common_size - 2
        ahead = t.face_vertices.take(np.stack(t.around_faces(t.next, count), axis=1))
        return count * row, ahead.take(half_edge, axis=0).ravel()
    counts = t.face_sizes[t.face[half_edge]] - 2
    start = ragged.starts(counts).astype(np.int32)[row]
    return start, t.face_vertices.take(t.along_faces(t.next.take(half_edge), counts))


@dataclass(frozen=True, eq=False)
class OneRing:
    """An unfolded one-ring: its local mesh, and the places of its vertices around the corners of the element."""

    # The local mesh, which has a border. Half-edge 0 names the element; the vertices of the element come first.
    topology: Topology
    around: list[IntArray]  # Half-edges of the fan at each corner of the element, from the most clockwise one on
    # (K,) int64: a corner that each vertex is around, and how far it comes after the start of `surroundings` there
    corner: IntArray
    offset: IntArray
    # Local vertices (corner, first, last) for each corner of the element on a border; first and last are its
    # `Topology.border_neighbours`, also where its fan lacks faces (`Fan.near`)
    open_fans: list[tuple[int, int, int]]

    @property
    def vertex_count(self) -> int:
        """K, the number of control points."""
        return self.topology.vertex_count

    def edge_neighbours(self) -> list[int]:
        """Return the edge neighbours of the first vertex, counter-clockwise; on a border, from border to border."""
        t, half_edges = self.topology, self.around[0]
        neighbours = t.face_vertices[t.prev[half_edges]].tolist()
        is_closed = int(t.turn[half_edges[-1]]) >= 0
        return neighbours if is_closed else [int(t.face_vertices[t.next[half_edges[0]]]), *neighbours]

    def end_open_fans(self, topology: Topology, columns: NDArray[np.int32]) -> None:
        """Set the border neighbours of corners, in the vertices ``(K, e)`` of elements of a mesh."""
        for centre, first, last in self.open_fans:
            columns[first], columns[last] = topology.border_neighbours(columns[centre])


class RingTable:
    """The vertices of a mesh in the one-rings of many elements, grouped by signature."""

    def __init__(
        self,
        topology: Topology,
        rings: list[OneRing],  # One-ring of each group
        half_edges: IndexArray,  # (e,) int32: the half-edge that names each element, group by group
        element_counts: IntArray,  # (g,) int: number of elements in each group
    ) -> None:
        self.topology, self.rings, self.half_edges = topology, rings, half_edges
        # (g,) int64: K, the number of control points
        self.vertex_counts = np.array([ring.vertex_count for ring in rings], dtype=np.int64)
        # (g + 1,) int64: index in `vertices` of the first entry of each group
        self.offsets = ragged.offsets(self.vertex_counts * element_counts)
        self._first_element = ragged.offsets(element_counts)
        self._corner_counts = np.array([len(ring.around) for ring in rings])
        self._corner = np.concatenate([ring.corner for ring in rings])
        self._offset = np.concatenate([ring.offset for ring in rings])
        self._surroundings: tuple[IndexArray, IndexArray] | None = None  # Kept from the first call of `vertices_of` on

    @cached_property
    def vertices(self) -> IndexArray:
        """The vertices of all groups, flat: for each local vertex of a group, those of all its elements."""
        # Often the largest array of all. The surroundings are half as large, and are not kept for it.
        t, vertices = self.topology, np.empty(self.offsets[-1], dtype=np.int32)
        start, around = self._surroundings or surroundings(t)
        bounds = pairwise(self._first_element.tolist()), pairwise(self.offsets.tolist())
        for ring, elements, entries in zip(self.rings, *bounds, strict=True):
            columns = vertices[slice(*entries)].reshape(ring.vertex_count, -1)
            half_edges, count = self.half_edges[slice(*elements)], len(ring.around)
            for part in ragged.chunks_of(len(half_edges), 8):
                corners = t.around_faces(half_edges[part], count)
                t.face_vertices.take(corners, out=columns[:count, part], mode="clip")
                index = start.take(corners).take(ring.corner[count:], axis=0) + ring.offset[count:, None]
                around.take(index, out=columns[count:, part], mode="clip")
            ring.end_open_fans(t, columns)
        return vertices

    def vertices_of(
        self,
        group: IntArray,  # (s,) int64, in increasing order
        element: IntArray,  # (s,) int64: index in the group
    ) -> list[IndexArray]:
        """Return the vertices ``(n, K)`` of some elements, for each group that has any of them."""
        t = self.topology
        start, around = self._surroundings = self._surroundings or surroundings(t)
        counts, corner_counts = self.vertex_counts[group], self._corner_counts[group]
        corners = t.along_faces(self.half_edges[self._first_element[group] + element], corner_counts)
        place = ragged.ranges(ragged.starts(self.vertex_counts)[group], counts)
        at = corners[np.repeat(ragged.starts(corner_counts), counts) + self._corner[place]]
        vertices = around[start[at] + self._offset[place]]
        vertices[ragged.ranges(ragged.starts(counts), corner_counts)] = t.face_vertices[corners]
        sizes = np.bincount(group)
        groups = np.flatnonzero(sizes)
        bounds, of_groups = pairwise(ragged.offsets(sizes[groups] * self.vertex_counts[groups]).tolist()), []
        for index, span in zip(groups.tolist(), bounds, strict=True):
            of_groups.append(vertices[slice(*span)].reshape(-1, self.rings[index].vertex_count))
            self.rings[index].end_open_fans(t, of_groups[-1].T)
        return of_groups


def one_ring(signature: Signature) -> OneRing:
    """Return the unfolded one-ring of a signature."""
    return one_rings([signature])[0]


def one_rings(signatures: Iterable[Signature]) -> list[OneRing]:
    """Return the unfolded one-rings of signatures; semi-sharp features change nothing."""
    smooth = [signature.smoothed for signature in signatures]
    different = dict.fromkeys(smooth)
    rings = {signature: ring for signature in different if (ring := _RINGS.get(signature)) is not None}
    if missing := [signature for signature in different if signature not in rings]:
        if len(_RINGS) + len(missing) > MOST_RINGS:
            _RINGS.clear()
        rings |= zip(missing, _glued_rings(missing), strict=True)
        _RINGS.update(rings)
    return [rings[signature] for signature in smooth]


def _glued_rings(signatures: Sequence[Signature]) -> list[OneRing]:
    """Glue the faces around elements along the edges at their corners, and nowhere else.

    A walk starts in the element, turns about one of its corners by a number of faces, and arrives at a face. Walks
    about neighbouring corners may arrive at the same face. In a quadrilateral mesh the walks (corner, turns) are::

        +-----------+-----------+-----------+
        |    3,2    | 2,3 = 3,1 |    2,2    |
        +-----------3-----------2-----------+
        |           | 0,0 = 1,0 |           |
        | 0,1 = 3,3 | 2,0 = 3,0 | 1,3 = 2,1 |
        +-----------0-----------1-----------+
        |    0,2    | 0,3 = 1,1 |    1,2    |
        +-----------+-----------+-----------+

    Walks without turns stay in the element. Every other walk initially has a separate face, whose half-edges are
    numbered from the one that begins at the walk's corner. Then faces are glued along the edges that the walks cross.
    Faces are sorted by the first walk to each, by its corner, then by its turns, so that the element comes first.
    """
    fans = [fan for signature in signatures for fan in signature.fans]
    corner_counts = np.array([len(signature.fans) for signature in signatures])
    first_fan, corner_of_fan = ragged.starts(corner_counts), ragged.index_in_row(corner_counts)
    # The walks about each corner, from the most clockwise one on.
    counts, behind = np.array([(fan.face_count, len(fan.behind or ())) for fan in fans]).T
    sizes = np.fromiter(chain.from_iterable((*(fan.behind or ())[::-1], *fan.ahead) for fan in fans), dtype=np.int64)
    fan_of_walk = np.repeat(np.arange(len(fans)), counts)
    turns = ragged.index_in_row(counts) - behind[fan_of_walk]
    stays = np.flatnonzero(turns == 0)
    has_face = turns != 0
    has_face[stays[first_fan]] = True
    order = np.lexsort((turns, np.abs(turns), fan_of_walk))
    order = order[has_face[order]]
    apart = Topology(0, sizes[order], np.zeros(sizes[order].sum()))
    walks = np.zeros_like(turns)
    walks[order] = apart.face_offsets[:-1]
    walks[stays] = np.repeat(walks[stays[first_fan]], corner_counts) + corner_of_fan

    # A turn counter-clockwise crosses the last edge of the face, which is the first edge of the next face.
    last = np.cumsum(counts) - 1
    after, is_crossing = np.roll(walks, -1), np.ones(len(walks), dtype=bool)
    after[last], is_crossing[last] = walks[last - counts + 1], [fan.is_closed for fan in fans]
    lowest, twin = _equal_half_edges(apart, apart.prev[walks[is_crossing]], after[is_crossing])
    kept = np.flatnonzero(lowest == np.arange(len(lowest)))
    number = np.full(len(lowest) + 1, len(kept))
    number[kept] = np.arange(len(kept))
    walks = number[lowest[walks]]
    # Edges are named by half-edges, not by vertices, so that the two sides of a crease stay separate even where the
    # ring closes around the end of the crease.
    names = np.minimum(np.arange(len(kept)), number[twin[kept]])
    glued = Topology(0, apart.face_sizes[lowest[apart.face_offsets[:-1]] == apart.face_offsets[:-1]], 0 * kept, names)

    # Vertices are numbered by their first half-edges.
    labels = fan_labels(glued)[0]
    first = ragged.first_indices(labels, len(labels))[labels]
    is_first = first == np.arange(len(first))
    vertex = (np.cumsum(is_first) - 1)[first]
    rules = np.zeros(np.count_nonzero(is_first), dtype=np.int8)
    rules[vertex[walks[stays]]] = [fan.rule for fan in fans]

    # Vertices around the corners, as in `surroundings`.
    counts_ahead = sizes - 2
    begins = ragged.starts(counts_ahead)
    walk, step = np.repeat(np.arange(len(walks)), counts_ahead), ragged.index_in_row(counts_ahead)
    listed = vertex[glued.along_faces(glued.next[walks], counts_ahead)].astype(np.int32)
    place = ragged.first_indices(listed, len(rules))
    # Those without a place are the last ones of open fans.
    corner = np.where(place < 0, 0, corner_of_fan[fan_of_walk[walk[place]]])
    offset = np.where(place < 0, 0, step[place] + (begins - begins[stays[fan_of_walk]])[walk[place]])

    # Each ring begins with its element.
    half_edges = np.append(walks[stays[first_fan]], len(kept))
    faces, vertices = np.append(glued.face, glued.face_count)[half_edges], np.append(vertex, len(rules))[half_edges]
    local_vertex = (vertex - np.repeat(vertices[:-1], np.diff(half_edges))).astype(np.int32)
    names -= np.repeat(half_edges[:-1], np.diff(half_edges))
    around = ragged.rows(walks - np.repeat(half_edges[:-1], corner_counts)[fan_of_walk], counts)
    ends = local_vertex[np.stack([glued.next[walks[last - counts + 1]], glued.prev[walks[last]]], axis=1)].tolist()
    spans = (pairwise(offsets.tolist()) for offsets in (faces, half_edges, vertices))
    rings = []
    for signature, fan, of_faces, of_edges, of_vertices in zip(signatures, first_fan.tolist(), *spans, strict=True):
        corners, edges, slots = range(len(signature.fans)), slice(*of_edges), slice(*of_vertices)
        topology = Topology(
            of_vertices[1] - of_vertices[0],
            glued.face_sizes[slice(*of_faces)],
            local_vertex[edges],
            names[edges],
            rules[slots],
        )
        open_fans = [(corner, *ends[fan + corner]) for corner in corners if not signature.fans[corner].is_closed]
        rings.append(OneRing(topology, around[fan : fan + len(corners)], corner[slots], offset[slots], open_fans))
    return rings


def _equal_half_edges(apart: Topology, one: IntArray, other: IntArray) -> tuple[IntArray, IntArray]:
    """Make pairs of half-edges twins, in a mesh of separate faces.

    If a half-edge is to be the twin of two, the two are the same half-edge, and their faces are the same face. Then
    their twins are the same, too. Returns ``(n_h,)`` the lowest half-edge that is equal to each one; and the twins of
    these, ``n_h`` for none.
    """
    count, face, begin = apart.half_edge_count, apart.face, apart.face_offsets
    index = np.arange(count) - begin[face]
    one, other = np.concatenate([one, other]), np.concatenate([other, one])
    lowest = np.arange(count)
    while True:
        twin, ends = np.full(count, count), lowest[other]
        np.minimum.at(twin, lowest[one], ends)
        lower = twin[lowest[one]]
        differs = face[lower] != face[ends]
        if not differs.any():
            return lowest, twin
        ends, lower = ends[differs], lower[differs]
        # For each face that is equal to a lower one, the half-edge there that is its own first one.
        images = np.full(apart.face_count, count)
        turned = begin[face[lower]] + (index[lower] - index[ends]) % apart.face_sizes[face[lower]]
        np.minimum.at(images, face[ends], turned)
        moved = np.flatnonzero(images[face] < count)
        image, step = images[face[moved]], np.arange(count)
        step[moved] = begin[face[image]] + (index[image] + index[moved]) % apart.face_sizes[face[image]]
        while (step != (step := step[step])).any():
            pass
        lowest = step[lowest]


def joined_rings(signatures: Sequence[Signature]) -> tuple[Topology, IntArray, IntArray]:
    """Join the one-rings of r signatures, with their semi-sharp features, to one mesh.

    Also returns ``(r,)`` half-edge 0 of each ring, which names its element, and ``(r + 1,)`` offsets of its vertices.
    """
    rings = one_rings(signatures)
    parts = [ring.topology for ring in rings]
    counts = [part.half_edge_count for part in parts]
    half_edges, vertices = ragged.offsets(counts), ragged.offsets([part.vertex_count for part in parts])
    topology = Topology(
        int(vertices[-1]),
        np.concatenate([part.face_sizes for part in parts]),
        np.concatenate([part.face_vertices for part in parts]) + np.repeat(vertices[:-1], counts),
        np.concatenate([part.edge_names for part in parts]) + np.repeat(half_edges[:-1], counts),
        np.concatenate([part.vertex_rules for part in parts]),
    )
    if any(signature.is_semi_sharp for signature in signatures):
        fans = [
            (fan, half_edge + around)
            for signature, ring, half_edge in zip(signatures, rings, half_edges.tolist(), strict=False)
            for fan, around in zip(signature.fans, ring.around, strict=True)
            if fan.is_semi_sharp
        ]
        topology = topology.with_rules(topology.vertex_rules, _semi_sharpness(topology, fans))
    return topology, half_edges[:-1], vertices


def _semi_sharpness(
    topology: Topology,
    fans: list[tuple[Fan, IntArray]],  # Semi-sharp fans, and their half-edges from the most clockwise one on
) -> SemiSharpness:
    """Return the semi-sharp features at the corners of elements; of others, only far ends of edges there matter."""
    edges, refined = np.zeros((2, topology.half_edge_count))
    vertices = np.zeros(topology.vertex_count)
    half_edges = np.concatenate([around for _, around in fans])
    sharpness, near_half, far_half = np.array([row for fan, _ in fans for row in fan.edges]).T
    edges[half_edges], refined[half_edges] = sharpness, near_half
    twins = topology.twin[half_edges]
    inside = twins >= 0
    edges[twins[inside]], refined[twins[inside]] = sharpness[inside], far_half[inside]
    centres = topology.face_vertices[[around[0] for _, around in fans]]
    vertices[centres] = [fan.vertex for fan, _ in fans]
    across = [(centre, *row) for centre, (fan, _) in zip(centres.tolist(), fans, strict=True) for row in fan.across]
    vertex, across_sharpness, across_refined, sharpens = np.array(across, dtype=float).reshape(-1, 4).T
    return SemiSharpness(
        edges, refined, vertices, vertex.astype(np.int64), across_sharpness, across_refined, sharpens > 0
    )
