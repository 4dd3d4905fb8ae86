"""Parameter domains on the device: sides, halved copies, and rotations of parameters."""

from __future__ import annotations

from functools import lru_cache

import drjit as dr

from ..schemes.domain import ParameterDomain
from .array_types import ArrayTypes
from .types import Float, Index


def distances(domain: ParameterDomain, u: Float, v: Float) -> tuple[Float, ...]:
    """Distances of parameters from each side of a domain, positive inside."""
    return (v, 1 - (u + v), u) if domain.corner_count == 3 else (v, 1 - u, 1 - v, u)


def along_sides(domain: ParameterDomain, u: Float, v: Float) -> tuple[Float, ...]:
    """Positions of parameters along each side of a domain, from the corner of the same number."""
    return (u, v, 1 - (u + v)) if domain.corner_count == 3 else (u, v, 1 - u, 1 - v)


def clamped(domain: ParameterDomain, u: Float, v: Float) -> tuple[Float, Float]:
    """The nearest parameters in a domain, or nearly so."""
    u, v = dr.clip(u, 0, 1), dr.clip(v, 0, 1)
    if domain.corner_count == 4:
        return u, v
    beyond = dr.maximum(u + v - 1, 0) / 2
    return dr.clip(u - beyond, 0, 1), dr.clip(v - beyond, 0, 1)


def in_child(domain: ParameterDomain, types: ArrayTypes, u: Float, v: Float) -> tuple[Index, Float, Float, Float]:
    """The halved copy of a domain that parameters lie in; not the first where `ParameterDomain.extent` is 0.5 or more.

    Returns its number, in the order of `ParameterDomain.children`; parameters in the copy; and their derivatives by the
    parameters before: 2, or -2 in the copy that is turned by half a turn.
    """
    right, upper = u >= 0.5, v >= 0.5
    one, of_index = types.float(1), types.index
    is_middle = None
    if domain.corner_count == 3:
        # Not both, in the middle of the third side.
        upper = upper & (right == False)  # noqa: E712 - an array
        is_middle = ((right | upper) == False) & (u + v >= 0.5)  # noqa: E712
        first = dr.select(is_middle, of_index(3), of_index(0))
        number = dr.select(right, of_index(1), dr.select(upper, of_index(2), first))
    else:
        number = dr.select(upper, dr.select(right, of_index(2), 3), dr.select(right, of_index(1), 0))
    inner_u, inner_v, scale = 2 * u - dr.select(right, one, 0), 2 * v - dr.select(upper, one, 0), 2 * one
    if is_middle is not None:
        inner_u, inner_v = dr.select(is_middle, one - 2 * u, inner_u), dr.select(is_middle, one - 2 * v, inner_v)
        scale = dr.select(is_middle, -scale, scale)
    return number, inner_u, inner_v, scale


def doublings(
    types: ArrayTypes,
    x: Float,  # Has no derivatives here
    most: Index,  # The number of times at most
) -> tuple[Index, Float]:
    """How many times a positive number can be doubled before it is 1 or more, and two to the power of that.

    Its exponent's bits are exact, and take a tenth of the operations of logarithms.
    """
    integer, mantissa, bias = (types.index64, 52, 1023) if types.is_double else (types.index, 23, 127)
    bits: Index = dr.reinterpret_array(integer, dr.detach(x))
    count: Index = dr.minimum(bias - 1 - dr.minimum(bits >> mantissa, bias - 1), integer(most))
    return types.index(count), dr.reinterpret_array(types.float, (count + bias) << mantissa)


def turned(domain: ParameterDomain, u: Float, v: Float, turn: Index) -> tuple[Float, Float]:
    """Parameters seen from the first corner, from those seen from corner ``turn``."""
    by_one, by_two = turn == 1, turn == 2
    if domain.corner_count == 4:
        by_three, rest_u, rest_v = turn == 3, 1 - u, 1 - v
        return (
            dr.select(by_one, rest_v, dr.select(by_two, rest_u, dr.select(by_three, v, u))),
            dr.select(by_one, u, dr.select(by_two, rest_v, dr.select(by_three, rest_u, v))),
        )
    rest = 1 - (u + v)
    return (dr.select(by_one, rest, dr.select(by_two, v, u)), dr.select(by_one, u, dr.select(by_two, rest, v)))


def turn_matrix(domain: ParameterDomain, types: ArrayTypes, turn: Index) -> tuple[Float, Float, Float, Float]:
    """Derivatives of the parameters seen from the first corner by those seen from corner ``turn``.

    Returns a, b, c, d, float arrays: of u by u and v; of v by u and v.
    """
    is_turned = [turn == k for k in range(1, domain.corner_count)]
    entries = []
    for first, *others in _turn_entries(domain):
        value = types.float(first)
        for is_by, other in zip(is_turned, others, strict=True):
            value = dr.select(is_by, types.float(other), value)
        entries.append(value)
    a, b, c, d = entries
    return a, b, c, d


@lru_cache(maxsize=8)
def _turn_entries(domain: ParameterDomain) -> list[tuple[float, ...]]:
    """Entries of the matrices of all turns: a for each, then b, c and d."""
    return list(zip(*(domain.rotation(k).matrix.ravel().tolist() for k in range(domain.corner_count)), strict=True))
