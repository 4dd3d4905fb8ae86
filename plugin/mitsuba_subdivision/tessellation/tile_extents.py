"""Tests by branch and bound whether the extent of the surface over tiles, along axes, is within a limit.

Tiles are divided, all together, and parts of equal structure of different tiles together. Corners of parts are points
of the surface. The hull of a piece's Bernstein coefficients contains it, and the hull of a part's control points the
part, if the scheme's rules are convex. A tile is decided as soon as its points extend too far, or all of its parts are
near enough to these; only undecided parts are divided further. Sums are in single precision, in units of a tile's
largest control point.
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

# Parts left after so many divisions are bounded by control points or, if the rules are not convex, as small as the
# rounding of single precision.
MOST_DIVISIONS = {True: 12, False: 40}
# Levels around an extraordinary point that are divided together: in each of the first divisions, and then, as few tiles
# are left; and of curves, which have few coefficients.
LEVELS_TOGETHER, LATER_TOGETHER, CURVES_TOGETHER = (1, 1, 2), 4, 8
# What single precision may leave of an extent, in parts of a tile's largest control point. Rows of weights and of
# eigenvectors multiply its rounding by some hundreds.
ROUNDING = 2.0**-14


class TileParts(NamedTuple):
    """Parts of tiles with the same subdivision."""

    tile: DividedTile
    values: FloatArray  # (K, d, p) float: coordinates of their control points, along d axes
    owner: IntArray  # (p,) int64: the tile, or side of a tile, that each belongs to
    side: int | None = None  # The corner that a side begins at, if only the curve along that is asked for

    def chosen(self, which: NDArray[np.bool_]) -> TileParts:
        """Some of the parts."""
        if which.all():
            return self
        chosen = np.flatnonzero(which)
        return self._replace(values=self.values.take(chosen, axis=2), owner=self.owner[chosen])


def alike(parts: list[TileParts]) -> list[TileParts]:
    """The same parts, those with the same subdivision merged."""
    found: dict[tuple[DividedTile, int | None], list[TileParts]] = {}
    for part in parts:
        found.setdefault((part.tile, part.side), []).append(part)
    return [
        own[0]
        if len(own) == 1
        else own[0]._replace(
            values=np.concatenate([each.values for each in own], axis=2),
            owner=np.concatenate([each.owner for each in own]),
        )
        for own in found.values()
    ]


def fit_within(scheme: Scheme, limit: FloatArray, tiles: list[TileParts]) -> NDArray[np.bool_]:
    """Whether the extents of the surface over tiles are within their limits.

    Returns (n,) bool: never true where it does not fit.

    Parameters
    ----------
    limit : (n,) float64
        How far the surface over each tile may extend: along one axis, or the size of a box of several; negative where
        it may not.
    tiles : list of TileParts
        Each tile as one part.
    """
    if not tiles:
        return np.zeros(len(limit), dtype=bool)
    is_convex, axis_count = scheme.has_convex_rules, tiles[0].values.shape[1]
    points, hulls = _Extents(axis_count, len(limit)), _Extents(axis_count, len(limit))
    waiting = []
    limit = limit.copy()
    for part in tiles:
        values, largest = _relative(part)
        limit[part.owner] = limit[part.owner] / largest - ROUNDING
        waiting.append(part._replace(values=values))
    for division in range(MOST_DIVISIONS[is_convex]):
        is_last = division == MOST_DIVISIONS[is_convex] - 1
        levels = LEVELS_TOGETHER[division] if division < len(LEVELS_TOGETHER) else LATER_TOGETHER
        # With boxes around their control points.
        below: list[tuple[TileParts, _Child, FloatArray, FloatArray]] = []
        for part in alike(waiting):
            divided = _divided(scheme, part.tile, part.side, levels if part.side is None else CURVES_TOGETHER)
            found = times(divided.rows, part.values)
            points.add(part.owner, found[: divided.point_count])
            if divided.hull_count > divided.point_count:
                hulls.add(part.owner, found[divided.point_count : divided.hull_count])
            for child in divided.children:
                below.append((part, child, found[child.ring].min(axis=0), found[child.ring].max(axis=0)))
        low, high = points.box()
        size = np.linalg.norm(np.maximum(0, high - low), axis=0)
        # Margin within which parts keep a tile's extent below its limit; negative if its points exceed it already.
        slack = (limit - size) / (2 * np.sqrt(axis_count))
        low, high = np.where(slack >= 0, low - slack, np.inf), np.where(slack >= 0, high + slack, -np.inf)
        if not below:
            break
        owner = np.concatenate([part.owner for part, *_ in below])
        is_left = slack[owner] >= 0
        if is_convex or is_last:
            ring_low, ring_high = (np.concatenate(each, axis=1) for each in list(zip(*below, strict=True))[2:])
            is_near = ((ring_low >= low[:, owner]) & (ring_high <= high[:, owner])).all(axis=0)
            is_done = is_left & (is_near | is_last)
            hulls.add_boxes(owner[is_done], ring_low[:, is_done], ring_high[:, is_done])
            is_left &= ~is_done
        waiting, ends = [], np.cumsum([len(part.owner) for part, *_ in below])
        for (part, child, *_), chosen in zip(below, np.split(is_left, ends[:-1]), strict=True):
            at = np.flatnonzero(chosen)
            if len(at):
                values = times(child.rows, part.values.take(at, axis=2))
                waiting.append(TileParts(child.tile, values, part.owner[at], part.side))
    (low, high), (hull_low, hull_high) = points.box(), hulls.box()
    size = np.linalg.norm(np.maximum(high, hull_high) - np.minimum(low, hull_low), axis=0)
    found_fit: NDArray[np.bool_] = size <= limit
    return found_fit


def _relative(part: TileParts) -> tuple[NDArray[np.float32], FloatArray]:
    """Control points of tiles seen from one of them, in units ``(p,)`` of the largest of each; and these units."""
    values = part.values - part.values[0]
    if part.tile.is_self_similar:
        # Of eigen-coordinates only the first one, the extraordinary point itself, depends on the origin.
        values[1:] = part.values[1:]
    largest = np.abs(values).max(axis=(0, 1))
    largest[largest == 0] = 1
    return (values / largest).astype(np.float32), largest


class _Child(NamedTuple):
    """A part of a tile that is divided further: its control points over those of the tile, and their rows."""

    tile: DividedTile
    rows: NDArray[np.float32]
    ring: slice


class _Division(NamedTuple):
    """A tile divided, or a side of it."""

    # (r, K) float32: over the control points of the tile: points of the surface, at corners of the tile and of
    # pieces; all other Bernstein coefficients of pieces, or of curves; and one-rings of the children
    rows: NDArray[np.float32]
    # Where the first two kinds of rows end
    point_count: int
    hull_count: int
    children: list[_Child]  # Parts that are no pieces


@lru_cache(maxsize=4096)
def _divided(scheme: Scheme, tile: DividedTile, side: int | None, levels: int) -> _Division:
    """Divide a tile once; around an extraordinary point, several levels at once."""
    basis = regular_bernstein(scheme).basis
    corners = range(scheme.domain.corner_count) if side is None else _ends(scheme, side)
    chosen = np.arange(len(basis.indices)) if side is None else basis.sides[side]
    below, pieces = [(tile, np.eye(tile.control_count))], []
    for _ in range(levels if tile.is_self_similar else 1):
        # Copies of a domain at its corners come first, and share the sides that meet there.
        copies = range(4) if side is None else corners
        parts = [(own.children[number], rows) for own, rows in below for number in copies]
        pieces += [own[chosen] @ rows for (child, own), rows in parts if child is None]
        below = [(child, own @ rows) for (child, own), rows in parts if child is not None]
    is_point = np.isin(chosen, basis.corners)
    points = [tile.corners[list(corners)], *(each[is_point] for each in pieces)]
    blocks, children = [*points, *(each[~is_point] for each in pieces)], []
    ends = np.cumsum([len(each) for each in blocks])
    end = int(ends[-1])
    for child, rows in below:
        blocks.append(child.one_ring_points(rows))
        children.append(_Child(child, rows.astype(np.float32), slice(end, end + len(blocks[-1]))))
        end += len(blocks[-1])
    return _Division(np.concatenate(blocks).astype(np.float32), int(ends[len(points) - 1]), int(ends[-1]), children)


def _ends(scheme: Scheme, side: int) -> list[int]:
    return [side, (side + 1) % scheme.domain.corner_count]


class _Extents:
    """Boxes around what is added to ``n`` tiles, along some axes."""

    def __init__(self, axis_count: int, count: int) -> None:
        self._low = np.full((axis_count, count), np.inf, dtype=np.float32)
        self._high = -self._low
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
