"""One-rings of elements: a local mesh for each signature, and its vertices in the cage.

The faces around the corners of the element are glued where they are the same face. A one-ring is *unfolded*: a vertex
of a small cage may occur several times as different vertices of the local mesh. Stencils over an unfolded ring are
still correct, because the weights of equal vertices add up.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from . import ragged
from .connectivity import IntArray, Topology
from .manifold import fan_labels
from .sharpness import SemiSharpness
from .signature import NEAR_FACES, FanHalfEdges, Signature, fan_half_edges

# A walk to a face: counter-clockwise turns about a corner of the element, as (corner, turns).
Walk = tuple[int, int]


@dataclass(frozen=True, eq=False)
class OneRing:
    """An unfolded one-ring: its local mesh, and walks to its faces and vertices."""

    # The local mesh, which has a border. Half-edge 0 names the element; the vertices of the element come first.
    topology: Topology
    faces: tuple[Walk, ...]  # The walk to each local face. Sorted by corner.
    # tuple of (local face, steps): the walk to each local vertex: steps along a local face from the half-edge where the
    # walk to the face ends. In increasing order.
    slots: tuple[tuple[int, int], ...]
    # Local vertices (corner, first, last) for each corner of the element whose fan may lack faces (`Fan.near`); first
    # and last are its `Topology.border_neighbours`
    cut_fans: list[list[int]]

    @property
    def vertex_count(self) -> int:
        """K, the number of control points."""
        return len(self.slots)

    def edge_neighbours(self) -> list[int]:
        """Return the edge neighbours of the first vertex, counter-clockwise; on a border, from border to border."""
        t, ((behind, ahead),) = self.topology, fan_half_edges(self.topology, 0, "vertex")
        half_edges = np.array(behind[::-1] + ahead)
        neighbours = t.face_vertices[t.prev[half_edges]].tolist()
        is_closed = int(t.turn(half_edges[-1])) >= 0
        return neighbours if is_closed else [int(t.face_vertices[t.next[half_edges[0]]]), *neighbours]

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
        arrived, local_face, steps = self._arrived(topology, half_edges), -1, 0
        for column, (face, face_steps) in zip(columns, self.slots, strict=True):
            if face != local_face:
                current, local_face, steps = arrived[self.faces[face]], face, 0
            for _ in range(face_steps - steps):
                current = topology.next[current]
            steps = face_steps
            topology.face_vertices.take(current, out=column, mode="clip")
        for centre, first, last in self.cut_fans:
            columns[first], columns[last] = topology.border_neighbours(columns[centre])
        return columns.T

    def _arrived(self, topology: Topology, half_edges: NDArray[np.integer]) -> dict[Walk, NDArray[np.integer]]:
        """Return the half-edges where the walks to all faces end, and those on the way."""
        arrived = {(0, 0): half_edges}
        for corner in range(self.faces[-1][0]):
            arrived[corner + 1, 0] = topology.next[arrived[corner, 0]]
        for corner, turns in self.faces:
            step, turn = (1, topology.turn) if turns > 0 else (-1, topology.turn_back)
            known = turns
            while (corner, known) not in arrived:
                known -= step
            for turned in range(known, turns, step):
                arrived[corner, turned + step] = turn(arrived[corner, turned])
        return arrived


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
    faces, sizes, twin = _glued_faces(signature)
    index = np.arange(len(twin))
    # Edges are named by half-edges, not by vertices, so that the two sides of a crease stay separate even where the
    # ring closes around the end of the crease.
    edge_names = np.where(twin < 0, index, np.minimum(index, twin))
    fan = fan_labels(Topology(1, sizes, np.zeros(len(twin), dtype=np.int32), edge_names))[0]
    _, first, which = np.unique(fan, return_index=True, return_inverse=True)
    # Vertices are numbered by their first half-edges.
    polygons = np.argsort(np.argsort(first))[which]
    first.sort()
    face = np.repeat(np.arange(len(sizes)), sizes)[first]
    slots = tuple(zip(face.tolist(), (first - ragged.starts(sizes)[face]).tolist(), strict=True))
    rules = np.zeros(len(slots), dtype=np.int8)
    rules[polygons[: len(signature.fans)]] = [fan.rule for fan in signature.fans]
    local = Topology(len(slots), sizes, polygons, edge_names, rules if rules.any() else None)
    cut = [c for c, fan in enumerate(signature.fans) if fan.is_open and fan.face_count == NEAR_FACES]
    cut_fans = np.stack([cut, *local.border_neighbours(np.array(cut, dtype=np.int32))], axis=1).tolist()
    return OneRing(local, tuple(faces), slots, cut_fans)


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
        if not fan.is_semi_sharp:
            continue
        centre = int(local.face_vertices[ahead[0]])
        vertices[centre] = fan.vertex
        across += [(centre, *row) for row in fan.across]
        half_edges = np.array(behind[::-1] + ahead)
        sharpness, near_half, far_half = np.array(fan.edges).T
        edges[half_edges], refined[half_edges] = sharpness, near_half
        twins = local.twin[half_edges]
        inside = twins >= 0
        edges[twins[inside]], refined[twins[inside]] = sharpness[inside], far_half[inside]
    vertex, across_sharpness, across_refined, sharpens = np.array(across, dtype=float).reshape(-1, 4).T
    semi_sharpness = SemiSharpness(
        edges, refined, vertices, vertex.astype(np.int64), across_sharpness, across_refined, sharpens > 0
    )
    return local.with_rules(local.rules, semi_sharpness)


def _glued_faces(signature: Signature) -> tuple[list[Walk], IntArray, IntArray]:
    """Glue the faces around an element along the edges that walks about its corners cross.

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

    Returns the first walk to each face, sorted by corner, then by turns, so that the element comes first; the sizes of
    the faces; and the twin of each of their half-edges, -1 if it is not glued.
    """
    fans = signature.fans
    walks = [(corner, turns) for corner, fan in enumerate(fans) for turns in fan.turns]
    faces: list[Walk] = []
    # The half-edge of each walk's face that begins at the walk's corner.
    begins: dict[Walk, int] = {}
    following: list[int] = []
    face_of: list[int] = []
    for walk in sorted(walks, key=lambda walk: (walk[0], abs(walk[1]), walk[1])):
        corner, turns = walk
        if signature.kind == "face" and turns == 0 and corner:
            begins[walk] = corner
            continue
        begin, size = len(following), fans[corner].size(turns)
        begins[walk] = begin
        face_of += [len(faces)] * size
        following += [*range(begin + 1, begin + size), begin]
        faces.append(walk)

    twin = [-1] * len(following)
    # An equal half-edge that is lower, or the half-edge itself.
    lower = list(range(len(following)))

    def lowest(half_edge: int) -> int:
        while lower[half_edge] != half_edge:
            half_edge = lower[half_edge]
        return half_edge

    # Pairs of half-edges to be made twins. A turn counter-clockwise crosses the last edge of the face, which is the
    # first edge of the next face.
    preceding = dict(zip(following, range(len(following)), strict=True))
    glued = [
        (preceding[begins[corner, turns]], begins[corner, ahead])
        for corner, fan in enumerate(fans)
        for turns, ahead in zip(fan.turns, [*fan.turns[1:], *([fan.turns[0]] if fan.is_closed else [])], strict=False)
    ]
    for pair in glued:
        one, other = map(lowest, pair)
        for half_edge, same in ((twin[one], other), (twin[other], one)):
            if half_edge < 0:
                continue
            kept, dropped = sorted((lowest(half_edge), lowest(same)))
            # Unite the half-edges, and the others of their faces.
            while face_of[kept] != face_of[dropped]:
                lower[dropped] = kept
                if twin[dropped] >= 0:
                    glued.append((kept, twin[dropped]))
                kept, dropped = sorted((lowest(following[kept]), lowest(following[dropped])))
        one, other = lowest(one), lowest(other)
        twin[one], twin[other] = other, one

    kept_half_edges = [half_edge for half_edge in range(len(following)) if lower[half_edge] == half_edge]
    number = {half_edge: index for index, half_edge in enumerate(kept_half_edges)}
    twins = [number[lowest(twin[half_edge])] if twin[half_edge] >= 0 else -1 for half_edge in kept_half_edges]
    kept_faces, sizes = np.unique([face_of[half_edge] for half_edge in kept_half_edges], return_counts=True)
    return [faces[face] for face in kept_faces.tolist()], sizes, np.array(twins)
