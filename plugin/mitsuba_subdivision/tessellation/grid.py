"""Vertices and triangles of uniform tessellations, shared along the edges of the elements.

Every edge carries the same samples seen from both sides, and each vertex of the tessellation has one number, so that
nothing can crack. Numbers go to the corners of the elements first, then to samples inside edges, then to samples inside
elements; those of one edge, and of one element, follow each other.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from ..mesh.connectivity import IndexArray, IntArray, Topology, gathered
from ..schemes.domain import FloatArray

VertexArray = NDArray[np.uint32]

# Triangles are made in runs of about this many vertices, which stay in a core's cache.
RUN = 1 << 16


@dataclass(frozen=True, eq=False)
class GridPart:
    """Samples whose vertices follow each other, and the patches that evaluate them; of several that share them, one.

    Attributes
    ----------
    samples : (S,) int64
        Indices into the grid of a patch.
    patches : (P,) int32
        Ascending.
    first_vertex : (P,) uint32
        Sample ``s`` of the part is vertex ``first_vertex + s``.
    corners : (P,) int32
        Corners of elements, which the samples may be counted from, too.
    uv : (S, 2) float64
        The samples' parameters from these corners.
    """

    samples: IntArray
    patches: IndexArray
    first_vertex: VertexArray
    corners: IndexArray
    uv: FloatArray

    def __post_init__(self) -> None:
        # There are as many as patches: 32 bits each.
        for name, kind in (("patches", np.int32), ("first_vertex", np.uint32), ("corners", np.int32)):
            object.__setattr__(self, name, getattr(self, name).astype(kind, copy=False))

    def shifted(self, count: int) -> GridPart:
        """The part, for patches that are numbered after others."""
        return replace(self, patches=self.patches + count) if count else self


@dataclass(frozen=True, eq=False)
class GridLayout:
    """The grids of patches that begin at given corners.

    Attributes
    ----------
    uv : (S, 2) float64
        Parameters of the samples.
    parts : list of GridPart
        Together they hold every vertex once that no other patch evaluates.
    """

    uv: FloatArray
    parts: list[GridPart]


class Grid(Protocol):
    """Numbering of a uniform tessellation.

    Attributes
    ----------
    topology : Topology
        Of the elements: each face is an element.
    rate : int
        Segments on every edge.
    outline : Outline
        Numbering of the vertices on edges.
    vertex_count : int
    """

    topology: Topology
    rate: int
    outline: Outline
    vertex_count: int

    def layout(self, corners: IntArray) -> GridLayout:
        """Grids of patches that begin at these corners; all whole elements, or all not."""
        ...

    def triangles(self) -> VertexArray:
        """``(m, 3)`` counter-clockwise from outside, in the order of the elements."""
        ...

    def element(self) -> NDArray[np.uint32]:
        """``(m,)`` element of each triangle."""
        ...


@dataclass(frozen=True, eq=False)
class Outline:
    """Numbering of the vertices at corners and on edges.

    Parameters
    ----------
    topology : Topology
    rate : int
    """

    topology: Topology
    rate: int

    @cached_property
    def corner_vertex(self) -> VertexArray:
        """``(n_v,)`` number of each vertex of the topology; those that no face uses have none of their own."""
        return np.cumsum(self._is_used, dtype=np.uint32) - 1

    def edge_start(self, corners: IntArray) -> IntArray:
        """Number of the first vertex inside the edges that begin at corners, counted along the lowest half-edges."""
        start = gathered(self.topology.edge, corners).astype(np.int64)
        start *= self.rate - 1
        start += self._corner_count
        return start

    @cached_property
    def vertex_count(self) -> int:
        return self._corner_count + self.topology.edge_count * (self.rate - 1)

    @cached_property
    def _corner_count(self) -> int:
        return int(np.count_nonzero(self._is_used))

    @cached_property
    def _is_used(self) -> NDArray[np.bool_]:
        return self.topology.vertex_half_edge >= 0

    def along(self, corners: IndexArray, steps: IntArray) -> VertexArray:
        """Vertices ``steps`` segments along half-edges: ``(*corners.shape, len(steps))``; both ends included."""
        t, is_forward = self.topology, gathered(self.owns_edge, corners)
        # Sums wrap around 2^32, so that signs do no harm.
        start = (self.edge_start(corners) + np.where(is_forward, -1, self.rate - 1)).astype(np.uint32)
        step = np.where(is_forward, 1, -1).astype(np.uint32)
        numbers = start[..., None] + step[..., None] * steps.astype(np.uint32)
        for end, at in ((0, corners), (self.rate, t.following(corners))):
            numbers[..., steps == end] = self._at_corners(at)[..., None]
        return numbers

    @cached_property
    def owns_edge(self) -> NDArray[np.bool_]:
        """``(n_h,)`` whether the element of each corner evaluates the edge that begins there: the lowest one."""
        twin = self.topology.twin
        return (twin < 0) | (twin > np.arange(len(twin), dtype=np.int32))

    @cached_property
    def owns_vertex(self) -> NDArray[np.bool_]:
        """``(n_h,)`` whether the element of each corner evaluates the vertex there."""
        owns = np.zeros(self.topology.half_edge_count, dtype=bool)
        owns[self.topology.vertex_half_edge[self._is_used]] = True
        return owns

    def edge_part(self, owners: IntArray, corners: IntArray, samples: IntArray, uv: FloatArray) -> GridPart:
        """The first samples inside edges, for patches and the corners where their edges begin."""
        return GridPart(samples, owners, self.edge_start(corners), corners, uv)

    def vertex_part(self, owners: IntArray, corners: IntArray, sample: IntArray) -> GridPart:
        """One sample at the vertices of corners."""
        return GridPart(sample, owners, self._at_corners(corners), corners, np.zeros((1, 2)))

    def _at_corners(self, corners: IndexArray) -> VertexArray:
        """Vertices at corners of elements."""
        return gathered(self.corner_vertex, gathered(self.topology.face_vertices, corners))

    def parts(self, corners: IntArray, sides: list[IntArray], along: FloatArray) -> list[GridPart]:
        """Edges and corners of whole elements.

        Parameters
        ----------
        corners : (p,) int64
        sides : list of (rate + 1,) int64
            Samples of the element's sides, one after the other, counter-clockwise from the corner on.
        along : (rate + 1,) float64
            Their parameters.
        """
        parts = []
        uv = np.stack([along, np.zeros_like(along)], axis=1)
        for side in sides:
            owners = np.flatnonzero(gathered(self.owns_edge, corners))
            parts.append(self.edge_part(owners, gathered(corners, owners), side[1:-1], uv[1:-1]))
            owners = np.flatnonzero(gathered(self.owns_vertex, corners))
            parts.append(self.vertex_part(owners, gathered(corners, owners), side[:1]))
            corners = self.topology.following(corners)
        return parts


def runs(indices: IntArray, size: int) -> Iterator[IntArray]:
    """Cut indices into runs, each of about `RUN` numbers where an index stands for ``size``."""
    length = max(1, RUN // size)
    for begin in range(0, len(indices), length):
        yield indices[begin : begin + length]
