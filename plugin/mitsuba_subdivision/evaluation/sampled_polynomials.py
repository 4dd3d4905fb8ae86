"""Polynomials over one-rings that hold given samples, such as the vertices of a tessellation.

A sample lies in a regular piece, or in one of the regular pieces around an extraordinary point: a polynomial, whose
coefficients are rows times control points. Where few samples lie in a piece, each has a polynomial of its own instead,
the plane through its point along its two tangents, which has fewer coefficients. So have samples at extraordinary
points, and near them beyond the levels that are pieces.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from ..mesh.connectivity import IntArray
from ..schemes.domain import FloatArray
from ..schemes.scheme import Scheme
from .divided_element import DividedElement
from .equations import locate
from .piece_tree import LEVEL_PIECES, PIECE_LEVELS, level_polynomials
from .polynomial_basis import polynomial_basis
from .sample_weights import Leaves, LocatedSamples, frame_magnitude, without_collapsed

# Fewer samples of a piece have planes.
FEW_SAMPLES = 4
# Exponents of the monomials of a plane.
PLANE_POWERS = np.array([(0, 0), (1, 0), (0, 1)])


class Polynomials(NamedTuple):
    """Polynomials of the same monomials, and the samples that they hold."""

    # list of (p, m, K) float64, for each element: times control points, the coefficients of each of its polynomials
    rows: list[FloatArray]
    # (s,) int64: which of them holds each sample, counted through all elements; -1 where none does
    polynomial: IntArray
    st: FloatArray  # (s, 2) float64: parameters of each sample there, from the middle of the domain


def sampled_polynomials(
    scheme: Scheme,
    elements: Sequence[DividedElement],  # All different
    uv: Sequence[FloatArray],  # (s, 2) float64: samples of each
) -> tuple[Polynomials, Polynomials]:
    """Planes, and polynomials of the scheme's `PolynomialBasis`, that hold samples.

    Normals are along the cross product of the derivatives. Those of planes are tangents of any length.

    Raises SchemeError if refinement does not separate the irregularities of a one-ring, or something always stays
    semi-sharp.
    """
    element = np.repeat(np.arange(len(elements)), [len(own) for own in uv])
    located = LocatedSamples(scheme, elements, element, np.concatenate(uv), 0 * element)
    numbers, parameters = zip(*(_in_pieces(scheme, leaves) for leaves in located.leaves), strict=True)
    number, st = located.per_sample(numbers), located.per_sample(parameters).T
    # Samples of an element that lie in the same piece follow each other.
    order = np.lexsort((number, located.path, element))
    keys = np.stack([element, located.path, number])[:, order]
    begins = np.flatnonzero((np.diff(keys, axis=1, prepend=-2) != 0).any(axis=0))
    counts = np.diff(begins, append=len(order))
    has_plane = (number[order[begins]] < 0) | (counts < FEW_SAMPLES)
    in_planes = np.sort(order[np.repeat(has_plane, counts)])
    # A piece is found at the first of its samples. The sort is stable, so that these come in the order of elements.
    in_pieces, first = order[~np.repeat(has_plane, counts)], order[begins[~has_plane]]
    plane, piece = np.full((2, len(element)), -1)
    plane[in_planes] = np.arange(len(in_planes))
    piece[in_pieces] = np.repeat(np.arange(len(first)), counts[~has_plane])
    return (
        Polynomials(_planes(located.chosen(in_planes)), plane, 0 * st),
        Polynomials(_pieces(located.chosen(first)), piece, st),
    )


def _in_pieces(scheme: Scheme, leaves: Leaves) -> tuple[IntArray, FloatArray]:
    """Of the samples in some leaves, numbers of their pieces, -1 where they have planes; ``(2, n)`` parameters there.

    Parameters are from the middle of the domain.
    """
    local, number = leaves.uv, np.zeros(len(leaves.uv), dtype=np.int64)
    if leaves.patch is not None:
        level, child, local = locate(scheme.domain, leaves.uv)
        has_piece = (level < PIECE_LEVELS) & (scheme.domain.extent(leaves.uv) > 0)
        number = np.where(has_piece, LEVEL_PIECES * level + child, -1)
    return number, (local - scheme.domain.centre).T


def _planes(samples: LocatedSamples) -> list[FloatArray]:
    """Coefficients ``(p, 3, K)`` of a plane through each sample, for each element."""
    rows = samples.rows("stabilized", np.float64, 1)
    found = samples.weights([np.concatenate([each.rows[:1], each.tangents]) for each in rows])
    if rows:
        magnitude = samples.per_sample([frame_magnitude(*each) for each in zip(samples.leaves, rows, strict=True)])
        for own, at in zip(found, samples.slices(), strict=True):
            without_collapsed(own[:, 1:].swapaxes(0, 1), magnitude[:, at])
    return found


def _pieces(samples: LocatedSamples) -> list[FloatArray]:
    """Coefficients ``(p, m, K)`` of the piece that each sample lies in, for each element."""
    scheme, rows = samples.scheme, []
    for leaves in samples.leaves:
        if leaves.patch is None:
            matrix = polynomial_basis(scheme).matrix[:, None]
            rows.append(np.broadcast_to(matrix, (len(matrix), len(leaves.uv), matrix.shape[2])))
        else:
            polynomials = level_polynomials(scheme, leaves.patch, PIECE_LEVELS)
            rows.append(polynomials[_in_pieces(scheme, leaves)[0]].swapaxes(0, 1))
    return samples.weights(rows)
