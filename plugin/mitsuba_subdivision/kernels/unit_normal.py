"""Unit normals of two tangents, and their derivatives in both directions."""

from __future__ import annotations

from typing import Any

import drjit as dr

# Tangents are divided by their longest component before their cross product, which else could under- or overflow. A
# component shorter than this means that the patch has collapsed to a point or a curve.
SHORTEST = 1e-30


# As `COLLAPSED` of the evaluation, whose reasons hold here, too.
COLLAPSED = {dr.VarType.Float32: 2.0**-19, dr.VarType.Float64: 2.0**-40}


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


def spanning(du: Any, dv: Any, du_terms: Any, dv_terms: Any) -> tuple[Any, Any]:
    """Tangents, but zero where they span no plane but what rounding makes of them; see `are_collapsed`.

    Parameters
    ----------
    du, dv : 3-vectors
    du_terms, dv_terms : 3-vectors
        The size of the terms that each coordinate of the tangents is the sum of.
    """
    tolerance = COLLAPSED[dr.type_v(du)]
    scale_u, scale_v = _scale(du), _scale(dv)
    u, v, u_terms, v_terms = du * scale_u, dv * scale_v, du_terms * scale_u, dv_terms * scale_v
    left = _absolute_cross(dr.abs(u), v_terms) + _absolute_cross(dr.abs(v), u_terms)
    # Not a number where nothing is left, and so not more.
    is_plane = dr.squared_norm(dr.cross(u, v)) > tolerance**2 * dr.squared_norm(left)
    return dr.select(is_plane, du, 0), dr.select(is_plane, dv, 0)


def _absolute_cross(a: Any, b: Any) -> Any:
    """What a cross product can be at most, from absolute values."""
    return type(a)(
        dr.fma(a.y, b.z, a.z * b.y),
        dr.fma(a.z, b.x, a.x * b.z),
        dr.fma(a.x, b.y, a.y * b.x),
    )


def _scale(tangent: Any) -> Any:
    return dr.rcp(dr.maximum(dr.max(dr.abs(tangent)), SHORTEST))
