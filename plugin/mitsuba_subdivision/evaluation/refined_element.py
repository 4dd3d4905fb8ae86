"""Elements' one-rings refined once, and the parts of the elements that this makes."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable
from dataclasses import dataclass
from functools import cached_property, lru_cache

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

# What rounding may leave of the difference between a sum of weights and one.
ROW_SUM = 1e-12

# Elements that take less time to refine together, with the mesh made for it, than one by one.
FEWEST_TOGETHER = 3

# Control points of elements that are refined together at most: all stencils of a one-ring are made, and kept.
MOST_CONTROLS_TOGETHER = 64


class RefinedElement:
    """An element refined once, when it or a part of it is first asked for; parts are made when they are asked for."""

    def __init__(self, scheme: Scheme, signature: Signature) -> None:
        self.signature, self.smooth = signature, signature.smoothed
        self._scheme = scheme
        # With others or alone, and which of the elements that differ in what is semi-sharp only.
        self._refined: tuple[_RefinedRings, int] | None = None
        self._parts: dict[int, tuple[Signature, FloatArray]] = {}

    @property
    def is_refined(self) -> bool:
        return self._refined is not None

    def take(self, refined: _RefinedRings, number: int) -> None:
        """Be one of the elements of refined rings."""
        self._refined = refined, number

    @cached_property
    def _ring(self) -> _RefinedRing:
        return _refined_ring(self._scheme, self.smooth)

    @property
    def domains(self) -> tuple[AffineMap, ...]:
        """From the element's parameters to those of each part."""
        return self._ring.domains

    @property
    def matrices(self) -> FloatArray:
        """``(4, 2, 2)`` or ``(1, 2, 2)`` of these maps."""
        return self._ring.matrices

    @property
    def offsets(self) -> FloatArray:
        """``(4, 2)`` or ``(1, 2)`` of these maps."""
        return self._ring.offsets

    def part(self, number: int) -> tuple[Signature, FloatArray]:
        """Signature of a part and its control points over the element's one-ring, ``(K_part, K)``."""
        if number not in self._parts:
            if self._refined is None:
                _refine_alone(self._scheme, self)
            refined, own = self._refined
            child, stencils = refined.part(self.smooth, own, self._ring.place(number))
            if not refined.rows_sum_to_one:
                _require_rows_to_one(self._scheme, self.signature, stencils)
            self._parts[number] = child, stencils
        return self._parts[number]


@lru_cache(maxsize=1024)
def refined_element(scheme: Scheme, signature: Signature) -> RefinedElement:
    """An element of a signature, refined once."""
    return RefinedElement(scheme, signature)


def refined_parts(scheme: Scheme, signature: Signature) -> list[tuple[AffineMap, Signature, FloatArray]]:
    """All parts after one refinement: parameter map, signature, and control points over the one-ring before."""
    element = RefinedElement(scheme, signature)
    return [(domain, *element.part(number)) for number, domain in enumerate(element.domains)]


class _RefinedRing:
    """A one-ring without semi-sharp features, refined, and where the parts of its element lie.

    Whatever is semi-sharp, faces and vertices have the same numbers.

    Attributes
    ----------
    topology : Topology
        The refined mesh.
    half_edges : list of int
        Names each part.
    domains : tuple of AffineMap
        From the element's parameters to those of each part.
    matrices, offsets : (4, 2, 2), (4, 2) or (1, 2, 2), (1, 2) float64
        Of these maps.
    numbers : _Numbers
        Its own.
    """

    def __init__(self, scheme: Scheme, smooth: Signature) -> None:
        self._kind = scheme.element
        before = one_ring(smooth).topology
        self.refinement = scheme.refine(before)
        self.topology = self.refinement.topology
        children = scheme.children(before, self.topology, 0)
        self.domains = tuple(domain for domain, _ in children)
        self.half_edges = [half_edge for _, half_edge in children]
        self.matrices = np.array([domain.matrix for domain in self.domains])
        self.offsets = np.array([domain.offset for domain in self.domains])
        half_edges, vertices = np.arange(self.topology.half_edge_count), np.arange(self.topology.vertex_count)
        self.numbers = _Numbers(half_edges[None], vertices[None])
        self._places: dict[int, _Place] = {}

    def place(self, number: int) -> _Place:
        """Where a part lies."""
        if number not in self._places:
            half_edge = self.half_edges[number]
            fans = fan_half_edges(self.topology, half_edge, self._kind)
            signature = smooth_signature(self.topology, fans, self._kind)
            vertices = one_ring(signature).vertices_around(self.topology, fans)
            self._places[number] = _Place(signature, vertices, half_edges_around(fans))
        return self._places[number]


_refined_ring = lru_cache(maxsize=1024)(_RefinedRing)


