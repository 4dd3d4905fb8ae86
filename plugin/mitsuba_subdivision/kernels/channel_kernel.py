"""Kernels that evaluate attributes and texture coordinates at any parameters, interpolated as in `patches.channel`."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import drjit as dr
import numpy as np

from ..patches import LinearChannel, PieceTable
from ..patches.piece_table import CODE, FOLLOWING, PRECEDING, WHOLE
from .algebra import Monomials
from .array_types import ArrayTypes, Float, Index, Mask, Value
from .linear_maps import CoefficientMap, ControlValues, SparseMatrix
from .piece_kernel import PatchValues, Piece, PieceKernel

if TYPE_CHECKING:
    from ..patches import Channel, SubdividedChannel
    from .locations import ElementWalk, Location

# Exponents of the monomials 1, u, v and, on the square, u v.
_POWERS = ((0, 0), (1, 0), (0, 1), (1, 1))


class SubdividedChannelKernel:
    """Evaluates values that are subdivided like points."""

    def __init__(
        self,
        channel: SubdividedChannel,  # Values of 1, 2 or 3 components
        float_type: type,  # Flat Dr.Jit array
    ) -> None:
        table = PieceTable.build(channel.patches, channel.value_index, len(channel.values))
        self._kernel, types = PieceKernel.shared(table, float_type), ArrayTypes.of(float_type)
        self._size = size = channel.values.shape[1]
        self.values = ControlValues(types, size, CoefficientMap.shared(table, float_type)).load(channel.values)

    def __call__(self, location: Location, active: Mask = True) -> tuple[Value, Value, Value]:
        """The value, and its derivatives by the parameters."""
        return _values(self, location, active)

    def piece(self, half_edge: Index, u: Float, v: Float, active: Mask = True) -> Piece:
        """The piece that contains given parameters, see `PieceKernel.piece`."""
        return self._kernel.piece(self.values.flat, half_edge, u, v, active, size=self._size)


@dataclass(frozen=True, eq=False)
class BilinearPiece:
    """Bilinear or linear values, with the interface of `Piece`."""

    coefficients: Sequence[Value]  # Coefficients of 1, u, v and, on the square, u v
    monomials: Monomials
    u: Float
    v: Float

    def values(self, du: Float = 0, dv: Float = 0, derivatives: int = 1) -> PatchValues:
        """See `Piece.values`."""
        value, by_u, by_v, *second = self.monomials.values(self.coefficients, self.u + du, self.v + dv, derivatives)
        return PatchValues(value, by_u, by_v, value * 0, tuple(second))


class LinearChannelKernel:
    """Evaluates linearly interpolated values."""

    def __init__(
        self,
        channel: LinearChannel,  # Values of 1, 2 or 3 components
        walk: ElementWalk,  # Elements of the surface
        float_type: type,  # Flat Dr.Jit array
    ) -> None:
        self._types, self._walk = ArrayTypes.of(float_type), walk
        patches = channel.patches
        topology, half_edges = patches.topology, patches.half_edge_of_corner
        self._domain = patches.scheme.domain
        self._is_triangular = self._domain.corner_count == 3
        self._has_polygons = not patches.is_whole.all()
        rows, weights = channel.value_index[half_edges], None
        if self._has_polygons:
            # Values at centres of elements are stored after all others. Rows alternate between a half-edge and its
            # centre.
            rows, weights = (
                np.stack([rows, len(channel.values) + topology.face[half_edges]], axis=1),
                channel.with_centres,
            )
        size = channel.values.shape[1]
        linear_map = None if weights is None else SparseMatrix(weights, float_type)
        self.values = ControlValues(self._types, size, linear_map).load(channel.values)
        self._monomials = Monomials(_POWERS[: 3 if self._is_triangular else 4])
        self._rows = self._types.indices(rows)

    def __call__(self, location: Location, active: Mask = True) -> tuple[Value, Value, Value]:
        """The value, and its derivatives by the parameters."""
        return _values(self, location, active)

    def piece(self, half_edge: Index, u: Float, v: Float, active: Mask = True) -> BilinearPiece:
        """The polynomial of a whole element, or of a corner of another element, from one of its half-edges."""
        row = self._walk.row(half_edge, active)
        following, preceding = row[FOLLOWING], row[PRECEDING]
        origin, along_u, along_v = (self._at(edge, active) for edge in (half_edge, following, preceding))
        mixed = []
        if not self._is_triangular:
            opposite = self._at(self._walk.row(following, active)[FOLLOWING], active)
            if self._has_polygons:
                is_whole = (row[CODE] & WHOLE) != 0
                opposite = dr.select(is_whole, opposite, self._at(half_edge, active, of_centre=True))
                along_u = dr.select(is_whole, along_u, (along_u + origin) * 0.5)
                along_v = dr.select(is_whole, along_v, (along_v + origin) * 0.5)
            mixed.append((opposite - along_v) - (along_u - origin))
        return BilinearPiece([origin, along_u - origin, along_v - origin, *mixed], self._monomials, u, v)

    def _at(self, half_edge: Index, active: Mask, *, of_centre: bool = False) -> Value:
        types = self._types
        row = 2 * half_edge + int(of_centre) if self._has_polygons else half_edge
        return self.values.fetch(types.fetch(types.index, self._rows, row, active), active)


ChannelKernel = SubdividedChannelKernel | LinearChannelKernel
AnyChannelPiece = Piece | BilinearPiece


def _values(kernel: ChannelKernel, location: Location, active: Mask) -> tuple[Value, Value, Value]:
    """The value of a channel, and its derivatives by the parameters."""
    u, v = dr.detach(location.u), dr.detach(location.v)
    piece = kernel.piece(location.half_edge, u, v, active)
    if dr.grad_enabled(location.u, location.v):
        values = piece.values(derivatives=2).shifted(location.u - u, location.v - v)
    else:
        values = piece.values()
    return values.value, values.du, values.dv


def channel_kernel(channel: Channel, walk: ElementWalk, float_type: type) -> ChannelKernel:
    """The kernel of a channel."""
    if isinstance(channel, LinearChannel):
        return LinearChannelKernel(channel, walk, float_type)
    return SubdividedChannelKernel(channel, float_type)
