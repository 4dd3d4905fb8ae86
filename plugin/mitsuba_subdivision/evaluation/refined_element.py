"""Elements refined once, and the children that this makes of them.

Usually an element has four children, the copies of its domain. An element that does not fit the domain, such as a
pentagon's corner under Catmull-Clark, has one child, which does.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property, lru_cache

import numpy as np

from ..mesh.connectivity import IndexArray, IntArray, Topology
from ..mesh.one_ring import one_ring
from ..mesh.signature import (
    FanSharpnessRows,
    Signature,
    fan_half_edges,
    half_edges_around,
    smooth_signature,
    with_sharpness,
)
from ..schemes.domain import AffineMap, FloatArray
from ..schemes.scheme import Scheme, SchemeError
from ..schemes.stencil_table import StencilTable

# How far rounding may move the sum of a stencil's weights from one.
ROW_SUM = 1e-12


class RefinedElement:
    """An element of a signature, refined once.

    The work is put off: the element is refined when a child is first asked for, and each child is made when that one is
    asked for. `RingMesh` refines many elements at once and hands each its result by `take`.
    """

    def __init__(self, scheme: Scheme, signature: Signature) -> None:
        self.signature, self.smooth = signature, signature.smoothed
        self._scheme = scheme
        # The refined one-ring: one of several in a mesh, and which of them.
        self._refined: tuple[RefinedRings, int] | None = None
        self._children: dict[int, tuple[Signature, FloatArray]] = {}

    @property
    def is_refined(self) -> bool:
        return self._refined is not None

    def take(self, refined: RefinedRings, number: int) -> None:
        """Take one of some refined one-rings as that of this element."""
        self._refined = refined, number

    @cached_property
    def _pattern(self) -> RingPattern:
        return ring_pattern(self._scheme, self.smooth)

    @property
    def domains(self) -> tuple[AffineMap, ...]:
        """From the element's parameters to those of each child."""
        return self._pattern.domains

    @property
    def matrices(self) -> FloatArray:
        """``(4, 2, 2)`` or ``(1, 2, 2)`` of these maps."""
        return self._pattern.matrices

    @property
    def offsets(self) -> FloatArray:
        """``(4, 2)`` or ``(1, 2)`` of these maps."""
        return self._pattern.offsets

    def child(self, number: int) -> tuple[Signature, FloatArray]:
        """Signature of a child, and its control points over those of the element, ``(K_child, K)``.

        Raises
        ------
        SchemeError
            If weights of a control point do not sum to one.
        """
        if number not in self._children:
            refined, own = self._refined or (self._refined_alone(), 0)
            child, stencils = refined.child(own, self._pattern.place(number))
            if not refined.rows_sum_to_one:
                _require_rows_to_one(self._scheme, self.signature, stencils)
            self._children[number] = child, stencils
        return self._children[number]

    def _refined_alone(self) -> RefinedRings:
        refinement = self._pattern.refinement
        if self.signature.is_semi_sharp:
            refinement = self._scheme.refine(one_ring(self.signature).topology)
        half_edges = np.arange(refinement.topology.half_edge_count)[None]
        refined = RefinedRings(refinement.topology, half_edges, refinement.stencils, False)
        self.take(refined, 0)
        return refined


@lru_cache(maxsize=1024)
def refined_element(scheme: Scheme, signature: Signature) -> RefinedElement:
    """An element of a signature, refined once; the same object whenever it is asked for."""
    return RefinedElement(scheme, signature)


def refined_children(scheme: Scheme, signature: Signature) -> list[tuple[AffineMap, Signature, FloatArray]]:
    """All children of an element: map of the parameters, signature, and control points over those of the element."""
    element = RefinedElement(scheme, signature)
    return [(domain, *element.child(number)) for number, domain in enumerate(element.domains)]