@dataclass(frozen=True, eq=False)
class _Place:
    """Where a part lies in the refined one-ring.

    Attributes
    ----------
    signature : Signature
        Without semi-sharp features.
    vertices : (K_part,) int32
        Its control points.
    around : (n,) int32
        Half-edges of the fans at its corners, one after the other, clockwise ones first.
    """

    signature: Signature
    vertices: IndexArray
    around: IndexArray


class RingMesh:
    """One-rings in one mesh, to refine them together: that takes little longer than to refine one.

    It serves again for other elements that have the same signatures but for what is semi-sharp.

    Parameters
    ----------
    counts : Counter of Signature
        How many one-rings there are of each signature, without semi-sharp features.
    """

    def __init__(self, scheme: Scheme, counts: Counter[Signature]) -> None:
        self._scheme, self.counts = scheme, counts
        self._rings = JoinedRings(list(counts.elements()))
        first = ragged.starts(np.array([*counts.values()])).tolist()
        self._first = dict(zip(counts, first, strict=True))
        self._topology = self._rings.topology
        self._numbers: dict[Signature, _Numbers] | None = None
        self._row_begins: IntArray | None = None

    def has_room(self, counts: Counter[Signature]) -> bool:
        """Whether there are as many one-rings of each signature."""
        return counts <= self.counts

    def refine(self, elements: list[RefinedElement]) -> None:
        """Refine elements together, for which there must be room.

        They are left as they are if the scheme does not number refined faces of one-rings beside each other as those of
        one alone, in this order.
        """
        used: Counter[Signature] = Counter()
        numbers = []
        for element in elements:
            numbers.append(used[element.smooth])
            used[element.smooth] += 1
        semi_sharpness = self._rings.sharpness(
            (self._first[e.smooth] + number, e.signature) for e, number in zip(elements, numbers, strict=True)
        )
        # What was computed of its connectivity is kept.
        topology = self._topology = self._topology.with_rules(self._topology.rules, semi_sharpness)
        refinement = self._scheme.refine(topology)
        if self._numbers is None:
            self._numbers = self._numbered(refinement)
        if self._numbers is None:
            return
        table = refinement.stencils
        sums = np.bincount(table.rows, table.weights, minlength=table.row_count)
        rows_sum_to_one = bool(np.abs(sums - 1).max() <= ROW_SUM)
        refined = _RefinedRings(refinement.topology, self._stencils(table), self._numbers, rows_sum_to_one)
        for element, number in zip(elements, numbers, strict=True):
            element.take(refined, number)

    def _stencils(self, table: StencilTable) -> dict[Signature, FloatArray]:
        """Stencils ``(e, n_v, K)`` of the vertices of all one-rings, each over its own vertices before."""
        # Where each refined vertex's row begins, less the number of the first vertex of its one-ring.
        if self._row_begins is None:
            self._row_begins = np.empty(table.row_count, dtype=np.int64)
            begin = 0
            for smooth, numbers in self._numbers.items():
                count, rows = numbers.vertices.shape
                columns, first = one_ring(smooth).vertex_count, self._rings.vertices[self._first[smooth]]
                begins = begin + columns * np.arange(count * rows).reshape(count, rows)
                self._row_begins[numbers.vertices] = begins - (first + columns * np.arange(count))[:, None]
                begin += columns * count * rows
            self._weight_count = begin
        at = self._row_begins[table.rows] + table.columns
        weights = np.bincount(at, table.weights, minlength=self._weight_count)
        found, end = {}, 0
        for smooth, numbers in self._numbers.items():
            begin, end = end, end + numbers.vertices.size * one_ring(smooth).vertex_count
            found[smooth] = weights[begin:end].reshape(*numbers.vertices.shape, -1)
        return found

    def _numbered(self, refinement: Refinement) -> dict[Signature, _Numbers] | None:
        """Numbers of what each one-ring is refined to, if they are in the order in which they are of one alone."""
        refined, stencils, counts = refinement.topology, refinement.stencils, self.counts
        sizes = np.diff([*self._rings.vertices, self._topology.vertex_count])
        # Numbers of 16 bits are sorted in linear time.
        ring = np.repeat(np.arange(len(sizes), dtype=np.min_scalar_type(len(sizes))), sizes)
        of_vertex = np.zeros(refined.vertex_count, dtype=ring.dtype)
        of_vertex[stencils.rows] = ring[stencils.columns]
        half_edges = np.argsort(of_vertex[refined.face_vertices], kind="stable")
        found: dict[Signature, _Numbers] = {}
        end = 0
        for smooth, count in counts.items():
            alone = _refined_ring(self._scheme, smooth)
            begin, end = end, end + count * alone.topology.half_edge_count
            if end > len(half_edges):
                return None
            own = half_edges[begin:end].reshape(count, -1)
            vertices = np.zeros((count, alone.topology.vertex_count), dtype=np.int32)
            vertices[:, alone.topology.face_vertices] = refined.face_vertices[own]
            first = self._rings.half_edges[self._first[smooth]]
            children = [half_edge for _, half_edge in self._scheme.children(self._topology, refined, first)]
            if not (
                np.array_equal(vertices[:, alone.topology.face_vertices], refined.face_vertices[own])
                and children == own[0, alone.half_edges].tolist()
            ):
                return None
            found[smooth] = _Numbers(own, vertices)
        return found if end == len(half_edges) else None


