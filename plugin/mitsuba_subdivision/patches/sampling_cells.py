"""Parts of a surface for sampling on a device, without rejection: every random number gives one point."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..mesh.connectivity import IntArray
from ..schemes.domain import FloatArray
from .polynomial_pieces import PolynomialPieces, SurfacePieces
from .surface_area import SurfaceAreas, largest_area_elements, piece_areas

# Pieces are halved until their area elements are nowhere larger than this, in means of the piece; but no more often.
UNEVEN, MOST_HALVINGS = 1.25, 3
# Around extraordinary points this many levels are cells of their own.
TIP_LEVELS = 2


@dataclass(frozen=True, eq=False)
class SamplingCells:
    """Parallelograms, or triangles, of parameters that cover a surface.

    Attributes
    ----------
    half_edge : (n,) int64
        The corner of an element where parameters begin, a half-edge of `PatchTable.elements`.
    matrices, offsets : (n, 2, 2), (n, 2) float64
        From the whole domain to the cell, in the element's parameters.
    areas : (n,) float64
        Of the surface there.
    """

    half_edge: IntArray
    matrices: FloatArray
    offsets: FloatArray
    areas: FloatArray

    @classmethod
    def build(cls, pieces: SurfacePieces, areas: SurfaceAreas) -> SamplingCells:
        """Cover a surface; around each extraordinary point beyond some levels with one cell."""
        parts = _even_parts(pieces.regular, areas.regular)
        for tips, of_tips in zip(pieces.tips, areas.tips, strict=True):
            for level in range(TIP_LEVELS):
                parts += _even_parts(tips.level(level), of_tips[level].ravel())
            scale = 2.0**-TIP_LEVELS
            parts.append((tips.half_edge, scale * tips.matrices, tips.offsets, of_tips[TIP_LEVELS:].sum(axis=(0, 1))))
        return cls(*(np.concatenate(column) for column in zip(*parts, strict=True)))


def _even_parts(
    pieces: PolynomialPieces, areas: FloatArray
) -> list[tuple[IntArray, FloatArray, FloatArray, FloatArray]]:
    """Columns of cells whose area elements vary little."""
    tolerance, parts = 1e-9 * float(areas.mean()) if len(areas) else 0.0, []
    for halving in range(MOST_HALVINGS + 1):
        is_even = pieces.basis.domain.area * largest_area_elements(pieces) <= UNEVEN * areas
        if halving == MOST_HALVINGS:
            is_even[:] = True
        done = pieces.chosen(is_even)
        parts.append((done.half_edge, done.matrices, done.offsets, areas[is_even]))
        pieces = pieces.chosen(~is_even).halved()
        areas = piece_areas(pieces, tolerance)
    return parts
