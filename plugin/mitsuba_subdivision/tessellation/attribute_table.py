"""Attributes at the vertices of a tessellation, which has a copy of a vertex for each side of a seam."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..cage.connectivity import IntArray
from ..cage.face_varying import cut_along_seams
from ..patches import Channel, LinearChannel, PatchTable, SubdividedChannel
from ..schemes.domain import FloatArray
from .grid import Grid, edge_vertices
from .sampling_table import CHUNK, SamplingTable, uniform_grid


@dataclass(frozen=True, eq=False)
class AttributeTable:
    """Vertices of a tessellation with attributes, and the attributes' values there.

    Attributes
    ----------
    vertex : (n,) int64 or None
        The vertex of the `SamplingTable` whose position and normal each vertex has; None where they are the same.
    triangles : (m, 3) uint32
        In the order of the sampling table's, and with corners in the same order.
    values : dict of str to (n, k) float64
        By the name of the attribute.
    """

    vertex: IntArray | None
    triangles: NDArray[np.uint32]
    values: Mapping[str, FloatArray]

    @classmethod
    def build(
        cls,
        table: SamplingTable,
        patches: PatchTable,
        copy_of: IntArray,
        rate: int,
        channels: Mapping[str, Channel],
    ) -> AttributeTable:
        """Evaluate attributes in float64.

        Parameters
        ----------
        table : SamplingTable
            Of the tessellation.
        patches, copy_of, rate
            What the table was built from.
        channels : dict of str to Channel
        """
        seams = [channel.seam for channel in channels.values() if channel.seam is not None]
        is_subdivided = all(isinstance(channel, SubdividedChannel) for channel in channels.values())
        if is_subdivided and not seams and all(channel.patches is patches for channel in channels.values()):
            values = {name: _on_surface(table, copy_of, channel) for name, channel in channels.items()}
            return cls(None, table.triangles, values)

        # Only elements that are faces get here. The grids number the same places of the same faces and edges.
        def grid_of(patches: PatchTable) -> Grid:
            return uniform_grid(patches.elements, rate, patches.scheme.domain.corner_count)

        grid = whole = grid_of(patches)
        vertex = None
        if seams:
            cut = cut_along_seams(patches.topology, np.any(seams, axis=0))
            grid = grid_of(PatchTable(cut.topology, patches.scheme, patches.is_hole))
            vertex = matching_vertices(grid, whole)
        values = {}
        for name, channel in channels.items():
            if isinstance(channel, LinearChannel):
                values[name] = channel.evaluate(*_places(grid, patches.scheme.domain.corner_count))
            elif channel.patches is patches:
                found = _on_surface(table, copy_of, channel)
                values[name] = found if vertex is None else found[vertex]
            else:
                own = SamplingTable.build(channel.patches, rate)
                found = _interpolated(own, channel.values[channel.row])
                values[name] = found[matching_vertices(grid, grid_of(channel.patches))]
        return cls(vertex, grid.triangles, values)

    def gathered(self, values: NDArray) -> NDArray:
        """What the sampling table has at its vertices, at the vertices of this one."""
        return values if self.vertex is None else values[self.vertex]


def matching_vertices(fine: Grid, coarse: Grid) -> IntArray:
    """For each vertex of a grid, the one at the same place of another, over the same mesh with fewer edges cut.

    Returns
    -------
    (fine.vertex_count,) int64
    """
    t, rate = fine.topology, fine.rate
    # No triangle uses a vertex without elements.
    corners = np.minimum(np.arange(t.vertex_count), coarse.topology.vertex_count - 1)
    corners[t.face_vertices] = coarse.topology.face_vertices
    along = edge_vertices(coarse.topology, rate, t.edge_half_edge, np.arange(1, rate))
    begin = t.vertex_count + along.size
    inside = np.arange(fine.vertex_count - begin) + coarse.vertex_count - (fine.vertex_count - begin)
    return np.concatenate([corners, along.ravel(), inside])


def _places(grid: Grid, corner_count: int) -> tuple[IntArray, FloatArray]:
    """A corner of a face and parameters from it for each vertex of a grid; those of vertices without faces say nothing.

    Returns
    -------
    (n,) int64, (n, 2) float64
    """
    t = grid.topology
    start, uv = np.zeros(grid.vertex_count, dtype=np.int64), np.zeros((grid.vertex_count, 2))
    is_whole = t.face_sizes == corner_count
    for corners in (t.face_offsets[:-1][is_whole], np.flatnonzero(~is_whole[t.face])):
        if not len(corners):
            continue
        layout = grid.layout(corners)
        for part in layout.parts:
            chosen = np.flatnonzero(part.evaluates)
            vertices = layout.vertices[chosen[:, None], part.samples]
            start[vertices] = part.corners[chosen, None]
            uv[vertices] = part.uv
    return start, uv


def _on_surface(table: SamplingTable, copy_of: IntArray, channel: Channel) -> FloatArray:
    """Values at the table's vertices of a channel without seams, on the same mesh as the surface."""
    at_control_points = np.zeros((table.control_count, channel.values.shape[1]))
    at_control_points[copy_of] = channel.values[channel.row]
    return _interpolated(table, at_control_points)[table.welded]


def _interpolated(table: SamplingTable, control_values: FloatArray) -> FloatArray:
    """``(n, k)`` values at the table's vertices from ``(control_count, k)`` ones."""
    found = np.zeros((table.vertex_count, control_values.shape[1]))
    for block in table.blocks:
        run = max(1, CHUNK // block.controls.shape[1])
        for begin in range(0, len(block.controls), run):
            controls = block.controls[begin : begin + run]
            origin = control_values[controls[:, :1]]
            found[block.vertices[begin : begin + run]] = origin + block.weights[0] @ (control_values[controls] - origin)
    return found
