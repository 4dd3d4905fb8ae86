"""One-rings of elements: a local mesh of the shape that a signature says, and the cage vertices that fill it.

A one-ring is *unfolded*: two places in it count as different even where a small cage puts the same vertex in both.
Stencils over an unfolded ring stay right, because the weights of equal vertices add up.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from . import ragged
from .connectivity import Topology, runs_of
from .sharpness import EdgesBeyond, SemiSharpness
from .signature import (
    FanHalfEdges,
    Signature,
    TaggedFan,
    fan_half_edges,
    fan_is_closed,
    fan_size,
    fan_turns,
)


@dataclass(frozen=True, eq=False)
class OneRing:
    """An unfolded one-ring: its local mesh and how to walk to its vertices.

    Attributes
    ----------
    topology : Topology
        The local mesh, with boundary. Half-edge 0 names the element; the element's own vertices come first.
    faces : tuple of (corner, turns)
        For each local face, the corner of the element and the counter-clockwise turns about it that lead there.
    slots : tuple of (local face, steps)
        For each local vertex, a local face and the steps along it from the half-edge where the walk arrived.
    """

    topology: Topology
    faces: tuple[tuple[int, int], ...]
    slots: tuple[tuple[int, int], ...]

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
        self, topology: Topology, half_edges: NDArray[np.integer], columns: NDArray[np.int32] | None = None
    ) -> NDArray[np.int32]:
        """Vertices of ``topology`` that fill the one-rings of many elements of this signature.

        Parameters
        ----------
        half_edges : (e,) int
            The half-edge that names each element.
        columns : (K, e) int32, optional
            Where to put them.

        Returns
        -------
        (e, K) int32
        """
        # Filled column by column, and often the largest array there is. In runs, what leads to it stays in the cache.
        if columns is None:
            columns = np.empty((self.vertex_count, len(half_edges)), dtype=np.int32)
        for run in runs_of(len(half_edges)):
            self._gather_run(topology, half_edges[run], columns[:, run])
        return columns.T

    def vertices_around(self, topology: Topology, fans: list[FanHalfEdges]) -> NDArray[np.int32]:
        """What `gather` finds for one element, of which `fan_half_edges` are known.

        Returns
        -------
        (K,) int32
        """
        arrived = [
            fans[corner][1][turns] if turns >= 0 else fans[corner][0][-1 - turns] for corner, turns in self.faces
        ]
        slots = np.array(self.slots)
        half_edges = np.array(arrived)[slots[:, 0]]
        faces = topology.face_of(half_edges)
        first = topology.face_offsets[faces]
        return topology.face_vertices[first + (half_edges - first + slots[:, 1]) % topology.face_sizes[faces]]

    def _gather_run(self, topology: Topology, half_edges: NDArray[np.integer], columns: NDArray[np.int32]) -> None:
        arrived = [half_edges] * len(self.faces)
        wanted = {place: index for index, place in enumerate(self.faces)}
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
            start = topology.following(start)
        for slots in _slots_by_face(self.slots):
            current = arrived[self.slots[slots[0]][0]]
            steps = 0
            for slot in slots:
                while steps < self.slots[slot][1]:
                    current = topology.following(current)
                    steps += 1
                topology.face_vertices.take(current, out=columns[slot], mode="clip")


def _slots_by_face(slots: tuple[tuple[int, int], ...]) -> list[list[int]]:
    """Local vertices grouped by the face whose walk reaches them, by increasing steps."""
    groups: dict[int, list[int]] = {}
    for slot in sorted(range(len(slots)), key=lambda slot: slots[slot]):
        groups.setdefault(slots[slot][0], []).append(slot)
    return list(groups.values())


@lru_cache(maxsize=4096)
def one_ring(signature: Signature) -> OneRing:
    """Unfold the one-ring of a signature into a local mesh.

    The faces met while turning about each corner are joined along the edges crossed, and nowhere else. Two of them are
    one face only where both lie across the same edge of a third.
    """
    smooth = signature.smoothed
    if smooth != signature:
        ring = one_ring(smooth)
        local = ring.topology
        semi_sharpness = _local_sharpness(local, [(signature, 0)])
        return replace(ring, topology=local.with_rules(local.rules, semi_sharpness))
    joined = _JoinedFaces(signature)
    faces = joined.faces()
    size = {face: joined.size(face) for face in faces}
    vertex_of = _joined_vertices(joined, faces)

    numbers: dict[HalfEdge, int] = {}
    slots = []
    polygons = []
    for index, face in enumerate(faces):
        polygon = []
        for step in range(size[face]):
            found = vertex_of[face, step]
            if found not in numbers:
                numbers[found] = len(numbers)
                slots.append((index, step))
            polygon.append(numbers[found])
        polygons.append(polygon)
    # Named by what joins them: the two sides of a crease stay apart even where the ring closes around its end.
    number = {half_edge: index for index, half_edge in enumerate(vertex_of)}
    edge_names = [min(index, number[joined.twins.get(half_edge, half_edge)]) for half_edge, index in number.items()]
    sizes = np.array([size[face] for face in faces])
    local = Topology(len(slots), sizes, np.concatenate(polygons), np.array(edge_names))
    tagged = {corner: fan for corner, fan in enumerate(signature.fans) if isinstance(fan, TaggedFan)}
    if tagged:
        rules = np.zeros(len(slots), dtype=np.int8)
        for corner, fan in tagged.items():
            rules[polygons[0][corner]] = fan.rule
        local = local.with_rules(rules, None)
    return OneRing(local, tuple(faces), tuple(slots))


class JoinedRings:
    """One-rings beside each other in one mesh.

    Parameters
    ----------
    signatures : sequence of Signature
        Without semi-sharp features.

    Attributes
    ----------
    topology : Topology
    half_edges, vertices : (n,) int64
        The first of each one-ring. The others follow in its order.
    """

    def __init__(self, signatures: Sequence[Signature]) -> None:
        rings = [one_ring(signature).topology for signature in signatures]
        *self.half_edges, _ = ragged.offsets([ring.half_edge_count for ring in rings]).tolist()
        *self.vertices, vertex_count = ragged.offsets([ring.vertex_count for ring in rings]).tolist()
        self.topology = Topology(
            vertex_count,
            np.concatenate([ring.face_sizes for ring in rings]),
            np.concatenate([ring.face_vertices + first for ring, first in zip(rings, self.vertices, strict=True)]),
            np.concatenate([ring.edge_names + first for ring, first in zip(rings, self.half_edges, strict=True)]),
            np.concatenate([ring.vertex_rules for ring in rings]) if any(r.rules is not None for r in rings) else None,
        )

    def sharpness(self, elements: Iterable[tuple[int, Signature]]) -> SemiSharpness | None:
        """Semi-sharp features at the corners of some of the elements; None if there are none."""
        sharp = [(signature, self.half_edges[number]) for number, signature in elements if signature.is_semi_sharp]
        return _local_sharpness(self.topology, sharp) if sharp else None


@lru_cache(maxsize=4096)
def _fans(smooth: Signature) -> list[FanHalfEdges]:
    """Half-edges of the fan at each corner of an element, of its one-ring's local mesh."""
    return fan_half_edges(one_ring(smooth).topology, 0, smooth.kind)


