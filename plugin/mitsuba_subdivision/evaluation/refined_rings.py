"""One-rings refined once.

Usually an element has four children, the copies of its domain. An element that does not fit the domain, such as a
pentagon's corner under Catmull-Clark, has one child, which does.
"""

from __future__ import annotations

from functools import lru_cache

import numpy as np

from ..mesh.connectivity import IndexArray
from ..mesh.one_ring import one_ring
from ..mesh.signature import (
    Signature,
    fan_half_edges,
    half_edges_around,
    smooth_signature,
    with_sharpness,
)
from ..schemes.domain import AffineMap, FloatArray
from ..schemes.scheme import Scheme, SchemeError

# Rounding error of the sum of a stencil's weights.
ROW_SUM = 1e-12


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


class RefinedRing:
    """A one-ring refined once, and the children of its element."""

    def __init__(self, scheme: Scheme, signature: Signature) -> None:
        self._pattern = ring_pattern(scheme, signature.smoothed)
        self._topology, self._stencils = self._pattern.refinement.topology, self._pattern.refinement.stencils
        if signature.is_semi_sharp:
            refined, self._stencils = scheme.refine(one_ring(signature).topology)
            # Connectivity is computed once for all that differ in semi-sharp features only.
            self._topology = self._topology.with_rules(refined.rules, refined.semi_sharpness)

    def signature(self, number: int) -> Signature:
        """Signature of a child."""
        smooth, _, around = self._pattern.child(number)
        return with_sharpness(smooth, self._topology, around)

    def stencils(self, number: int) -> FloatArray:
        """Control points of a child over those of the element, ``(K_child, K)``.

        Raises SchemeError if weights of a control point do not sum to one.
        """
        stencils = self._stencils.dense(self._pattern.child(number)[1])
        error = np.abs(stencils.sum(axis=1) - 1)
        # Written so that a sum that is not a number is refused as well.
        if not error.max() <= ROW_SUM:
            smooth = self._pattern.smooth
            raise SchemeError(
                f"{self._pattern.scheme.name}: a refined vertex near a {smooth.kind} with fans {smooth.fans} has "
                f"weights that sum to {stencils[np.argmax(error)].sum():.12g}; expected 1"
            )
        return stencils


@lru_cache(maxsize=1024)
def refined_ring(scheme: Scheme, signature: Signature) -> RefinedRing:
    """The refined one-ring of a signature."""
    return RefinedRing(scheme, signature)


def refined_children(scheme: Scheme, signature: Signature) -> list[tuple[AffineMap, Signature, FloatArray]]:
    """All children of an element: map of the parameters, signature, and control points over those of the element."""
    ring, domains = refined_ring(scheme, signature), ring_pattern(scheme, signature.smoothed).domains
    return [(domain, ring.signature(number), ring.stencils(number)) for number, domain in enumerate(domains)]
