"""An element's one-ring refined once, and the parts of the element that this makes."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from ..cage.connectivity import IndexArray
from ..cage.one_ring import one_ring
from ..cage.signature import FanHalfEdges, Signature, fan_half_edges, signature_at, with_sharpness
from ..schemes.domain import AffineMap, FloatArray
from ..schemes.scheme import Scheme, SchemeError

# What rounding may leave of the difference between a sum of weights and one.
ROW_SUM = 1e-12


class RefinedElement:
    """An element refined once; its parts are made when they are asked for.

    Attributes
    ----------
    domains : tuple of AffineMap
        From the element's parameters to those of each part.
    matrices, offsets : (4, 2, 2), (4, 2) or (1, 2, 2), (1, 2) float64
        Of these maps.
    """

    def __init__(self, scheme: Scheme, signature: Signature) -> None:
        self._scheme, self._signature = scheme, signature
        smooth = signature.smoothed
        # Where faces and vertices come to lie does not depend on sharpness.
        self._smooth = None if smooth == signature else refined_element(scheme, smooth)
        self._refinement = scheme.refine(one_ring(signature).topology)
        self._topology = self._refinement.topology if self._smooth is None else self._smooth._topology
        self._children = self._smooth._children if self._smooth else self._named_children()
        self.domains = tuple(domain for domain, _ in self._children)
        self.matrices = np.array([domain.matrix for domain in self.domains])
        self.offsets = np.array([domain.offset for domain in self.domains])
        self._parts: dict[int, tuple[Signature, FloatArray]] = {}
        self._places: dict[int, _Place] = {}

    def _named_children(self) -> list[tuple[AffineMap, int]]:
        return self._scheme.children(one_ring(self._signature).topology, self._topology, 0)

    def part(self, number: int) -> tuple[Signature, FloatArray]:
        """Signature of a part and its control points over the element's one-ring, ``(K_part, K)``."""
        if number not in self._parts:
            place = (self._smooth or self)._place(number)
            semi_sharpness = self._refinement.topology.semi_sharpness
            child = with_sharpness(place.signature, place.fans, self._topology, semi_sharpness)
            stencils = self._refinement.stencils.dense(place.vertices)
            _require_rows_to_one(self._scheme, self._signature, stencils)
            self._parts[number] = child, stencils
        return self._parts[number]

    def _place(self, number: int) -> _Place:
        if number not in self._places:
            half_edge, kind = self._children[number][1], self._scheme.element
            smooth = signature_at(self._topology, half_edge, kind)
            vertices = one_ring(smooth).gather(self._topology, np.array([half_edge]))[0]
            self._places[number] = _Place(smooth, fan_half_edges(self._topology, half_edge, kind), vertices)
        return self._places[number]


@dataclass(frozen=True, eq=False)
class _Place:
    """Where a part lies in the refined one-ring.

    Attributes
    ----------
    signature : Signature
        Without semi-sharp features.
    fans : list of FanHalfEdges
        Half-edges of the fan at each of its corners.
    vertices : (K_part,) int32
        Its control points.
    """

    signature: Signature
    fans: list[FanHalfEdges]
    vertices: IndexArray


@lru_cache(maxsize=1024)
def refined_element(scheme: Scheme, signature: Signature) -> RefinedElement:
    """Refine an element's one-ring once."""
    return RefinedElement(scheme, signature)


def refined_parts(scheme: Scheme, signature: Signature) -> list[tuple[AffineMap, Signature, FloatArray]]:
    """All parts after one refinement: parameter map, signature, and control points over the one-ring before."""
    element = RefinedElement(scheme, signature)
    return [(domain, *element.part(number)) for number, domain in enumerate(element.domains)]


def _require_rows_to_one(scheme: Scheme, signature: Signature, stencils: FloatArray) -> None:
    sums = stencils.sum(axis=1)
    worst = int(np.argmax(np.abs(sums - 1)))
    if not abs(sums[worst] - 1) <= ROW_SUM:
        raise SchemeError(
            f"{scheme.name}: a refined vertex near a {signature.kind} with fans {signature.fans} has weights that sum "
            f"to {sums[worst]:.12g}; expected 1"
        )
