"""Attributes and texture coordinates at any parameters, as `patches.channel` interpolates them."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import drjit as dr
import numpy as np

from ..patches import LinearChannel, PieceTable
from ..patches.piece_table import FOLLOWING, PRECEDING
from .array_types import ArrayTypes
from .control_values import ControlValues
from .domain_map import MappedParameters
from .patch_kernel import PatchKernel
from .piece_polynomial import PiecePolynomial
from .polynomial import Polynomial

if TYPE_CHECKING:
    from ..patches import Channel, SubdividedChannel
    from .element_walk import ElementWalk, Location

# Of 1, u, v and, over squares, u v.
_POWERS = ((0, 0), (1, 0), (0, 1), (1, 1))


class SubdividedChannelKernel:
    """Values that are subdivided as points are.

    Parameters
    ----------
    channel : SubdividedChannel
        Of 1, 2 or 3 numbers.
    float_type : type
        Flat Dr.Jit array, or ``float``.

    Attributes
    ----------
    values : ControlValues
    """

    def __init__(self, channel: SubdividedChannel, float_type: type) -> None:
        table = PieceTable.build(channel.patches, channel.row, len(channel.values))
        self._kernel = PatchKernel(table, float_type)
        self.values = ControlValues(channel.values, table.refinement, ArrayTypes.of(float_type))

    def __call__(self, location: Location, active: Any = True) -> tuple[Any, Any, Any]:
        """The value, and its derivatives by the parameters."""
        return _values(self, location, active)

    def piece(self, half_edge: Any, u: Any, v: Any, active: Any = True) -> PiecePolynomial:
        """The values around a location, as `PatchKernel.piece`."""
        # Derivatives pass through no loop.
        return self._kernel.piece(self.values.fetch, half_edge, u, v, active, unrolled=self.values.are_moving)

    def nothing(self) -> PiecePolynomial:
        """As `PatchKernel.nothing`."""
        return self._kernel.nothing(self.values.kind)


class LinearChannelKernel:
    """Values that are interpolated linearly.

    Parameters
    ----------
    channel : LinearChannel
        Of 1, 2 or 3 numbers.
    walk : ElementWalk
        Over the surface's elements.
    float_type : type
        Flat Dr.Jit array, or ``float``.

    Attributes
    ----------
    values : ControlValues
    """

    def __init__(self, channel: LinearChannel, walk: ElementWalk, float_type: type) -> None:
        self._types, self._walk = ArrayTypes.of(float_type), walk
        patches = channel.patches
        t, half_edges = patches.topology, patches.half_edge_of_corner
        self._domain = patches.scheme.domain
        self._is_triangular = self._domain.corner_count == 3
        self._has_polygons = not patches.is_whole.all()
        rows, weights = channel.row[half_edges], None
        if self._has_polygons:
            # The centre's value comes after all others, and its row after those of the half-edges.
            rows, weights = np.stack([rows, len(channel.values) + t.face_of(half_edges)], axis=1), channel.with_centres
        self.values = ControlValues(channel.values, weights, self._types)
        self._rows = self._types.indices(rows)

    def __call__(self, location: Location, active: Any = True) -> tuple[Any, Any, Any]:
        """The value, and its derivatives by the parameters."""
        return _values(self, location, active)

    def piece(self, half_edge: Any, u: Any, v: Any, active: Any = True) -> PiecePolynomial:
        """The values over the element or the corner of an element that a half-edge names."""
        following, preceding = (self._walk.neighbour(half_edge, column, active) for column in (FOLLOWING, PRECEDING))
        origin, along_u, along_v = (self._at(edge, active) for edge in (half_edge, following, preceding))
        mixed = []
        if not self._is_triangular:
            opposite = self._at(self._walk.neighbour(following, FOLLOWING, active), active)
            if self._has_polygons:
                is_whole = self._walk.is_whole(half_edge, active)
                opposite = dr.select(is_whole, opposite, self._at(half_edge, active, of_centre=True))
                along_u = dr.select(is_whole, along_u, (along_u + origin) * 0.5)
                along_v = dr.select(is_whole, along_v, (along_v + origin) * 0.5)
            mixed.append((opposite - along_v) - (along_u - origin))
        parameters = MappedParameters.of(u, v, self._types.float)
        return self._polynomial(origin, [origin * 0, along_u - origin, along_v - origin, *mixed], parameters)

    def nothing(self) -> PiecePolynomial:
        """As `PatchKernel.nothing`."""
        zero, nothing = self._types.float(0), self.values.kind(0)
        count = 3 if self._is_triangular else 4
        return self._polynomial(nothing, [nothing] * count, MappedParameters(zero, zero, (zero,) * 4))  # type: ignore[arg-type]

    def _polynomial(self, origin: Any, coefficients: list, parameters: MappedParameters) -> PiecePolynomial:
        polynomial = Polynomial(tuple(coefficients), _POWERS[: len(coefficients)])
        one, no = self._types.float(1), self._types.float(0) > 1
        return PiecePolynomial(origin, polynomial, one, parameters, (0.0, 0.0), self._domain, no)

    def _at(self, half_edge: Any, active: Any, *, of_centre: bool = False) -> Any:
        types = self._types
        location = 2 * half_edge + int(of_centre) if self._has_polygons else half_edge
        row = types.fetch(types.index, self._rows, location, active)
        return self.values.fetch(row, active)


ChannelKernel = SubdividedChannelKernel | LinearChannelKernel


def _values(kernel: ChannelKernel, location: Location, active: Any) -> tuple[Any, Any, Any]:
    """The value of a channel, and its derivatives by the parameters."""
    u, v = dr.detach(location.u), dr.detach(location.v)
    piece = kernel.piece(location.half_edge, u, v, active)
    if dr.grad_enabled(location.u, location.v):
        # Derivatives pass through no loop, as those that find the piece.
        piece = piece.moved(location.u - u, location.v - v)
    found = piece.values()
    return found.value, found.du, found.dv


def channel_kernel(channel: Channel, walk: ElementWalk, float_type: type) -> ChannelKernel:
    """The kernel of a channel."""
    if isinstance(channel, LinearChannel):
        return LinearChannelKernel(channel, walk, float_type)
    return SubdividedChannelKernel(channel, float_type)
