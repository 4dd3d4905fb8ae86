"""Polynomials over an element's one-ring that hold given samples, such as the vertices of a tessellation.

A sample lies in a regular piece, or in one of the regular pieces around an extraordinary point: a polynomial, whose
coefficients are rows times control points. Where few samples lie in a piece, each has a polynomial of its own instead,
the plane through its point along its two tangents, which has fewer coefficients. So have samples at extraordinary
points, and near them beyond the levels that are pieces.
"""

from __future__ import annotations

from functools import lru_cache
from typing import NamedTuple

import numpy as np

from ..mesh.connectivity import IntArray
from ..schemes.domain import FloatArray
from ..schemes.scheme import Scheme
from .divided_element import MOST_DEPTH, DividedElement, not_isolated
from .equations import locate, times
from .irregular_patch import IrregularPatch
from .patch_pieces import Piece
from .piece_tree import LEVEL_PIECES, PIECE_LEVELS, level_polynomials
from .polynomial_basis import polynomial_basis

# Fewer samples of a piece have planes.
FEW_SAMPLES = 4
# Exponents of the monomials of a plane.
PLANE_POWERS = np.array([(0, 0), (1, 0), (0, 1)])
# Polynomials of a piece are kept for no more samples. Those of 512 pieces of ordinary valences then take 32 MB.
MOST_KEPT = 100
# A sum of weights that is smaller than this part of its absolute terms is rounding, as on the fold between two faces
# back to back.
CANCELLED = 2.0**-48


class Polynomials(NamedTuple):
    """Polynomials of the same monomials, and the samples that they hold."""

    rows: FloatArray  # (p, m, K) float64: times control points, the coefficients of each
    sample: IntArray  # (n,) int64: which of the samples lie in them
    polynomial: IntArray  # (n,) int64: in which
    st: FloatArray  # (n, 2) float64: at which parameters, from the middle of the domain


# Planes, and polynomials of the scheme's `PolynomialBasis`.
Sampled = tuple[Polynomials, Polynomials]
# By elements and the bytes of parameters.
Known = dict[tuple[DividedElement, bytes], Sampled]


def sampled_polynomials(element: DividedElement, uv: FloatArray, known: Known, depth: int = 0) -> Sampled:
    """Planes and polynomials that hold samples ``(s, 2)`` of an element.

    Normals are along the cross product of the derivatives. Those of planes are tangents of any length.

    ``known`` keeps what was found: parts of elements have it in common. ``depth`` is how often this part was divided.
    Raises SchemeError if refinement does not separate the irregularities of the one-ring, or something always stays
    semi-sharp.
    """
    if depth > MOST_DEPTH:
        raise not_isolated(element.scheme, element.signature, depth)
    if element.piece is not None and len(uv) <= MOST_KEPT:
        return _kept(element.piece, element.scheme, uv.tobytes())
    key = element, uv.tobytes()
    if key not in known:
        if element.piece is None:
            known[key] = _of_children(element, uv, known, depth)
        else:
            known[key] = _of_piece(element.piece, element.scheme, uv)
    return known[key]


@lru_cache(maxsize=512)
def _kept(piece: Piece, scheme: Scheme, uv: bytes) -> Sampled:
    """Polynomials that are kept, because many shapes have the same pieces with the same samples."""
    return _of_piece(piece, scheme, np.frombuffer(uv).reshape(-1, 2))


def _of_piece(piece: Piece, scheme: Scheme, uv: FloatArray) -> Sampled:
    if piece.patch is None:
        return _of_regular(scheme, piece, uv)
    return _of_tip(scheme, piece, piece.patch, uv)


def _of_children(element: DividedElement, uv: FloatArray, known: Known, depth: int) -> Sampled:
    child, inner = np.zeros(len(uv), dtype=np.int64), uv.T
    if len(element.domains) > 1:
        child, inner = element.scheme.domain.first_child(uv.T)
    parts: list[list[Polynomials]] = [[], []]
    counts = [0, 0]
    for number in np.unique(child).tolist():
        own = np.flatnonzero(child == number)
        uv_below = np.ascontiguousarray(inner[:, own].T)
        below = sampled_polynomials(element.child_element(number), uv_below, known, depth + 1)
        for form, found in enumerate(below):
            if len(found.rows):
                rows = _times(found.rows, element.child(number)[1])
                parts[form].append(Polynomials(rows, own[found.sample], counts[form] + found.polynomial, found.st))
                counts[form] += len(rows)
    planes, others = (
        Polynomials(*map(np.concatenate, zip(*found, strict=True))) if found else _none(element.control_count)
        for found in parts
    )
    return planes, others


def _of_regular(scheme: Scheme, piece: Piece, uv: FloatArray) -> Sampled:
    every, none = np.arange(len(uv)), _none(piece.stencils.shape[1])
    if len(uv) < FEW_SAMPLES:
        rows = _times(scheme.regular_basis(uv, 1).swapaxes(0, 1), piece.stencils)
        return Polynomials(rows, every, every, 0 * uv), none
    basis = polynomial_basis(scheme)
    rows = _times(basis.matrix[None], piece.stencils)
    return none, Polynomials(rows, every, 0 * every, uv - basis.centre)


def _of_tip(scheme: Scheme, piece: Piece, patch: IrregularPatch, uv: FloatArray) -> Sampled:
    uv = piece.domain(uv)
    level, child, local = locate(scheme.domain, uv)
    number = LEVEL_PIECES * level + child
    # Samples at the point itself, and at deeper levels, have planes.
    has_piece = (level < PIECE_LEVELS) & (scheme.domain.extent(uv) > 0)
    counts = np.bincount(number[has_piece], minlength=LEVEL_PIECES * PIECE_LEVELS)
    has_piece[has_piece] = counts[number[has_piece]] >= FEW_SAMPLES
    in_planes, in_pieces = np.flatnonzero(~has_piece), np.flatnonzero(has_piece)
    planes = others = _none(piece.stencils.shape[1])
    if len(in_planes):
        found = patch.rows(uv[in_planes], "stabilized", np.float64)
        rows = np.concatenate([found.rows[:1], found.tangents]).swapaxes(0, 1)
        at = np.arange(len(in_planes))
        planes = Polynomials(_times(rows, piece.coordinates), in_planes, at, np.zeros((len(at), 2)))
    if len(in_pieces):
        pieces, at = np.unique(number[in_pieces], return_inverse=True)
        rows = level_polynomials(scheme, patch, PIECE_LEVELS)[pieces]
        st = local[in_pieces] - polynomial_basis(scheme).centre
        others = Polynomials(_times(rows, piece.coordinates), in_pieces, at, st)
    return planes, others


def _none(control_count: int) -> Polynomials:
    return Polynomials(
        np.empty((0, 0, control_count)), np.empty(0, dtype=np.int64), np.empty(0, dtype=np.int64), np.empty((0, 2))
    )


def _times(rows: FloatArray, matrix: FloatArray) -> FloatArray:
    """Rows ``(p, m, K')`` over the control points of a part, as rows over those of the element: times ``(K', K)``."""
    flat = np.ascontiguousarray(rows).reshape(1, -1, rows.shape[2])
    found = times(flat, matrix)
    found[np.abs(found) < CANCELLED * times(np.abs(flat), np.abs(matrix))] = 0
    return found.reshape(*rows.shape[:2], -1)
