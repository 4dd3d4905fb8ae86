"""Elements' one-rings refined once, and the parts of the elements that this makes."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable
from dataclasses import dataclass
from functools import cached_property, lru_cache

import numpy as np

from ..cage.connectivity import IndexArray, Topology
from ..cage.one_ring import JoinedRings, one_ring
from ..cage.signature import FanSharpnessRows, Signature, fans_around, signature_at, with_sharpness
from ..schemes.domain import AffineMap, FloatArray
from ..schemes.scheme import Refinement, Scheme, SchemeError

# What rounding may leave of the difference between a sum of weights and one.
ROW_SUM = 1e-12


class RefinedElement:
    """An element refined once, when it or a part of it is first asked for; parts are made when they are asked for."""

    def __init__(self, scheme: Scheme, signature: Signature) -> None:
        self.signature, self.smooth = signature, signature.smoothed
        self._scheme = scheme
        # Of the refinement of several elements, and which of these this is.
        self._refined: tuple[_RefinedRings, int] | None = None
        self._parts: dict[int, tuple[Signature, FloatArray]] = {}
        # Signatures of parts without semi-sharp features, of those that were asked for in some mesh.
        self.smooth_parts: dict[int, Signature] = {}

    @property
    def is_refined(self) -> bool:
        return self._refined is not None

    def take(self, refined: _RefinedRings, number: int) -> None:
        """Be the element of a number in rings that are refined."""
        self._refined = refined, number

    def _taken(self) -> tuple[_RefinedRings, int]:
        if self._refined is None:
            RingMesh(self._scheme, Counter([self.smooth])).refine([self])
        return self._refined

    @cached_property
    def domains(self) -> tuple[AffineMap, ...]:
        """From the element's parameters to those of each part."""
        return tuple(domain for domain, _ in self.mesh.children(self.smooth)[0])

    @cached_property
    def matrices(self) -> FloatArray:
        """``(4, 2, 2)`` or ``(1, 2, 2)`` of these maps."""
        return np.array([domain.matrix for domain in self.domains])

    @cached_property
    def offsets(self) -> FloatArray:
        """``(4, 2)`` or ``(1, 2)`` of these maps."""
        return np.array([domain.offset for domain in self.domains])

    @property
    def mesh(self) -> RingMesh:
        """The mesh in which it is refined."""
        return self._taken()[0].mesh

    def has(self, number: int) -> bool:
        """Whether a part is made already."""
        return number in self._parts

    def part(self, number: int) -> tuple[Signature, FloatArray]:
        """Signature of a part and its control points over the element's one-ring, ``(K_part, K)``."""
        if number not in self._parts:
            refined, own = self._taken()
            child, stencils = refined.part(self.smooth, own, number)
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


class RingMesh:
    """One-rings in one mesh, to refine them together, and where parts of their elements come to lie in the refined one.

    To refine a small mesh takes nearly as long as to refine one of some dozen such. Whatever is semi-sharp, faces and
    vertices have the same numbers, so that the mesh serves again for elements that differ in this only.

    Parameters
    ----------
    counts : Counter of Signature
        How many one-rings there are of each signature, without semi-sharp features.
    """

    def __init__(self, scheme: Scheme, counts: Counter[Signature]) -> None:
        self.scheme, self.counts = scheme, counts
        self.rings = JoinedRings([smooth for smooth, count in counts.items() for _ in range(count)])
        first = np.cumsum([0, *counts.values()]).tolist()
        self.numbers = {smooth: range(*ends) for smooth, ends in zip(counts, zip(first, first[1:]), strict=False)}
        self._topology = self.rings.topology
        self._refined: Topology | None = None
        self._children: dict[Signature, list[list[tuple[AffineMap, int]]]] = {}
        self._places: dict[tuple[Signature, int], _Places] = {}

    def has_room(self, counts: Counter[Signature]) -> bool:
        """Whether there are as many one-rings of each signature."""
        return all(self.counts.get(smooth, 0) >= count for smooth, count in counts.items())

    def refine(self, elements: Iterable[RefinedElement]) -> None:
        """Refine elements together, for which there must be room."""
        left = {smooth: iter(numbers) for smooth, numbers in self.numbers.items()}
        numbered = [(next(left[element.smooth]), element) for element in elements]
        semi_sharpness = self.rings.sharpness((number, element.signature) for number, element in numbered)
        # What was computed of its connectivity is kept.
        self._topology = self._topology.with_rules(self._topology.rules, semi_sharpness)
        refinement = self.scheme.refine(self._topology)
        if self._refined is None:
            self._refined = refinement.topology.with_rules(refinement.topology.rules, None)
        refined = _RefinedRings(self, refinement)
        for number, element in numbered:
            element.take(refined, number)

    def children(self, smooth: Signature) -> list[list[tuple[AffineMap, int]]]:
        """Of each element of a signature, `Scheme.children`."""
        if smooth not in self._children:
            topology, refined, first = self._topology, self._refined, self.rings.half_edges
            self._children[smooth] = [
                self.scheme.children(topology, refined, first[number]) for number in self.numbers[smooth]
            ]
        return self._children[smooth]

    def place(self, parts: Iterable[tuple[Signature, int]]) -> None:
        """Find where parts lie in the refined mesh, given by signatures of elements and numbers of parts of these."""
        new = [part for part in dict.fromkeys(parts) if part not in self._places]
        alike: dict[Signature, list[tuple[tuple[Signature, int], list[int]]]] = {}
        for smooth, number in new:
            half_edges = [children[number][1] for children in self.children(smooth)]
            known = refined_element(self.scheme, smooth).smooth_parts
            if number not in known:
                known[number] = signature_at(self._refined, half_edges[0], self.scheme.element)
            alike.setdefault(known[number], []).append(((smooth, number), half_edges))
        for child, found in alike.items():
            half_edges = np.array([half_edge for _, own in found for half_edge in own])
            vertices = one_ring(child).gather(self._refined, half_edges)
            around = fans_around(self._refined, half_edges, child)
            end = 0
            for part, own in found:
                begin, end = end, end + len(own)
                self._places[part] = _Places(child, vertices[begin:end], [fan[begin:end] for fan in around])

    def places(self, smooth: Signature, number: int) -> _Places:
        """Where parts of a number lie in the refined mesh."""
        self.place([(smooth, number)])
        return self._places[smooth, number]

    @property
    def refined_topology(self) -> Topology:
        """The refined mesh."""
        return self._refined


