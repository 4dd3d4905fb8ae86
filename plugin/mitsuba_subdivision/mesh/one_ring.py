"""One-rings of elements: a local mesh for each signature, and its vertices in the cage.

The faces around the corners of the element are glued where they are the same face. A one-ring is *unfolded*: a vertex
of a small cage may occur several times as different vertices of the local mesh. Stencils over an unfolded ring are
still correct, because the weights of equal vertices add up.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property, lru_cache

import numpy as np
from numpy.typing import NDArray

from . import ragged
from .connectivity import IntArray, Topology
from .sharpness import SemiSharpness
from .signature import (
    NEAR_FACES,
    ElementKind,
    FanHalfEdges,
    Signature,
    TaggedFan,
    fan_face_count,
    fan_half_edges,
    fan_is_closed,
    fan_size,
    fan_turns,
    half_edges_around,
)

# Number of elements up to which walks around one element at a time are faster than array operations on all elements.
FEW_ELEMENTS = 4


@dataclass(frozen=True, eq=False)
class OneRing:
    """An unfolded one-ring: its local mesh, and walks to its faces and vertices."""

    # The local mesh, which has a border. Half-edge 0 names the element; the vertices of the element come first.
    topology: Topology
    # tuple of (corner, turns): the walk to each local face: counter-clockwise turns about a corner of the element.
    # Sorted by corner.
    faces: tuple[tuple[int, int], ...]
    # tuple of (local face, steps): the walk to each local vertex: steps along a local face from the half-edge where the
    # walk to the face ends
    slots: tuple[tuple[int, int], ...]
    # Local vertices (corner, first, last) for each corner of the element whose fan may lack faces (`TaggedFan.near`);
    # first and last are its `Topology.border_neighbours`
    cut_fans: list[list[int]]

    @property
    def vertex_count(self) -> int:
        """K, the number of control points."""
        return len(self.slots)

    def edge_neighbours(self) -> list[int]:
        """Return the edge neighbours of the first vertex, counter-clockwise; on a border, from border to border."""
        t, half_edge = self.topology, 0
        while (previous := int(t.turn_back(half_edge))) > 0:
            half_edge = previous
        neighbours, first = [int(t.face_vertices[t.next[half_edge]])], half_edge
        while True:
            neighbours.append(int(t.face_vertices[t.prev[half_edge]]))
            half_edge = int(t.turn(half_edge))
            if half_edge < 0:
                return neighbours
            if half_edge == first:
                return neighbours[:-1]

    def gather(
        self,
        topology: Topology,
        half_edges: NDArray[np.integer],  # (e,) int: the half-edge that names each element
        # (K, e) int32: output array; the result is a transposed view of it
        columns: NDArray[np.int32] | None = None,
    ) -> NDArray[np.int32]:
        """Find the vertices of ``topology`` in the one-rings of many elements of this signature.

        Returns (e, K) int32.
        """
        # Often the largest array of all. It is filled by local vertices, so these are along the first axis.
        if columns is None:
            columns = np.empty((self.vertex_count, len(half_edges)), dtype=np.int32)
        if len(half_edges) <= FEW_ELEMENTS:
            # A common case: around vertices of high valence few faces have the same signature.
            kind: ElementKind = "face" if self.faces[-1][0] else "vertex"
            for number, half_edge in enumerate(half_edges.tolist()):
                columns[:, number] = self.vertices_around(topology, fan_half_edges(topology, half_edge, kind))
        else:
            self._gather_columns(topology, half_edges, columns)
        for centre, first, last in self.cut_fans:
            columns[first], columns[last] = topology.border_neighbours(columns[centre])
        return columns.T

    def vertices_around(self, topology: Topology, fans: list[FanHalfEdges]) -> NDArray[np.int32]:
        """Find the vertices in the one-ring of one element, given its `fan_half_edges`. Returns (K,) int32."""
        corners, turns, steps = self._slot_walks
        begins = ragged.starts(np.array([len(behind) + len(ahead) for behind, ahead in fans]))
        first_ahead = begins + [len(behind) for behind, _ in fans]
        half_edges = half_edges_around(fans)[first_ahead[corners] + turns]
        faces = topology.face[half_edges]
        first = topology.face_offsets[faces]
        return topology.face_vertices[first + (half_edges - first + steps) % topology.face_sizes[faces]]

    @cached_property
    def _slot_walks(self) -> tuple[IntArray, IntArray, IntArray]:
        """``(K,)`` walk to each local vertex: corner of the element, turns about it, and steps along the face."""
        face, steps = np.array(self.slots).T
        corners, turns = np.array(self.faces).T
        return corners[face], turns[face], steps

    def _gather_columns(self, topology: Topology, half_edges: NDArray[np.integer], columns: NDArray[np.int32]) -> None:
        arrived = [half_edges] * len(self.faces)
        face_of_walk = {walk: index for index, walk in enumerate(self.faces)}
        start = half_edges
        for corner in range(1 + max(corner for corner, _ in self.faces)):
            turns = [turns for face_corner, turns in self.faces if face_corner == corner]
            for step, walk in ((1, topology.turn), (-1, topology.turn_back)):
                current = start
                for turned in range(0, max([0, *(step * t for t in turns)]) + 1):
                    if turned:
                        current = walk(current)
                    if (corner, step * turned) in face_of_walk:
                        arrived[face_of_walk[corner, step * turned]] = current
            start = topology.next[start]
        for slots in _slots_by_face(self.slots):
            current = arrived[self.slots[slots[0]][0]]
            steps = 0
            for slot in slots:
                while steps < self.slots[slot][1]:
                    current = topology.next[current]
                    steps += 1
                topology.face_vertices.take(current, out=columns[slot], mode="clip")


def _slots_by_face(slots: tuple[tuple[int, int], ...]) -> list[list[int]]:
    """Group local vertices by the local face of their walk, sorted by steps."""
    groups: dict[int, list[int]] = {}
    for slot in sorted(range(len(slots)), key=lambda slot: slots[slot]):
        groups.setdefault(slots[slot][0], []).append(slot)
    return list(groups.values())


@lru_cache(maxsize=4096)
def one_ring(signature: Signature) -> OneRing:
    """Return the unfolded one-ring of a signature.

    The faces around each corner are glued along the edges at the corner, and nowhere else. Two walks lead to the same
    face only if both cross the same edge of another face.
    """
    smooth = signature.smoothed
    if smooth != signature:
        ring = one_ring(smooth)
        return replace(ring, topology=_with_sharpness(ring.topology, signature))
    glued = GluedFaces(signature)
    half_edges = [glued.half_edges(face) for face in glued.faces]
    sizes = np.array([len(face_half_edges) for face_half_edges in half_edges])
    kept = np.concatenate(half_edges)
    index = np.arange(len(kept))
    new_index = np.full(len(glued.twin), -1)
    new_index[kept] = index
    twin = np.array(glued.twin)[kept]
    twin = np.where(twin < 0, -1, new_index[twin])
    first_vertex = _first_at_vertices(twin, sizes)
    is_first = first_vertex == index
    polygons = (np.cumsum(is_first) - 1)[first_vertex]
    face = np.repeat(np.arange(len(sizes)), sizes)
    step = index - ragged.starts(sizes)[face]
    slots = tuple(zip(face[is_first].tolist(), step[is_first].tolist(), strict=True))
    # Edges are named by half-edges, not by vertices, so that the two sides of a crease stay separate even where the
    # ring closes around the end of the crease.
    local = Topology(len(slots), sizes, polygons, np.where(twin < 0, index, np.minimum(index, twin)))
    tagged = {corner: fan for corner, fan in enumerate(signature.fans) if isinstance(fan, TaggedFan)}
    if tagged:
        rules = np.zeros(len(slots), dtype=np.int8)
        for corner, fan in tagged.items():
            rules[polygons[corner]] = fan.rule
        local = local.with_rules(rules, None)
    cut = [int(polygons[c]) for c, fan in tagged.items() if fan.is_open and fan_face_count(fan) == NEAR_FACES]
    cut_fans = np.stack([cut, *local.border_neighbours(np.array(cut, dtype=np.int32))], axis=1).tolist()
    return OneRing(local, tuple(glued.walks[face] for face in glued.faces), slots, cut_fans)


def _first_at_vertices(twin: IntArray, sizes: IntArray) -> IntArray:
    """Return, for each half-edge, the first half-edge at the same vertex; ``sizes`` are the face sizes."""
    index = np.arange(len(twin))
    ends = ragged.starts(sizes) + sizes - 1
    following = index + 1
    following[ends] -= sizes
    # One turn clockwise about the vertex, and one counter-clockwise; at a border, the half-edge itself.
    inside = twin >= 0
    clockwise, back = index.copy(), index.copy()
    clockwise[inside] = following[twin[inside]]
    back[clockwise[inside]] = index[inside]
    return _least_ahead(_least_ahead(index, clockwise), back)


def _least_ahead(values: IntArray, step: IntArray) -> IntArray:
    """Return, for each index, the least value at the indices that any number of steps leads to."""
    while True:
        least = np.minimum(values, values[step])
        if (least == values).all():
            return values
        # Double the number of steps.
        values, step = least, step[step]


@lru_cache(maxsize=4096)
def _fans(smooth: Signature) -> list[FanHalfEdges]:
    """Return the half-edges of the fan at each corner of the element in its local mesh."""
    return fan_half_edges(one_ring(smooth).topology, 0, smooth.kind)


def _with_sharpness(local: Topology, signature: Signature) -> Topology:
    """Return the topology of a one-ring with the semi-sharp features at the corners of its element.

    Of the features elsewhere in the one-ring, only the refined sharpness at the far ends of the edges at the corners
    affects the element.
    """
    edges, refined = np.zeros((2, local.half_edge_count))
    vertices = np.zeros(local.vertex_count)
    across: list[tuple[int, float, float, bool]] = []
    for (behind, ahead), fan in zip(_fans(signature.smoothed), signature.fans, strict=True):
        if not isinstance(fan, TaggedFan) or fan.sharpness is None:
            continue
        centre = int(local.face_vertices[ahead[0]])
        vertices[centre] = fan.sharpness.vertex
        across += [(centre, *row) for row in fan.sharpness.across]
        half_edges = np.array(behind[::-1] + ahead)
        sharpness, near_half, far_half = np.array(fan.sharpness.edges).T
        edges[half_edges], refined[half_edges] = sharpness, near_half
        twins = local.twin[half_edges]
        inside = twins >= 0
        edges[twins[inside]], refined[twins[inside]] = sharpness[inside], far_half[inside]
    vertex, across_sharpness, across_refined, sharpens = np.array(across, dtype=float).reshape(-1, 4).T
    semi_sharpness = SemiSharpness(
        edges, refined, vertices, vertex.astype(np.int64), across_sharpness, across_refined, sharpens > 0
    )
    return local.with_rules(local.rules, semi_sharpness)


class GluedFaces:
    """The faces around an element, glued along the edges that walks about its corners cross.

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
    If a half-edge is to be glued to a second half-edge, the first and the second are the same half-edge, and their
    faces are the same face. Sets of equal half-edges are represented by their lowest member (union-find), which belongs
    to the first walk that arrives at the face.
    """

    def __init__(self, signature: Signature) -> None:
        fans = signature.fans
        walks = [(corner, turns) for corner, fan in enumerate(fans) for turns in fan_turns(fan)]
        # (corner, turns), sorted by corner, then by number of turns; the element comes first
        self.walks = sorted(walks, key=lambda walk: (walk[0], abs(walk[1]), walk[1]))
        is_element = [signature.kind == "face" and turns == 0 for _, turns in self.walks]
        sizes = [
            0 if is_known and corner else fan_size(fans[corner], turns)
            for (corner, turns), is_known in zip(self.walks, is_element, strict=True)
        ]
        self._begins = ragged.offsets(sizes).tolist()
        self._walk_of = np.repeat(np.arange(len(sizes)), sizes).tolist()
        # Twin of each half-edge that represents its set, -1 if it is not glued.
        self.twin = [-1] * self._begins[-1]
        # Parent of each half-edge in the union-find forest: a lower equal half-edge, or the half-edge itself.
        self._lower = list(range(len(self.twin)))

        # The half-edge of each walk's face that begins at the walk's corner.
        first = {
            walk: walk[0] if is_known else begin
            for walk, is_known, begin in zip(self.walks, is_element, self._begins[:-1], strict=True)
        }
        for corner, fan in enumerate(fans):
            turns = fan_turns(fan)
            ahead = [*turns[1:], turns[0]] if fan_is_closed(fan) else turns[1:]
            for face_turns, next_turns in zip(turns, ahead, strict=False):
                # A turn counter-clockwise crosses the last edge of the face, which is the first edge of the next face.
                self._glue(self._preceding(first[corner, face_turns]), first[corner, next_turns])

    @property
    def faces(self) -> list[int]:
        """Distinct faces, each represented by the number of the first walk that arrives there."""
        return [
            face
            for face, begin in enumerate(self._begins[:-1])
            if begin < self._begins[face + 1] and self._lower[begin] == begin
        ]

    def half_edges(self, face: int) -> range:
        return range(self._begins[face], self._begins[face + 1])

    def _preceding(self, half_edge: int) -> int:
        half_edges = self.half_edges(self._walk_of[half_edge])
        return half_edge - 1 if half_edge > half_edges.start else half_edges.stop - 1

    def _around(self, half_edge: int) -> list[int]:
        """Return all half-edges of the face, starting with ``half_edge``."""
        half_edges = self.half_edges(self._walk_of[half_edge])
        return [*half_edges[half_edge - half_edges.start :], *half_edges[: half_edge - half_edges.start]]

    def _glue(self, one: int, other: int) -> None:
        """Make two half-edges twins."""
        for half_edge, new_twin in ((one, other), (other, one)):
            twin = self.twin[_first(self._lower, half_edge)]
            if twin >= 0:
                self._make_same(twin, new_twin)
        one, other = _first(self._lower, one), _first(self._lower, other)
        self.twin[one], self.twin[other] = other, one

    def _make_same(self, one: int, other: int) -> None:
        """Unite two half-edges, and so their faces."""
        kept, dropped = sorted((_first(self._lower, one), _first(self._lower, other)))
        if self._walk_of[kept] == self._walk_of[dropped]:
            return
        for kept_half_edge, dropped_half_edge in zip(self._around(kept), self._around(dropped), strict=True):
            one, other = _first(self._lower, kept_half_edge), _first(self._lower, dropped_half_edge)
            self._lower[max(one, other)] = min(one, other)
        for half_edge in self._around(dropped):
            twin, self.twin[half_edge] = self.twin[half_edge], -1
            if twin >= 0:
                self._glue(half_edge, twin)


def _first(lower: list[int], member: int) -> int:
    """Return the root of a member of a union-find forest, the least member of its set."""
    while (parent := lower[member]) != member:
        member = parent
    return member
