"""Parameter domains: the unit square and the unit triangle, their corners, and their four halved copies."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

FloatArray = NDArray[np.floating]


class AffineMap(NamedTuple):
    """A map ``uv -> matrix @ uv + offset`` between parameter domains; exact, as its entries are small integers."""

    matrix: FloatArray
    offset: FloatArray

    def __call__(self, uv: FloatArray) -> FloatArray:
        """Map ``(s, 2)`` parameters."""
        # Products and sums one by one, not by BLAS: a fused or reordered sum could lose the low bits of tiny
        # parameters.
        (a, b), (c, d) = self.matrix
        return np.stack(
            [a * uv[..., 0] + b * uv[..., 1] + self.offset[0], c * uv[..., 0] + d * uv[..., 1] + self.offset[1]],
            axis=-1,
        )

    def __matmul__(self, first: AffineMap) -> AffineMap:
        """Return the map that applies ``first`` and then this one."""
        return AffineMap(self.matrix @ first.matrix, self.matrix @ first.offset + self.offset)

    def inverse(self) -> AffineMap:
        """Return the inverse map."""
        inverse = np.linalg.inv(self.matrix)
        return AffineMap(inverse, -inverse @ self.offset)

    def is_same(self, other: AffineMap) -> bool:
        """Whether two maps are equal, bit by bit."""
        return np.array_equal(self.matrix, other.matrix) and np.array_equal(self.offset, other.offset)


IDENTITY = AffineMap(np.eye(2), np.zeros(2))


class ParameterDomain:
    """A parameter domain with a corner at (0, 0), which splits into four copies of itself at half the size.

    Parameters
    ----------
    name : str
    corners : (m, 2) float64
        Counter-clockwise from (0, 0).
    children : tuple of AffineMap
        From the domain to each copy's own parameters. Copy 0 holds the corner (0, 0).
    """

    def __init__(self, name: str, corners: FloatArray, children: tuple[AffineMap, ...]) -> None:
        self.name, self.corners, self.children = name, corners, children

    @property
    def corner_count(self) -> int:
        return len(self.corners)

    def rotation(self, corner: int) -> AffineMap:
        """From parameters with (0, 0) at corner ``corner`` to parameters with (0, 0) at corner 0."""
        start = self.corners[corner]
        along_u = self.corners[(corner + 1) % self.corner_count] - start
        along_v = self.corners[corner - 1] - start
        return AffineMap(np.stack([along_u, along_v], axis=1), start)

    def inside(self, uv: FloatArray) -> FloatArray:
        """``(s,)`` how far inside parameters lie: positive inside, zero on the domain's edges, negative outside."""
        u, v = uv[..., 0], uv[..., 1]
        if self.corner_count == 3:
            return np.minimum(np.minimum(u, v), 1 - (u + v))
        return np.minimum(np.minimum(u, v), np.minimum(1 - u, 1 - v))

    def first_child(self, uv: FloatArray) -> tuple[NDArray[np.int64], FloatArray]:
        """The first of `children` that holds parameters ``(2, s)``, and the parameters ``(2, s)`` there."""
        u, v = uv
        if self.corner_count == 3:
            is_outer = u + v > 0.5
            right, top = is_outer & (u >= 0.5), is_outer & (u < 0.5) & (v >= 0.5)
            is_middle = is_outer & ~right & ~top
            inner = 2 * uv - np.stack([right, top])
            return right + 2 * top + 3 * is_middle, np.where(is_middle, 1 - inner, inner)
        top = v > 0.5
        right = (u > 0.5) | (top & (u == 0.5))
        return right ^ (3 * top), 2 * uv - np.stack([right, top])

    def extent(self, uv: ArrayLike) -> FloatArray:
        """``(s,)`` size of the smallest scaled copy of the domain, with its corner at (0, 0), that contains ``uv``.

        It is 1 for the whole domain.
        """
        uv = np.asarray(uv)
        return uv[..., 0] + uv[..., 1] if self.corner_count == 3 else np.maximum(uv[..., 0], uv[..., 1])


def _halved(sign: float, offset: tuple[float, float]) -> AffineMap:
    return AffineMap(2 * sign * np.eye(2), np.array(offset, dtype=float))


SQUARE = ParameterDomain(
    "square",
    np.array([(0, 0), (1, 0), (1, 1), (0, 1)], dtype=float),
    (_halved(1, (0, 0)), _halved(1, (-1, 0)), _halved(1, (-1, -1)), _halved(1, (0, -1))),
)

# The middle child is turned by half a turn: its parameters run backwards.
TRIANGLE = ParameterDomain(
    "triangle",
    np.array([(0, 0), (1, 0), (0, 1)], dtype=float),
    (_halved(1, (0, 0)), _halved(1, (-1, 0)), _halved(1, (0, -1)), _halved(-1, (1, 1))),
)
