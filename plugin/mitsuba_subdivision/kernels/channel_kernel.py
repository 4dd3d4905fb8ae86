"""Kernels that evaluate attributes and texture coordinates at any parameters, interpolated as in `patches.channel`."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from typing import TYPE_CHECKING

import drjit as dr
import numpy as np

from ..patches import PieceTable
from ..patches.piece_table import CODE, FOLLOWING, PRECEDING, WHOLE
from .algebra import Monomials
from .array_types import ArrayTypes, Float, Index, Mask, Value
from .linear_maps import CoefficientMap, ControlValues, SparseMatrix
from .piece_kernel import PatchValues, PieceKernel

if TYPE_CHECKING:
    from ..patches import Channel
    from .locations import ElementWalk, Location

# Exponents of the monomials 1, u, v and, on the square, u v.
_POWERS = ((0, 0), (1, 0), (0, 1), (1, 1))


def channel_kernel(channel: Channel, walk: ElementWalk, float_type: type) -> ChannelKernel:
    """The kernel of a channel with values of 1, 2 or 3 components, over the elements of a surface."""
    if channel.is_linear:
        return LinearChannelKernel(channel, walk, float_type)
    return ChannelKernel(channel, float_type)


class ChannelKernel:
    """Evaluates values that are subdivided like points."""

    def __init__(self, channel: Channel, float_type: type) -> None:
        table = PieceTable.build(channel.patches, channel.value_index, len(channel.values))
        self._kernel = PieceKernel.shared(table, float_type)
        values = ControlValues(self._kernel.types, channel.values.shape[1], CoefficientMap.shared(table, float_type))
        self.values = values.load(channel.values)

    def __call__(self, location: Location, active: Mask = True) -> tuple[Value, Value, Value]:
        """The value, and its derivatives by the parameters."""
        u, v = dr.detach(location.u), dr.detach(location.v)
        evaluate = self.at(location.half_edge, u, v, active)
        if dr.grad_enabled(location.u, location.v):
            values = evaluate(derivatives=2).shifted(location.u - u, location.v - v)
        else:
            values = evaluate()
        return values.value, values.du, values.dv

    def at(self, half_edge: Index, u: Float, v: Float, active: Mask = True) -> Callable[..., PatchValues]:
        """A function that evaluates the polynomial under given parameters, see `Piece.values`."""
        return self._kernel.piece(self.values.flat, half_edge, u, v, active, size=self.values.size).values


class LinearChannelKernel(ChannelKernel):
    """Evaluates linearly interpolated values."""

    def __init__(self, channel: Channel, walk: ElementWalk, float_type: type) -> None:
        self._types, self._walk = ArrayTypes(float_type), walk
        patches = channel.patches
        half_edges = patches.half_edge_of_corner
        self._has_polygons = not patches.is_whole.all()
        rows, linear_map = channel.value_index[half_edges], None
        if self._has_polygons:
            # Values at centres of elements are stored after all others. Rows alternate between a half-edge and its
            # centre.
            rows = np.stack([rows, len(channel.values) + patches.topology.face[half_edges]], axis=1)
            linear_map = SparseMatrix(channel.with_centres, float_type)
        self.values = ControlValues(self._types, channel.values.shape[1], linear_map).load(channel.values)
        self._monomials = Monomials(_POWERS[: walk.domain.corner_count])
        self._rows = self._types.indices(rows)

    def at(self, half_edge: Index, u: Float, v: Float, active: Mask = True) -> Callable[..., PatchValues]:
        """A function that evaluates a whole element, or a corner of another element, from one of its half-edges."""
        row = self._walk.row(half_edge, active)
        following, preceding = row[FOLLOWING], row[PRECEDING]
        origin, along_u, along_v = (self._value(edge, active) for edge in (half_edge, following, preceding))
        mixed = []
        if self._walk.domain.corner_count == 4:
            opposite = self._value(self._walk.row(following, active)[FOLLOWING], active)
            if self._has_polygons:
                is_whole = (row[CODE] & WHOLE) != 0
                opposite = dr.select(is_whole, opposite, self._value(half_edge, active, of_centre=True))
                along_u = dr.select(is_whole, along_u, (along_u + origin) * 0.5)
                along_v = dr.select(is_whole, along_v, (along_v + origin) * 0.5)
            mixed.append((opposite - along_v) - (along_u - origin))
        return partial(self._evaluated, [origin, along_u - origin, along_v - origin, *mixed], u, v)

    def _evaluated(
        self, coefficients: Sequence[Value], u: Float, v: Float, du: Float = 0, dv: Float = 0, derivatives: int = 1
    ) -> PatchValues:
        value, by_u, by_v, *second = self._monomials.values(coefficients, u + du, v + dv, derivatives)
        return PatchValues(value, by_u, by_v, value * 0, tuple(second))

    def _value(self, half_edge: Index, active: Mask, *, of_centre: bool = False) -> Value:
        types = self._types
        row = 2 * half_edge + int(of_centre) if self._has_polygons else half_edge
        return self.values.fetch(dr.gather(types.index, self._rows, row, active), active)
