"""One refinement of one-rings: the children of an element.

An element usually has four children, which are copies of its domain. An element that does not fit the domain, such as a
corner of a pentagon under Catmull-Clark, has one child that does.

Semi-sharp features change the weights of refined vertices, but not the refined connectivity. So connectivity is
computed once for all one-rings that differ in semi-sharp features only.
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
from ..schemes.domain import FloatArray, ParameterMap
from ..schemes.scheme import Refinement, Scheme, SchemeError

# Tolerance when comparing the sum of a stencil's weights with 1.
ROW_SUM = 1e-12


# The limit is that of `patch_tree`.
@lru_cache(maxsize=8192)
def refined_ring(scheme: Scheme, signature: Signature) -> Refinement:
    """Refine the one-ring of a signature."""
    refined = scheme.refine(one_ring(signature).topology)
    if not signature.is_semi_sharp:
        return refined
    smooth, topology = refined_ring(scheme, signature.smoothed).topology, refined.topology
    return Refinement(smooth.with_rules(topology.vertex_rules, topology.semi_sharpness), refined.stencils)


@lru_cache(maxsize=1024)
def _children(scheme: Scheme, smooth: Signature) -> list[tuple[ParameterMap, int]]:
    """Return the domain and the half-edge in the refined mesh of each child."""
    return scheme.children(one_ring(smooth).topology, refined_ring(scheme, smooth).topology, 0)


def child_domains(scheme: Scheme, signature: Signature) -> tuple[ParameterMap, ...]:
    """Return the maps from an element's parameters to those of each child."""
    return tuple(domain for domain, _ in _children(scheme, signature.smoothed))


@lru_cache(maxsize=4096)
def _smooth_child(scheme: Scheme, smooth: Signature, number: int) -> tuple[Signature, IndexArray, IndexArray]:
    """Return signature, control points and half-edges of a child in the refined one-ring.

    The half-edges are those of the fans at its corners, fan by fan; in each fan the clockwise ones come first.
    """
    topology, half_edge = refined_ring(scheme, smooth).topology, _children(scheme, smooth)[number][1]
    fans = fan_half_edges(topology, half_edge, scheme.element)
    signature = smooth_signature(topology, fans, scheme.element)
    return signature, one_ring(signature).gather(topology, np.array([half_edge]))[0], half_edges_around(fans)


def child_signature(scheme: Scheme, signature: Signature, number: int) -> Signature:
    """Return the signature of a child."""
    smooth, _, around = _smooth_child(scheme, signature.smoothed, number)
    return with_sharpness(smooth, refined_ring(scheme, signature).topology, around)


def child_stencils(scheme: Scheme, signature: Signature, number: int) -> FloatArray:
    """Return ``(K_child, K)`` stencils of a child's control points over those of the element.

    Raises SchemeError if the weights of a control point do not sum to one.
    """
    smooth = signature.smoothed
    stencils = refined_ring(scheme, signature).stencils.dense(_smooth_child(scheme, smooth, number)[1])
    error = np.abs(stencils.sum(axis=1) - 1)
    # `not <=` also refuses NaN.
    if not error.max() <= ROW_SUM:
        raise SchemeError(
            f"{scheme.name}: a refined vertex near a {smooth.kind} with fans {smooth.fans} has "
            f"weights that sum to {stencils[np.argmax(error)].sum():.12g}; expected 1"
        )
    return stencils


def refined_children(scheme: Scheme, signature: Signature) -> list[tuple[ParameterMap, Signature, FloatArray]]:
    """Return domain, signature and stencils of all children of an element."""
    return [
        (domain, child_signature(scheme, signature, number), child_stencils(scheme, signature, number))
        for number, domain in enumerate(child_domains(scheme, signature))
    ]
