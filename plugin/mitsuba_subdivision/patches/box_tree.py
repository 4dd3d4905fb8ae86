"""A hierarchy of boxes, to find those near a point."""

from __future__ import annotations

import sys
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..mesh.connectivity import IntArray
from ..schemes.domain import FloatArray

# Children of a node.
WIDTH = 8
# Bits of each coordinate along the curve that boxes are sorted along.
CURVE_BITS = 20
# Pairs of a point and a box are tested together up to this many, so that arrays stay in a processor's cache.
MOST_PAIRS = 1 << 15


@dataclass(frozen=True, eq=False)
class BoxTree:
    """Boxes with sides along the axes, sorted along a curve; ``WIDTH`` consecutive ones share a parent.

    Attributes
    ----------
    order : (n,) int64
        The boxes in the order of the leaves.
    levels : tuple of ((m, 3), (m, 3)) float64
        Corners of the boxes of all nodes, the leaves first.
    """

    order: IntArray
    levels: tuple[tuple[FloatArray, FloatArray], ...]

    @classmethod
    def build(cls, lower: FloatArray, upper: FloatArray) -> BoxTree:
        """Sort boxes ``(n, 3)``, at least one."""
        order = np.argsort(_along_curve((lower + upper) / 2), kind="stable")
        levels = [(lower[order], upper[order])]
        while len(levels[-1][0]) > WIDTH:
            low, high = levels[-1]
            begins = np.arange(0, len(low), WIDTH)
            levels.append((np.minimum.reduceat(low, begins), np.maximum.reduceat(high, begins)))
        return cls(order, tuple(levels))

    def near(self, points: FloatArray, squared_distance: FloatArray) -> tuple[IntArray, IntArray]:
        """Pairs of a point and a box that is no further from it than a distance of its own.

        Parameters
        ----------
        points : (s, 3) float64
        squared_distance : (s,) float64

        Returns
        -------
        point, box : (n,) int64
        """
        point = np.repeat(np.arange(len(points)), len(self.levels[-1][0]))
        node = np.tile(np.arange(len(self.levels[-1][0])), len(points))
        return self._below(points, squared_distance, point, node, len(self.levels) - 1)

    def _below(
        self, points: FloatArray, squared_distance: FloatArray, point: IntArray, node: IntArray, level: int
    ) -> tuple[IntArray, IntArray]:
        """Pairs at the leaves below some nodes of a level."""
        for at in range(level, -1, -1):
            if len(point) > MOST_PAIRS:
                half = len(point) // 2
                parts = [
                    self._below(points, squared_distance, point[side], node[side], at)
                    for side in (slice(half), slice(half, None))
                ]
                return np.concatenate([part[0] for part in parts]), np.concatenate([part[1] for part in parts])
            low, high = self.levels[at]
            gaps = squared_gaps(points.take(point, axis=0), low.take(node, axis=0), high.take(node, axis=0))
            keep = gaps <= squared_distance.take(point)
            point, node = point[keep], node[keep]
            if at:
                point, node = np.repeat(point, WIDTH), (WIDTH * node[:, None] + np.arange(WIDTH)).ravel()
                exists = node < len(self.levels[at - 1][0])
                point, node = point[exists], node[exists]
        return point, self.order[node]


def squared_gaps(points: FloatArray, lower: FloatArray, upper: FloatArray) -> FloatArray:
    """``(s,)`` squared distances of points ``(s, 3)`` from a box each; zero inside."""
    gap = np.maximum(lower - points, points - upper)
    np.maximum(gap, 0, out=gap)
    return np.einsum("sx,sx->s", gap, gap)


def _along_curve(points: FloatArray) -> NDArray[np.uint64]:
    """Morton codes of points in their bounding box."""
    low = points.min(axis=0)
    size = max(float((points - low).max()), sys.float_info.min)
    cell = np.minimum((points - low) / size * 2**CURVE_BITS, 2**CURVE_BITS - 1).astype(np.uint64)
    found = np.zeros(len(points), dtype=np.uint64)
    for bit in range(CURVE_BITS):
        for axis in range(3):
            found |= (cell[:, axis] >> np.uint64(bit) & np.uint64(1)) << np.uint64(3 * bit + axis)
    return found
