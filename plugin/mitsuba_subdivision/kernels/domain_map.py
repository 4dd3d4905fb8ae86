"""Parameters on the device: turned, halved, and carried across the edges of elements."""

from __future__ import annotations

from dataclasses import dataclass
from functools import reduce
from typing import Any

import drjit as dr

from ..schemes.domain import AffineMap, ParameterDomain


@dataclass(frozen=True, eq=False)
class MappedParameters:
    """Parameters, and their derivatives by those from which they were mapped.

    Attributes
    ----------
    u, v : float arrays
    jacobian : tuple of four float arrays
        Of u by the first and by the second parameter; of v likewise.
    """

    u: Any
    v: Any
    jacobian: tuple[Any, Any, Any, Any]

    @classmethod
    def of(cls, u: Any, v: Any, float_type: type) -> MappedParameters:
        """Parameters that have not been mapped."""
        one, zero = float_type(1), float_type(0)
        return cls(u, v, (one, zero, zero, one))

    def mapped(self, by: AffineMap) -> MappedParameters:
        """The parameters after another map."""
        (a, b), (c, d) = by.matrix.tolist()
        (x, y), (ju, jv, ku, kv) = by.offset.tolist(), self.jacobian
        return MappedParameters(
            _sum((a, self.u), (b, self.v), start=x),
            _sum((c, self.u), (d, self.v), start=y),
            (_sum((a, ju), (b, ku)), _sum((a, jv), (b, kv)), _sum((c, ju), (d, ku)), _sum((c, jv), (d, kv))),
        )

    def after(self, first: AffineMap) -> MappedParameters:
        """The same parameters, with derivatives by those that another map makes the given ones of."""
        (e, f), (g, h) = first.matrix.tolist()
        a, b, c, d = self.jacobian
        jacobian = _sum((e, a), (g, b)), _sum((f, a), (h, b)), _sum((e, c), (g, d)), _sum((f, c), (h, d))
        return MappedParameters(self.u, self.v, jacobian)

    def scaled(self, factor: Any) -> MappedParameters:
        """The parameters times a factor."""
        return MappedParameters(self.u * factor, self.v * factor, tuple(each * factor for each in self.jacobian))  # type: ignore[arg-type]

    def turned(self, domain: ParameterDomain, turn: Any) -> MappedParameters:
        """The parameters seen from the first corner instead of from corner ``turn``."""
        found = self
        for corner in range(1, domain.corner_count):
            found = found.chosen(turn == corner, self.mapped(domain.rotation(corner)))
        return found

    def chosen(self, condition: Any, other: MappedParameters) -> MappedParameters:
        """Other parameters where a condition holds."""
        select = dr.select
        jacobian = tuple(select(condition, b, a) for a, b in zip(self.jacobian, other.jacobian, strict=True))
        return MappedParameters(select(condition, other.u, self.u), select(condition, other.v, self.v), jacobian)  # type: ignore[arg-type]

    def in_child(self, domain: ParameterDomain, first: int) -> tuple[MappedParameters, Any]:
        """Parameters in the copy of the domain that they lie in, and its number, counted from copy ``first`` on."""
        best, number = self.mapped(domain.children[first]), 0
        inside = best.inside(domain)
        for k, child in enumerate(domain.children[first + 1 :], start=1):
            other = self.mapped(child)
            is_better = other.inside(domain) > inside
            inside = dr.maximum(inside, other.inside(domain))
            best, number = best.chosen(is_better, other), dr.select(is_better, k, number)
        return best, number

    def inside(self, domain: ParameterDomain) -> Any:
        """As `ParameterDomain.inside`."""
        return reduce(dr.minimum, distances(domain, self.u, self.v))


def distances(domain: ParameterDomain, u: Any, v: Any) -> tuple[Any, ...]:
    """How far inside parameters are of each side of a domain, from the first on."""
    return (v, 1 - (u + v), u) if domain.corner_count == 3 else (v, 1 - u, 1 - v, u)


def clamped(domain: ParameterDomain, u: Any, v: Any) -> tuple[Any, Any]:
    """The nearest parameters in a domain, or nearly so."""
    u, v = dr.clip(u, 0, 1), dr.clip(v, 0, 1)
    if domain.corner_count == 4:
        return u, v
    beyond = dr.maximum(u + v - 1, 0) / 2
    return dr.clip(u - beyond, 0, 1), dr.clip(v - beyond, 0, 1)


def _sum(*terms: tuple[float, Any], start: float = 0) -> Any:
    """Sum of products with constants, most of which are 0, 1 or -1."""
    total: Any = start
    for factor, value in terms:
        if factor == 1:
            total = total + value if not _is_nought(total) else value
        elif factor == -1:
            total = total - value
        elif factor:
            total = total + factor * value
    return total


def _is_nought(value: Any) -> bool:
    return isinstance(value, (int, float)) and value == 0
