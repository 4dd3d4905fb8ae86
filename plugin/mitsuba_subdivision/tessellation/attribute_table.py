"""Attributes at the vertices of a tessellation, whose vertices are split along seams."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cache, cached_property, partial
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from ..mesh.connectivity import IntArray
from ..mesh.shared import Content, Shared
from ..patches.patch_table import PatchTable
from ..schemes.domain import FloatArray
from .uniform import uniform_table
from .uniform_grid import UniformGrid
from .vertex_table import VertexTable

if TYPE_CHECKING:
    from ..patches.channel import Channel, ChannelLayout


@dataclass(frozen=True, eq=False)
class AttributeLayout:
    """Triangles and vertex locations of a tessellation with attributes, independent of the attributes' values."""

    # (n,) int64 or None: the vertex of the `VertexTable` whose position and normal each split vertex has. None without
    # seams, when both tables have the same vertices.
    surface_vertex: IntArray | None
    find_triangles: Callable[[], NDArray[np.uint32]]  # Computes `triangles` on demand
    # Computes the locations of split vertices, on the vertices' sides of seams; see `UniformGrid.locations`
    locate: Callable[[], tuple[IntArray, FloatArray]]
    # For each channel layout, the function that evaluates a channel at the vertices: ``(n, k)`` float64
    evaluate: tuple[Callable[[Channel], FloatArray], ...] = ()

    @cached_property
    def triangles(self) -> NDArray[np.uint32]:
        """``(m, 3)``: the vertex table's triangles in the same order, each with its corners in the same order."""
        return self.find_triangles()

    def gathered(self, values: NDArray) -> NDArray:
        """Values at split vertices, from values at the vertices of the vertex table."""
        return values if self.surface_vertex is None else values[self.surface_vertex]


_LAYOUTS: Shared[AttributeLayout] = Shared()


@dataclass(frozen=True, eq=False)
class AttributeTable:
    """Attributes of a tessellation, evaluated at its vertices."""

    layout: AttributeLayout  # Shared by tables of the same tessellation and the same channel layouts
    # dict of str to (n, k) float64: values at the vertices by the name of the attribute; read-only, as tables with
    # equal values share them
    values: Mapping[str, FloatArray]

    @classmethod
    def build(
        cls,
        table: VertexTable,  # Of the tessellation
        patches: PatchTable,  # That the table was built from
        channels: Mapping[str, Channel],
    ) -> AttributeTable:
        """Evaluate attributes in float64."""
        layouts = tuple(channel.layout for channel in channels.values())
        layout = _LAYOUTS.get((table, *layouts), lambda: _layout(table, patches, layouts))
        values = {}
        for index, (name, channel) in enumerate(channels.items()):
            key, evaluate = (layout, index, Content(channel.values)), partial(layout.evaluate[index], channel)
            values[name] = _VALUES.get(key, evaluate)
            values[name].flags.writeable = False
        return cls(layout, values)


_VALUES: Shared[FloatArray] = Shared()


def _layout(table: VertexTable, patches: PatchTable, layouts: tuple[ChannelLayout, ...]) -> AttributeLayout:
    """The layout of attributes with the given channel layouts at the vertices of a tessellation."""
    # Only elements that are faces have seams. Cutting them along seams keeps their half-edges.
    grid, surface_vertex = table.grid, None
    seams = [layout.seam for layout in layouts if layout.seam is not None]
    if seams:
        from ..mesh.cuts import cut_along_seams

        cut = cut_along_seams(patches.topology, np.any(seams, axis=0))
        grid = grid.cut(PatchTable(cut.topology, patches.scheme, patches.is_hole).elements)
        surface_vertex = grid.vertices_of(table.grid)
    locate = cache(grid.locations)

    def interpolated(table: VertexTable, channel: Channel) -> FloatArray:
        control_values = np.zeros((table.control_count, channel.values.shape[1]))
        control_values[channel.layout.patches.control_of_vertex] = channel.values[channel.layout.value_index]
        return table.interpolated(control_values)

    def on_surface(channel: Channel) -> FloatArray:
        # Without seams, and subdivided on the surface's mesh.
        vertex_values = interpolated(table, channel)
        vertex_values[table.copies[0]] = vertex_values[table.copies[1]]
        return vertex_values if surface_vertex is None else vertex_values[surface_vertex]

    def evaluate(layout: ChannelLayout) -> Callable[[Channel], FloatArray]:
        if layout.patches is patches and not layout.is_linear:
            return on_surface
        if layout.is_linear or not isinstance(table.grid, UniformGrid):
            return lambda channel: channel.evaluate(*locate())
        channel_table = uniform_table(layout.patches, table.grid.rate)
        vertices = grid.vertices_of(channel_table.grid)
        return lambda channel: interpolated(channel_table, channel)[vertices]

    evaluations = tuple(map(evaluate, layouts))
    if not seams:
        return AttributeLayout(None, lambda: table.triangles, table.locations, evaluations)
    return AttributeLayout(surface_vertex, grid.triangles, locate, evaluations)
