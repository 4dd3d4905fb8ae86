"""Nearest points of a whole surface: global minima of the distance."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from ..evaluation.irregular_patch import level_at_size
from ..mesh.connectivity import IntArray
from ..schemes.domain import FloatArray
from .nearest_in_piece import ROUNDED, TurnedBoxes, nearest_in_pieces, slopes
from .polynomial_pieces import Parts, PolynomialPieces, SurfacePieces, Tips

if TYPE_CHECKING:
    from scipy.spatial import cKDTree

# Pieces are halved until the thickness of their boxes over the length is at most FLAT, but at most MOST_HALVINGS times.
FLAT, MOST_HALVINGS = 0.05, 4
# More pieces than this, as of semi-sharp cages, are halved only where a query needs it, to save memory.
MOST_HALVED = 20_000
# Most pieces that are kept in memory for levels around extraordinary points, at about a kilobyte per piece. Pieces of
# deeper levels are computed whenever a query needs them.
MOST_KEPT = 200_000
# Most times that a piece in which the distance to a point may have several minima is halved.
MOST_CONVEX_HALVINGS = 3
# A location is a minimum where the distance falls no faster than this along the surface, see `slopes`.
FLAT_SLOPE = 1e-10
# Relative size down to which levels around an extraordinary point are searched. The point stands for smaller ones.
SMALLEST = 2.0**-44
# Points per run of a query, which bounds temporary memory to some hundred megabytes.
CHUNK = 1 << 17

# Children of a node of `BoxTree`.
WIDTH = 8
# Most pairs of a point and a box that are tested together, so that arrays stay in a processor's cache.
MOST_PAIRS = 1 << 15


@dataclass(frozen=True, eq=False)
class ClosestPoints:
    """The points of a surface that are nearest to the points of a query.

    Attributes
    ----------
    element, corner : (s,) int64
        0-based, as for `LimitSurface.evaluate`.
    uv : (s, 2) float64
    p, n : (s, 3) float64
        Points and unit normals of the surface, see `SurfaceSamples`.
    distance : (s,) float64
    """

    element: IntArray
    corner: IntArray
    uv: FloatArray
    p: FloatArray
    n: FloatArray
    distance: FloatArray


class ClosestPointSearch:
    """Finds nearest points of a surface.

    The surface is divided into nearly flat polynomial pieces, each in an oriented box. The nearest middle of a piece
    gives a first distance. Newton's method then finds the least distance within every piece whose box is no further
    away; around an extraordinary point, level by level.
    """

    def __init__(self, pieces: SurfacePieces) -> None:
        from scipy.spatial import cKDTree

        self._tips, parts = pieces.tips, [pieces.regular]
        # For each of the tips, the first level whose pieces are not kept, but computed when a query needs them.
        most = max((tips.bounded_levels for tips in self._tips), default=0)
        per_level = sum(3 * len(tips) for tips in self._tips)
        kept = min(most, max(MOST_KEPT - len(pieces.regular), 0) // max(per_level, 1))
        self._first_levels = [min(kept, tips.bounded_levels) for tips in self._tips]
        for tips, first_level in zip(self._tips, self._first_levels, strict=True):
            parts += [tips.level(level) for level in range(first_level)]
        self._size = float(pieces.sizes.max())
        self._pieces, self._boxes = _flat_pieces(PolynomialPieces.joined(parts), ROUNDED * self._size)
        boxes = [self._pieces.box()]
        # Points of the surface and their locations: first the middles of `_pieces`, then points of the tips.
        known = [self._pieces.middles()]
        for tips, first_level in zip(self._tips, self._first_levels, strict=True):
            reach = tips.reach(first_level)
            boxes.append((tips.points - reach, tips.points + reach))
            known += [(tips.points, tips.half_edge, tips.offsets), tips.level(first_level).middles()]
        self._tree = BoxTree.build(*map(np.concatenate, zip(*boxes, strict=True)))
        points, self._start, self._uv = map(np.concatenate, zip(*known, strict=True))
        self._known: cKDTree = cKDTree(points)

    def nearest(self, points: FloatArray) -> tuple[NDArray[np.int64], FloatArray]:
        """Locate the nearest points of the surface to ``(s, 3)`` points, as half-edges and parameters."""
        locations = [self._nearest(run) for run in np.split(points, range(CHUNK, len(points), CHUNK))]
        half_edge, uv = zip(*locations, strict=True)
        return np.concatenate(half_edge), np.concatenate(uv)

    def _nearest(self, points: FloatArray) -> tuple[NDArray[np.int64], FloatArray]:
        size = self._size + float(np.abs(points).max(initial=0))
        distance, nearest = self._known.query(points)
        first: IntArray = np.asarray(nearest)
        best = _Best(points, size, np.asarray(distance) ** 2, self._start[first], self._uv[first])
        begins = np.flatnonzero(first < len(self._pieces))
        best.descend(begins, self._pieces, first[begins], self._boxes)
        point, leaf = self._tree.near(points, best.reach)
        is_piece = leaf < len(self._pieces)
        best.try_pieces(point[is_piece], self._pieces, leaf[is_piece], self._boxes)
        point, leaf = point[~is_piece], leaf[~is_piece] - len(self._pieces)
        for tips, first_level in zip(self._tips, self._first_levels, strict=True):
            is_tip = (leaf >= 0) & (leaf < len(tips))
            best.try_tips(point[is_tip], tips, leaf[is_tip], first_level)
            leaf = leaf - len(tips)
        return best.half_edge, best.uv


class _Best:
    """The nearest locations found so far; pairs of a point and a piece (tip, part) are two index arrays."""

    def __init__(
        self,
        points: FloatArray,  # (s, 3) float64
        size: float,  # Largest absolute coordinate, for the rounding error
        # Initial locations, see `ClosestPointSearch.nearest`
        squared_distance: FloatArray,
        half_edge: NDArray[np.int64],
        uv: FloatArray,
    ) -> None:
        self._points, self._size = points, size
        self._squared_distance, self._slope = squared_distance, np.full(len(points), np.inf)
        self.half_edge, self.uv = half_edge, uv

    @property
    def reach(self) -> FloatArray:
        """``(s,)`` squared distances so far plus their rounding error: boxes further away hold no nearer point."""
        return self._squared_distance + self._rounded(self._squared_distance)

    def _rounded(self, squared_distance: FloatArray) -> FloatArray:
        rounded = ROUNDED * self._size
        return rounded * (2 * np.sqrt(squared_distance) + rounded)

    def descend(self, point: IntArray, pieces: PolynomialPieces, piece: IntArray, boxes: TurnedBoxes) -> None:
        """Descend to a minimum of the distance in pieces, as if each piece had only one."""
        if not len(point):
            return
        points = self._points[point]
        begin = boxes.starts(points, piece)
        uv, squared_distance, slope = nearest_in_pieces(pieces, piece, points, begin, self._size)
        self._take(point, squared_distance, slope, pieces.half_edge[piece], pieces.chosen(piece).parameters(uv))

    def try_pieces(
        self, point: IntArray, pieces: PolynomialPieces, piece: IntArray, boxes: TurnedBoxes | None = None
    ) -> None:
        """Find the least distance in pieces; without ``boxes``, compute those around the pieces."""
        for halving in range(MOST_CONVEX_HALVINGS + 1):
            if boxes is None:
                point, pieces, piece = self._near(point, pieces, piece, *pieces.box())
                boxes = TurnedBoxes.around(pieces)
            points = self._points.take(point, axis=0)
            near, squared_distance, away = boxes.near(points, piece, self.reach.take(point))
            point, piece = point[near], piece[near]
            is_tiny = (boxes.halves.max(axis=1) <= ROUNDED * self._size)[piece]
            is_convex = boxes.are_convex(away, piece) | is_tiny | (halving == MOST_CONVEX_HALVINGS)
            is_last = is_convex.copy()
            # If the nearest location so far lies in a convex piece and is a minimum, the piece has no other.
            is_last[is_last] = ~self._are_minima(point[is_last], pieces, piece[is_last])
            self.descend(point[is_last], pieces, piece[is_last], boxes)
            left = ~is_convex & (squared_distance <= self.reach[point])
            if not left.any():
                return
            used, used_index = np.unique(piece[left], return_inverse=True)
            pieces, boxes = pieces.chosen(used).halved(), None
            point, piece = np.tile(point[left], 4), (used_index + len(used) * np.arange(4)[:, None]).ravel()

    def _near(
        self, point: IntArray, parts: Parts, part: IntArray, lower: FloatArray, upper: FloatArray
    ) -> tuple[IntArray, Parts, IntArray]:
        """Pairs of a point and a part whose box is within reach: points, the parts in use, and indices into these."""
        gaps = squared_gaps(self._points.take(point, axis=0), lower.take(part, axis=0), upper.take(part, axis=0))
        is_near = gaps <= self.reach.take(point)
        used, used_index = np.unique(part[is_near], return_inverse=True)
        return point[is_near], parts.chosen(used), used_index

    def _are_minima(self, point: IntArray, pieces: PolynomialPieces, piece: IntArray) -> NDArray[np.bool_]:
        """Whether the nearest locations so far lie in their pieces and are minima along the surface."""
        away = self.uv[point] - pieces.offsets[piece]
        (a, b), (c, d) = pieces.matrices[piece].transpose(1, 2, 0)
        uv_in_piece = np.stack([d * away[:, 0] - b * away[:, 1], a * away[:, 1] - c * away[:, 0]], axis=1)
        uv_in_piece /= (a * d - b * c)[:, None]
        is_inside = (self.half_edge[point] == pieces.half_edge[piece]) & (pieces.basis.domain.inside(uv_in_piece) >= 0)
        return is_inside & (self._slope[point] <= FLAT_SLOPE * np.sqrt(self._squared_distance[point]))

    def try_tips(self, point: IntArray, tips: Tips, tip: IntArray, first_level: int) -> None:
        """Find the least distance in tips, from level ``first_level`` on."""
        if not len(point):
            return
        difference = self._points[point] - tips.points[tip]
        squared = np.einsum("nx,nx->n", difference, difference)
        slope = slopes(tips.tangents[tip], difference)
        self._take(point, squared, slope, tips.half_edge[tip], tips.offsets[tip])
        used, tip = np.unique(tip, return_inverse=True)
        tips = tips.chosen(used)
        for level in range(first_level, level_at_size(tips.patch, SMALLEST)):
            reach = tips.reach(level)
            point, tips, tip = self._near(point, tips, tip, tips.points - reach, tips.points + reach)
            if not len(point):
                return
            pieces = tips.level(level)
            count = len(pieces) // len(tips)
            piece = (tip + len(tips) * np.arange(count)[:, None]).ravel()
            self.try_pieces(np.tile(point, count), pieces, piece)

    def _take(
        self, point: IntArray, squared: FloatArray, slope: FloatArray, half_edge: IntArray, uv: FloatArray
    ) -> None:
        """Take over nearer locations; among equally near ones, as on edges of pieces, those of least slope."""
        least = self._squared_distance.copy()
        np.minimum.at(least, point, squared)
        limit = least + self._rounded(least)
        self._slope[self._squared_distance > limit] = np.inf
        candidates = np.flatnonzero(squared <= limit[point])
        # Keep the candidate of least slope of each point.
        candidates = candidates[np.lexsort((slope[candidates], point[candidates]))]
        candidates = candidates[np.flatnonzero(np.diff(point[candidates], prepend=-1))]
        candidates = candidates[slope[candidates] < self._slope[point[candidates]]]
        updated = point[candidates]
        self._squared_distance[updated], self._slope[updated] = squared[candidates], slope[candidates]
        self.half_edge[updated], self.uv[updated] = half_edge[candidates], uv[candidates]


def _flat_pieces(pieces: PolynomialPieces, rounded: float) -> tuple[PolynomialPieces, TurnedBoxes]:
    """Halve pieces until they are flat up to rounding. Returns them and boxes around them."""
    done: list[tuple[PolynomialPieces, TurnedBoxes]] = []
    for halving in range(MOST_HALVINGS + 1):
        boxes = TurnedBoxes.around(pieces)
        is_flat = boxes.halves[:, 2] <= FLAT * boxes.halves[:, :2].max(axis=1) + rounded
        if halving == MOST_HALVINGS or np.count_nonzero(~is_flat) > MOST_HALVED:
            is_flat[:] = True
        done.append((pieces.chosen(is_flat), boxes.chosen(is_flat)))
        pieces = pieces.chosen(~is_flat).halved()
    return PolynomialPieces.joined(flat for flat, _ in done), TurnedBoxes.joined(boxes for _, boxes in done)


@dataclass(frozen=True, eq=False)
class BoxTree:
    """A hierarchy of axis-aligned boxes: ``WIDTH`` boxes that are consecutive in a k-d tree share a parent."""

    order: IntArray  # (n,) int64: indices of the boxes in the order of the leaves
    # tuple of ((m, 3), (m, 3)) float64: lower and upper corners of the boxes of each level, the leaves first
    levels: tuple[tuple[FloatArray, FloatArray], ...]

    @classmethod
    def build(cls, lower: FloatArray, upper: FloatArray) -> BoxTree:
        from scipy.spatial import cKDTree

        order = cKDTree((lower + upper) / 2, leafsize=WIDTH).indices
        levels = [(lower[order], upper[order])]
        while len(levels[-1][0]) > WIDTH:
            low, high = levels[-1]
            begins = np.arange(0, len(low), WIDTH)
            levels.append((np.minimum.reduceat(low, begins), np.maximum.reduceat(high, begins)))
        return cls(order, tuple(levels))

    def near(
        self,
        points: FloatArray,  # (s, 3) float64
        squared_distance: FloatArray,  # (s,) float64
    ) -> tuple[IntArray, IntArray]:
        """Find all pairs of a point and a box within the point's distance. Returns point, box, (n,) int64."""
        top, leaves = np.arange(len(self.levels[-1][0])), list[tuple[IntArray, IntArray]]()
        # Pairs of a point and a node of a level.
        waiting = [(len(self.levels) - 1, np.repeat(np.arange(len(points)), len(top)), np.tile(top, len(points)))]
        while waiting:
            level, point, node = waiting.pop()
            if len(point) > MOST_PAIRS:
                half = len(point) // 2
                waiting += [(level, point[side], node[side]) for side in (slice(half, None), slice(half))]
                continue
            low, high = self.levels[level]
            gaps = squared_gaps(points.take(point, axis=0), low.take(node, axis=0), high.take(node, axis=0))
            keep = gaps <= squared_distance.take(point)
            point, node = point[keep], node[keep]
            if not level:
                leaves.append((point, self.order[node]))
                continue
            point, node = np.repeat(point, WIDTH), (WIDTH * node[:, None] + np.arange(WIDTH)).ravel()
            exists = node < len(self.levels[level - 1][0])
            waiting.append((level - 1, point[exists], node[exists]))
        point, box = map(np.concatenate, zip(*leaves, strict=True))
        return point, box


def squared_gaps(points: FloatArray, lower: FloatArray, upper: FloatArray) -> FloatArray:
    """``(s,)`` squared distances of points ``(s, 3)`` to their boxes; zero inside."""
    gap = np.maximum(lower - points, points - upper)
    np.maximum(gap, 0, out=gap)
    return np.einsum("sx,sx->s", gap, gap)
