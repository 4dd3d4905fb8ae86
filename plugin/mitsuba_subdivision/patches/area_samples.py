"""Area of a surface, and random points that are uniform by area."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..evaluation.polynomials import BernsteinBasis, times
from ..mesh.connectivity import IntArray
from ..schemes.domain import FloatArray
from .polynomial_pieces import PolynomialPieces, SurfacePieces, Tips

# Relative tolerance of the surface's area, divided evenly among the pieces; relative rounding error of a piece's area.
TOLERANCE, ROUNDED = 1e-12, 1e-14
# Pairs of numbers of Gauss nodes along each parameter. The difference of the two areas is the error estimate. A piece
# for which no pair is accurate is halved, at most MOST_HALVINGS times: along a fold, where area elements have a kink,
# this leaves an error of about 1e-8 of the area of the pieces there.
ORDERS = ((2, 3), (3, 5), (5, 8))
MOST_HALVINGS = 10
# Area of a level around an extraordinary point, relative to the first, down to which levels are measured. The areas of
# later levels form a geometric series with an error below the tolerance.
TAIL = 2.0**-36
# Points per run when measuring areas, whose arrays stay in a processor's cache; and pieces per run when bounding area
# elements, which bounds temporary memory to some tens of megabytes.
MOST_POINTS, CHUNK = 1 << 14, 2048
# Factor that protects the bound of area elements from rounding.
BOUND_ROUNDED = 1 + 1e-9
# Largest area element of a sampling cell, relative to its mean, above which pieces are halved; and most halvings.
UNEVEN, CELL_HALVINGS = 1.25, 3
# Levels around extraordinary points whose pieces are sampling cells. One more cell covers the deeper levels of a tip.
TIP_LEVELS = 2


def surface_areas(pieces: SurfacePieces) -> tuple[list[FloatArray], float]:
    """Areas of the pieces of `SurfacePieces.parts` for `level_count`, and of all that is beyond these levels."""
    first_parts = pieces.parts(lambda _: 1)
    rough = sum(float(_measured(part(), ORDERS[0])[1].sum()) for part in first_parts)
    count = len(pieces.regular) + sum(3 * level_count(tips) * len(tips) for tips in pieces.tips)
    tolerance = TOLERANCE * rough / count
    areas, rest = [piece_areas(part(), tolerance) for part in pieces.parts(level_count)], 0.0
    end = 1
    for tips in pieces.tips:
        end += level_count(tips)
        before, last = (level_areas.reshape(3, -1).sum(axis=0) for level_areas in areas[end - 2 : end])
        factor = np.divide(last, before, out=np.zeros_like(last), where=before > 0)
        rest += float((last * factor / (1 - np.minimum(factor, 1 / 2))).sum())
    return areas, rest


def piece_areas(pieces: PolynomialPieces, tolerance: float) -> FloatArray:
    """``(n,)`` areas, each within ``tolerance``."""
    areas = np.zeros(len(pieces))
    owner = np.arange(len(pieces))
    for halving in range(MOST_HALVINGS + 1):
        left = np.ones(len(pieces), dtype=bool)
        for orders in ORDERS:
            left_indices = np.flatnonzero(left)
            rough, area = _measured(pieces if left.all() else pieces.chosen(left_indices), orders)
            # Written so that areas that are not a number, by overflow, are accepted: halving does not improve them.
            is_good = ~(np.abs(area - rough) > np.maximum(tolerance, ROUNDED * area))
            if halving == MOST_HALVINGS and orders == ORDERS[-1]:
                is_good[:] = True
            np.add.at(areas, owner[left_indices[is_good]], area[is_good])
            left[left_indices[is_good]] = False
        if not left.any():
            break
        pieces, owner, tolerance = pieces.chosen(left).halved(), np.tile(owner[left], 4), tolerance / 4
    return areas


def _area_elements(du: FloatArray, dv: FloatArray) -> FloatArray:
    """``(g, n)`` lengths of the cross products of vectors ``(g, 3, n)``."""
    # Relative to the largest component, so that squares neither overflow nor underflow.
    unit = max(np.abs(du).max(initial=0), np.abs(dv).max(initial=0)) or 1.0
    (a, b, c), (d, e, f) = (du / unit).swapaxes(0, 1), (dv / unit).swapaxes(0, 1)
    return unit * unit * np.sqrt((b * f - c * e) ** 2 + (c * d - a * f) ** 2 + (a * e - b * d) ** 2)


def level_count(tips: Tips) -> int:
    """Number of levels whose areas are measured, see `TAIL`."""
    moduli = tips.patch.basis.moduli
    return int(np.ceil(np.log(TAIL) / np.log(moduli[1] * moduli[2])))


def _measured(pieces: PolynomialPieces, orders: tuple[int, int]) -> FloatArray:
    (coarse, coarse_weights), (fine, fine_weights) = (pieces.basis.domain.quadrature(order) for order in orders)
    weights = np.zeros((2, len(coarse) + len(fine)))
    weights[0, : len(coarse)], weights[1, len(coarse) :] = coarse_weights, fine_weights
    du, dv = pieces.basis.values(np.concatenate([coarse, fine])) @ pieces.basis.derivatives
    areas = np.empty((2, len(pieces)))
    for run, columns in pieces.runs(MOST_POINTS // len(du)):
        areas[:, run] = weights @ _area_elements(times(du, columns), times(dv, columns))
    return areas


def largest_area_elements(pieces: PolynomialPieces) -> FloatArray:
    """``(n,)`` upper bounds of area elements: the longest Bernstein coefficient of the derivatives' cross product."""
    basis = BernsteinBasis(pieces.basis.domain, 2 * pieces.basis.degree)
    values = pieces.basis.values(basis.indices / basis.degree)
    bounds = np.empty(len(pieces))
    for run in np.split(np.arange(len(pieces)), range(CHUNK, len(pieces), CHUNK)):
        du, dv = ((values @ derivative) @ pieces.coefficients[run] for derivative in pieces.basis.derivatives)
        bounds[run] = np.linalg.norm(basis.coefficients(np.cross(du, dv)), axis=2).max(axis=1)
    return bounds


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
    pieces: SurfacePieces,
    areas: Sequence[FloatArray],  # `surface_areas`
    count: int,
    rng: np.random.Generator,
) -> tuple[NDArray[np.int64], FloatArray]:
    """Draw half-edges of `PatchTable.elements` and parameters ``(count, 2)`` from there, uniform by area.

    A piece is chosen with a probability proportional to its area. Within the piece, rejection sampling accepts uniform
    parameters with the ratio of the area element to its bound. The levels around extraordinary points that are not
    measured, about 1e-11 of the surface, are left out.
    """
    cumulative = np.cumsum(np.concatenate(areas))
    chosen = np.searchsorted(cumulative, rng.random(count) * cumulative[-1], side="right")
    half_edge, uv = np.empty(count, dtype=np.int64), np.empty((count, 2))
    bounds = np.cumsum([0, *map(len, areas)])
    for part, begin, end in zip(pieces.parts(level_count), bounds[:-1], bounds[1:], strict=True):
        samples = np.flatnonzero((chosen >= begin) & (chosen < end))
        if len(samples):
            used, used_index = np.unique(chosen[samples] - begin, return_inverse=True)
            used_pieces = part().chosen(used)
            uv_in_piece = _uniform_in_pieces(used_pieces, used_index, rng)
            half_edge[samples] = used_pieces.half_edge[used_index]
            uv[samples] = used_pieces.chosen(used_index).parameters(uv_in_piece)
    return half_edge, uv


