"""Numbering of uniform tessellations: what grids over squares and over triangles have in common.

Every edge carries the same samples seen from both sides, and each vertex of the tessellation has one number, so that
nothing can crack. Corners of the elements are numbered first, then samples inside edges, then samples inside elements.
The samples inside one edge, and those inside one element, have successive numbers.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from ..mesh.connectivity import IntArray, Topology
from ..schemes.domain import FloatArray

# Triangles are made in slices of about this many vertices, which stay in a core's cache.
VERTICES_AT_ONCE = 1 << 16


@dataclass(frozen=True, eq=False)
class GridPart:
    """A part of the grids of some patches, such as their inside or one of their sides.

    In every patch, the samples of the part are successive vertices. Where patches share samples, at corners and along
    edges, only one of the patches is in the part: the one that evaluates them.
    """

    samples: IntArray  # (S,) int64: indices into the parameters of `UniformGrid.layout`
    patches: IntArray  # (P,) int32: ascending
    # (P,) uint32: vertex of the first sample in each patch; sample ``samples[i]`` is vertex ``first_vertex + i``
    first_vertex: IntArray
    corners: IntArray  # (P,) int32: A corner of each patch's element, not always the one that the patch begins at
    uv: FloatArray  # (S, 2) float64: the samples' parameters, seen from these corners

    @classmethod
    def of(
        cls, samples: IntArray, patches: IntArray, first_vertex: IntArray, corners: IntArray, uv: FloatArray
    ) -> GridPart:
        """A part of these samples, with 32 bits for each of the numbers of which there are as many as patches."""
        return cls(
            samples,
            patches.astype(np.int32, copy=False),
            first_vertex.astype(np.uint32, copy=False),
            corners.astype(np.int32, copy=False),
            uv,
        )

    @property
    def vertices(self) -> IntArray:
        """``(P, S)`` the vertices of all samples of each patch."""
        return self.first_vertex.astype(np.int64)[:, None] + np.arange(len(self.samples))


class UniformGrid(ABC):
    """Numbering of a uniform tessellation, see `Grid`."""

    whole_size: int
    """Corners of elements that fit the domain."""

    def __init__(
        self,
        # Of the elements: each face is an element, and a half-edge stands for the corner where it begins.
        # Faces without corners are left out.
        topology: Topology,
        rate: int,  # Segments on every edge
    ) -> None:
        self.topology, self.rate = topology, rate

    @property
    @abstractmethod
    def vertex_count(self) -> int:
        """Vertices of the tessellation."""

    @property
    @abstractmethod
    def triangle_counts(self) -> IntArray:
        """``(n_f,)`` triangles of each element."""

    @abstractmethod
    def layout(self, corners: IntArray) -> tuple[FloatArray, list[GridPart]]:
        """Grids of the patches that begin at these corners, numbered from 0; all of them whole elements, or none.

        Returns
        -------
        uv : (S, 2) float64
            Parameters of the samples of any patch, seen from the corner that it begins at.
        parts : list of GridPart
            Together they hold every vertex once that these patches evaluate, and not others.
        """

    @abstractmethod
    def triangle_parameters(self) -> tuple[FloatArray, FloatArray]:
        """Parameters at the corners of an element's triangles.

        Returns
        -------
        whole : (T, 3, 2) float64
            Of an element that fits the domain, seen from its first corner.
        corner : (T, 3, 2) float64
            Of a corner of any other element, to which so many triangles belong for each; seen from that corner. Some
            may reach beyond u = 1, into the next corner.
        """

    @abstractmethod
    def triangles(self) -> NDArray[np.uint32]:
        """``(m, 3)`` vertices, counter-clockwise from outside, in the order of the elements."""

    @abstractmethod
    def element(self) -> NDArray[np.uint32]:
        """``(m,)`` element of each triangle."""

    def at_rate(self, rate: int) -> UniformGrid:
        """The grid of another rate over the same elements."""
        return type(self)(self.topology, rate)

    def cut(self, topology: Topology) -> UniformGrid:
        """See `Grid.cut`."""
        return type(self)(topology, self.rate)

    def vertices_of(self, other: UniformGrid) -> IntArray:
        """See `Grid.vertices_of`."""
        t, steps = self.topology, np.arange(1, self.rate)
        found = np.empty(self.vertex_count, dtype=np.int64)
        found[self.corner_vertex[t.face_vertices]] = other.corner_vertex[other.topology.face_vertices]
        found[self.edge_start(t.edge_half_edge)[:, None] + steps - 1] = other.along(t.edge_half_edge, steps)
        found[self.inner_begin :] = np.arange(other.inner_begin, other.vertex_count)
        return found

    def locations(self) -> tuple[IntArray, FloatArray]:
        """See `Grid.locations`."""
        t = self.topology
        half_edge, uv = np.zeros(self.vertex_count, dtype=np.int64), np.zeros((self.vertex_count, 2))
        is_whole = t.face_sizes == self.whole_size
        for corners in (t.face_offsets[:-1][is_whole], t.half_edges_of(~is_whole)):
            if len(corners):
                for part in self.layout(corners)[1]:
                    half_edge[part.vertices] = part.corners[:, None]
                    uv[part.vertices] = part.uv
        return half_edge, uv

    @cached_property
    def corner_vertex(self) -> NDArray[np.uint32]:
        """``(n_v,)`` number of each vertex of the topology; without meaning where no face uses it."""
        return np.cumsum(self._is_used, dtype=np.uint32) - 1

    def edge_start(self, corners: IntArray) -> IntArray:
        """Number of the first vertex inside each edge that begins at a corner, along the edge's lowest half-edge."""
        start = self.topology.edge[corners].astype(np.int64)
        start *= self.rate - 1
        start += self._corner_count
        return start

    @cached_property
    def inner_begin(self) -> int:
        """Number of the first vertex inside an element."""
        return self._corner_count + self.topology.edge_count * (self.rate - 1)

    @cached_property
    def _corner_count(self) -> int:
        return int(np.count_nonzero(self._is_used))

    @cached_property
    def _is_used(self) -> NDArray[np.bool_]:
        return self.topology.vertex_half_edge >= 0

    def along(self, corners: IntArray, steps: IntArray) -> NDArray[np.uint32]:
        """Vertices after so many segments along the edges from corners: ``(*corners.shape, len(steps))``.

        Steps 0 and ``rate`` are the edge's ends.
        """
        is_forward = self.owns_edge[corners]
        # Sums wrap around 2^32, so that signs do no harm.
        start = self.edge_start(corners).astype(np.uint32)
        start += np.where(is_forward, np.uint32(2**32 - 1), np.uint32(self.rate - 1))
        step = np.where(is_forward, np.uint32(1), np.uint32(2**32 - 1))
        # There are more corners than steps, and NumPy's loops over a last axis should be long.
        numbers = np.multiply.outer(steps.astype(np.uint32), step)
        numbers += start
        for place in np.flatnonzero(steps == 0):
            numbers[place] = self._at_corners(corners)
        for place in np.flatnonzero(steps == self.rate):
            numbers[place] = self._at_corners(self.topology.next[corners])
        return np.moveaxis(numbers, 0, -1)

    @cached_property
    def owns_edge(self) -> NDArray[np.bool_]:
        """``(n_h,)`` whether the element of each corner evaluates the edge that begins there: that of the lower one."""
        twin = self.topology.twin
        return (twin < 0) | (twin > np.arange(len(twin), dtype=np.int32))

    @cached_property
    def owns_vertex(self) -> NDArray[np.bool_]:
        """``(n_h,)`` whether the element of each corner evaluates the vertex there."""
        owns = np.zeros(self.topology.half_edge_count, dtype=bool)
        owns[self.topology.vertex_half_edge[self._is_used]] = True
        return owns

    def edge_part(self, owners: IntArray, corners: IntArray, samples: IntArray, uv: FloatArray) -> GridPart:
        """Samples inside the edges from corners, whose patches are ``owners``."""
        return GridPart.of(samples, owners, self.edge_start(corners), corners, uv)

    def vertex_part(self, owners: IntArray, corners: IntArray, sample: IntArray) -> GridPart:
        """One sample, which lies at corners, whose patches are ``owners``."""
        return GridPart.of(sample, owners, self._at_corners(corners), corners, np.zeros((1, 2)))

    def _at_corners(self, corners: IntArray) -> NDArray[np.uint32]:
        """Vertices at corners."""
        return self.corner_vertex[self.topology.face_vertices[corners]]

    def side_parts(
        self,
        corners: IntArray,  # (p,) int64: where the patches begin
        # list of (rate + 1,) int64: samples of a patch's sides, counter-clockwise from this corner on
        sides: list[IntArray],
        along: FloatArray,  # (rate + 1,) float64: parameters of these along a side
    ) -> list[GridPart]:
        """Parts at the corners and along the sides of patches that are whole elements."""
        parts = []
        uv = np.stack([along, np.zeros_like(along)], axis=1)
        for side in sides:
            owners = np.flatnonzero(self.owns_edge[corners])
            parts.append(self.edge_part(owners, corners[owners], side[1:-1], uv[1:-1]))
            owners = np.flatnonzero(self.owns_vertex[corners])
            parts.append(self.vertex_part(owners, corners[owners], side[:1]))
            corners = self.topology.next[corners]
        return parts


def slices_of(indices: IntArray, size: int) -> Iterator[IntArray]:
    """Cut indices, each of which stands for ``size`` vertices, into slices of about `VERTICES_AT_ONCE`."""
    length = max(1, VERTICES_AT_ONCE // size)
    for begin in range(0, len(indices), length):
        yield indices[begin : begin + length]
