"""Decimal arithmetic on short vectors, with the few functions the references need."""

from collections.abc import Iterable, Sequence
from contextlib import contextmanager
from decimal import Decimal, getcontext, localcontext
from functools import cache
from operator import mul

import mpmath

Vector = tuple[Decimal, ...]


@contextmanager
def precision(digits: int):
    """Decimal arithmetic with this many digits inside the block."""
    with localcontext() as context:
        context.prec = digits
        yield


@cache
def _cos_of_turn(k: int, n: int, digits: int) -> Decimal:
    with mpmath.workdps(digits + 10):
        return Decimal(mpmath.nstr(mpmath.cospi(mpmath.mpf(2 * k) / n), digits + 5))


def cos_of_turn(k: int, n: int) -> Decimal:
    """``cos(2 pi k / n)`` to the precision of the current context."""
    return _cos_of_turn(k, n, getcontext().prec)


def sin_of_turn(k: int, n: int) -> Decimal:
    """``sin(2 pi k / n)`` to the precision of the current context."""
    return cos_of_turn(4 * k - n, 4 * n)


def mean(points: Sequence[Vector]) -> Vector:
    return tuple(sum(c) / len(points) for c in zip(*points, strict=True))


def combine(weights: Iterable[Decimal], points: Iterable[Vector]) -> Vector:
    weights = list(weights)
    return tuple(sum(map(mul, weights, c)) for c in zip(*points, strict=True))


def unit_normal(a: Vector, b: Vector) -> Vector | None:
    """Normalised cross product of two vectors; None unless they have three coordinates."""
    if len(a) != 3:
        return None
    cross = [a[i - 2] * b[i - 1] - a[i - 1] * b[i - 2] for i in range(3)]
    length = sum(c * c for c in cross).sqrt()
    return tuple(c / length for c in cross)
