"""How far the surface over tiles extends along axes: whether it fits into a limit, by branch and bound.

What is known at first are points at the tiles' corners. Then tiles are divided, all together, and so are parts of equal
structure of different tiles: pieces have Bernstein coefficients, whose hull contains them. A part that is not divided
further lies within the hull of its control points, if the scheme's rules are convex. So a tile is done with as soon as
its points extend too far, or all of its parts are near enough to these; only what is left is divided.
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
from ..schemes.members import optional_member
from ..schemes.scheme import Scheme

# What is left after so many divisions is bounded by control points or, if the rules are not convex, as small as the
# rounding of single precision.
MOST_DIVISIONS = {True: 12, False: 40}


class TileValues(NamedTuple):
    """Coordinates of the control points of tiles that are divided alike, along d axes.

    Attributes
    ----------
    tile : DividedTile
    values : (K, d, t) float64
    limit : (t,) float64
        How far the surface may extend: along one axis, or the size of a box of several; negative where it may not.
    side : int or None
        The corner that a side begins at, if only the curve along that is asked for.
    """

    tile: DividedTile
    values: FloatArray
    limit: FloatArray
    side: int | None = None


class _Parts(NamedTuple):
    """Parts of tiles that are divided alike: their control points ``(K, d, n)``, and whose parts they are."""

    values: FloatArray
    owner: IntArray


class _LookedAt(NamedTuple):
    """What of a tile is looked at: all of it, or the curve along a side.

    Attributes
    ----------
    corners, children : list of int
    ends, coefficients : list of int
        Of the Bernstein coefficients of pieces, those that are points of the surface, and all.
    """

    corners: list[int]
    children: list[int]
    ends: list[int]
    coefficients: list[int]


@lru_cache(maxsize=64)
def _part_looked_at(scheme: Scheme, side: int | None) -> _LookedAt:
    basis, corner_count = regular_bernstein(scheme).basis, scheme.domain.corner_count
    if side is None:
        corners, children, coefficients = (
            range(corner_count),
            range(len(scheme.domain.children)),
            range(len(basis.indices)),
        )
        return _LookedAt([*corners], [*children], basis.corners.tolist(), [*coefficients])
    # Copies of a domain at its corners come first, and share the sides that meet there.
    ends = [side, (side + 1) % corner_count]
    return _LookedAt(ends, ends, basis.corners[ends].tolist(), basis.sides[side].tolist())


class _Extents:
    """How far the surface over ``n`` tiles extends at least, and at most as far as that was looked at.

    Parameters
    ----------
    axis_count : int
    limit : (n,) float64
    """

    def __init__(self, axis_count: int, limit: FloatArray) -> None:
        shape = axis_count, len(limit)
        self._limit = limit
        self._known = np.full(shape, np.inf), np.full(shape, -np.inf)
        self._bound = np.full(shape, np.inf), np.full(shape, -np.inf)

    def add_points(self, owner: IntArray, points: FloatArray) -> None:
        """Take points of the surface, ``(p, d, n)``, into account."""
        _extend(self._known, owner, points)

    def add_hulls(self, owner: IntArray, points: FloatArray) -> None:
        """Take points whose hull contains a part of the surface, ``(p, d, n)``, into account."""
        _extend(self._bound, owner, points)

    def slack(self) -> FloatArray:
        """``(n,)`` how far parts may reach beyond known points on either side; negative where these extend too far."""
        size = np.linalg.norm(np.maximum(0, self._known[1] - self._known[0]), axis=0)
        return (self._limit - size) / (2 * np.sqrt(len(self._known[0])))

    def are_near(self, owner: IntArray, points: FloatArray, slack: FloatArray) -> NDArray[np.bool_]:
        """``(n,)`` whether points ``(p, d, n)`` are all as near to the known ones as the slack of their owners."""
        low, high = (known[:, owner] for known in self._known)
        return ((points.min(axis=0) >= low - slack) & (points.max(axis=0) <= high + slack)).all(axis=0)

    def fit(self) -> NDArray[np.bool_]:
        """``(n,)`` whether all that was taken into account is within the limit."""
        low = np.minimum(self._known[0], self._bound[0])
        high = np.maximum(self._known[1], self._bound[1])
        return np.linalg.norm(high - low, axis=0) <= self._limit


def _extend(extents: tuple[FloatArray, FloatArray], owner: IntArray, points: FloatArray) -> None:
    for axis in range(points.shape[1]):
        np.minimum.at(extents[0][axis], owner, points[:, axis].min(axis=0))
        np.maximum.at(extents[1][axis], owner, points[:, axis].max(axis=0))


def fit_within(scheme: Scheme, groups: list[TileValues]) -> list[NDArray[np.bool_]]:
    """Whether the surface over tiles fits into their limits.

    Returns
    -------
    list of (t,) bool
        For each of the groups. Never true where it does not fit.
    """
    is_convex = bool(optional_member(scheme, "has_convex_rules"))
    counts = [len(each.limit) for each in groups]
    extents = _Extents(groups[0].values.shape[1], np.concatenate([each.limit for each in groups]))
    waiting: dict[tuple[DividedTile, int | None], list[_Parts]] = {}
    for each, owner in zip(groups, np.split(np.arange(sum(counts)), np.cumsum(counts)[:-1]), strict=True):
        corners = _part_looked_at(scheme, each.side).corners
        extents.add_points(owner, times(each.tile.corners[corners], each.values))
        waiting.setdefault((each.tile, each.side), []).append(_Parts(each.values, owner))
    for division in range(MOST_DIVISIONS[is_convex] + 1):
        slack = extents.slack()
        divided: dict[tuple[DividedTile, int | None], list[_Parts]] = {}
        for (tile, side), parts in waiting.items():
            values, owner = (np.concatenate(each, axis=-1) for each in zip(*parts, strict=True))
            left = np.flatnonzero(slack[owner] >= 0)
            values, owner = values[..., left], owner[left]
            points = tile.one_ring_points(values)
            is_done = np.full(len(owner), division == MOST_DIVISIONS[is_convex])
            if is_convex:
                is_done |= extents.are_near(owner, points, slack[owner])
            extents.add_hulls(owner[is_done], points[..., is_done])
            values, owner = values[..., ~is_done], owner[~is_done]
            if not len(owner):
                continue
            looked_at = _part_looked_at(scheme, side)
            for child, rows in (tile.children[number] for number in looked_at.children):
                points = times(rows, values)
                if child is None:
                    extents.add_points(owner, points[looked_at.ends])
                    extents.add_hulls(owner, points[looked_at.coefficients])
                else:
                    divided.setdefault((child, side), []).append(_Parts(points, owner))
        if not divided:
            break
        waiting = divided
    return np.split(extents.fit(), np.cumsum(counts)[:-1])
