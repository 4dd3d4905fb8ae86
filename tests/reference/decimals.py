"""Decimal arithmetic on short vectors, with the few functions the references need."""

from collections.abc import Iterable, Sequence
from contextlib import contextmanager
from decimal import Decimal, getcontext, localcontext
from functools import cache
from operator import mul

Vector = tuple[Decimal, ...]


@contextmanager
def precision(digits: int):
    """Decimal arithmetic with this many digits inside the block."""
    with localcontext() as context:
        context.prec = digits
        yield


@cache
def _pi(digits: int) -> Decimal:
    """Pi by Machin's formula."""
    with precision(digits + 10):

        def arctan_of_inverse(n: int) -> Decimal:
            power, total, k = 1 / Decimal(n), Decimal(0), 1
            while power > Decimal(10) ** -(digits + 10):
                total += power / (k if k % 4 == 1 else -k)
                power /= n * n
                k += 2
            return total

        return 4 * (4 * arctan_of_inverse(5) - arctan_of_inverse(239))


@cache
def _cos_of_turn(k: int, n: int, digits: int) -> Decimal:
    with precision(digits + 10):
        x = 2 * _pi(digits + 10) * (k % n) / n
        term = total = Decimal(1)
        i = 0
        while abs(term) > Decimal(10) ** -(digits + 10):
            i += 2
            term *= -x * x / (i * (i - 1))
            total += term
    return total


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
