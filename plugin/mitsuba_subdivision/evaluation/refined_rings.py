"""One refinement of one-rings: the children of elements.

An element usually has four children, which are copies of its domain. An element that does not fit the domain, such as a
corner of a pentagon under Catmull-Clark, has one child that does.

One-rings are small, and a surface may have hundreds of kinds of them. So they are refined side by side, as one mesh.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from ..mesh import ragged
from ..mesh.connectivity import IndexArray
from ..mesh.one_ring import joined_rings, one_ring
from ..mesh.signature import Signature, signatures_at
from ..schemes.domain import FloatArray, ParameterMap
from ..schemes.scheme import Scheme, SchemeError

# Tolerance when comparing the sum of a stencil's weights with 1.
ROW_SUM = 1e-12


class Child(NamedTuple):
    """A child of an element."""

    domain: ParameterMap  # From the element's parameters to the child's
    signature: Signature
    stencils: FloatArray  # (K_child, K) float64: the child's control points over those of the element


def refined_children(scheme: Scheme, signatures: Sequence[Signature]) -> list[list[Child]]:
    """Return the children of elements of some signatures.

    Raises SchemeError if the weights of a control point do not sum to one.
    """
    topology, first_half_edges, first_vertices = joined_rings(signatures)
    refined, table = scheme.refine(topology)
    parts = [
        (parent, domain, half_edge)
        for parent, first in enumerate(first_half_edges.tolist())
        for domain, half_edge in scheme.children(topology, refined, first)
    ]
    half_edges = np.array([half_edge for *_, half_edge in parts])
    of_parts = signatures_at(refined, half_edges, scheme.element)
    # Control points of children of equal connectivity are gathered at once.
    alike: dict[Signature, list[int]] = {}
    for index, signature in enumerate(of_parts):
        alike.setdefault(signature.smoothed, []).append(index)
    controls: dict[int, IndexArray] = {}
    for signature, indices in alike.items():
        controls |= zip(indices, one_ring(signature).gather(refined, half_edges[indices]), strict=True)

    # A row for each control point of each child, as long as the one-ring of the parent has vertices.
    of_children = [controls[index] for index in range(len(parts))]
    row_counts = [len(of_child) for of_child in of_children]
    parent_of_row = np.repeat([parent for parent, *_ in parts], row_counts)
    offsets = ragged.offsets(np.diff(first_vertices)[parent_of_row])
    rows, columns, weights = table.entries(np.concatenate(of_children))
    error = np.abs(np.bincount(rows, weights, minlength=len(parent_of_row)) - 1)
    # `not <=` also refuses NaN.
    if not error.max() <= ROW_SUM:
        worst = int(np.argmax(error))
        smooth, total = signatures[parent_of_row[worst]].smoothed, weights[rows == worst].sum()
        raise SchemeError(
            f"{scheme.name}: a refined vertex near a {smooth.kind} with fans {smooth.fans} has "
            f"weights that sum to {total:.12g}; expected 1"
        )
    places = offsets[rows] + columns - first_vertices[parent_of_row[rows]]
    flat: FloatArray = np.bincount(places, weights, minlength=offsets[-1]).astype(np.float64, copy=False)
    blocks = np.split(flat, offsets[np.cumsum(row_counts)[:-1]])
    children: list[list[Child]] = [[] for _ in signatures]
    for (parent, domain, _), signature, count, block in zip(parts, of_parts, row_counts, blocks, strict=True):
        children[parent].append(Child(domain, signature, block.reshape(count, -1)))
    return children
