"""Attributes at the vertices of a tessellation, whose vertices are split along seams."""

from __future__ import annotations

from collections.abc import Mapping
from functools import cached_property, partial
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from ..mesh.connectivity import IntArray
from ..mesh.cuts import cut_along_seams
from ..mesh.shared import Content, shared, shared_by_key
from ..patches.patch_table import PatchTable
from ..schemes.domain import FloatArray
from .uniform import uniform_table
from .uniform_grid import UniformGrid
from .vertex_table import VertexTable

if TYPE_CHECKING:
    from ..patches.channel import Channel, ChannelLayout


class AttributeLayout:
    """Triangles and vertex locations of a tessellation of patches with attributes, whatever the attributes' values."""

    def __init__(self, table: VertexTable, patches: PatchTable, layouts: tuple[ChannelLayout, ...]) -> None:
        self._table, self._patches, self._grid = table, patches, table.grid
        # (n,) int64 or None: the vertex of the `VertexTable` whose position and normal each split vertex has. None
        # without seams, when both tables have the same vertices.
        self.surface_vertex: IntArray | None = None
        # Tables of the meshes of channels, and the vertex there of each split vertex
        self._tables: dict[ChannelLayout, tuple[VertexTable, IntArray]] = {}
        if seams := [layout.seam for layout in layouts if layout.seam is not None]:
            # Only elements that are faces have seams. Cutting them along seams keeps their half-edges.
            cut = cut_along_seams(patches.topology, np.any(seams, axis=0))
            self._grid = table.grid.cut(PatchTable(cut.topology, patches.scheme, patches.is_hole).elements)
            self.surface_vertex = self._grid.vertices_of(table.grid)

    @cached_property
    def triangles(self) -> NDArray[np.uint32]:
        """``(m, 3)``: the vertex table's triangles in the same order, each with its corners in the same order."""
        return self._table.triangles if self.surface_vertex is None else self._grid.triangles()

    def locate(self) -> tuple[IntArray, FloatArray]:
        """The locations of split vertices, on the vertices' sides of seams; see `UniformGrid.locations`."""
        return self._grid.locations()

    def gathered(self, values: NDArray) -> NDArray:
        """Values at split vertices, from values at the vertices of the vertex table."""
        return values if self.surface_vertex is None else values[self.surface_vertex]

    def evaluated(self, channel: Channel) -> FloatArray:
        """``(n, k)`` float64 values of a channel, of one of the layouts, at the vertices."""
        layout, table, grid = channel.layout, self._table, self._table.grid
        if not layout.is_linear and layout.patches is self._patches:
            values = _interpolated(table, channel)
            values[table.copies[0]] = values[table.copies[1]]
            return self.gathered(values)
        if layout.is_linear or not isinstance(grid, UniformGrid):
            return channel.evaluate(*self.locate())
        if layout not in self._tables:
            table = uniform_table(layout.patches, grid.rate)
            self._tables[layout] = table, self._grid.vertices_of(table.grid)
        table, vertices = self._tables[layout]
        return _interpolated(table, channel)[vertices]


def _interpolated(table: VertexTable, channel: Channel) -> FloatArray:
    control_values = np.zeros((table.patches.control_count, channel.values.shape[1]))
    control_values[channel.layout.patches.control_of_vertex] = channel.values[channel.layout.value_index]
    return table.interpolated(control_values)


def attribute_table(
    table: VertexTable, patches: PatchTable, channels: Mapping[str, Channel]
) -> tuple[AttributeLayout, dict[str, FloatArray]]:
    """Evaluate attributes at the vertices of a tessellation.

    Returns the layout, shared by tessellations with the same channel layouts; and ``(n, k)`` float64 values by name,
    read-only, as attributes with equal values share them.
    """
    layout, values = shared(AttributeLayout, table, patches, tuple(c.layout for c in channels.values())), {}
    for name, channel in channels.items():
        key = AttributeLayout, layout, channel.layout, Content(channel.values)
        values[name] = shared_by_key(key, partial(layout.evaluated, channel))
        values[name].flags.writeable = False
    return layout, values
