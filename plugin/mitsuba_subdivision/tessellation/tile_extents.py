"""Tests by branch and bound whether the extent of the surface over tiles, along axes, is within a limit.

The test starts from points at the tiles' corners. Tiles are then divided, all together, and parts of equal structure of
different tiles together: the hull of a piece's Bernstein coefficients contains it. A part that is not divided further
lies within the hull of its control points, if the scheme's rules are convex. A tile is decided as soon as its points
extend too far, or all of its parts are near enough to these; only undecided tiles are divided.
"""

from __future__ import annotations

from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..evaluation.bernstein import regular_bernstein, times
from ..evaluation.divided_tile import DividedTile
from ..mesh.connectivity import IntArray
from ..schemes.domain import FloatArray
from ..schemes.scheme import Scheme
from ..schemes.scheme_members import optional_member

# Parts left after so many divisions are bounded by control points or, if the rules are not convex, as small as the
# rounding of single precision.
MOST_DIVISIONS = {True: 12, False: 40}


class TileParts(NamedTuple):
    """Parts of tiles with the same subdivision.

    Attributes
    ----------
    tile : DividedTile
    values : (K, d, p) float64
        Coordinates of their control points, along d axes.
    owner : (p,) int64
        The tile, or side of a tile, that each belongs to.
    side : int or None
        The corner that a side begins at, if only the curve along that is asked for.
    """

    tile: DividedTile
    values: FloatArray
    owner: IntArray
    side: int | None = None


def fit_within(scheme: Scheme, limit: FloatArray, tiles: list[TileParts]) -> NDArray[np.bool_]:
    """Whether the extents of the surface over tiles are within their limits.

    Parameters
    ----------
    scheme : Scheme
    limit : (n,) float64
        How far the surface over each tile may extend: along one axis, or the size of a box of several; negative where
        it may not.
    tiles : list of TileParts
        Each tile as one part.

    Returns
    -------
    (n,) bool
        Never true where it does not fit.
    """
    if not tiles:
        return np.zeros(len(limit), dtype=bool)
    is_convex, axis_count = bool(optional_member(scheme, "has_convex_rules")), tiles[0].values.shape[1]
    points, hulls = _Extents(axis_count, len(limit)), _Extents(axis_count, len(limit))
    waiting: dict[tuple[DividedTile, int | None], list[TileParts]] = {}
    for part in tiles:
        corners = part.tile.corners if part.side is None else part.tile.corners[_ends(scheme, part.side)]
        points.add(part.owner, times(corners, part.values))
        waiting.setdefault((part.tile, part.side), []).append(part)
    for division in range(MOST_DIVISIONS[is_convex] + 1):
        is_last = division == MOST_DIVISIONS[is_convex]
        low, high = points.box()
        size = np.linalg.norm(np.maximum(0, high - low), axis=0)
        # Margin within which parts keep a tile's extent below its limit; negative if its points exceed it already.
        slack = (limit - size) / (2 * np.sqrt(axis_count))
        low, high = np.where(slack >= 0, low - slack, np.inf), np.where(slack >= 0, high + slack, -np.inf)
        divided: dict[tuple[DividedTile, int | None], list[TileParts]] = {}
        for (tile, side), parts in waiting.items():
            values, owner = _joined(parts)
            is_left = slack[owner] >= 0
            if is_convex or is_last:
                ring = tile.one_ring_points(values)
                ring_low, ring_high = ring.min(axis=0), ring.max(axis=0)
                is_done = is_left & ((ring_low >= low[:, owner]) & (ring_high <= high[:, owner])).all(axis=0)
                if is_last:
                    is_done = is_left
                hulls.add_boxes(owner[is_done], ring_low[:, is_done], ring_high[:, is_done])
                is_left &= ~is_done
            if not is_left.all():
                values, owner = values[..., is_left], owner[is_left]
            if not len(owner):
                continue
            below, ends, coefficients = _divided(scheme, tile, side)
            if len(coefficients):
                found = times(coefficients, values)
                points.add(owner, found[ends])
                hulls.add(owner, found)
            for child, rows in below:
                divided.setdefault((child, side), []).append(TileParts(child, times(rows, values), owner, side))
        if not divided:
            break
        waiting = divided
    (low, high), (hull_low, hull_high) = points.box(), hulls.box()
    size = np.linalg.norm(np.maximum(high, hull_high) - np.minimum(low, hull_low), axis=0)
    found_fit: NDArray[np.bool_] = size <= limit
    return found_fit


def _joined(parts: list[TileParts]) -> tuple[FloatArray, IntArray]:
    if len(parts) == 1:
        return parts[0].values, parts[0].owner
    return np.concatenate([each.values for each in parts], axis=2), np.concatenate([each.owner for each in parts])


def _ends(scheme: Scheme, side: int) -> list[int]:
    return [side, (side + 1) % scheme.domain.corner_count]


@lru_cache(maxsize=4096)
def _divided(
    scheme: Scheme, tile: DividedTile, side: int | None
) -> tuple[list[tuple[DividedTile, FloatArray]], list[int], FloatArray]:
    """The copies of a tile, or those along a side.

    Returns
    -------
    below : list of DividedTile and (n, K) float64
        Copies that are divided further, and their control points over those of the tile.
    ends : list of int
        Which of the coefficients are points of the surface.
    coefficients : (c, K) float64
        Bernstein coefficients of all other copies, or of curves.
    """
    basis = regular_bernstein(scheme).basis
    # Copies of a domain at its corners come first, and share the sides that meet there.
    children = tile.children if side is None else [tile.children[number] for number in _ends(scheme, side)]
    below = [(child, rows) for child, rows in children if child is not None]
    chosen = np.arange(len(basis.indices)) if side is None else basis.sides[side]
    at_ends = np.isin(chosen, basis.corners)
    pieces = [rows[chosen] for child, rows in children if child is None]
    ends = np.flatnonzero(np.tile(at_ends, len(pieces))).tolist()
    return below, ends, np.concatenate(pieces) if pieces else np.empty((0, tile.control_count))


class _Extents:
    """Boxes around what is added to ``n`` tiles, along some axes."""

    def __init__(self, axis_count: int, count: int) -> None:
        self._low, self._high = np.full((axis_count, count), np.inf), np.full((axis_count, count), -np.inf)
        self._added: list[tuple[IntArray, FloatArray, FloatArray]] = []

    def add(self, owner: IntArray, points: FloatArray) -> None:
        """Take points ``(p, d, n)`` of tiles into account."""
        self.add_boxes(owner, points.min(axis=0), points.max(axis=0))

    def add_boxes(self, owner: IntArray, low: FloatArray, high: FloatArray) -> None:
        """Take boxes ``(d, n)`` in tiles into account."""
        self._added.append((owner, low, high))

    def box(self) -> tuple[FloatArray, FloatArray]:
        """``(d, n)`` least and largest coordinates of all that was added."""
        if self._added:
            # All at once, as tiles of many kinds are few of each.
            owner, low, high = (np.concatenate(each, axis=-1) for each in zip(*self._added, strict=True))
            for axis in range(len(low)):
                np.minimum.at(self._low[axis], owner, low[axis])
                np.maximum.at(self._high[axis], owner, high[axis])
            self._added.clear()
        return self._low, self._high
