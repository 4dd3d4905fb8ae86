"""Unit normals of two tangents, and their derivatives in both directions."""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr

from ..evaluation import normals
from .types import Float, Vector3

# Tangents are divided by their longest component before their cross product, which else could under- or overflow. A
# component shorter than this means that the patch has collapsed to a point or a curve.
SHORTEST = 1e-30
TANGENT_ROUNDING = {dr.VarType.Float32: normals.TANGENT_ROUNDING[32], dr.VarType.Float64: normals.TANGENT_ROUNDING[64]}
LEAST_EXTENT = {dr.VarType.Float32: normals.LEAST_EXTENT[32], dr.VarType.Float64: normals.LEAST_EXTENT[64]}


@dataclass(frozen=True)
class RoundingBound:
    """What rounding may leave of two tangents, as sums of weighted points."""

    # Sum of the absolute weights in either tangent, times what rounding may leave of such a sum
    weight_u: Float
    weight_v: Float
    extent: Vector3  # Of the weighted points along each axis, from one of them


class UnitNormal:
    """The normal along the cross product of two tangents: of unit length, or zero where these are parallel."""

    def __init__(
        self,
        # Of any Dr.Jit type; not differentiated through: derivatives are `forward` and `backward`
        du: Vector3,
        dv: Vector3,
        # Of the tangents. Where rounding alone could have made the plane that the tangents span, the normal
        # is zero, too, as in `evaluation.normals.unit_normals`.
        bound: RoundingBound | None = None,
    ) -> None:
        # The tangents' lengths matter neither to the normal nor, but for these factors, to its derivative.
        self._scale_u, self._scale_v = _scale(du), _scale(dv)
        self._du, self._dv = du * self._scale_u, dv * self._scale_v
        cross = dr.cross(self._du, self._dv)
        squared = dr.squared_norm(cross)
        self.exists = squared > (0 if bound is None else self._rounding_of_cross(bound))
        self._inverse_length = dr.select(self.exists, dr.rsqrt(squared), 0)
        self.value = cross * self._inverse_length

    def _rounding_of_cross(self, bound: RoundingBound) -> Float:
        """Square of what rounding may leave of the cross product of parallel tangents."""
        left_u, left_v = bound.weight_u * self._scale_u, bound.weight_v * self._scale_v
        # For each product of two coordinates: those of one tangent times what rounding may leave of the other's.
        a, b = dr.fma(dr.abs(self._du), left_v, dr.abs(self._dv) * left_u), bound.extent
        return (
            dr.square(dr.fma(a.y, b.z, a.z * b.y))
            + dr.square(dr.fma(a.z, b.x, a.x * b.z))
            + dr.square(dr.fma(a.x, b.y, a.y * b.x))
        )

    def forward(self, change_u: Vector3, change_v: Vector3) -> Vector3:
        """Change of the normal where the tangents change; zero where there is no normal."""
        change = dr.cross(change_u * self._scale_u, self._dv) + dr.cross(self._du, change_v * self._scale_v)
        return self._across(change)

    def backward(self, gradient: Vector3) -> tuple[Vector3, Vector3]:
        """Gradients by the tangents from that by the normal; zero where there is no normal."""
        across = self._across(gradient)
        return dr.cross(self._dv, across) * self._scale_u, dr.cross(across, self._du) * self._scale_v

    def _across(self, vector: Vector3) -> Vector3:
        """The part of a vector across the normal, over the length of the cross product."""
        return (vector - self.value * dr.dot(self.value, vector)) * self._inverse_length


def _scale(tangent: Vector3) -> Float:
    return dr.rcp(dr.maximum(dr.max(dr.abs(tangent)), SHORTEST))
