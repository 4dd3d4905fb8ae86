"""Attributes and texture coordinates at any parameters, as `patches.channel` interpolates them."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import drjit as dr
import numpy as np

from ..patches import LinearChannel, PieceTable
from ..patches.piece_table import FOLLOWING, PRECEDING
from .array_types import ArrayTypes
from .patch_kernel import PatchKernel

if TYPE_CHECKING:
    from ..patches import Channel, SubdividedChannel
    from .element_walk import ElementWalk, Location


class SubdividedChannelKernel:
    """Values that are subdivided as points are.

    Parameters
    ----------
    channel : SubdividedChannel
        Of 1, 2 or 3 numbers.
    float_type : type
        Flat Dr.Jit array, or ``float``.
    """

    def __init__(self, channel: SubdividedChannel, float_type: type) -> None:
        self._types = ArrayTypes.of(float_type)
        table = PieceTable.build(channel.patches, channel.row, len(channel.values))
        values = channel.values if table.refinement is None else table.refinement @ channel.values
        self._kernel = PatchKernel(table, float_type)
        self._kind, self._values = self._types.vector(values.shape[1]), self._types.floats(values)

    def __call__(self, location: Location, active: Any = True) -> tuple[Any, Any, Any]:
        """The value, and its derivatives by the parameters."""
        found = self._kernel.piece(self._fetch, location.half_edge, location.u, location.v, active).values()
        return found.value, found.du, found.dv

    def _fetch(self, index: Any, active: Any) -> Any:
        return self._types.fetch(self._kind, self._values, index, active)


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
    """

    def __init__(self, channel: LinearChannel, walk: ElementWalk, float_type: type) -> None:
        self._types, self._walk = ArrayTypes.of(float_type), walk
        patches = channel.patches
        t, half_edges = patches.topology, patches.half_edge_of_corner
        self._is_triangular = patches.scheme.domain.corner_count == 3
        self._has_polygons = not patches.is_whole.all()
        values, rows = channel.values, channel.row[half_edges]
        if self._has_polygons:
            # The centre's value comes after all others, and its row after those of the half-edges.
            rows = np.stack([rows, len(values) + t.face_of(half_edges)], axis=1)
            values = np.concatenate([values, channel.centres])
        self._kind, self._values = self._types.vector(values.shape[1]), self._types.floats(values)
        self._rows = self._types.indices(rows)

    def __call__(self, location: Location, active: Any = True) -> tuple[Any, Any, Any]:
        """The value, and its derivatives by the parameters."""
        following, preceding = (
            self._walk.neighbour(location.half_edge, column, active) for column in (FOLLOWING, PRECEDING)
        )
        origin, along_u, along_v = (self._at(edge, active) for edge in (location.half_edge, following, preceding))
        if self._is_triangular:
            du, dv = along_u - origin, along_v - origin
            return origin + location.u * du + location.v * dv, du, dv
        opposite = self._at(self._walk.neighbour(following, FOLLOWING, active), active)
        if self._has_polygons:
            is_whole = self._walk.is_whole(location.half_edge, active)
            opposite = dr.select(is_whole, opposite, self._at(location.half_edge, active, of_centre=True))
            along_u = dr.select(is_whole, along_u, (along_u + origin) * 0.5)
            along_v = dr.select(is_whole, along_v, (along_v + origin) * 0.5)
        du = (along_u - origin) * (1 - location.v) + (opposite - along_v) * location.v
        dv = (along_v - origin) * (1 - location.u) + (opposite - along_u) * location.u
        return origin + (along_u - origin) * location.u + dv * location.v, du, dv

    def _at(self, half_edge: Any, active: Any, *, of_centre: bool = False) -> Any:
        types = self._types
        location = 2 * half_edge + int(of_centre) if self._has_polygons else half_edge
        row = types.fetch(types.index, self._rows, location, active)
        return types.fetch(self._kind, self._values, row, active)


ChannelKernel = SubdividedChannelKernel | LinearChannelKernel


def channel_kernel(channel: Channel, walk: ElementWalk, float_type: type) -> ChannelKernel:
    """The kernel of a channel."""
    if isinstance(channel, LinearChannel):
        return LinearChannelKernel(channel, walk, float_type)
    return SubdividedChannelKernel(channel, float_type)
