"""Random points of a surface, uniform by area."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..mesh.connectivity import IntArray
from ..schemes.domain import FloatArray
from .polynomial_pieces import PolynomialPieces, SurfacePieces
from .surface_area import SurfaceAreas, largest_area_elements

# The bound of a piece's area elements is raised by this against rounding.
ROUNDED = 1 + 1e-9


@dataclass(frozen=True, eq=False)
class AreaSamples:
    """Random points of a surface.

    Attributes
    ----------
    element, corner : (s,) int64
        0-based, as for `LimitSurface.evaluate`.
    uv : (s, 2) float64
    p, n : (s, 3) float64
        Points and unit normals, see `SurfaceSamples`.
    dp_du, dp_dv : (s, 3) float64
    """

    element: IntArray
    corner: IntArray
    uv: FloatArray
    p: FloatArray
    n: FloatArray
    dp_du: FloatArray
    dp_dv: FloatArray


def uniform_locations(
    pieces: SurfacePieces, areas: SurfaceAreas, count: int, rng: np.random.Generator
) -> tuple[NDArray[np.int64], FloatArray]:
    """Random locations on a surface, uniform by area.

    A piece is chosen with a probability in proportion to its area. In the piece, samples that are uniform in parameters
    are accepted with the ratio of the area element to its bound. The surface beyond the measured levels around
    extraordinary points, some 10^-11 of it, is left out.

    Returns
    -------
    half_edge : (count,) int64
        The corner of an element where parameters begin, a half-edge of `PatchTable.elements`.
    uv : (count, 2) float64
    """
    flat = [areas.regular, *(each.ravel() for each in areas.tips)]
    until = np.cumsum(np.concatenate(flat))
    chosen = np.searchsorted(until, rng.random(count) * until[-1], side="right")
    half_edge, uv = np.empty(count, dtype=np.int64), np.empty((count, 2))
    for which, of_level, numbers in _chosen_pieces(pieces, areas, chosen):
        number, own = np.unique(numbers, return_inverse=True)
        used_pieces = of_level.chosen(number)
        local = _uniform_in_pieces(used_pieces, own, rng)
        half_edge[which] = used_pieces.half_edge[own]
        uv[which] = used_pieces.chosen(own).parameters(local)
    return half_edge, uv


def _chosen_pieces(
    pieces: SurfacePieces, areas: SurfaceAreas, chosen: IntArray
) -> list[tuple[IntArray, PolynomialPieces, IntArray]]:
    """Samples in the regular pieces, and at every level around extraordinary points; the pieces, and which of these."""
    at: IntArray = np.flatnonzero(chosen < len(pieces.regular))
    found: list[tuple[IntArray, PolynomialPieces, IntArray]] = [(at, pieces.regular, chosen[at])]
    begin = len(pieces.regular)
    for tips, of_tips in zip(pieces.tips, areas.tips, strict=True):
        within = np.flatnonzero((chosen >= begin) & (chosen < begin + of_tips.size))
        level, number = np.divmod(chosen[within] - begin, of_tips[0].size)
        for each in np.unique(level).tolist():
            of_level = level == each
            found.append((within[of_level], tips.level(each), number[of_level]))
        begin += of_tips.size
    return found


def _uniform_in_pieces(pieces: PolynomialPieces, which: IntArray, rng: np.random.Generator) -> FloatArray:
    """``(s, 2)`` parameters in pieces, uniform by area."""
    bound = ROUNDED * largest_area_elements(pieces)
    found, left = np.empty((len(which), 2)), np.arange(len(which))
    while len(left):
        uv = pieces.basis.domain.from_square(rng.random((len(left), 2)))
        own = which[left]
        keep = rng.random(len(left)) * bound[own] < _area_elements_at(pieces, own, uv)
        found[left[keep]] = uv[keep]
        left = left[~keep]
    return found


def _area_elements_at(pieces: PolynomialPieces, which: IntArray, uv: FloatArray) -> FloatArray:
    """``(s,)`` area elements, each at one location in one piece."""
    values = pieces.basis.values(uv)
    rows = np.stack([values @ each for each in pieces.basis.derivatives], axis=1)
    du, dv = (rows @ pieces.coefficients[which]).swapaxes(0, 1)
    return np.linalg.norm(np.cross(du, dv), axis=1)
