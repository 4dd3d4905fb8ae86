"""Operations on vectors of three components: 3-vectors of Dr.Jit, or lists of arrays, such as whole arrays on the host.

Those of Dr.Jit's own that are here as well take several times as long to trace.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import reduce

import drjit as dr

from .types import Float, Vector3


def dot(a: Sequence[Float], b: Sequence[Float]) -> Float:
    """Scalar product."""
    (a_x, a_y, a_z), (b_x, b_y, b_z) = a, b
    return dr.fma(a_x, b_x, dr.fma(a_y, b_y, a_z * b_z))


def cross(a: Vector3, b: Vector3) -> Vector3:
    """Cross product."""
    (a_x, a_y, a_z), (b_x, b_y, b_z) = a, b
    components = [
        dr.fma(a_y, b_z, -(a_z * b_y)),
        dr.fma(a_z, b_x, -(a_x * b_z)),
        dr.fma(a_x, b_y, -(a_y * b_x)),
    ]
    return like(components, a)


def unit(vector: Vector3) -> Vector3:
    """The vector over its length; zero if that is zero, infinite, or so small that its inverse is."""
    # Over the largest component first, so that squares neither overflow nor vanish.
    largest = dr.detach(reduce(dr.maximum, [dr.abs(x) for x in vector]))
    scale = 1 / dr.select(largest > 0, largest, 1)
    exists = (largest > 0) & (scale > 0) & dr.isfinite(scale)
    scaled = [dr.select(exists, x * scale, 0) for x in vector]
    inverse = dr.select(exists, dr.rsqrt(dr.select(exists, dot(scaled, scaled), 1)), 0)
    return like([x * inverse for x in scaled], vector)


def added(a: Vector3, b: Vector3, factor: Float = 1) -> Vector3:
    """A vector, and another times a factor."""
    return like([dr.fma(y, factor, x) for x, y in zip(a, b, strict=True)], a)


def combined(a: Sequence[Float], by_a: Float, b: Sequence[Float], by_b: Float) -> list[Float]:
    """The sum of a vector times a factor and another times another, of any number of components."""
    return [dr.fma(x, by_a, y * by_b) for x, y in zip(a, b, strict=True)]


def like(components: list, vector: Vector3) -> Vector3:
    """A vector of three components, of the type of another one."""
    return components if isinstance(vector, list) else type(vector)(*components)
