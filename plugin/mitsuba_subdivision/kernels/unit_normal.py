"""Unit normals of two tangents, and their derivatives in both directions."""

from __future__ import annotations

from typing import Any

import drjit as dr

# Tangents are divided by their longest component before their cross product, which else could under- or overflow. A
# component shorter than this means that the patch has collapsed to a point or a curve.
SHORTEST = 1e-30


class UnitNormal:
    """The normal along the cross product of two tangents: of unit length, or zero where these are parallel.

    Parameters
    ----------
    du, dv : 3-vectors
        Of any Dr.Jit type; not differentiated through: derivatives are `forward` and `backward`.

    Attributes
    ----------
    value : 3-vector
    """

    def __init__(self, du: Any, dv: Any) -> None:
        # The tangents' lengths matter neither to the normal nor, but for these factors, to its derivative.
        self._scale_u, self._scale_v = _scale(du), _scale(dv)
        self._du, self._dv = du * self._scale_u, dv * self._scale_v
        cross = dr.cross(self._du, self._dv)
        squared = dr.squared_norm(cross)
        self._inverse_length = dr.select(squared > 0, dr.rsqrt(squared), 0)
        self.value = cross * self._inverse_length

    def forward(self, change_u: Any, change_v: Any) -> Any:
        """Change of the normal where the tangents change; zero where there is no normal."""
        change = dr.cross(change_u * self._scale_u, self._dv) + dr.cross(self._du, change_v * self._scale_v)
        return self._across(change)

    def backward(self, gradient: Any) -> tuple[Any, Any]:
        """Gradients by the tangents from that by the normal; zero where there is no normal."""
        across = self._across(gradient)
        return dr.cross(self._dv, across) * self._scale_u, dr.cross(across, self._du) * self._scale_v

    def _across(self, vector: Any) -> Any:
        """The part of a vector across the normal, over the length of the cross product."""
        return (vector - self.value * dr.dot(self.value, vector)) * self._inverse_length


def unit_normal(du: Any, dv: Any) -> Any:
    """Value of the normal."""
    return UnitNormal(du, dv).value


def _scale(tangent: Any) -> Any:
    return dr.rcp(dr.maximum(dr.max(dr.abs(tangent)), SHORTEST))
