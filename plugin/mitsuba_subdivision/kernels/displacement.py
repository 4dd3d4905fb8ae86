"""Displacement of a surface along its normals.

    D = S + h n,   D_u = S_u + h_u n + h n_u,   n_u = (c_u - n (n · c_u)) / |c|,   c = S_u x S_v.

- `displaced` evaluates these formulas for arrays of a kernel, single points, and arrays on the host.
- `Displacement` contains the heights, a function of a channel's values, and their scale.
- `DisplacedPiece` is a displaced `Piece`, for Newton's method.

All quantities are in object space. At extraordinary points, where second derivatives do not exist, n_u is set to zero:
the normal of the displaced surface follows from the limit normal and the slope of the heights. Where curvature
vanishes, as at valence 3 under Catmull-Clark, that is the limit.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import drjit as dr

from ..patches.channel import Channel
from .algebra import added, cross, dot, like, unit
from .array_types import Float, Index, Mask, Value
from .channel_kernel import ChannelKernel
from .piece_kernel import PatchValues, Piece, differences

# Minimum cosine of the angle between the normal and the cross product of the derivatives at which these span the
# tangent plane. Derivatives are parallel at extraordinary points on borders, and their cross product is not normal at
# sharp tips.
SPANNING = 0.5


class Heights:
    """Heights as a function of the values of a channel: these values themselves."""

    def __call__(self, value: Value, du: Value, dv: Value, active: Mask = True) -> tuple[Float, Float, Float]:  # noqa: ARG002
        """Heights and their derivatives by the parameters, from the channel's values and their derivatives."""
        return value, du, dv

    def height(self, value: Value) -> Float:
        """Heights without derivatives."""
        return value

    def variables(self) -> list:
        """Arrays that the heights are differentiable with respect to."""
        return []

    def range(self, channel: Channel) -> tuple[float, float]:
        """Interval of the control values, which contains all heights because weights are not negative."""
        return float(channel.values.min()), float(channel.values.max())


def displaced(
    surface: PatchValues,  # With second derivatives; vectors are 3-vectors of Dr.Jit, or lists of three arrays
    height: tuple[Float, Float, Float],  # The height, and its derivatives by the parameters
) -> PatchValues:
    """Displace points of a surface along its normals.

    Returns PatchValues of the displaced surface, without second derivatives. The normal is the cross product of the
    derivatives where these span the tangent plane, else the normal of the surface. A point without a normal is not
    displaced.
    """
    uu, uv, vv = surface.second
    crossed = cross(surface.du, surface.dv)
    n = unit(surface.normal)
    spans, squared = dot(n, unit(crossed)) > SPANNING, dot(crossed, crossed)
    inverse = dr.select(spans, dr.rsqrt(dr.select(spans, squared, 1.0)), 0.0)
    h, h_u, h_v = height
    tangents = []
    for tangent, slope, c_u in (
        (surface.du, h_u, added(cross(uu, surface.dv), cross(surface.du, uv))),
        (surface.dv, h_v, added(cross(uv, surface.dv), cross(surface.du, vv))),
    ):
        n_u = added(c_u, n, -dot(n, c_u))
        tangents.append(added(added(tangent, n, slope), n_u, inverse * h))
    du, dv = tangents
    normal = [dr.select(spans, x, y) for x, y in zip(cross(du, dv), surface.normal, strict=True)]
    return PatchValues(added(surface.value, n, h), du, dv, like(normal, surface.normal))


@dataclass(eq=False)
class Displacement:
    """Heights and scale of a displacement."""

    channel: ChannelKernel  # Channel that heights depend on, such as texture coordinates
    heights: Heights  # Function of the values of ``channel``
    scale: Float  # Factor of the heights

    def variables(self) -> list:
        """Arrays that the displacement is differentiable with respect to."""
        values = self.channel.values.flat
        return [self.scale, *([values] if dr.grad_enabled(values) else []), *self.heights.variables()]

    def piece(self, surface: Piece, half_edge: Index, u: Float, v: Float, active: Mask) -> DisplacedPiece:
        """Displace the piece of the surface at a location."""
        channel = self.channel.at(half_edge, u, v, active)
        return DisplacedPiece(**vars(surface), channel=channel, displacement=self, active=active)


@dataclass(frozen=True, eq=False)
class DisplacedPiece(Piece):
    """A piece of the displaced surface."""

    channel: Callable[..., PatchValues]  # Values of the channel that heights depend on
    displacement: Displacement
    active: Mask

    def values(self, du: Float = 0, dv: Float = 0, derivatives: int = 1) -> PatchValues:
        """See `Piece.values`; second derivatives are detached finite differences of the first derivatives."""
        surface, channel = super().values(du, dv, 2), self.channel(du, dv)
        height = self.displacement.heights(channel.value, channel.du, channel.dv, self.active)
        h, h_u, h_v = (self.displacement.scale * component for component in height)
        values = displaced(surface, (h, h_u, h_v))
        if derivatives == 1:
            return values
        (uu, _), (uv, vv) = differences(lambda u, v: self.values(du + u, dv + v).first_order[1:3], self.magnification)
        return replace(values, second=(uu, uv, vv))
