"""Origins of the face corners of a refined mesh: a vertex, an edge or a face of the cage."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from ..cage.control_cage import ControlCage
from ..mesh.connectivity import IntArray, Topology
from ..schemes import Scheme, SchemeError

# Origins of a refined vertex.
VERTEX, EDGE, FACE = range(3)


@dataclass(frozen=True, eq=False)
class RefinedCorners:
    """The face corners, or half-edges, of a cage's mesh refined once.

    First come the faces at the old corners, one for each, listed from the old vertex on; then perhaps others, with the
    points of edges at their corners.
    """

    cage: ControlCage
    refined: Topology  # Of the cut mesh
    kind: IntArray  # (n_c,) int: whether there is the point of a vertex, an edge or a face at each refined corner
    # (n_c,) int: of the cage: one that begins at this vertex, runs along this edge, or lies in this face
    half_edge: IntArray

    @classmethod
    def of(cls, cage: ControlCage, scheme: Scheme, refined: Topology) -> RefinedCorners:
        """Find the origin of each corner.

        Raises SchemeError if the scheme numbers refined faces in a way of its own.
        """
        t, cut = cage.topology, cage.cut_mesh.topology
        h = np.arange(t.half_edge_count)
        if scheme.splits_corners:
            kind = np.tile([VERTEX, EDGE, FACE, EDGE], len(h))
            half_edge = np.stack([h, h, h, t.prev], axis=1).ravel()
        else:
            kind = np.concatenate([np.tile([VERTEX, EDGE, EDGE], len(h)), np.full(len(h), EDGE)])
            half_edge = np.concatenate([np.stack([h, h, t.prev], axis=1).ravel(), h])
        found = cls(cage, refined, kind, half_edge)
        # In the cut mesh these are the same vertices, and the same edges on either side.
        parents = np.where(kind == VERTEX, cut.face_vertices[half_edge], cut.vertex_count + cut.edge[half_edge])
        known = (kind != FACE) & (len(kind) == refined.half_edge_count)
        if not known.any() or not _are_one_to_one(parents[known], refined.face_vertices[known]):
            raise SchemeError(
                f"{cage.source.name}: the scheme {scheme.name} numbers refined faces in a way of its own; expected one "
                "that refines as Catmull-Clark, Loop or Doo-Sabin do"
            )
        return found

    @cached_property
    def edge(self) -> IntArray:
        """``(n_h,)`` a number for each half-edge that all sides of its edge share, also where it is non-manifold."""
        found = self.cage.non_manifold
        return self.cage.topology.edge if found is None else found.edge

    @cached_property
    def is_split(self) -> NDArray[np.bool_]:
        """``(n_h,)`` whether some face has the edge twice: the two halves of the face must not get a common vertex."""
        t = self.cage.topology
        of_face = self.edge.astype(np.int64) * t.face_count + t.face
        _, which, count = np.unique(of_face, return_inverse=True, return_counts=True)
        is_double = np.zeros(int(self.edge.max()) + 1, dtype=bool)
        is_double[self.edge[count[which.ravel()] > 1]] = True
        return is_double[self.edge]

    @cached_property
    def vertex(self) -> IntArray:
        """``(n_c,)`` the refined cage's vertex at each corner: the same on all sides of a cut."""
        t, h = self.cage.topology, self.half_edge
        count, edge_count = self.cage.vertex_count, int(self.edge.max()) + 1
        of_sides = count + edge_count + t.face_count + self.refined.face_vertices
        number = np.select(
            [self.kind == VERTEX, self.kind == FACE, self.is_split[h]],
            [t.face_vertices[h], count + edge_count + t.face[h], of_sides],
            count + self.edge[h],
        )
        is_new = number >= count
        number[is_new] = count + np.unique(number[is_new], return_inverse=True)[1].ravel()
        return number

    @cached_property
    def copies(self) -> IntArray:
        """``(n,)`` one vertex of the refined cut mesh for each of the refined cage; old ones keep their numbers."""
        found = np.arange(max(self.cage.vertex_count, int(self.vertex.max()) + 1))
        later = self.vertex >= self.cage.vertex_count
        found[self.vertex[later]] = self.refined.face_vertices[later]
        return found

    @cached_property
    def old_edge(self) -> IntArray:
        """``(n_c,)`` the cage's half-edge that each refined half-edge is a half of, -1 for new edges."""
        other = self.refined.next
        is_edge, goes_to_edge = self.kind == EDGE, self.kind[other] == EDGE
        from_edge = np.where(is_edge & (self.kind[other] == VERTEX), self.half_edge, -1)
        return np.where(goes_to_edge & (self.kind == VERTEX), self.half_edge[other], from_edge)

    def elements(self) -> tuple[IntArray, IntArray]:
        """Face of the cage that each refined face lies in, and the corner at which it lies; -1 for none."""
        t, first = self.cage.topology, self.refined.face_offsets[:-1]
        half_edge = self.half_edge[first].astype(np.int64)
        face = t.face[half_edge].astype(np.int64)
        corner = np.where(self.kind[first] == VERTEX, half_edge - t.face_offsets[face], -1)
        return face, corner

    def values(
        self,
        indices: IntArray,  # (n_h,) int: of the values at the cage's face corners
    ) -> tuple[IntArray, IntArray]:
        """How many different values of a face-varying attribute there are, and where.

        Corners share a value if they are of the same vertex of the refined cage and follow from the same values: those
        at the old vertex, or at both ends of the edge.

        Returns a corner that has each value, (n,) int64, and the indices of the values at all corners, (n_c,) int64.
        """
        t, h = self.cage.topology, self.half_edge
        start, end = h, np.where(self.kind == EDGE, t.next[h], h)
        swaps = t.face_vertices[start] > t.face_vertices[end]
        start, end = np.where(swaps, end, start), np.where(swaps, start, end)
        pair = np.where(self.kind == FACE, 0, indices[start] * (int(indices.max()) + 1) + indices[end])
        pairs, number = np.unique(pair, return_inverse=True)
        _, first, found = np.unique(self.vertex * len(pairs) + number, return_index=True, return_inverse=True)
        return first, found

    def linear(self, values: NDArray[np.float64]) -> NDArray[np.floating]:
        """``(n_c, k)`` values at refined corners from ``(n_h, k)`` at the cage's: means over edges and faces."""
        t, h = self.cage.topology, self.half_edge
        sums = [np.bincount(t.face, column, minlength=t.face_count) for column in values.T]
        means = np.stack(sums, axis=1) / t.face_sizes[:, None]
        kind = self.kind[:, None]
        along = (values[h] + values[t.next[h]]) / 2
        return np.select([kind == VERTEX, kind == FACE], [values[h], means[t.face[h]]], along)

    def at_ends(
        self,
        of_vertices: NDArray[np.bool_],  # (n_v,) bool
        topology: Topology,  # The mesh before, cut in some way
    ) -> NDArray[np.bool_]:
        """``(n_c,)`` whether a corner is the point of an edge on a border, at both of whose ends something holds."""
        h, t = self.half_edge, topology
        ends = of_vertices[t.face_vertices[h]] & of_vertices[t.face_vertices[t.next[h]]]
        return (self.kind == EDGE) & (t.twin[h] < 0) & ends


def _are_one_to_one(one: IntArray, other: IntArray) -> bool:
    """Whether equal numbers in either array stand beside equal ones in the other."""
    there, back = np.zeros(one.max() + 1, dtype=np.int64), np.zeros(other.max() + 1, dtype=np.int64)
    there[one], back[other] = other, one
    return np.array_equal(there[one], other) and np.array_equal(back[other], one)
