"""Displacement: a surface moved along its normals, by heights that vary over it.

    D = S + h d,   d = M n,   D_u = S_u + h_u d + h d_u,   d_u = M n_u,

where n is the unit normal of object space, and M takes object space to the world, in which S is given. With
c = S_u x S_v, n is along q = Mᵀ c, or against it if M is a reflection, and n_u = (q_u - n (n · q_u)) / |q|.

- `displaced` is these formulas. It takes nothing of a vector but its three components, so that it serves a kernel's
  arrays, single points, and whole arrays on the host alike.
- `Displacement` knows the heights: those of a channel's values, which its caller states a function for.
- `DisplacedPiece` is to `SurfaceKernel` what a `Piece` is, moved: Newton's method runs on it.

At extraordinary points, where second derivatives do not exist, d_u is taken for zero: the normal of the moved surface
follows from the limit normal and the slope of the heights. Where curvature vanishes, as at valence 3 under
Catmull-Clark, that is the limit.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import reduce
from typing import TYPE_CHECKING, Any, Protocol

import drjit as dr

from .piece_kernel import DIFFERENCE, PatchValues, Piece

if TYPE_CHECKING:
    from .channel_kernel import AnyChannelPiece, ChannelKernel

# Cosine between the normal and the cross product of the derivatives: below it the derivatives do not span the tangent
# plane. They are parallel at extraordinary points on borders, and have other normals at sharp tips.
SPANNING = 0.5


class Heights(Protocol):
    """Heights that depend on the values of a channel."""

    def __call__(self, value: Any, du: Any, dv: Any, active: Any = True) -> tuple[Any, Any, Any]:
        """Heights and their derivatives by the parameters.

        Parameters
        ----------
        value, du, dv : arrays
            The channel's value, and its derivatives by the parameters.
        active : mask
        """
        ...

    def height(self, value: Any) -> Any:
        """The heights alone."""
        ...

    def variables(self) -> list:
        """Arrays that derivatives reach."""
        ...


@dataclass(frozen=True, eq=False)
class LinearMap:
    """Where directions of object space lie in the world.

    Attributes
    ----------
    rows : sequence of three sequences of three numbers
    mirrors : bool
        Whether it is a reflection, which turns cross products over.
    """

    rows: Sequence[Sequence[Any]]
    mirrors: bool

    def __call__(self, vector: Sequence[Any]) -> list[Any]:
        """Map a vector."""
        return [dot(row, vector) for row in self.rows]

    def transposed(self, vector: Sequence[Any]) -> list[Any]:
        """Map a cross product of vectors in the world back, but for a positive factor if the map is no reflection."""
        sign = -1.0 if self.mirrors else 1.0
        return [dot([row[i] for row in self.rows], vector) * sign for i in range(3)]

    def displacement(self, normal: Sequence[Any]) -> list[Any]:
        """Where in the world the unit normal of object space points, of a normal in the world; zero for zero."""
        return self(unit(self.transposed(normal)))


def displaced(
    surface: PatchValues, height: tuple[Any, Any, Any], linear: LinearMap | None, vector: Callable[..., Any]
) -> PatchValues:
    """Move points of a surface along its normals.

    Parameters
    ----------
    surface : PatchValues
        In the world, with second derivatives; its vectors are anything with three components.
    height : tuple
        The height, in units of object space, and its derivatives by the parameters.
    linear : LinearMap, or None
        From object space to the world; None if they are the same.
    vector : callable
        Makes the result's vectors of their components.

    Returns
    -------
    PatchValues
        Of the moved surface, without second derivatives. Its normal is the cross product of the derivatives where these
        span the tangent plane, else that of the surface. Where the surface has no normal, nothing is moved.
    """
    uu, uv, vv = surface.second
    crosses = [list(surface.normal), cross(surface.du, surface.dv)]
    changes = [
        add(cross(uu, surface.dv), cross(surface.du, uv)),
        add(cross(uv, surface.dv), cross(surface.du, vv)),
    ]
    spans = _agree(*crosses)
    if linear is not None:
        crosses, changes = ([linear.transposed(each) for each in group] for group in (crosses, changes))
    n, squared = unit(crosses[0]), dot(crosses[1], crosses[1])
    inverse = dr.select(spans, dr.rsqrt(dr.select(spans, squared, 1.0)), 0.0)
    d_u, d_v = ([(x - y * dot(n, change)) * inverse for x, y in zip(change, n, strict=True)] for change in changes)
    if linear is not None:
        n, d_u, d_v = linear(n), linear(d_u), linear(d_v)
    h, h_u, h_v = height
    value = vector(*(x + h * y for x, y in zip(surface.value, n, strict=True)))
    du, dv = (
        vector(*(x + slope * y + h * z for x, y, z in zip(tangent, n, change, strict=True)))
        for tangent, slope, change in ((surface.du, h_u, d_u), (surface.dv, h_v, d_v))
    )
    normal = vector(*(dr.select(spans, x, y) for x, y in zip(cross(du, dv), surface.normal, strict=True)))
    return PatchValues(value, du, dv, normal)


@dataclass(eq=False)
class Displacement:
    """How far the points of a surface are moved.

    Attributes
    ----------
    channel : ChannelKernel
        What heights depend on, such as texture coordinates.
    heights : Heights
        Of this channel's values.
    scale : float array
        What heights are multiplied by.
    linear : LinearMap, or None
        From object space to the space of the surface's control points; None if they are the same.
    """

    channel: ChannelKernel
    heights: Heights
    scale: Any
    linear: LinearMap | None = None

    def variables(self) -> list:
        """Arrays that derivatives reach."""
        rows = [] if self.linear is None else [entry for row in self.linear.rows for entry in row]
        values = [self.channel.values.flat] if self.channel.values.are_moving else []
        return [self.scale, *rows, *values, *self.heights.variables()]

    def piece(self, surface: Piece, half_edge: Any, u: Any, v: Any, active: Any) -> DisplacedPiece:
        """Move a piece of the surface, which lies at a location."""
        return DisplacedPiece(surface, self.channel.piece(half_edge, u, v, active), self, active)


@dataclass(frozen=True, eq=False)
class DisplacedPiece:
    """A piece of the moved surface; see `Piece`, whose members it has.

    Attributes
    ----------
    surface : Piece
        Before it is moved.
    channel : Piece or BilinearPiece
        What heights depend on, at the same location.
    displacement : Displacement
    active : mask
    """

    surface: Piece
    channel: AnyChannelPiece
    displacement: Displacement
    active: Any

    @property
    def magnification(self) -> Any:
        """See `Piece`."""
        return self.surface.magnification

    def is_inside(self, du: Any, dv: Any, tolerance: Any) -> Any:
        """See `Piece.is_inside`."""
        return self.surface.is_inside(du, dv, tolerance)

    def values(self, du: Any = 0, dv: Any = 0, derivatives: int = 1) -> PatchValues:
        """See `Piece.values`; second derivatives are differences of the first, and have no derivatives of their own."""
        surface, channel = self.surface.values(du, dv, 2), self.channel.values(du, dv)
        height = self.displacement.heights(channel.value, channel.du, channel.dv, self.active)
        found = displaced(
            surface,
            tuple(self.displacement.scale * each for each in height),  # type: ignore[arg-type]
            self.displacement.linear,
            type(surface.value),
        )
        if derivatives == 1:
            return found
        step = DIFFERENCE * dr.rcp(self.magnification)
        with dr.suspend_grad():
            by_u, by_v = (
                [self.values(du + x * sign, dv + y * sign) for sign in (1, -1)] for x, y in ((step, 0), (0, step))
            )
        per = 0.5 * dr.rcp(step)
        uu, uv, vv = (
            (getattr(after, name) - getattr(before, name)) * per
            for (after, before), name in ((by_u, "du"), (by_v, "du"), (by_v, "dv"))
        )
        return replace(found, second=(uu, uv, vv))


def dot(a: Sequence[Any], b: Sequence[Any]) -> Any:
    """Scalar product of vectors of three components."""
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


def cross(a: Sequence[Any], b: Sequence[Any]) -> list[Any]:
    """Cross product of vectors of three components."""
    return [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]]


def add(a: Sequence[Any], b: Sequence[Any]) -> list[Any]:
    """Sum of vectors."""
    return [x + y for x, y in zip(a, b, strict=True)]


def unit(vector: Sequence[Any]) -> list[Any]:
    """The vector over its length; zero if that is zero."""
    # Over the largest component first, so that squares neither overflow nor vanish.
    largest = dr.detach(reduce(dr.maximum, [dr.abs(x) for x in vector]))
    exists = largest > 0
    scaled = [x / dr.select(exists, largest, 1.0) for x in vector]
    inverse = dr.select(exists, dr.rsqrt(dr.select(exists, dot(scaled, scaled), 1.0)), 0.0)
    return [x * inverse for x in scaled]


def _agree(a: Sequence[Any], b: Sequence[Any]) -> Any:
    """Whether two vectors point in about the same direction; not if one of them is zero."""
    return dot(unit(a), unit(b)) > SPANNING
