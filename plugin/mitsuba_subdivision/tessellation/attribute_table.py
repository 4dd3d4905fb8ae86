"""Attributes at the vertices of a tessellation, which has a vertex of its own for each side of a seam."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cache, cached_property, partial
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from ..mesh.connectivity import IntArray
from ..mesh.shared import Content, Shared
from ..patches import PatchTable
from ..schemes.domain import FloatArray
from .grid import Grid, grid_of
from .sampling_table import CHUNK, SamplingTable

if TYPE_CHECKING:
    from ..patches import Channel, ChannelLayout
    from .adaptive_table import AdaptiveTable


@dataclass(frozen=True, eq=False)
class AttributeLayout:
    """A tessellation whose vertices have attributes, whatever these are: triangles, and where vertices lie.

    Attributes
    ----------
    surface_vertex : (n,) int64 or None
        For each split vertex, the vertex of the `SamplingTable` whose position and normal it has. None where there are
        no seams, and both tables have the same vertices.
    find_triangles : callable
        Makes `triangles`, when these are asked for.
    evaluate : tuple of callables
        Each makes the values at the vertices, ``(n, k)`` float64, of a channel of one layout.
    locate : callable, or None
        Finds where split vertices lie, each on its own side of seams, as `SamplingTable.locations`. None where both
        tables have the same vertices.
    """

    surface_vertex: IntArray | None
    find_triangles: Callable[[], NDArray[np.uint32]]
    evaluate: tuple[Callable[[Channel], FloatArray], ...] = ()
    locate: Callable[[], tuple[IntArray, FloatArray]] | None = None

    @cached_property
    def triangles(self) -> NDArray[np.uint32]:
        """``(m, 3)``: the sampling table's triangles in the same order, each with its corners in the same order."""
        return self.find_triangles()


_LAYOUTS: Shared[AttributeLayout] = Shared()


@dataclass(frozen=True, eq=False)
class AttributeTable:
    """A tessellation whose vertices have attributes.

    Attributes
    ----------
    layout : AttributeLayout
        Tables of the same tessellation, with attributes of the same layouts, share it.
    values : dict of str to (n, k) float64
        At the vertices, by the name of the attribute; read-only, as tables of the same values share them.
    """

    layout: AttributeLayout
    values: Mapping[str, FloatArray]

    @classmethod
    def build(
        cls,
        table: SamplingTable | AdaptiveTable,
        patches: PatchTable,
        control_of_vertex: IntArray,
        channels: Mapping[str, Channel],
    ) -> AttributeTable:
        """Evaluate attributes in float64.

        Parameters
        ----------
        table : SamplingTable or AdaptiveTable
            Of the tessellation.
        patches, control_of_vertex
            What the table was built from.
        channels : dict of str to Channel
        """
        layouts = tuple(channel.layout for channel in channels.values())

        def make() -> AttributeLayout:
            if isinstance(table, SamplingTable):
                return _uniform(table, patches, control_of_vertex, layouts)
            return _adaptive(table, patches, layouts)

        layout = _LAYOUTS.get((table, *layouts), make)
        values = {
            name: _VALUES.get((layout, index, Content(channel.values)), partial(_read_only, evaluate, channel))
            for index, (evaluate, (name, channel)) in enumerate(zip(layout.evaluate, channels.items(), strict=True))
        }
        return cls(layout, values)

    @property
    def surface_vertex(self) -> IntArray | None:
        """See `AttributeLayout`."""
        return self.layout.surface_vertex

    @property
    def locate(self) -> Callable[[], tuple[IntArray, FloatArray]] | None:
        """See `AttributeLayout`."""
        return self.layout.locate

    @property
    def triangles(self) -> NDArray[np.uint32]:
        """See `AttributeLayout`."""
        return self.layout.triangles

    def gathered(self, values: NDArray) -> NDArray:
        """Values at the vertices of this table, from values at the vertices of the sampling table."""
        return values if self.surface_vertex is None else values[self.surface_vertex]


def _read_only(evaluate: Callable[[Channel], FloatArray], channel: Channel) -> FloatArray:
    values = evaluate(channel)
    values.flags.writeable = False
    return values


_VALUES: Shared[FloatArray] = Shared()


def _uniform(
    table: SamplingTable, patches: PatchTable, control_of_vertex: IntArray, layouts: tuple[ChannelLayout, ...]
) -> AttributeLayout:
    """Attributes of a uniform tessellation."""
    if not layouts:
        return AttributeLayout(None, lambda: table.triangles)
    from ..mesh.seams import cut_along_seams
    from ..patches import LinearChannel, SubdividedChannel

    seams = [layout.seam for layout in layouts if layout.seam is not None]
    is_subdivided = all(layout.kind is SubdividedChannel for layout in layouts)
    on_surface = partial(_on_surface, table, control_of_vertex)
    if is_subdivided and not seams and all(layout.patches is patches for layout in layouts):
        return AttributeLayout(None, lambda: table.triangles, (on_surface,) * len(layouts))

    # Only elements that are faces get here. All grids lie over the same faces and edges, with vertices at the same
    # places, though numbered differently where more edges are cut.
    grid, surface_vertex = table.grid, None
    if seams:
        cut = cut_along_seams(patches.topology, np.any(seams, axis=0))
        grid = grid_of(PatchTable(cut.topology, patches.scheme, patches.is_hole), table.grid.rate)
        surface_vertex = matching_vertices(grid, table.grid)
    locate = cache(partial(_places, grid, patches.scheme.domain.corner_count))

    def evaluate(layout: ChannelLayout) -> Callable[[Channel], FloatArray]:
        if layout.kind is LinearChannel:
            return lambda channel: channel.evaluate(*locate())
        if layout.patches is patches:
            return lambda channel: _chosen(on_surface(channel), surface_vertex)
        own = SamplingTable.build(layout.patches, table.grid.rate)
        places = matching_vertices(grid, own.grid)
        return lambda channel: _interpolated(own, channel.values[channel.value_index])[places]

    triangles = grid.triangles if seams else lambda: table.triangles
    return AttributeLayout(surface_vertex, triangles, tuple(map(evaluate, layouts)), locate if seams else None)


