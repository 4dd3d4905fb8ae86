"""Evaluation of polynomials of two parameters and their derivatives."""

from __future__ import annotations

from collections.abc import Sequence

import drjit as dr

from .array_types import Float, Value


class Monomials:
    """Monomials that polynomials are linear combinations of."""

    def __init__(
        self,
        powers: Sequence[Sequence[int]],  # (m, 2) exponents of s and t
    ) -> None:
        self.powers = powers
        highest = max(b for _, b in powers)
        # For each power of t, the index of the monomial with each power of s, or None.
        self._columns: list[list[int | None]] = []
        for power in range(highest + 1):
            column = {a: index for index, (a, b) in enumerate(powers) if b == power}
            self._columns.append([column.get(a) for a in range(max(column, default=0) + 1)])

    def values(self, coefficients: Sequence[Value], s: Float, t: Float, derivatives: int = 1) -> tuple[Value, ...]:
        """Evaluate a polynomial from its m coefficients, which are numbers or vectors.

        Returns the value; derivatives by s and t; and if ``derivatives`` is 2, those by ss, st and tt.
        """
        along_s = [
            _horner([0 if k is None else coefficients[k] for k in column], s, derivatives) for column in self._columns
        ]
        value, by_t, by_tt = _horner([row[0] for row in along_s], t, derivatives)
        by_s, by_st, _ = _horner([row[1] for row in along_s if row[1] is not None], t, derivatives - 1)
        results = [value, by_s, by_t]
        if derivatives == 2:
            by_ss, _, _ = _horner([row[2] for row in along_s if row[2] is not None] or [None], t, 0)
            results += [by_ss, by_st, by_tt]
        return tuple(value * 0 if row is None else row for row in results)

    def each(self, s: Float, t: Float) -> list[tuple[Float, Float | None, Float | None]]:
        """The value of each monomial, and its derivatives by s and t; None for derivatives that are zero."""
        return [
            (
                _power(s, a) * _power(t, b),
                a * _power(s, a - 1) * _power(t, b) if a else None,
                b * _power(s, a) * _power(t, b - 1) if b else None,
            )
            for a, b in self.powers
        ]


def _power(x: Float, exponent: int) -> Float:
    product = 1.0
    for _ in range(exponent):
        product = product * x
    return product


def _horner(coefficients: list[Value], x: Float, derivatives: int) -> tuple[Value, Value, Value]:
    """Value and derivatives of a polynomial of one variable; None for derivatives that are zero."""
    value, first, half_second = coefficients[-1], None, None
    for coefficient in coefficients[-2::-1]:
        if derivatives == 2 and first is not None:
            half_second = first if half_second is None else dr.fma(half_second, x, first)
        if derivatives:
            first = value if first is None else dr.fma(first, x, value)
        value = dr.fma(value, x, coefficient)
    return value, first, None if half_second is None else 2 * half_second