@dataclass(frozen=True, eq=False)
class _Numbers:
    """Numbers that half-edges and vertices of a refined one-ring have in a mesh with others.

    Attributes
    ----------
    half_edges, vertices : (e, n_h), (e, n_v) int
        For each of the one-rings that are equal.
    """

    half_edges: IndexArray
    vertices: IndexArray


class _RefinedRings:
    """Several one-rings, refined with the semi-sharp features of their elements.

    Parameters
    ----------
    topology : Topology
        The refined mesh.
    stencils : dict of Signature to (e, n_v, K) float64 or StencilTable
        Of all vertices of the one-rings that are equal, or of one that is alone in the mesh; each over its own vertices
        before.
    numbers : dict of Signature to _Numbers
    rows_sum_to_one : bool
        Whether all stencils are known to.
    """

    def __init__(
        self,
        topology: Topology,
        stencils: dict[Signature, FloatArray] | dict[Signature, StencilTable],
        numbers: dict[Signature, _Numbers],
        rows_sum_to_one: bool,
    ) -> None:
        self.rows_sum_to_one = rows_sum_to_one
        self._topology, self._stencils, self._numbers = topology, stencils, numbers
        self._sharpness: dict[_Place, FanSharpnessRows] = {}

    def part(self, smooth: Signature, element: int, place: _Place) -> tuple[Signature, FloatArray]:
        """Signature of a part of an element, and its control points over the element's one-ring."""
        found = self._stencils[smooth]
        alone = isinstance(found, StencilTable)
        stencils = found.dense(place.vertices) if alone else found[element, place.vertices]
        semi = self._topology.semi_sharpness
        if semi is None:
            return place.signature, stencils
        if place not in self._sharpness:
            around = self._numbers[smooth].half_edges[:, place.around]
            self._sharpness[place] = FanSharpnessRows(self._topology, around, semi)
        return with_sharpness(place.signature, self._sharpness[place], element), stencils


def refined_together(
    scheme: Scheme, signatures: Iterable[Signature], mesh: RingMesh | None
) -> tuple[list[RefinedElement], RingMesh | None]:
    """Elements of some signatures, those that are not yet refined in one mesh: in ``mesh`` if there is room.

    Returns
    -------
    elements : list of RefinedElement
    mesh : RingMesh or None
        To refine others in.
    """
    elements = [refined_element(scheme, signature) for signature in signatures]
    new = [element for element in elements if not element.is_refined]
    sharp = [
        element
        for element in new
        if element.signature.is_semi_sharp and one_ring(element.smooth).vertex_count <= MOST_CONTROLS_TOGETHER
    ]
    if len(sharp) >= FEWEST_TOGETHER:
        counts = Counter(element.smooth for element in sharp)
        if mesh is None or not mesh.has_room(counts):
            # With room for some more, as often there are more after the next refinement.
            room = Counter({smooth: 1 << (count - 1).bit_length() for smooth, count in counts.items()})
            mesh = RingMesh(scheme, room if mesh is None else room | mesh.counts)
        mesh.refine(sharp)
    for element in new:
        if not element.is_refined:
            _refine_alone(scheme, element)
    return elements, mesh


def _refine_alone(scheme: Scheme, element: RefinedElement) -> None:
    ring = _refined_ring(scheme, element.smooth)
    refinement = ring.refinement
    if element.signature.is_semi_sharp:
        refinement = scheme.refine(one_ring(element.signature).topology)
    numbers, stencils = {element.smooth: ring.numbers}, {element.smooth: refinement.stencils}
    element.take(_RefinedRings(refinement.topology, stencils, numbers, False), 0)


def _require_rows_to_one(scheme: Scheme, signature: Signature, stencils: FloatArray) -> None:
    sums = stencils.sum(axis=1)
    off = np.abs(sums - 1)
    # Not a number is not right, either.
    if not off.max() <= ROW_SUM:
        raise SchemeError(
            f"{scheme.name}: a refined vertex near a {signature.kind} with fans {signature.fans} has weights that sum "
            f"to {sums[np.argmax(off)]:.12g}; expected 1"
        )
