"""Polynomials of two parameters with vectors as coefficients, and their derivatives."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import drjit as dr


@dataclass(frozen=True, eq=False)
class Polynomial:
    """A sum of monomials in s and t.

    Attributes
    ----------
    coefficients : tuple of arrays
        One for each monomial, of any Dr.Jit type.
    powers : sequence of (int, int)
        Of s and of t, in increasing order of the first.
    """

    coefficients: tuple[Any, ...]
    powers: Sequence[tuple[int, int]]

    def values(self, s: Any, t: Any, derivatives: int) -> tuple[Any, ...]:
        """The value; its derivatives by s and t; if 2 are asked for, those by ss, st and tt."""
        along_s: list[tuple[Any, ...]] = []
        for power in range(max(b for _, b in self.powers) + 1):
            column = {a: c for c, (a, b) in zip(self.coefficients, self.powers, strict=True) if b == power}
            zero = self.coefficients[0] * 0
            along_s.append(_horner([column.get(a, zero) for a in range(max(column) + 1)], s, derivatives))
        value, by_t, *by_tt = _horner([each[0] for each in along_s], t, derivatives)
        by_s, *by_st = _horner([each[1] for each in along_s], t, derivatives - 1)
        if derivatives < 2:
            return value, by_s, by_t
        (by_ss,) = _horner([each[2] for each in along_s], t, 0)
        return value, by_s, by_t, by_ss, by_st[0], by_tt[0]


def _horner(coefficients: list[Any], x: Any, derivatives: int) -> tuple[Any, ...]:
    """A polynomial of one variable and so many of its derivatives."""
    found = [coefficients[-1], *[coefficients[-1] * 0] * derivatives]
    for coefficient in reversed(coefficients[:-1]):
        for order in range(derivatives, 0, -1):
            found[order] = dr.fma(found[order], x, order * found[order - 1])
        found[0] = dr.fma(found[0], x, coefficient)
    return tuple(found)
