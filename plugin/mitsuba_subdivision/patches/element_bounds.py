"""Boxes of elements that contain the limit surface, also as evaluated in single precision."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from ..evaluation.bernstein import BernsteinBasis, times
from ..mesh.connectivity import IntArray, Topology
from ..schemes.domain import FloatArray
from .polynomial_pieces import PolynomialPieces, SurfacePieces

# Every element is divided this often, so into 8 by 8 parts, before the coefficients of the parts bound it. A box is
# then larger than the tight one by some percent of the bend of a part, which is a 64th of the element's.
HALVINGS = 3
# Single precision rounds control points, and sums relative to one of them: so many units of the last place of the
# largest coordinate. The most that was measured are seven, around a face of 50 corners.
UNITS, UNIT = 16, 2.0**-24
# Pieces are divided in runs of this many, which bounds temporary memory to some megabytes.
CHUNK = 128


@dataclass(frozen=True, eq=False)
class ElementBounds:
    """Boxes with sides along the axes, each around the surface over one element.

    Attributes
    ----------
    element : (e,) int64
        0-based, as for `LimitSurface.evaluate`.
    lower, upper : (e, 3) float64
        Opposite corners of the boxes, in the cage's space.
    """

    element: IntArray
    lower: FloatArray
    upper: FloatArray


def element_bounds(pieces: SurfacePieces, elements: Topology) -> tuple[FloatArray, FloatArray]:
    """Corners ``(n_e, 3)`` of boxes around all elements; inverted and infinite where there is no element.

    Parameters
    ----------
    elements : Topology
        `PatchTable.elements`.
    """
    lower, upper = np.full_like(pieces.sizes, np.inf), np.full_like(pieces.sizes, -np.inf)

    def widen(half_edge: IntArray, low: FloatArray, high: FloatArray) -> None:
        element = elements.face_of(half_edge)
        np.minimum.at(lower, element, low)
        np.maximum.at(upper, element, high)

    def widen_by(part: PolynomialPieces) -> None:
        halvings = np.maximum(HALVINGS - _halvings_before(part), 0)
        for count in np.unique(halvings).tolist():
            which = np.flatnonzero(halvings == count)
            divide = _divided(part.basis, count)
            chosen = part.chosen(which)
            for at, columns in chosen.runs(CHUNK):
                divided, origins = times(divide, columns), chosen.origins[at]
                widen(chosen.half_edge[at], origins + divided.min(axis=0).T, origins + divided.max(axis=0).T)

    widen_by(pieces.regular)
    for tips in pieces.tips:
        for level in range(tips.bounded_levels):
            widen_by(tips.level(level))
        reach = tips.reach(tips.bounded_levels)
        widen(tips.half_edge, tips.points - reach, tips.points + reach)
    rounded = UNITS * UNIT * pieces.sizes
    return lower - rounded, upper + rounded


def _halvings_before(pieces: PolynomialPieces) -> IntArray:
    """``(n,)`` number of halvings of the element that make each piece."""
    size = np.sqrt(np.abs(np.linalg.det(pieces.matrices)))
    return np.rint(-np.log2(size)).astype(np.int64)


@lru_cache(maxsize=64)
def _divided(basis: BernsteinBasis, count: int) -> FloatArray:
    """``(c, b)`` map from coefficients to all different ones of the parts after so many halvings."""
    found: FloatArray = np.eye(len(basis.indices))[None]
    for _ in range(count):
        found = np.concatenate([half @ found for half in basis.halves])
    # Neighbouring parts share coefficients.
    return np.unique(found.reshape(-1, found.shape[2]).round(14), axis=0)
