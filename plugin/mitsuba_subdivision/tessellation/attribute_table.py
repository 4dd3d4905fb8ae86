"""Attributes at the vertices of a tessellation, which has a copy of a vertex for each side of a seam."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..mesh.connectivity import IntArray
from ..mesh.seams import cut_along_seams
from ..patches import Channel, LinearChannel, PatchTable, SubdividedChannel
from ..schemes.domain import FloatArray
from .grid import Grid
from .sampling_table import CHUNK, SamplingTable


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
        channels: Mapping[str, Channel],
    ) -> AttributeTable:
        """Evaluate attributes in float64.

        Parameters
        ----------
        table : SamplingTable
            Of the tessellation.
        patches, copy_of
            What the table was built from.
        channels : dict of str to Channel
        """
        seams = [channel.seam for channel in channels.values() if channel.seam is not None]
        is_subdivided = all(isinstance(channel, SubdividedChannel) for channel in channels.values())
        if is_subdivided and not seams and all(channel.patches is patches for channel in channels.values()):
            values = {name: _on_surface(table, copy_of, channel) for name, channel in channels.items()}
            return cls(None, table.triangles, values)

        # Only elements that are faces get here. The grids number the same places of the same faces and edges.
        grid, vertex = table.grid, None
        if seams:
            cut = cut_along_seams(patches.topology, np.any(seams, axis=0))
            elements = PatchTable(cut.topology, patches.scheme, patches.is_hole).elements
            grid = type(table.grid)(elements, table.grid.rate)
            vertex = matching_vertices(grid, table.grid)
        values = {}
        for name, channel in channels.items():
            if isinstance(channel, LinearChannel):
                values[name] = channel.evaluate(*_places(grid, patches.scheme.domain.corner_count))
            elif channel.patches is patches:
                found = _on_surface(table, copy_of, channel)
                values[name] = found if vertex is None else found[vertex]
            else:
                own = SamplingTable.build(channel.patches, table.grid.rate)
                found = _interpolated(own, channel.values[channel.row])
                values[name] = found[matching_vertices(grid, own.grid)]
        return cls(vertex, grid.triangles() if seams else table.triangles, values)

    def gathered(self, values: NDArray) -> NDArray:
        """What the sampling table has at its vertices, at the vertices of this one."""
        return values if self.vertex is None else values[self.vertex]


def matching_vertices(fine: Grid, coarse: Grid) -> IntArray:
    """For each vertex of a grid, the one at the same place of another, over the same mesh with fewer edges cut.

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
    """A corner of an element and parameters from it for each vertex of a grid.

    Returns
    -------
    (n,) int64, (n, 2) float64
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


def _on_surface(table: SamplingTable, copy_of: IntArray, channel: Channel) -> FloatArray:
    """Values at the table's vertices of a channel without seams, on the same mesh as the surface."""
    at_control_points = np.zeros((table.control_count, channel.values.shape[1]))
    at_control_points[copy_of] = channel.values[channel.row]
    found = _interpolated(table, at_control_points)
    found[table.copies[0]] = found[table.copies[1]]
    return found


def _interpolated(table: SamplingTable, control_values: FloatArray) -> FloatArray:
    """``(n, k)`` values at the table's vertices from ``(control_count, k)`` ones."""
    control_values = table.class_points(control_values)
    found = np.empty((table.vertex_count, control_values.shape[1]))
    for evaluated in table.class_parts:
        members, samples, patches = evaluated.members, evaluated.part.samples, evaluated.patches
        weights, run = members.weights[0, samples], max(1, CHUNK // len(samples))
        for begin in range(0, len(patches), run):
            controls = members.controls[patches[begin : begin + run]]
            origin = control_values[controls[:, :1]]
            vertices = evaluated.first_vertex[begin : begin + run, None] + np.arange(len(samples))
            found[vertices] = origin + weights @ (control_values[controls] - origin)
    return found
