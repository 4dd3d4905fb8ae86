"""One-rings of elements: a local mesh in the shape of a signature, and which vertices of the cage are in it.

The faces around the corners of the element are glued where they are the same. A one-ring is *unfolded*: two vertices of
the local mesh count as different even where a small cage has the same vertex at both places. Stencils over an unfolded
ring stay right, because the weights of equal vertices add up.
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

# Elements up to which walks around one after the other take less time than steps of all together.
FEW_ELEMENTS = 4


@dataclass(frozen=True, eq=False)
class OneRing:
    """An unfolded one-ring: its local mesh and how to walk to its vertices."""

    # The local mesh, which has a border. Half-edge 0 names the element; the element's own vertices come first.
    topology: Topology
    # tuple of (corner, turns): for each local face, the corner of the element and the counter-clockwise turns about
    # it that lead there. In the order of the corners.
    faces: tuple[tuple[int, int], ...]
    # tuple of (local face, steps): for each local vertex, a local face and the steps along it from the half-edge
    # where the walk arrived
    slots: tuple[tuple[int, int], ...]
    # Corners of the element in whose fans faces may have been left out (`TaggedFan.near`), each with its two
    # neighbours on the border, as `Topology.border_neighbours` has them
    cut_fans: list[list[int]]

    @property
    def vertex_count(self) -> int:
        """K, the number of control points."""
        return len(self.slots)

    def edge_neighbours(self) -> list[int]:
        """Neighbours of the first vertex along edges, counter-clockwise, from border to border if it is on one."""
        t, half_edge = self.topology, 0
        while (back := int(t.turn_back(half_edge))) > 0:
            half_edge = back
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
        # (K, e) int32: array for the result, which is a transposed view of it
        columns: NDArray[np.int32] | None = None,
    ) -> NDArray[np.int32]:
        """Find the one-rings of many elements of this signature: the vertices of ``topology`` at each local vertex.

        Returns (e, K) int32.
        """
        # This is often the largest array of all, and is filled column by column.
        if columns is None:
            columns = np.empty((self.vertex_count, len(half_edges)), dtype=np.int32)
        if len(half_edges) <= FEW_ELEMENTS:
            # Around vertices of high valence few faces have the same signature.
            kind: ElementKind = "face" if self.faces[-1][0] else "vertex"
            for number, half_edge in enumerate(half_edges.tolist()):
                columns[:, number] = self.vertices_around(topology, fan_half_edges(topology, half_edge, kind))
        else:
            self._gather_columns(topology, half_edges, columns)
        for centre, first, last in self.cut_fans:
            columns[first], columns[last] = topology.border_neighbours(columns[centre])
        return columns.T

    def vertices_around(self, topology: Topology, fans: list[FanHalfEdges]) -> NDArray[np.int32]:
        """`gather` for one element with known `fan_half_edges`. Returns (K,) int32."""
        corners, turns, steps = self._slot_walks
        begins = ragged.starts(np.array([len(behind) + len(ahead) for behind, ahead in fans]))
        unturned = begins + [len(behind) for behind, _ in fans]
        half_edges = half_edges_around(fans)[unturned[corners] + turns]
        faces = topology.face[half_edges]
        first = topology.face_offsets[faces]
        return topology.face_vertices[first + (half_edges - first + steps) % topology.face_sizes[faces]]

    @cached_property
    def _slot_walks(self) -> tuple[IntArray, IntArray, IntArray]:
        """``(K,)`` for each local vertex: a corner of the element, turns about it, and steps along the face there."""
        face, steps = np.array(self.slots).T
        corners, turns = np.array(self.faces).T
        return corners[face], turns[face], steps

    def _gather_columns(self, topology: Topology, half_edges: NDArray[np.integer], columns: NDArray[np.int32]) -> None:
        arrived = [half_edges] * len(self.faces)
        wanted = {walk: index for index, walk in enumerate(self.faces)}
        start = half_edges
        for corner in range(1 + max(corner for corner, _ in self.faces)):
            turns = [turns for at, turns in self.faces if at == corner]
            for step, walk in ((1, topology.turn), (-1, topology.turn_back)):
                current = start
                for turned in range(0, max([0, *(step * t for t in turns)]) + 1):
                    if turned:
                        current = walk(current)
                    if (corner, step * turned) in wanted:
                        arrived[wanted[corner, step * turned]] = current
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
    """Local vertices grouped by the local face that leads to them, in order of their steps along it."""
    groups: dict[int, list[int]] = {}
    for slot in sorted(range(len(slots)), key=lambda slot: slots[slot]):
        groups.setdefault(slots[slot][0], []).append(slot)
    return list(groups.values())


@lru_cache(maxsize=4096)
def one_ring(signature: Signature) -> OneRing:
    """Unfold the one-ring of a signature into a local mesh.

    The faces around each corner are glued along the edges that lead away from the corner, and nowhere else. Two of them
    are one face only where both lie across the same edge of a third.
    """
    smooth = signature.smoothed
    if smooth != signature:
        ring = one_ring(smooth)
        return replace(ring, topology=_with_sharpness(ring.topology, signature))
    glued = GluedFaces(signature)
    half_edges = [glued.half_edges(face) for face in glued.faces]
    sizes = np.array([len(own) for own in half_edges])
    every = np.concatenate(half_edges)
    index = np.arange(len(every))
    number = np.full(len(glued.twin), -1)
    number[every] = index
    twin = np.array(glued.twin)[every]
    twin = np.where(twin < 0, -1, number[twin])
    first_vertex = _first_at_vertices(twin, sizes)
    is_first = first_vertex == index
    polygons = (np.cumsum(is_first) - 1)[first_vertex]
    face = np.repeat(np.arange(len(sizes)), sizes)
    step = index - ragged.starts(sizes)[face]
    slots = tuple(zip(face[is_first].tolist(), step[is_first].tolist(), strict=True))
    # Edges are named by the half-edges that are glued, not by vertices: the two sides of a crease stay apart even where
    # the ring closes around the crease's end.
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
    """For each half-edge, the first of all that begin at the same vertex; ``sizes`` are those of the faces."""
    index = np.arange(len(twin))
    ends = ragged.starts(sizes) + sizes - 1
    following = index + 1
    following[ends] -= sizes
    # One turn clockwise about the vertex, and one back; at a border, none.
    inside = twin >= 0
    clockwise, back = index.copy(), index.copy()
    clockwise[inside] = following[twin[inside]]
    back[clockwise[inside]] = index[inside]
    return _least_ahead(_least_ahead(index, clockwise), back)


def _least_ahead(values: IntArray, step: IntArray) -> IntArray:
    """The least of all values that any number of steps leads to."""
    while True:
        least = np.minimum(values, values[step])
        if (least == values).all():
            return values
        # Twice as many steps at once.
        values, step = least, step[step]


@lru_cache(maxsize=4096)
def _fans(smooth: Signature) -> list[FanHalfEdges]:
    """Half-edges of the fan at each corner of the element in the local mesh of its one-ring."""
    return fan_half_edges(one_ring(smooth).topology, 0, smooth.kind)


def _with_sharpness(local: Topology, signature: Signature) -> Topology:
    """The topology of a one-ring, with the semi-sharp features at the corners of its element.

    Features elsewhere in the one-ring do not matter to the element, but for the refined sharpness at the far
    ends of the edges that meet its corners.
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
        at = np.array(behind[::-1] + ahead)
        sharpness, here, there = np.array(fan.sharpness.edges).T
        edges[at], refined[at] = sharpness, here
        twins = local.twin[at]
        inside = twins >= 0
        edges[twins[inside]], refined[twins[inside]] = sharpness[inside], there[inside]
    vertex, across_sharpness, across_refined, sharpens = np.array(across, dtype=float).reshape(-1, 4).T
    semi_sharpness = SemiSharpness(
        edges, refined, vertices, vertex.astype(np.int64), across_sharpness, across_refined, sharpens > 0
    )
    return local.with_rules(local.rules, semi_sharpness)