def _local_sharpness(local: Topology, elements: Iterable[tuple[Signature, int]]) -> SemiSharpness:
    """Semi-sharp features at the corners of elements, each with the first half-edge of its one-ring.

    Those elsewhere in the one-ring do not matter to the element, but for what they leave at the far ends of edges.
    """
    edges, left = np.zeros((2, local.half_edge_count))
    vertices = np.zeros(local.vertex_count)
    beyond: list[tuple[int, float, float, bool]] = []
    half_edges, rows = [], []
    for signature, first in elements:
        for (behind, ahead), fan in zip(_fans(signature.smoothed), signature.fans, strict=True):
            if not isinstance(fan, TaggedFan) or fan.sharpness is None:
                continue
            centre = int(local.face_vertices[first + ahead[0]])
            vertices[centre] = fan.sharpness.vertex
            beyond += [(centre, *row) for row in fan.sharpness.beyond]
            half_edges += [first + half_edge for half_edge in behind[::-1] + ahead]
            rows += fan.sharpness.edges
    at = np.array(half_edges)
    sharpness, here, there = np.array(rows).T
    edges[at], left[at] = sharpness, here
    twins = local.twin[at]
    inside = twins >= 0
    edges[twins[inside]], left[twins[inside]] = sharpness[inside], there[inside]
    vertex, sharpness_beyond, left_beyond, sharpens = np.array(beyond, dtype=float).reshape(-1, 4).T
    rows = EdgesBeyond(vertex.astype(np.int64), sharpness_beyond, sharpens > 0)
    return SemiSharpness(edges, left, vertices, rows, left_beyond)


