"""Parameter domains: the unit square and the unit triangle, their corners and their four children."""

from __future__ import annotations

from collections.abc import Callable
from functools import cached_property, lru_cache, reduce
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..mesh.connectivity import IntArray

FloatArray = NDArray[np.floating]


class ParameterMap(NamedTuple):
    """A map ``uv -> matrix @ uv + offset`` between parameter domains; exact, as its entries are small integers."""

    matrix: FloatArray
    offset: FloatArray

    def __call__(self, uv: FloatArray) -> FloatArray:
        """Map ``(s, 2)`` parameters."""
        # Not by BLAS: a fused or reordered sum could lose the low bits of tiny parameters.
        (a, b), (c, d) = self.matrix
        return np.stack(
            [a * uv[..., 0] + b * uv[..., 1] + self.offset[0], c * uv[..., 0] + d * uv[..., 1] + self.offset[1]],
            axis=-1,
        )

    def __matmul__(self, first: ParameterMap) -> ParameterMap:
        """Return the map that applies ``first`` and then this one."""
        return ParameterMap(self.matrix @ first.matrix, self.matrix @ first.offset + self.offset)

    def inverse(self) -> ParameterMap:
        """Return the inverse map."""
        inverse = np.linalg.inv(self.matrix)
        return ParameterMap(inverse, -inverse @ self.offset)

    def is_same(self, other: ParameterMap) -> bool:
        """Return whether two maps are exactly equal."""
        return self is other or all(map(np.array_equal, self, other))


IDENTITY = ParameterMap(np.eye(2), np.zeros(2))