@dataclass(frozen=True, eq=False)
class _Places:
    """Where parts of elements of the same signature lie in the refined mesh.

    Attributes
    ----------
    signature : Signature
        Without semi-sharp features.
    vertices : (e, K_part) int32
        Their control points.
    around : list of (e, valence) int32
        Half-edges of the fan at each of their corners.
    """

    signature: Signature
    vertices: IndexArray
    around: list[IndexArray]


class _RefinedRings:
    """A mesh of one-rings, refined with the semi-sharp features of some elements."""

    def __init__(self, mesh: RingMesh, refinement: Refinement) -> None:
        self.mesh = mesh
        self._semi_sharpness = refinement.topology.semi_sharpness
        self._stencils = refinement.stencils.divided(mesh.rings.vertices)
        self._sharpness: dict[tuple[Signature, int], FanSharpnessRows] = {}

    def part(self, smooth: Signature, element: int, number: int) -> tuple[Signature, FloatArray]:
        """Signature of a part of an element, and its control points over the element's one-ring."""
        places = self.mesh.places(smooth, number)
        own = element - self.mesh.numbers[smooth].start
        stencils, child = self._stencils[element].dense(places.vertices[own]), places.signature
        if self._semi_sharpness is not None:
            if (smooth, number) not in self._sharpness:
                topology = self.mesh.refined_topology
                self._sharpness[smooth, number] = FanSharpnessRows(topology, places.around, self._semi_sharpness)
            child = with_sharpness(child, self._sharpness[smooth, number], own)
        return child, stencils


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
    if new:
        counts = Counter(element.smooth for element in new)
        if mesh is None or not mesh.has_room(counts):
            # With room for some more, as often there are more after the next refinement.
            room = Counter({smooth: 1 << (count - 1).bit_length() for smooth, count in counts.items()})
            mesh = RingMesh(scheme, room if mesh is None else room | mesh.counts)
        mesh.refine(new)
    return elements, mesh


def place_parts(parts: Iterable[tuple[RefinedElement, int]]) -> None:
    """Find where parts of elements lie, all at once, before they are asked for: elements and numbers of their parts."""
    by_mesh: dict[RingMesh, list[tuple[Signature, int]]] = {}
    for element, number in parts:
        if not element.has(number):
            by_mesh.setdefault(element.mesh, []).append((element.smooth, number))
    for mesh, places in by_mesh.items():
        mesh.place(places)


def _require_rows_to_one(scheme: Scheme, signature: Signature, stencils: FloatArray) -> None:
    sums = stencils.sum(axis=1)
    off = np.abs(sums - 1)
    # Not a number is not right, either.
    if not off.max() <= ROW_SUM:
        raise SchemeError(
            f"{scheme.name}: a refined vertex near a {signature.kind} with fans {signature.fans} has weights that sum "
            f"to {sums[np.argmax(off)]:.12g}; expected 1"
        )
