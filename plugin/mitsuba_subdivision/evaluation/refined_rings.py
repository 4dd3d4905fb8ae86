"""One-rings refined once, alone or many together in one mesh.

Usually an element has four children, the copies of its domain. An element that does not fit the domain, such as a
pentagon's corner under Catmull-Clark, has one child, which does. Refining many one-rings beside each other in one mesh
takes little longer than refining one.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable
from functools import lru_cache
from typing import NamedTuple

import numpy as np

from ..mesh import ragged
from ..mesh.connectivity import IndexArray, IntArray, Topology
from ..mesh.one_ring import JoinedRings, one_ring
from ..mesh.signature import (
    FanSharpnessRows,
    Signature,
    fan_half_edges,
    half_edges_around,
    smooth_signature,
    with_sharpness,
)
from ..schemes.domain import AffineMap, FloatArray
from ..schemes.scheme import Refinement, Scheme, SchemeError
from ..schemes.stencil_table import StencilTable

# Rounding error of the sum of a stencil's weights.
ROW_SUM = 1e-12
# From this many one-rings on, refining them together takes less time than one by one, with the mesh made for it.
FEWEST_TOGETHER = 3
# One-rings with more control points are refined alone: together, the stencils of all refined vertices are made and
# kept.
MOST_CONTROLS_TOGETHER = 64


class RefinedRing(NamedTuple):
    """One of some refined one-rings."""

    rings: RefinedRings
    ring: int

    def signature(self, number: int) -> Signature:
        """Signature of a child."""
        return self.rings.signature(self.ring, number)

    def stencils(self, number: int) -> FloatArray:
        """Control points of a child over those of the element, ``(K_child, K)``."""
        return self.rings.stencils(self.ring, number)


class RingPattern:
    """The refinement of a one-ring without its semi-sharp features.

    Semi-sharp features change the weights of refined vertices. They change neither the refined faces nor the numbers of
    faces and vertices. So the children are found once, without such features.

    Attributes
    ----------
    smooth : Signature
        Without semi-sharp features.
    refinement : Refinement
        Of this one-ring.
    half_edges : list of int
        Half-edges of the refined mesh that name the children.
    domains : tuple of AffineMap
        From the element's parameters to those of each child.
    """

    def __init__(self, scheme: Scheme, smooth: Signature) -> None:
        self.scheme, self.smooth = scheme, smooth
        before = one_ring(smooth).topology
        self.refinement = scheme.refine(before)
        children = scheme.children(before, self.refinement.topology, 0)
        self.domains = tuple(domain for domain, _ in children)
        self.half_edges = [half_edge for _, half_edge in children]
        self._children: dict[int, tuple[Signature, IndexArray, IndexArray]] = {}

    def child(self, number: int) -> tuple[Signature, IndexArray, IndexArray]:
        """Signature, control points and half-edges of a child in the refined one-ring.

        Returns
        -------
        signature : Signature
            Without semi-sharp features.
        vertices : (K_child,) int32
        around : (n,) int32
            Half-edges of the fans at its corners, one fan after the other, in each the clockwise ones first.
        """
        if number not in self._children:
            topology, kind = self.refinement.topology, self.scheme.element
            fans = fan_half_edges(topology, self.half_edges[number], kind)
            signature = smooth_signature(topology, fans, kind)
            vertices = one_ring(signature).vertices_around(topology, fans)
            self._children[number] = signature, vertices, half_edges_around(fans)
        return self._children[number]


@lru_cache(maxsize=1024)
def ring_pattern(scheme: Scheme, smooth: Signature) -> RingPattern:
    """How a one-ring is refined; ``smooth`` is its signature without semi-sharp features."""
    return RingPattern(scheme, smooth)


class RefinedRings:
    """Refined one-rings that are equal but for their semi-sharp features; often there is only one.

    Parameters
    ----------
    topology : Topology
        The refined mesh, which may hold other one-rings, too.
    half_edges : (e, n_h) int
        Numbers in this mesh of the half-edges of each refined one-ring, in the order of the pattern.
    stencils : (e, n_v, K) float64, or StencilTable
        Of the vertices of each refined one-ring, over its vertices before. A table if there is one one-ring only.
    rows_sum_to_one : bool
        Whether the weights of every vertex are known to sum to one.
    """

    def __init__(
        self,
        pattern: RingPattern,
        topology: Topology,
        half_edges: IntArray,
        stencils: FloatArray | StencilTable,
        rows_sum_to_one: bool,
    ) -> None:
        self._pattern, self._topology, self._half_edges = pattern, topology, half_edges
        self._stencils, self._rows_sum_to_one = stencils, rows_sum_to_one
        # By the numbers of the children.
        self._sharpness: dict[int, FanSharpnessRows] = {}

    def child(self, ring: int, number: int) -> tuple[Signature, FloatArray]:
        """`signature` and `stencils` of a child of one of the elements."""
        return self.signature(ring, number), self.stencils(ring, number)

    def signature(self, ring: int, number: int) -> Signature:
        """Signature of a child of one of the elements."""
        signature, _, around = self._pattern.child(number)
        semi = self._topology.semi_sharpness
        if semi is None:
            return signature
        if number not in self._sharpness:
            self._sharpness[number] = FanSharpnessRows(self._topology, self._half_edges[:, around], semi)
        return with_sharpness(signature, self._sharpness[number], ring)

    def stencils(self, ring: int, number: int) -> FloatArray:
        """Control points of a child over those of the element, ``(K_child, K)``.

        Raises SchemeError if weights of a control point do not sum to one.
        """
        vertices = self._pattern.child(number)[1]
        if isinstance(self._stencils, StencilTable):
            stencils = self._stencils.dense(vertices)
        else:
            stencils = self._stencils[ring, vertices]
        if not self._rows_sum_to_one:
            _require_rows_to_one(self._pattern, stencils.sum(axis=1))
        return stencils


@lru_cache(maxsize=1024)
def refined_ring(scheme: Scheme, signature: Signature) -> RefinedRings:
    """The one-ring of a signature, refined alone."""
    pattern = ring_pattern(scheme, signature.smoothed)
    topology, stencils = pattern.refinement.topology, pattern.refinement.stencils
    if signature.is_semi_sharp:
        refined, stencils = scheme.refine(one_ring(signature).topology)
        # Connectivity is computed once for all that differ in semi-sharp features only.
        topology = topology.with_rules(refined.rules, refined.semi_sharpness)
    half_edges = np.arange(topology.half_edge_count, dtype=np.int32)[None]
    return RefinedRings(pattern, topology, half_edges, stencils, False)


def refined_children(scheme: Scheme, signature: Signature) -> list[tuple[AffineMap, Signature, FloatArray]]:
    """All children of an element: map of the parameters, signature, and control points over those of the element."""
    rings = refined_ring(scheme, signature)
    domains = ring_pattern(scheme, signature.smoothed).domains
    return [(domain, *rings.child(0, number)) for number, domain in enumerate(domains)]


def refined_together(
    scheme: Scheme, signatures: Iterable[Signature], mesh: RingMesh | None
) -> tuple[dict[Signature, RefinedRing], RingMesh | None]:
    """One-rings of different signatures, refined together where that saves time.

    Parameters
    ----------
    mesh : RingMesh or None
        The result of the last call; its connectivity is used again if it has capacity for the one-rings.

    Returns
    -------
    refined : dict
        For signatures that were refined together, the refined one-ring of each.
    mesh : RingMesh or None
        For the next call.
    """
    chosen = [
        signature
        for signature in signatures
        if signature.is_semi_sharp and one_ring(signature.smoothed).vertex_count <= MOST_CONTROLS_TOGETHER
    ]
    if len(chosen) < FEWEST_TOGETHER:
        return {}, mesh
    counts = Counter(signature.smoothed for signature in chosen)
    if mesh is None or not mesh.has_capacity(counts):
        # Rounded up to a power of two, because there are often more one-rings after the next refinement.
        capacity = Counter({smooth: 1 << (count - 1).bit_length() for smooth, count in counts.items()})
        mesh = RingMesh(scheme, capacity if mesh is None else capacity | mesh.counts)
    return dict(zip(chosen, mesh.refined(chosen), strict=False)), mesh


class RingMesh:
    """One-rings beside each other in one mesh.

    The mesh is used again for other one-rings that differ from these in semi-sharp features only.

    Parameters
    ----------
    counts : Counter of Signature
        Number of one-rings of each signature; signatures have no semi-sharp features.
    """

    def __init__(self, scheme: Scheme, counts: Counter[Signature]) -> None:
        self._scheme, self.counts = scheme, counts
        self._joined = JoinedRings(list(counts.elements()))
        # The first one-ring of each signature.
        self._first = dict(zip(counts, ragged.starts(np.array([*counts.values()])).tolist(), strict=True))
        self._topology = self._joined.topology
        # Known after the first refinement: for each signature the half-edges ``(e, n_h)`` and vertices ``(e, n_v)`` of
        # its one-rings in the refined mesh, in the order of `RingPattern`.
        self._rings: dict[Signature, tuple[IntArray, IndexArray]] | None = None
        self._weight_indices: tuple[IntArray, int] | None = None

    def has_capacity(self, counts: Counter[Signature]) -> bool:
        """Whether there are as many one-rings of each signature."""
        return counts <= self.counts

    def refined(self, signatures: list[Signature]) -> list[RefinedRing]:
        """Refine one-rings together, for which there must be capacity.

        Returns
        -------
        list of RefinedRing
            One for each signature. In these, refined faces come in the order in which they come when the one-ring is
            refined alone. The list is empty if the scheme numbers refined faces in an order of its own.
        """
        used: Counter[Signature] = Counter()
        numbers = []
        smooth = [signature.smoothed for signature in signatures]
        for each in smooth:
            numbers.append(used[each])
            used[each] += 1
        semi_sharpness = self._joined.sharpness(
            (self._first[each] + number, signature)
            for each, number, signature in zip(smooth, numbers, signatures, strict=True)
        )
        # Replaced, not constructed again, as it keeps what has been computed of its connectivity.
        self._topology = self._topology.with_rules(self._topology.rules, semi_sharpness)
        refinement = self._scheme.refine(self._topology)
        if self._rings is None:
            self._rings = self._found_rings(refinement)
        if self._rings is None:
            return []
        table = refinement.stencils
        sums = np.bincount(table.rows, table.weights, minlength=table.row_count)
        rows_sum_to_one = bool(np.abs(sums - 1).max() <= ROW_SUM)
        stencils = self._stencils(table, self._rings)
        refined = {
            each: RefinedRings(
                ring_pattern(self._scheme, each), refinement.topology, half_edges, stencils[each], rows_sum_to_one
            )
            for each, (half_edges, _) in self._rings.items()
        }
        return [RefinedRing(refined[each], number) for each, number in zip(smooth, numbers, strict=True)]

    def _stencils(
        self, table: StencilTable, rings: dict[Signature, tuple[IntArray, IndexArray]]
    ) -> dict[Signature, FloatArray]:
        """For each signature, ``(e, n_v, K)`` stencils of refined vertices, each over its own one-ring's vertices."""
        if self._weight_indices is None:
            self._weight_indices = self._found_weight_indices(table, rings)
        row_begins, weight_count = self._weight_indices
        weights = np.bincount(row_begins[table.rows] + table.columns, table.weights, minlength=weight_count)
        found, begin = {}, 0
        for smooth, (_, vertices) in rings.items():
            shape = *vertices.shape, one_ring(smooth).vertex_count
            end = begin + int(np.prod(shape))
            found[smooth] = weights[begin:end].reshape(shape)
            begin = end
        return found

    def _found_weight_indices(
        self, table: StencilTable, rings: dict[Signature, tuple[IntArray, IndexArray]]
    ) -> tuple[IntArray, int]:
        """Indices of the stencils' weights in one array that holds the dense stencils of all one-rings.

        Returns
        -------
        row_begins : (refined vertices,) int64
            The weight of vertex ``c`` in the stencil of refined vertex ``r`` goes to ``row_begins[r] + c``.
        weight_count : int
            Length of the array.
        """
        row_begins = np.empty(table.row_count, dtype=np.int64)
        begin = 0
        for smooth, (_, vertices) in rings.items():
            count, row_count = vertices.shape
            width = one_ring(smooth).vertex_count
            first_columns = self._joined.vertices[self._first[smooth]] + width * np.arange(count)
            begins = begin + width * np.arange(count * row_count).reshape(count, row_count)
            row_begins[vertices] = begins - first_columns[:, None]
            begin += width * count * row_count
        return row_begins, begin

    def _found_rings(self, refinement: Refinement) -> dict[Signature, tuple[IntArray, IndexArray]] | None:
        """Find each refined one-ring in the refined mesh; None if its faces are not in the order of `RingPattern`."""
        refined, stencils = refinement.topology, refinement.stencils
        sizes = np.diff([*self._joined.vertices, self._topology.vertex_count])
        # A refined vertex belongs to the one-ring whose vertices it is made of. Sorting by one-ring takes linear time,
        # as their numbers fit into 16 bits.
        ring = np.repeat(np.arange(len(sizes), dtype=np.min_scalar_type(len(sizes))), sizes)
        of_vertex = np.zeros(refined.vertex_count, dtype=ring.dtype)
        of_vertex[stencils.rows] = ring[stencils.columns]
        half_edges = np.argsort(of_vertex[refined.face_vertices], kind="stable")
        found: dict[Signature, tuple[IntArray, IndexArray]] = {}
        end = 0
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
            found[smooth] = own, vertices
        return found if end == len(half_edges) else None


def _require_rows_to_one(pattern: RingPattern, sums: FloatArray) -> None:
    error = np.abs(sums - 1)
    # Written so that a sum that is not a number is refused as well.
    if not error.max() <= ROW_SUM:
        raise SchemeError(
            f"{pattern.scheme.name}: a refined vertex near a {pattern.smooth.kind} with fans {pattern.smooth.fans} has "
            f"weights that sum to {sums[np.argmax(error)]:.12g}; expected 1"
        )