def _uniform_in_pieces(pieces: PolynomialPieces, which: IntArray, rng: np.random.Generator) -> FloatArray:
    bound = BOUND_ROUNDED * largest_area_elements(pieces)
    accepted_uv, left = np.empty((len(which), 2)), np.arange(len(which))
    while len(left):
        uv = pieces.basis.domain.from_square(rng.random((len(left), 2)))
        piece, values = which[left], pieces.basis.values(uv)
        rows = np.stack([values @ derivative for derivative in pieces.basis.derivatives], axis=1)
        du, dv = (rows @ pieces.coefficients[piece]).swapaxes(0, 1)
        is_accepted = rng.random(len(left)) * bound[piece] < np.linalg.norm(np.cross(du, dv), axis=1)
        accepted_uv[left[is_accepted]] = uv[is_accepted]
        left = left[~is_accepted]
    return accepted_uv


@dataclass(frozen=True, eq=False)
class SamplingCells:
    """Parallelograms, or triangles, of the parameter domains that together cover a surface."""

    # (n,) int64: the corner of an element at which parameters start, a half-edge of `PatchTable.elements`
    half_edge: IntArray
    # (n, 2, 2), (n, 2) float64: affine maps from the whole domain to the cell, in the element's parameters
    matrices: FloatArray
    offsets: FloatArray
    areas: FloatArray  # (n,) float64: area of the surface over each cell

    @classmethod
    def build(
        cls,
        pieces: SurfacePieces,
        areas: Sequence[FloatArray],  # `surface_areas`
    ) -> SamplingCells:
        """Cover a surface with cells; one cell covers all levels from `TIP_LEVELS` on around an extraordinary point."""
        (regular, *levels), scale, end = areas, 2.0**-TIP_LEVELS, 0
        parts = _even_parts(pieces.regular, regular)
        for tips in pieces.tips:
            begin, end = end, end + level_count(tips)
            for level in range(TIP_LEVELS):
                parts += _even_parts(tips.level(level), levels[begin + level])
            deeper = np.sum(levels[begin + TIP_LEVELS : end], axis=0).reshape(3, -1).sum(axis=0)
            parts.append((tips.half_edge, scale * tips.matrices, tips.offsets, deeper))
        return cls(*(np.concatenate(column) for column in zip(*parts, strict=True)))


def _even_parts(
    pieces: PolynomialPieces, areas: FloatArray
) -> list[tuple[IntArray, FloatArray, FloatArray, FloatArray]]:
    """Halve pieces into cells whose area elements vary little. Returns lists of fields of `SamplingCells`."""
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
