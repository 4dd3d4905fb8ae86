"""Many one-rings refined at once, in one mesh."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable
from typing import NamedTuple

import numpy as np

from ..mesh import ragged
from ..mesh.connectivity import IndexArray, IntArray
from ..mesh.one_ring import JoinedRings, one_ring
from ..mesh.signature import Signature
from ..schemes.domain import FloatArray
from ..schemes.scheme import Refinement, Scheme
from ..schemes.stencil_table import StencilTable
from .refined_element import ROW_SUM, RefinedElement, RefinedRings, refined_element, ring_pattern

# From this many elements on, refining them together takes less time than one by one, with the mesh made for it.
FEWEST_TOGETHER = 3

# Elements with more control points are refined alone: together, the stencils of all refined vertices are made and kept.
MOST_CONTROLS_TOGETHER = 64


def refined_together(
    scheme: Scheme, signatures: Iterable[Signature], mesh: RingMesh | None
) -> tuple[list[RefinedElement], RingMesh | None]:
    """Elements of some signatures. Those that are new are refined together, if that saves time.

    Parameters
    ----------
    mesh : RingMesh or None
        What was returned before; its connectivity serves again if it has room for the new elements.

    Returns
    -------
    elements : list of RefinedElement
    mesh : RingMesh or None
        For the next call.
    """
    elements = [refined_element(scheme, signature) for signature in signatures]
    new = [
        element
        for element in elements
        if not element.is_refined
        and element.signature.is_semi_sharp
        and one_ring(element.smooth).vertex_count <= MOST_CONTROLS_TOGETHER
    ]
    if len(new) >= FEWEST_TOGETHER:
        counts = Counter(element.smooth for element in new)
        if mesh is None or not mesh.has_room(counts):
            # Rounded up to a power of two, because there are often more elements after the next refinement.
            room = Counter({smooth: 1 << (count - 1).bit_length() for smooth, count in counts.items()})
            mesh = RingMesh(scheme, room if mesh is None else room | mesh.counts)
        mesh.refine(new)
    return elements, mesh


class _EqualRings(NamedTuple):
    """One-rings of a mesh that have the same signature but for semi-sharp features, after the refinement.

    Attributes
    ----------
    smooth : Signature
        Without semi-sharp features.
    half_edges, vertices : (e, n_h), (e, n_v) int
        Numbers in the refined mesh of the half-edges and vertices of each one-ring, in the order of `RingPattern`.
    """

    smooth: Signature
    half_edges: IntArray
    vertices: IndexArray


class RingMesh:
    """One-rings beside each other in one mesh, to refine them together: that takes little longer than to refine one.

    The mesh is used again for other elements whose one-rings differ from these in semi-sharp features only.

    Parameters
    ----------
    scheme : Scheme
    counts : Counter of Signature
        How many one-rings there are of each signature; signatures have no semi-sharp features.
    """

    def __init__(self, scheme: Scheme, counts: Counter[Signature]) -> None:
        self._scheme, self.counts = scheme, counts
        self._joined = JoinedRings(list(counts.elements()))
        # The first one-ring of each signature.
        self._first = dict(zip(counts, ragged.starts(np.array([*counts.values()])).tolist(), strict=True))
        self._topology = self._joined.topology
        # Known after the first refinement.
        self._rings: list[_EqualRings] | None = None
        self._weight_places: tuple[IntArray, int] | None = None

    def has_room(self, counts: Counter[Signature]) -> bool:
        """Whether there are as many one-rings of each signature."""
        return counts <= self.counts

    def refine(self, elements: list[RefinedElement]) -> None:
        """Refine elements together, for which there must be room.

        Elements of a scheme that numbers refined faces in an order of its own are left as they are. In all others, the
        refined faces of each one-ring come in the order in which they come when the one-ring is refined alone.
        """
        used: Counter[Signature] = Counter()
        numbers = []
        for element in elements:
            numbers.append(used[element.smooth])
            used[element.smooth] += 1
        semi_sharpness = self._joined.sharpness(
            (self._first[e.smooth] + number, e.signature) for e, number in zip(elements, numbers, strict=True)
        )
        # Replaced, not made anew, as it keeps what has been computed of its connectivity.
        self._topology = self._topology.with_rules(self._topology.rules, semi_sharpness)
        refinement = self._scheme.refine(self._topology)
        if self._rings is None:
            self._rings = self._found_rings(refinement)
        if self._rings is None:
            return
        table = refinement.stencils
        sums = np.bincount(table.rows, table.weights, minlength=table.row_count)
        rows_sum_to_one = bool(np.abs(sums - 1).max() <= ROW_SUM)
        refined = {
            rings.smooth: RefinedRings(refinement.topology, rings.half_edges, stencils, rows_sum_to_one)
            for rings, stencils in zip(self._rings, self._stencils(table, self._rings), strict=True)
        }
        for element, number in zip(elements, numbers, strict=True):
            element.take(refined[element.smooth], number)

    def _stencils(self, table: StencilTable, all_rings: list[_EqualRings]) -> list[FloatArray]:
        """For each signature, ``(e, n_v, K)`` stencils of refined vertices, each over its own one-ring's vertices."""
        if self._weight_places is None:
            self._weight_places = self._found_weight_places(table, all_rings)
        row_begins, weight_count = self._weight_places
        weights = np.bincount(row_begins[table.rows] + table.columns, table.weights, minlength=weight_count)
        found, begin = [], 0
        for rings in all_rings:
            shape = *rings.vertices.shape, one_ring(rings.smooth).vertex_count
            end = begin + int(np.prod(shape))
            found.append(weights[begin:end].reshape(shape))
            begin = end
        return found

    def _found_weight_places(self, table: StencilTable, all_rings: list[_EqualRings]) -> tuple[IntArray, int]:
        """Where the stencils' weights go in one array that holds the dense stencils of all one-rings.

        Returns
        -------
        row_begins : (refined vertices,) int64
            The weight of vertex ``c`` in the stencil of refined vertex ``r`` goes to ``row_begins[r] + c``.
        weight_count : int
            Length of the array.
        """
        row_begins = np.empty(table.row_count, dtype=np.int64)
        begin = 0
        for rings in all_rings:
            count, row_count = rings.vertices.shape
            width = one_ring(rings.smooth).vertex_count
            first_columns = self._joined.vertices[self._first[rings.smooth]] + width * np.arange(count)
            begins = begin + width * np.arange(count * row_count).reshape(count, row_count)
            row_begins[rings.vertices] = begins - first_columns[:, None]
            begin += width * count * row_count
        return row_begins, begin

    def _found_rings(self, refinement: Refinement) -> list[_EqualRings] | None:
        """Find each refined one-ring in the refined mesh; None if its faces are not in the order of `RingPattern`."""
        refined, stencils = refinement.topology, refinement.stencils
        sizes = np.diff([*self._joined.vertices, self._topology.vertex_count])
        # A refined vertex belongs to the one-ring whose vertices it is made of. Sorting by one-ring takes linear time,
        # as their numbers fit into 16 bits.
        ring = np.repeat(np.arange(len(sizes), dtype=np.min_scalar_type(len(sizes))), sizes)
        of_vertex = np.zeros(refined.vertex_count, dtype=ring.dtype)
        of_vertex[stencils.rows] = ring[stencils.columns]
        half_edges = np.argsort(of_vertex[refined.face_vertices], kind="stable")
        found, end = [], 0
        for smooth, count in self.counts.items():
            pattern = ring_pattern(self._scheme, smooth)
            alone = pattern.refinement.topology
            begin, end = end, end + count * alone.half_edge_count
            if end > len(half_edges):
                return None
            own = half_edges[begin:end].reshape(count, -1)
            vertices = np.zeros((count, alone.vertex_count), dtype=np.int32)
            vertices[:, alone.face_vertices] = refined.face_vertices[own]
            # Each refined vertex is the beginning of several half-edges; in the right order they agree on it.
            if not np.array_equal(vertices[:, alone.face_vertices], refined.face_vertices[own]):
                return None
            first = self._joined.half_edges[self._first[smooth]]
            children = [half_edge for _, half_edge in self._scheme.children(self._topology, refined, first)]
            if children != own[0, pattern.half_edges].tolist():
                return None
            found.append(_EqualRings(smooth, own, vertices))
        return found if end == len(half_edges) else None
