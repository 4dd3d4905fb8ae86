"""Evaluation of attributes and texture coordinates at any parameters, interpolated as in `patches.channel`."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import drjit as dr

from ..mesh.shared import shared
from ..patches.channel import Channel
from ..patches.piece_table import PieceTable
from .algebra import Monomials
from .array_types import ArrayTypes, Float, Index, Mask, Value
from .linear_maps import CoefficientMap, ControlValues, SparseMatrix
from .locations import Location
from .piece_kernel import PatchValues, PieceKernel

# Exponents of the monomials 1, u, v and, on the square, u v.
_POWERS = ((0, 0), (1, 0), (0, 1), (1, 1))


class ChannelKernel:
    """Evaluates a channel with values of 1, 2 or 3 components over the elements of a surface."""

    def __init__(self, channel: Channel, float_type: type) -> None:
        types, size = ArrayTypes(float_type), channel.values.shape[1]
        self._pieces: PieceKernel | None = None
        how: tuple = _linear_map, channel
        if channel.layout.is_linear:
            # A polynomial for each half-edge
            self._monomials = Monomials(_POWERS[: channel.layout.patches.scheme.domain.corner_count])
        else:
            table = PieceTable.build(channel.layout.patches, channel.layout.value_index, len(channel.values))
            self._pieces, how = shared(PieceKernel, table, float_type), (CoefficientMap, table)
        self._types, self.values = types, ControlValues(types, size, *how).load(channel.values)

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
        flat, size = self.values.flat, self.values.size
        if self._pieces is not None:
            return self._pieces.piece(flat, half_edge, u, v, active, size=size).values
        numbers = self._types.row(flat, size * len(self._monomials.powers), half_edge, active)
        return partial(self._linear_values, [numbers[i::size] for i in range(size)], u, v)

    def _linear_values(
        self, coefficients: list[list[Float]], u: Float, v: Float, du: Float = 0, dv: Float = 0, derivatives: int = 1
    ) -> PatchValues:
        components = (self._monomials.values(numbers, u + du, v + dv, derivatives) for numbers in coefficients)
        vector = self._types.vector(self.values.size)
        value, by_u, by_v, *second = (vector(*numbers) for numbers in zip(*components, strict=True))
        return PatchValues(value, by_u, by_v, value * 0, tuple(second))


def _linear_map(channel: Channel, float_type: type) -> SparseMatrix:
    return SparseMatrix(channel.linear_polynomials, float_type, is_relative=False)