class ParameterDomain:
    """A parameter domain with a corner at (0, 0), which splits into four copies of half the size, its children.

    There are two, `SQUARE` and `TRIANGLE`. Arguments ``u`` and ``v`` may be NumPy or Dr.Jit arrays.

    Parameters
    ----------
    corners : (m, 2) float64
        Counter-clockwise from (0, 0). Edge i begins at corner i.
    children : tuple of ParameterMap
        Maps from the parameters of the domain to those of each child. Child 0 contains the corner (0, 0).
    """

    def __init__(self, name: str, area: float, corners: FloatArray, children: tuple[ParameterMap, ...]) -> None:
        self.name, self.area, self.corners, self.children = name, area, corners, children
        self._is_triangle = len(corners) == 3

    @property
    def corner_count(self) -> int:
        return len(self.corners)

    @cached_property
    def centre(self) -> FloatArray:
        """``(2,)`` mean of the corners."""
        return self.corners.mean(axis=0)

    @cached_property
    def edge_normals(self) -> FloatArray:
        """``(m, 2)`` inward normals of the edges: the gradients of `edge_distances`."""
        (u, v), (u_next, v_next) = self.corners.T, np.roll(self.corners, -1, axis=0).T
        return np.stack([v - v_next, u_next - u], axis=1)

    def rotation(self, corner: int) -> ParameterMap:
        """Return the map from parameters with (0, 0) at corner ``corner`` to parameters with (0, 0) at corner 0."""
        start = self.corners[corner]
        along_u = self.corners[(corner + 1) % self.corner_count] - start
        return ParameterMap(np.stack([along_u, self.corners[corner - 1] - start], axis=1), start)

    def inside(self, uv: FloatArray) -> FloatArray:
        """Return ``(s,)`` depth of parameters: positive inside the domain, zero on its edges, negative outside."""
        return reduce(np.minimum, self.edge_distances(uv[..., 0], uv[..., 1]))

    def edge_distances(self, u: Any, v: Any) -> tuple[Any, ...]:
        """Return signed distances of parameters from each edge along `edge_normals`, positive inside."""
        return (v, 1 - (u + v), u) if self._is_triangle else (v, 1 - u, 1 - v, u)

    def corner_weights(self, u: Any, v: Any) -> tuple[Any, ...]:
        """Return the weights of corners in linear interpolation: bilinear weights, or barycentric coordinates."""
        if self._is_triangle:
            return 1 - u - v, u, v
        return (1 - u) * (1 - v), u * (1 - v), u * v, (1 - u) * v

    def corner_derivatives(self, u: Any, v: Any) -> tuple[tuple[Any, ...], tuple[Any, ...]]:
        """Return the derivatives of `corner_weights` by u, and by v."""
        if self._is_triangle:
            zero = 0 * (u + v)
            return (zero - 1, zero + 1, zero), (zero - 1, zero, zero + 1)
        return (v - 1, 1 - v, v, -v), (u - 1, -u, u, 1 - u)

    def indices(self, degree: int) -> IntArray:
        """Return ``(n, 2)`` indices along u and v of the grid with ``degree`` intervals along each edge, u fastest."""
        v, u = np.indices((degree + 1, degree + 1)).reshape(2, -1)
        return np.stack([u, v], axis=1)[self.inside(np.stack([u, v], axis=1) / degree) >= -1 / (2 * degree)]

    def extent(self, uv: ArrayLike) -> FloatArray:
        """Return ``(s,)`` size, relative to the domain, of its least copy scaled about (0, 0) that contains ``uv``."""
        u, v = np.moveaxis(np.asarray(uv), -1, 0)
        return u + v if self._is_triangle else np.maximum(u, v)

    def child_at(self, u: Any, v: Any, select: Callable[..., Any] = np.where) -> tuple[Any, Any, Any, Any]:
        """Return which of `children` contains parameters: not the first one if their extent is at least 0.5.

        And parameters in the child, with their derivative by the given ones: 2, or -2 where they run backwards.
        ``select`` is `numpy.where`, or ``drjit.select`` for arrays of Dr.Jit.
        """
        is_right = u >= 0.5
        # At the midpoint of a triangle's third side not both.
        is_upper = (v >= 0.5) & ~is_right if self._is_triangle else v >= 0.5
        right, upper = select(is_right, 1, 0), select(is_upper, 1, 0)
        inner_u, inner_v = 2 * u - right, 2 * v - upper
        if not self._is_triangle:
            return select(is_upper, 3 - right, right), inner_u, inner_v, 2
        is_middle = ~(is_right | is_upper) & (u + v >= 0.5)
        number, speed = select(is_middle, 3, right + 2 * upper), select(is_middle, -2, 2)
        return number, select(is_middle, 1 - inner_u, inner_u), select(is_middle, 1 - inner_v, inner_v), speed

    def clamped(self, uv: FloatArray) -> FloatArray:
        """Return ``(s, 2)`` parameters clamped to the domain, to the nearest point or close to it."""
        uv = np.clip(uv, 0, 1)
        if not self._is_triangle:
            return uv
        return np.clip(uv - np.maximum(uv.sum(axis=-1, keepdims=True) - 1, 0) / 2, 0, 1)

    def from_square(self, uv: FloatArray) -> FloatArray:
        """Map ``(s, 2)`` random numbers that are uniform in the unit square to ones that are uniform in the domain."""
        return np.where(uv.sum(axis=-1, keepdims=True) > 1, 1 - uv, uv) if self._is_triangle else uv

    def quadrature(self, order: int) -> tuple[FloatArray, FloatArray]:
        """Return points ``(g, 2)`` and weights ``(g,)`` of Gauss quadrature, ``order`` points along each parameter."""
        nodes, weights = _gauss(order)
        nodes, weights = (nodes + 1) / 2, weights / 2
        u, v = (grid.ravel() for grid in np.meshgrid(nodes, nodes))
        products = np.outer(weights, weights).ravel()
        if self._is_triangle:
            v, products = v * (1 - u), products * (1 - u)  # The rule of the square, with one side collapsed to a point
        return np.stack([u, v], axis=1), products


# Nodes and weights on [-1, 1], which need an eigenvalue problem.
_gauss = lru_cache(maxsize=32)(np.polynomial.legendre.leggauss)


def _halved(sign: float, offset: tuple[float, float]) -> ParameterMap:
    return ParameterMap(2 * sign * np.eye(2), np.array(offset, dtype=float))


SQUARE = ParameterDomain(
    "square",
    1.0,
    np.array([(0, 0), (1, 0), (1, 1), (0, 1)], dtype=float),
    (_halved(1, (0, 0)), _halved(1, (-1, 0)), _halved(1, (-1, -1)), _halved(1, (0, -1))),
)

# The middle child is rotated by half a turn: its parameters run backwards.
TRIANGLE = ParameterDomain(
    "triangle",
    0.5,
    np.array([(0, 0), (1, 0), (0, 1)], dtype=float),
    (_halved(1, (0, 0)), _halved(1, (-1, 0)), _halved(1, (0, -1)), _halved(-1, (1, 1))),
)
