"""Bases of regular patches, exactly: uniform B-splines and the quartic box spline, with derivatives."""

from collections.abc import Callable
from decimal import Decimal


def b_spline(degree: int, t: Decimal) -> list[list[Decimal]]:
    """Values, first and second derivatives of the uniform B-splines on [0, 1], by the Cox-de Boor recursion."""
    orders = [[Decimal(1)]]
    for p in range(1, degree + 1):
        lower = [Decimal(0), *orders[-1], Decimal(0)]
        orders.append([((t + p - j) * lower[j] + (j + 1 - t) * lower[j + 1]) / p for j in range(p + 1)])
    rows = [orders[degree]]
    for order in (1, 2):
        row = orders[degree - order]
        for _ in range(order):
            row = [a - b for a, b in zip([Decimal(0), *row], [*row, Decimal(0)], strict=True)]
        rows.append(row)
    return rows


def tensor_weights(degree: int, u: Decimal, v: Decimal) -> Callable:
    """Weight of the control point at (i, j), i, j = -1, 0, .., with derivatives to the second, as a function."""
    a, b = b_spline(degree, u), b_spline(degree, v)
    orders = ((0, 0), (1, 0), (0, 1), (2, 0), (1, 1), (0, 2))
    return lambda i, j: [a[k][i + 1] * b[m][j + 1] for k, m in orders]


def _box_spline_coefficients() -> dict[tuple[int, int], int]:
    """Coefficients of ``((1 - x)(1 - y)(1 - x y))^2``."""
    product = {(0, 0): 1}
    for di, dj in ((1, 0), (0, 1), (1, 1)) * 2:
        shifted = {(i + di, j + dj): -c for (i, j), c in product.items()}
        product = {k: product.get(k, 0) + shifted.get(k, 0) for k in product.keys() | shifted.keys()}
    return {k: c for k, c in product.items() if c}


BOX_SPLINE = _box_spline_coefficients()


def _cone_spline(x: Decimal, y: Decimal) -> list[Decimal]:
    """The integral of ``s (x - s) (y - s)`` over s from 0 to min(x, y), and its derivatives, to the second.

    This is the density of sums of (1, 0), (0, 1), (1, 1), each taken twice with factors of any positive size.
    """
    if min(x, y) <= 0:
        return [Decimal(0)] * 6
    if y > x:
        f, fy, fx, fyy, fxy, fxx = _cone_spline(y, x)
        return [f, fx, fy, fxx, fxy, fyy]
    rows = y**3 * (2 * x - y), 2 * y**3, 6 * x * y**2 - 4 * y**3, Decimal(0), 6 * y**2, 12 * y * (x - y)
    return [c / 12 for c in rows]


def box_weights(u: Decimal, v: Decimal) -> Callable:
    """Weight of the control point at (i, j) of the triangular lattice, with derivatives to the second, as a function.

    The shear (u, v) -> (u + v, v) sends the lattice's edges to (1, 0), (0, 1), (1, 1).
    """

    def weight(i, j):
        x, y = u + v - i - j + 2, v - j + 2
        rows = [[c * d for d in _cone_spline(x - k, y - m)] for (k, m), c in BOX_SPLINE.items()]
        f, fx, fy, fxx, fxy, fyy = (sum(column) for column in zip(*rows, strict=True))
        return [f, fx, fx + fy, fxx, fxx + fxy, fxx + 2 * fxy + fyy]

    return weight
