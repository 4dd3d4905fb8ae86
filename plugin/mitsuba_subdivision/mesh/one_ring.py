"""One-rings of elements: a local mesh for each signature, and its vertices in the cage.

The faces around the corners of the element are glued where they are the same face. A one-ring is *unfolded*: a vertex
of a small cage may occur several times as different vertices of the local mesh. Stencils over an unfolded ring are
still correct, because the weights of equal vertices add up.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from . import ragged
from .connectivity import IndexArray, IntArray, SemiSharpness, Topology
from .signature import NEAR_FACES, Fan, Signature

# Steps from one half-edge to another: to the next one of its face, and to its twin.
NEXT, TWIN = range(2)


@dataclass(frozen=True, eq=False)
class OneRing:
    """An unfolded one-ring: its local mesh, and a way from the element to its vertices."""

    # The local mesh, which has a border. Half-edge 0 names the element; the vertices of the element come first.
    topology: Topology
    around: list[list[int]]  # Half-edges of the fan at each corner of the element, from the most clockwise one on
    # For each local half-edge but 0, in the order of a walk, the half-edge before it and the step from there
    way: dict[int, tuple[int, int]]
    # Local vertices (corner, first, last) for each corner of the element whose fan may lack faces (`Fan.near`); first
    # and last are its `Topology.border_neighbours`
    cut_fans: list[tuple[int, int, int]]

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

    def gather(
        self,
        topology: Topology,
        half_edges: IndexArray,  # (e,) int32: the half-edge that names each element
        # (K, e) int32: output array; the result is a transposed view of it
        columns: NDArray[np.int32] | None = None,
    ) -> NDArray[np.int32]:
        """Find the vertices of ``topology`` in the one-rings of many elements of this signature.

        Returns (e, K) int32.
        """
        # Often the largest array of all. It is filled by local vertices, so these are along the first axis.
        if columns is None:
            columns = np.empty((self.vertex_count, len(half_edges)), dtype=np.int32)
        tables, first_half_edges = (topology.next, topology.twin), self.topology.vertex_half_edge.tolist()
        for part in ragged.chunks_of(len(half_edges)):
            reached = {0: half_edges[part]}
            for half_edge, (before, step) in self.way.items():
                reached[half_edge] = tables[step].take(reached[before])
            for column, half_edge in zip(columns[:, part], first_half_edges, strict=True):
                topology.face_vertices.take(reached[half_edge], out=column, mode="clip")
        for centre, first, last in self.cut_fans:
            columns[first], columns[last] = topology.border_neighbours(columns[centre])
        return columns.T


@lru_cache(maxsize=4096)
def one_ring(signature: Signature) -> OneRing:
    """Return the unfolded one-ring of a signature; semi-sharp features change nothing.

    The faces around each corner are glued along the edges at the corner, and nowhere else. Two walks lead to the same
    face only if both cross the same edge of another face.
    """
    if signature.is_semi_sharp:
        return one_ring(signature.smoothed)
    fans = signature.fans
    sizes, following, preceding, twin, around = _glued_faces(signature)
    # Vertices are numbered by their first half-edges.
    vertex, first = [-1] * len(twin), list[int]()
    for half_edge in range(len(twin)):
        if vertex[half_edge] >= 0:
            continue
        first.append(half_edge)
        same = [half_edge]
        while same:
            current = same.pop()
            if current >= 0 and vertex[current] < 0:
                vertex[current] = len(first) - 1
                same.append(twin[preceding[current]])
                if twin[current] >= 0:
                    same.append(following[twin[current]])
    # Edges are named by half-edges, not by vertices, so that the two sides of a crease stay separate even where the
    # ring closes around the end of the crease.
    edge_names = [min(half_edge, other) if other >= 0 else half_edge for half_edge, other in enumerate(twin)]
    rules = np.zeros(len(first), dtype=np.int8)
    rules[vertex[: len(fans)]] = [fan.rule for fan in fans]
    local = Topology(len(first), np.array(sizes), np.array(vertex), np.array(edge_names), rules)
    cut_fans = [
        (vertex[half_edges[0]], vertex[following[half_edges[0]]], vertex[preceding[half_edges[-1]]])
        for half_edges, fan in zip(around, fans, strict=True)
        if fan.is_open and fan.face_count == NEAR_FACES
    ]
    return OneRing(local, around, _way(sizes, following, twin), cut_fans)


def _way(sizes: list[int], following: list[int], twin: list[int]) -> dict[int, tuple[int, int]]:
    """Return `OneRing.way`. It enters each face across the first edge that leads there from an earlier one."""
    way, begin = dict[int, tuple[int, int]](), 0
    for size in sizes:
        half_edge = next((h for h in range(begin, begin + size) if 0 <= twin[h] < begin), begin)
        way[half_edge] = twin[half_edge], TWIN
        while (after := following[half_edge]) not in way:
            way[after], half_edge = (half_edge, NEXT), after
        begin += size
    del way[0]
    return way


def joined_rings(signatures: Sequence[Signature]) -> tuple[Topology, IntArray, IntArray]:
    """Join the one-rings of r signatures, with their semi-sharp features, to one mesh.

    Returns the mesh; ``(r,)`` half-edge 0 of each ring, which names its element; and ``(r + 1,)`` offsets of vertices:
    those of ring ``i`` are ``offsets[i]`` up to ``offsets[i + 1]``.
    """
    rings = [one_ring(signature) for signature in signatures]
    parts = [ring.topology for ring in rings]
    half_edges, vertices = (
        ragged.offsets(counts)
        for counts in ([part.half_edge_count for part in parts], [part.vertex_count for part in parts])
    )
    counts = np.diff(half_edges)
    topology = Topology(
        int(vertices[-1]),
        np.concatenate([part.face_sizes for part in parts]),
        np.concatenate([part.face_vertices for part in parts]) + np.repeat(vertices[:-1], counts),
        np.concatenate([part.edge for part in parts]) + np.repeat(half_edges[:-1], counts),
        np.concatenate([part.vertex_rules for part in parts]),
    )
    if any(signature.is_semi_sharp for signature in signatures):
        fans = [
            (fan, half_edge + np.array(around))
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
    """Return the semi-sharp features at the corners of elements.

    Of the features elsewhere in a one-ring, only the refined sharpness at the far ends of the edges at the corners
    affects the element.
    """
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


def _glued_faces(signature: Signature) -> tuple[list[int], list[int], list[int], list[int], list[list[int]]]:
    """Glue the faces around an element along the edges at its corners.

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

    Returns the sizes of the faces; the next half-edge, the previous one and the twin of each half-edge, -1 for none;
    and `OneRing.around`. Faces are sorted by the first walk to each, by its corner, then by its turns, so that the
    element comes first.
    """
    sizes: list[int] = []
    following: list[int] = []
    preceding: list[int] = []
    face: list[int] = []
    # For each corner, the half-edge of each face that begins there, from the most clockwise face on.
    around: list[list[int]] = []
    for corner, fan in enumerate(signature.fans):
        begins = {0: corner} if corner else {}
        for turns in sorted(fan.turns, key=lambda turns: (abs(turns), turns)):
            if turns not in begins:
                begin, size = len(face), fan.size(turns)
                following += [*range(begin + 1, begin + size), begin]
                preceding += [begin + size - 1, *range(begin, begin + size - 1)]
                face += [len(sizes)] * size
                sizes.append(size)
                begins[turns] = begin
        around.append([begins[turns] for turns in fan.turns])

    twin = [-1] * len(face)
    # An equal half-edge that is lower, or the half-edge itself.
    lower = list(range(len(face)))

    def lowest(half_edge: int) -> int:
        while lower[half_edge] != half_edge:
            half_edge = lower[half_edge]
        return half_edge

    # Pairs of half-edges to be made twins. A turn counter-clockwise crosses the last edge of the face, which is the
    # first edge of the next face.
    glued = [
        (preceding[before], after)
        for half_edges, fan in zip(around, signature.fans, strict=True)
        for before, after in pairwise([*half_edges, half_edges[0]] if fan.is_closed else half_edges)
    ]
    for first, second in glued:
        one, other = lowest(first), lowest(second)
        for half_edge, same in ((twin[one], other), (twin[other], one)):
            if half_edge < 0:
                continue
            kept, dropped = sorted((lowest(half_edge), lowest(same)))
            # Unite the half-edges, and the others of their faces.
            while face[kept] != face[dropped]:
                lower[dropped] = kept
                if twin[dropped] >= 0:
                    glued.append((kept, twin[dropped]))
                kept, dropped = sorted((lowest(following[kept]), lowest(following[dropped])))
        one, other = lowest(one), lowest(other)
        twin[one], twin[other] = other, one

    is_lowest = [low == half_edge for half_edge, low in enumerate(lower)]
    number = {half_edge: index for index, half_edge in enumerate(np.flatnonzero(is_lowest).tolist())}
    return (
        [sizes[index] for index in dict.fromkeys(face[half_edge] for half_edge in number)],
        [number[following[half_edge]] for half_edge in number],
        [number[preceding[half_edge]] for half_edge in number],
        [number[lowest(twin[half_edge])] if twin[half_edge] >= 0 else -1 for half_edge in number],
        [[number[lowest(half_edge)] for half_edge in half_edges] for half_edges in around],
    )