# A face of a one-ring is named by a walk that leads there, a corner of the element and turns about it; a half-edge of
# it by the steps along the face from where the walk arrives.
Face = tuple[int, int]
HalfEdge = tuple[Face, int]


def _nearness(face: Face) -> tuple[int, int, int]:
    """Order of names: the element first, and walks with few turns before those with many."""
    corner, turns = face
    return corner, abs(turns), turns


class _JoinedFaces:
    """The faces that walks about an element's corners lead to, with the pairs of half-edges that join them.

    Several walks may lead to one face; the first by `_nearness` names it.
    """

    def __init__(self, signature: Signature):
        self._fans = signature.fans
        self._same: dict[Face, HalfEdge] = {}
        self.twins: dict[HalfEdge, HalfEdge] = {}
        if signature.kind == "face":
            for corner in range(1, len(self._fans)):
                self._identify(((0, 0), corner), ((corner, 0), 0))
        for corner, fan in enumerate(self._fans):
            turns = fan_turns(fan)
            following = [*turns[1:], 0] if fan_is_closed(fan) else turns[1:]
            for here, beyond in zip(turns, following, strict=False):
                # Turning counter-clockwise crosses the last edge of the face, the first of the next.
                self._join(((corner, here), fan_size(fan, here) - 1), ((corner, beyond), 0))

    def size(self, face: Face) -> int:
        return fan_size(self._fans[face[0]], face[1])

    def faces(self) -> list[Face]:
        found = {
            self.named(((corner, turns), 0))[0] for corner, fan in enumerate(self._fans) for turns in fan_turns(fan)
        }
        return sorted(found, key=_nearness)

    def named(self, half_edge: HalfEdge) -> HalfEdge:
        """The half-edge under the name that its face keeps."""
        face, step = half_edge
        while face in self._same:
            face, shift = self._same[face]
            step += shift
        return face, step % self.size(face)

    def _join(self, a: HalfEdge, b: HalfEdge) -> None:
        """Make two half-edges twins; where one of them has a twin already, that is the same half-edge as the new."""
        for one, other in ((a, b), (b, a)):
            present = self.twins.get(self.named(one))
            if present is not None:
                self._identify(present, other)
        a, b = self.named(a), self.named(b)
        self.twins[a], self.twins[b] = b, a

    def _identify(self, a: HalfEdge, b: HalfEdge) -> None:
        """Make two half-edges, and so their faces, the same."""
        (kept, step), (dropped, other) = sorted((self.named(a), self.named(b)), key=lambda named: _nearness(named[0]))
        if kept == dropped:
            return
        self._same[dropped] = (kept, step - other)
        for edge in range(self.size(dropped)):
            twin = self.twins.pop((dropped, edge), None)
            if twin is not None:
                self._join((dropped, edge), twin)


def _joined_vertices(joined: _JoinedFaces, faces: list[Face]) -> dict[HalfEdge, HalfEdge]:
    """For each half-edge, one that stands for the vertex where it begins."""
    stands: dict[HalfEdge, HalfEdge] = {}

    def standing(half_edge: HalfEdge) -> HalfEdge:
        while half_edge in stands:
            half_edge = stands[half_edge]
        return half_edge

    for (face, step), (twin_face, twin_step) in joined.twins.items():
        end = (twin_face, (twin_step + 1) % joined.size(twin_face))
        first, second = sorted((standing((face, step)), standing(end)))
        if first != second:
            stands[second] = first
    return {(face, step): standing((face, step)) for face in faces for step in range(joined.size(face))}
