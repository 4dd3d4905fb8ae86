"""Areas of a surface, and random points that are uniform by area."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..evaluation.irregular_patch import IrregularPatch
from ..evaluation.polynomials import BernsteinBasis, times
from ..mesh.connectivity import IntArray
from ..schemes.domain import FloatArray
from .polynomial_pieces import PolynomialPieces, SurfacePieces

# Tolerance of the area, relative to it. Each piece gets its share, and the rounding error of its own area.
TOLERANCE, ROUNDED = 1e-12, 1e-14
# Points along each parameter: the change by the larger number is the error of the smaller one. A piece for which no
# pair is accurate is halved. Along the edge of a fold, where areas have a kink, this ends after so many times; it
# leaves some 10^-8 of the area of the pieces there.
ORDERS = ((2, 3), (3, 5), (5, 8))
MOST_HALVINGS = 10
# Around extraordinary points levels are measured until their areas have shrunk to this. From there on each level is
# smaller than the one before by the same factor: what this leaves is below the tolerance.
TAIL = 2.0**-36
# Pieces are measured in runs of this many points, whose arrays stay in a processor's cache; bounds of area elements are
# found in runs of this many pieces, which bounds temporary memory to some tens of megabytes.
MOST_POINTS, CHUNK = 1 << 14, 2048
# The bound of a piece's area elements is raised by this against rounding.
BOUND_ROUNDED = 1 + 1e-9
# Pieces are halved until their area elements are nowhere larger than this, in means of the piece; but no more often.
UNEVEN, CELL_HALVINGS = 1.25, 3
# Around extraordinary points this many levels are cells of their own.
TIP_LEVELS = 2


@dataclass(frozen=True, eq=False)
class SurfaceAreas:
    """Areas of a surface's pieces."""

    regular: FloatArray  # (n,) float64: of `SurfacePieces.regular`
    # tuple of (levels, 3, t) float64: for each of `SurfacePieces.tips`, of its levels and their regular pieces
    tips: tuple[FloatArray, ...]
    rest: float  # Of the surface beyond these levels

    @classmethod
    def of(cls, pieces: SurfacePieces) -> SurfaceAreas:
        """Measure a surface."""
        parts = [pieces.regular, *(tips.level(0) for tips in pieces.tips)]
        rough = sum(float(_measured(part, ORDERS[0])[1].sum()) for part in parts)
        count = len(pieces.regular) + sum(3 * _level_count(tips.patch) * len(tips) for tips in pieces.tips)
        tolerance = TOLERANCE * rough / count
        found, rest = [], 0.0
        for tips in pieces.tips:
            levels = range(_level_count(tips.patch))
            areas = np.stack([piece_areas(tips.level(level), tolerance) for level in levels])
            found.append(areas.reshape(len(levels), 3, -1))
            last, before = (found[-1][k].sum(axis=0) for k in (-1, -2))
            factor = np.divide(last, before, out=np.zeros_like(last), where=before > 0)
            rest += float((last * factor / (1 - np.minimum(factor, 1 / 2))).sum())
        return cls(piece_areas(pieces.regular, tolerance), tuple(found), rest)

    @property
    def total(self) -> float:
        """The area of the surface."""
        return float(self.regular.sum() + sum(each.sum() for each in self.tips) + self.rest)


def piece_areas(pieces: PolynomialPieces, tolerance: float) -> FloatArray:
    """``(n,)`` areas, each within a tolerance."""
    found = np.zeros(len(pieces))
    owner = np.arange(len(pieces))
    for halving in range(MOST_HALVINGS + 1):
        left = np.ones(len(pieces), dtype=bool)
        for orders in ORDERS:
            of_left = np.flatnonzero(left)
            rough, area = _measured(pieces if left.all() else pieces.chosen(of_left), orders)
            # Areas that are no number, of points beyond all measure, get no better.
            is_good = ~(np.abs(area - rough) > np.maximum(tolerance, ROUNDED * area))
            if halving == MOST_HALVINGS and orders == ORDERS[-1]:
                is_good[:] = True
            np.add.at(found, owner[of_left[is_good]], area[is_good])
            left[of_left[is_good]] = False
        if not left.any():
            break
        pieces, owner, tolerance = pieces.chosen(left).halved(), np.tile(owner[left], 4), tolerance / 4
    return found