class GluedFaces:
    """The faces around an element, glued along the edges that walks about its corners cross.

    A walk starts in the element, turns about one of its corners by a number of faces, and arrives at a face. Walks
    about neighbouring corners may arrive at the same one. Around a quadrilateral amid others, (corner, turns) are::

        +-----------+-----------+-----------+
        |    3,2    | 2,3 = 3,1 |    2,2    |
        +-----------3-----------2-----------+
        |           | 0,0 = 1,0 |           |
        | 0,1 = 3,3 | 2,0 = 3,0 | 1,3 = 2,1 |
        +-----------0-----------1-----------+
        |    0,2    | 0,3 = 1,1 |    1,2    |
        +-----------+-----------+-----------+

    Walks without turns stay in the element. Every other walk at first has a face of its own, with half-edges numbered
    from the one that begins at the walk's corner. Then faces are glued along the edges that the walks cross. If a
    half-edge is to be glued to a second one, the two that it is glued to are the same half-edge, and their faces the
    same face. Sets of half-edges that are the same are named by the first one, which belongs to the first walk that
    arrives at the face.
    """

    def __init__(self, signature: Signature) -> None:
        fans = signature.fans
        walks = [(corner, turns) for corner, fan in enumerate(fans) for turns in fan_turns(fan)]
        # (corner, turns): the element first, and walks with few turns before those with many
        self.walks = sorted(walks, key=lambda walk: (walk[0], abs(walk[1]), walk[1]))
        is_element = [signature.kind == "face" and turns == 0 for _, turns in self.walks]
        sizes = [
            0 if is_known and corner else fan_size(fans[corner], turns)
            for (corner, turns), is_known in zip(self.walks, is_element, strict=True)
        ]
        self._begins = ragged.offsets(sizes).tolist()
        self._walk_of = np.repeat(np.arange(len(sizes)), sizes).tolist()
        # The half-edge that each one is glued to, -1 if none; for half-edges that name their sets
        self.twin = [-1] * self._begins[-1]
        # A half-edge that is the same, lower but for the first of all that are the same.
        self._lower = list(range(len(self.twin)))

        # The half-edge of each walk's face that begins at the walk's corner.
        first = {
            walk: walk[0] if is_known else begin
            for walk, is_known, begin in zip(self.walks, is_element, self._begins[:-1], strict=True)
        }
        for corner, fan in enumerate(fans):
            turns = fan_turns(fan)
            ahead = [*turns[1:], turns[0]] if fan_is_closed(fan) else turns[1:]
            for here, beyond in zip(turns, ahead, strict=False):
                # A turn counter-clockwise crosses the last edge of the face, which is the first one of the next face.
                self._glue(self._preceding(first[corner, here]), first[corner, beyond])

    @property
    def faces(self) -> list[int]:
        """One face of all that are the same: the number of the first walk that arrives there."""
        return [
            face
            for face, begin in enumerate(self._begins[:-1])
            if begin < self._begins[face + 1] and self._lower[begin] == begin
        ]

    def half_edges(self, face: int) -> range:
        return range(self._begins[face], self._begins[face + 1])

    def _preceding(self, half_edge: int) -> int:
        own = self.half_edges(self._walk_of[half_edge])
        return half_edge - 1 if half_edge > own.start else own.stop - 1

    def _around(self, half_edge: int) -> list[int]:
        """All half-edges of the same face, from this one on."""
        half_edges = self.half_edges(self._walk_of[half_edge])
        return [*half_edges[half_edge - half_edges.start :], *half_edges[: half_edge - half_edges.start]]

    def _glue(self, one: int, other: int) -> None:
        """Make two half-edges twins."""
        for here, there in ((one, other), (other, one)):
            present = self.twin[_first(self._lower, here)]
            if present >= 0:
                self._make_same(present, there)
        one, other = _first(self._lower, one), _first(self._lower, other)
        self.twin[one], self.twin[other] = other, one

    def _make_same(self, one: int, other: int) -> None:
        """Make two half-edges, and so their faces, the same."""
        kept, dropped = sorted((_first(self._lower, one), _first(self._lower, other)))
        if self._walk_of[kept] == self._walk_of[dropped]:
            return
        for here, there in zip(self._around(kept), self._around(dropped), strict=True):
            # Make one set of those of the two.
            one, other = _first(self._lower, here), _first(self._lower, there)
            self._lower[max(one, other)] = min(one, other)
        for half_edge in self._around(dropped):
            twin, self.twin[half_edge] = self.twin[half_edge], -1
            if twin >= 0:
                self._glue(half_edge, twin)


def _first(lower: list[int], member: int) -> int:
    """The least member of a set of integers, each of which leads to a lower one, the least to itself."""
    while (other := lower[member]) != member:
        member = other
    return member