@dataclass(frozen=True, eq=False)
class ChildPlace:
    """Where a child lies in the refined one-ring of its element.

    Attributes
    ----------
    number : int
        Which of the children it is.
    signature : Signature
        Of the child, without semi-sharp features.
    vertices : (K_child,) int32
        Its control points.
    around : (n,) int32
        Half-edges of the fans at its corners, one fan after the other, in each the clockwise ones first.
    """

    number: int
    signature: Signature
    vertices: IndexArray
    around: IndexArray


class RingPattern:
    """How a one-ring is refined, whatever is semi-sharp in it.

    Semi-sharp features change the weights of refined vertices. They change neither the refined faces nor the numbers of
    faces and vertices. So the places of the children are found once, without such features.

    Attributes
    ----------
    refinement : Refinement
        Of the one-ring without semi-sharp features.
    half_edges : list of int
        Half-edges of the refined mesh that name the children.
    domains : tuple of AffineMap
        From the element's parameters to those of each child.
    matrices, offsets : (4, 2, 2), (4, 2) or (1, 2, 2), (1, 2) float64
        Of these maps.
    """

    def __init__(self, scheme: Scheme, smooth: Signature) -> None:
        self._kind = scheme.element
        before = one_ring(smooth).topology
        self.refinement = scheme.refine(before)
        children = scheme.children(before, self.refinement.topology, 0)
        self.domains = tuple(domain for domain, _ in children)
        self.half_edges = [half_edge for _, half_edge in children]
        self.matrices = np.array([domain.matrix for domain in self.domains])
        self.offsets = np.array([domain.offset for domain in self.domains])
        self._places: dict[int, ChildPlace] = {}

    def place(self, number: int) -> ChildPlace:
        """Where a child lies."""
        if number not in self._places:
            topology = self.refinement.topology
            fans = fan_half_edges(topology, self.half_edges[number], self._kind)
            signature = smooth_signature(topology, fans, self._kind)
            vertices = one_ring(signature).vertices_around(topology, fans)
            self._places[number] = ChildPlace(number, signature, vertices, half_edges_around(fans))
        return self._places[number]


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
        Numbers in this mesh of the half-edges of each refined one-ring, in the order of `RingPattern`.
    stencils : (e, n_v, K) float64, or StencilTable
        Of the vertices of each refined one-ring, over its vertices before. A table if there is one one-ring only.
    rows_sum_to_one : bool
        Whether the weights of every vertex are known to sum to one.
    """

    def __init__(
        self, topology: Topology, half_edges: IntArray, stencils: FloatArray | StencilTable, rows_sum_to_one: bool
    ) -> None:
        self.rows_sum_to_one = rows_sum_to_one
        self._topology, self._half_edges, self._stencils = topology, half_edges, stencils
        # By the numbers of the children.
        self._sharpness: dict[int, FanSharpnessRows] = {}

    def child(self, number: int, place: ChildPlace) -> tuple[Signature, FloatArray]:
        """Signature of a child of one of the elements, and its control points over the element's one-ring."""
        if isinstance(self._stencils, StencilTable):
            stencils = self._stencils.dense(place.vertices)
        else:
            stencils = self._stencils[number, place.vertices]
        semi = self._topology.semi_sharpness
        if semi is None:
            return place.signature, stencils
        if place.number not in self._sharpness:
            around = self._half_edges[:, place.around]
            self._sharpness[place.number] = FanSharpnessRows(self._topology, around, semi)
        return with_sharpness(place.signature, self._sharpness[place.number], number), stencils


def _require_rows_to_one(scheme: Scheme, signature: Signature, stencils: FloatArray) -> None:
    sums = stencils.sum(axis=1)
    error = np.abs(sums - 1)
    # Written so that a sum that is not a number is refused as well.
    if not error.max() <= ROW_SUM:
        raise SchemeError(
            f"{scheme.name}: a refined vertex near a {signature.kind} with fans {signature.fans} has weights that sum "
            f"to {sums[np.argmax(error)]:.12g}; expected 1"
        )