def _area_elements(du: FloatArray, dv: FloatArray) -> FloatArray:
    """``(g, n)`` lengths of the cross products of vectors ``(g, 3, n)``."""
    # In units of the largest, so that squares neither overflow nor vanish.
    unit = max(np.abs(du).max(initial=0), np.abs(dv).max(initial=0)) or 1.0
    (a, b, c), (d, e, f) = (du / unit).swapaxes(0, 1), (dv / unit).swapaxes(0, 1)
    return unit * unit * np.sqrt((b * f - c * e) ** 2 + (c * d - a * f) ** 2 + (a * e - b * d) ** 2)


def _level_count(patch: IrregularPatch) -> int:
    """Number of levels that are measured."""
    return int(np.ceil(np.log(TAIL) / np.log(patch.basis.moduli[1] * patch.basis.moduli[2])))


def _measured(pieces: PolynomialPieces, orders: tuple[int, int]) -> FloatArray:
    """``(2, n)`` areas by fewer and by more points along each parameter."""
    (fewer, of_fewer), (more, of_more) = (pieces.basis.domain.quadrature(order) for order in orders)
    weights = np.zeros((2, len(fewer) + len(more)))
    weights[0, : len(fewer)], weights[1, len(fewer) :] = of_fewer, of_more
    du, dv = pieces.basis.values(np.concatenate([fewer, more])) @ pieces.basis.derivatives
    found = np.empty((2, len(pieces)))
    for at, columns in pieces.runs(MOST_POINTS // len(du)):
        found[:, at] = weights @ _area_elements(times(du, columns), times(dv, columns))
    return found


def largest_area_elements(pieces: PolynomialPieces) -> FloatArray:
    """``(n,)`` bounds of `area_elements` over all of each piece.

    The cross product of the derivatives is a polynomial, and no longer than its longest Bernstein coefficient.
    """
    basis = BernsteinBasis(pieces.basis.domain, 2 * pieces.basis.degree)
    values = pieces.basis.values(basis.indices / basis.degree)
    found = np.empty(len(pieces))
    for at in np.split(np.arange(len(pieces)), range(CHUNK, len(pieces), CHUNK)):
        du, dv = ((values @ each) @ pieces.coefficients[at] for each in pieces.basis.derivatives)
        found[at] = np.linalg.norm(basis.coefficients(np.cross(du, dv)), axis=2).max(axis=1)
    return found


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

    Returns ``half_edge``, (count,) int64: the corner of an element where parameters begin, a half-edge of
    `PatchTable.elements`; and ``uv``, (count, 2) float64.
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
    bound = BOUND_ROUNDED * largest_area_elements(pieces)
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


@dataclass(frozen=True, eq=False)
class SamplingCells:
    """Parallelograms, or triangles, of parameters that cover a surface."""

    # (n,) int64: the corner of an element where parameters begin, a half-edge of `PatchTable.elements`
    half_edge: IntArray
    # (n, 2, 2), (n, 2) float64: from the whole domain to the cell, in the element's parameters
    matrices: FloatArray
    offsets: FloatArray
    areas: FloatArray  # (n,) float64: of the surface there

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
    for halving in range(CELL_HALVINGS + 1):
        is_even = pieces.basis.domain.area * largest_area_elements(pieces) <= UNEVEN * areas
        if halving == CELL_HALVINGS:
            is_even[:] = True
        done = pieces.chosen(is_even)
        parts.append((done.half_edge, done.matrices, done.offsets, areas[is_even]))
        pieces = pieces.chosen(~is_even).halved()
        areas = piece_areas(pieces, tolerance)
    return parts