def _adaptive(table: AdaptiveTable, patches: PatchTable, layouts: tuple[ChannelLayout, ...]) -> AttributeLayout:
    """Attributes of an adaptive tessellation, evaluated where its vertices lie."""
    seams = [layout.seam for layout in layouts if layout.seam is not None]
    if not seams:
        return AttributeLayout(None, lambda: table.triangles, _evaluated_at(table.locations, layouts))
    from ..mesh.seams import cut_along_seams

    # Cut along all seams, elements have the same half-edges, and more edges and vertices.
    cut = cut_along_seams(patches.topology, np.any(seams, axis=0))
    topology, grid = PatchTable(cut.topology, patches.scheme, patches.is_hole).elements, table.grid
    vertices, count = grid.sample_vertices(topology)
    surface_vertex = np.empty(count, dtype=np.int64)
    surface_vertex[vertices], _ = grid.sample_vertices()
    locate = partial(grid.locations, topology)
    return AttributeLayout(surface_vertex, partial(grid.triangles, topology), _evaluated_at(locate, layouts), locate)


def _evaluated_at(
    locate: Callable[[], tuple[IntArray, FloatArray]], layouts: tuple[ChannelLayout, ...]
) -> tuple[Callable[[Channel], FloatArray], ...]:
    """Evaluation of channels where vertices lie, which is found once for all of them."""
    locate = cache(locate)
    return (lambda channel: channel.evaluate(*locate()),) * len(layouts)


def _chosen(values: FloatArray, rows: IntArray | None) -> FloatArray:
    return values if rows is None else values[rows]


def matching_vertices(fine: Grid, coarse: Grid) -> IntArray:
    """For each vertex of a grid, the vertex at the same place in another grid, over the same mesh with fewer edges cut.

    Returns
    -------
    (fine.vertex_count,) int64
    """
    outline, other, t = fine.outline, coarse.outline, fine.topology
    found = np.empty(fine.vertex_count, dtype=np.int64)
    found[outline.corner_vertex[t.face_vertices]] = other.corner_vertex[coarse.topology.face_vertices]
    steps = np.arange(1, fine.rate)
    found[outline.edge_start(t.edge_half_edge)[:, None] + steps - 1] = other.along(t.edge_half_edge, steps)
    found[outline.vertex_count :] = np.arange(other.vertex_count, coarse.vertex_count)
    return found


def _places(grid: Grid, corner_count: int) -> tuple[IntArray, FloatArray]:
    """Where each vertex of a grid lies: a corner of an element, and parameters seen from it.

    Returns
    -------
    start : (n,) int64
    uv : (n, 2) float64
    """
    t = grid.topology
    start, uv = np.zeros(grid.vertex_count, dtype=np.int64), np.zeros((grid.vertex_count, 2))
    is_whole = t.face_sizes == corner_count
    for corners in (t.face_offsets[:-1][is_whole], t.half_edges_of(~is_whole)):
        if not len(corners):
            continue
        for part in grid.layout(corners).parts:
            vertices = part.first_vertex[:, None] + np.arange(len(part.samples))
            start[vertices] = part.corners[:, None]
            uv[vertices] = part.uv
    return start, uv


def _on_surface(table: SamplingTable, control_of_vertex: IntArray, channel: Channel) -> FloatArray:
    """Values at the table's vertices, of a channel without seams that is subdivided on the surface's own mesh."""
    at_control_points = np.zeros((table.control_count, channel.values.shape[1]))
    at_control_points[control_of_vertex] = channel.values[channel.value_index]
    found = _interpolated(table, at_control_points)
    found[table.copies[0]] = found[table.copies[1]]
    return found


def _interpolated(table: SamplingTable, control_values: FloatArray) -> FloatArray:
    """``(n, k)`` values at the table's vertices from ``(control_count, k)`` ones."""
    control_values = table.refined(control_values)
    found = np.empty((table.vertex_count, control_values.shape[1]))
    for class_part in table.class_parts:
        stencils, samples, patches = class_part.stencils, class_part.part.samples, class_part.patches
        weights, run = stencils.weights[0, samples], max(1, CHUNK // len(samples))
        for begin in range(0, len(patches), run):
            controls = stencils.controls[patches[begin : begin + run]]
            origin = control_values[controls[:, :1]]
            vertices = class_part.first_vertex[begin : begin + run, None] + np.arange(len(samples))
            found[vertices] = origin + weights @ (control_values[controls] - origin)
    return found
