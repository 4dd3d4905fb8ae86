"""One refinement of one-rings.

An element usually has four children, which are copies of its domain. An element that does not fit the domain, such as a
corner of a pentagon under Catmull-Clark, has one child that does.
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

# Tolerance when comparing the sum of a stencil's weights with 1.
ROW_SUM = 1e-12


class RingPattern:
    """The refinement of a one-ring without its semi-sharp features.

    Semi-sharp features change the weights of refined vertices, but not the refined connectivity. So the children are
    computed once for all one-rings that differ in semi-sharp features only.

    Attributes
    ----------
    smooth : Signature
        Signature without semi-sharp features.
    refinement : Refinement
        Refinement of this one-ring.
    half_edges : list of int
        Half-edge of each child in the refined mesh.
    domains : tuple of AffineMap
        Maps from the element's parameters to those of each child.
    """

    def __init__(self, scheme: Scheme, smooth: Signature) -> None:
        self.scheme, self.smooth = scheme, smooth
        topology = one_ring(smooth).topology
        self.refinement = scheme.refine(topology)
        children = scheme.children(topology, self.refinement.topology, 0)
        self.domains = tuple(domain for domain, _ in children)
        self.half_edges = [half_edge for _, half_edge in children]
        self._children: dict[int, tuple[Signature, IndexArray, IndexArray]] = {}

    def child(self, number: int) -> tuple[Signature, IndexArray, IndexArray]:
        """Return signature, control points and half-edges of a child in the refined one-ring.

        Returns
        -------
        signature : Signature
            Signature without semi-sharp features.
        vertices : (K_child,) int32
        around : (n,) int32
            Half-edges of the fans at its corners, fan by fan; in each fan the clockwise ones come first.
        """
        if number not in self._children:
            topology, kind = self.refinement.topology, self.scheme.element
            fans = fan_half_edges(topology, self.half_edges[number], kind)
            signature = smooth_signature(topology, fans, kind)
            vertices = one_ring(signature).gather(topology, np.array(self.half_edges[number : number + 1]))[0]
            self._children[number] = signature, vertices, half_edges_around(fans)
        return self._children[number]


@lru_cache(maxsize=1024)
def ring_pattern(scheme: Scheme, smooth: Signature) -> RingPattern:
    """Return the refinement of a one-ring whose signature without semi-sharp features is ``smooth``."""
    return RingPattern(scheme, smooth)


class RefinedRing:
    """A one-ring refined once, and the children of its element."""

    def __init__(self, scheme: Scheme, signature: Signature) -> None:
        self._pattern = ring_pattern(scheme, signature.smoothed)
        self._topology, self._stencils = self._pattern.refinement.topology, self._pattern.refinement.stencils
        if signature.is_semi_sharp:
            refined, self._stencils = scheme.refine(one_ring(signature).topology)
            # Reuse the connectivity, which does not depend on semi-sharp features.
            self._topology = self._topology.with_rules(refined.rules, refined.semi_sharpness)

    def signature(self, number: int) -> Signature:
        """Return the signature of a child."""
        smooth, _, around = self._pattern.child(number)
        return with_sharpness(smooth, self._topology, around)

    def stencils(self, number: int) -> FloatArray:
        """Return ``(K_child, K)`` stencils of a child's control points over those of the element.

        Raises SchemeError if the weights of a control point do not sum to one.
        """
        stencils = self._stencils.dense(self._pattern.child(number)[1])
        error = np.abs(stencils.sum(axis=1) - 1)
        # `not <=` also refuses NaN.
        if not error.max() <= ROW_SUM:
            smooth = self._pattern.smooth
            raise SchemeError(
                f"{self._pattern.scheme.name}: a refined vertex near a {smooth.kind} with fans {smooth.fans} has "
                f"weights that sum to {stencils[np.argmax(error)].sum():.12g}; expected 1"
            )
        return stencils


@lru_cache(maxsize=1024)
def refined_ring(scheme: Scheme, signature: Signature) -> RefinedRing:
    """Return the refined one-ring of a signature."""
    return RefinedRing(scheme, signature)


def refined_children(scheme: Scheme, signature: Signature) -> list[tuple[AffineMap, Signature, FloatArray]]:
    """Return domain, signature and stencils of all children of an element, see `RingPattern` and `RefinedRing`."""
    ring, domains = refined_ring(scheme, signature), ring_pattern(scheme, signature.smoothed).domains
    return [(domain, ring.signature(number), ring.stencils(number)) for number, domain in enumerate(domains)]
