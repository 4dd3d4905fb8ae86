"""Numbering of uniform tessellations: the common base of grids over squares and over triangles.

The two elements at an edge share the samples on it, so there are no cracks. Corners of the elements are numbered first,
then samples inside edges, then samples inside elements. The samples inside an edge, and those inside an element, have
consecutive numbers.
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

# Vertices per slice when computing triangles, so that arrays stay in a core's cache.
VERTICES_AT_ONCE = 1 << 16


@dataclass(frozen=True, eq=False)
class GridPart:
    """A part of the grids of several patches, such as their inside or one of their sides.

    In every patch, the samples of the part are consecutive vertices. Where patches share samples, at corners and along
    edges, only the patch that evaluates them is in the part.
    """

    samples: IntArray  # (S,) int64: indices into the parameters of `UniformGrid.layout`
    patches: IntArray  # (P,) int32: patches in ascending order
    # (P,) uint32: vertex of the first sample in each patch; sample ``samples[i]`` is vertex ``first_vertex + i``
    first_vertex: IntArray
    corners: IntArray  # (P,) int32: a corner of each patch's element, not always the one at which the patch begins
    uv: FloatArray  # (S, 2) float64: parameters of the samples, starting at `corners`

    @classmethod
    def of(
        cls, samples: IntArray, patches: IntArray, first_vertex: IntArray, corners: IntArray, uv: FloatArray
    ) -> GridPart:
        """A part with arrays over patches converted to 32 bits."""
        return cls(
            samples,
            patches.astype(np.int32, copy=False),
            first_vertex.astype(np.uint32, copy=False),
            corners.astype(np.int32, copy=False),
            uv,
        )

    @property
    def vertices(self) -> IntArray:
        """``(P, S)`` vertices of the samples of each patch."""
        return self.first_vertex.astype(np.int64)[:, None] + np.arange(len(self.samples))


class UniformGrid(ABC):
    """Numbering of a uniform tessellation, see `Grid`."""

    whole_size: int
    """Corners of elements that fit the domain."""

    def __init__(
        self,
        # Of the elements: each face with corners is an element, and a half-edge represents the corner at which it
        # begins
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
        """The grids of the patches that begin at ``corners``, which are all whole elements or all not.

        Returns
        -------
        uv : (S, 2) float64
            Parameters of the samples of a patch, starting at the corner at which the patch begins.
        parts : list of GridPart
            Parts that together contain every vertex that these patches evaluate exactly once. Patches are numbered in
            the order of ``corners``.
        """

    @abstractmethod
    def triangle_parameters(self) -> tuple[FloatArray, FloatArray]:
        """Parameters at the corners of an element's triangles.

        Returns
        -------
        whole : (T, 3, 2) float64
            Triangles of a whole element; parameters start at its first corner.
        corner : (T, 3, 2) float64
            Triangles of one corner of any other element; parameters start at that corner. Some triangles may reach
            beyond u = 1, into the patch of the next corner.
        """

    @abstractmethod
    def triangles(self) -> NDArray[np.uint32]:
        """``(m, 3)`` vertices, counter-clockwise from outside, in the order of the elements."""

    @abstractmethod
    def element(self) -> NDArray[np.uint32]:
        """``(m,)`` element of each triangle."""

    def at_rate(self, rate: int) -> UniformGrid:
        """A grid of another rate over the same elements."""
        return type(self)(self.topology, rate)

    def cut(self, topology: Topology) -> UniformGrid:
        """See `Grid.cut`."""
        return type(self)(topology, self.rate)

    def vertices_of(self, other: UniformGrid) -> IntArray:
        """See `Grid.vertices_of`."""
        t, steps = self.topology, np.arange(1, self.rate)
        originals = np.empty(self.vertex_count, dtype=np.int64)
        originals[self.corner_vertex[t.face_vertices]] = other.corner_vertex[other.topology.face_vertices]
        originals[self.edge_start(t.edge_half_edge)[:, None] + steps - 1] = other.along(t.edge_half_edge, steps)
        originals[self.inner_begin :] = np.arange(other.inner_begin, other.vertex_count)
        return originals

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
        """``(n_v,)`` number of each vertex of the topology; undefined where no face uses it."""
        return np.cumsum(self._is_used, dtype=np.uint32) - 1

    def edge_start(self, corners: IntArray) -> IntArray:
        """Number of the first vertex inside the edge that begins at each corner, along the edge's lowest half-edge."""
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
        """Vertices ``steps`` segments along the edges that begin at corners: ``(*corners.shape, len(steps))``.

        Steps 0 and ``rate`` are the ends of the edge.
        """
        is_forward = self.owns_edge[corners]
        # Unsigned sums wrap around 2^32, so that 2^32 - 1 acts as -1.
        start = self.edge_start(corners).astype(np.uint32)
        start += np.where(is_forward, np.uint32(2**32 - 1), np.uint32(self.rate - 1))
        step = np.where(is_forward, np.uint32(1), np.uint32(2**32 - 1))
        # Corners are the last axis, as there are more corners than steps, and NumPy's inner loops should be long.
        numbers = np.multiply.outer(steps.astype(np.uint32), step)
        numbers += start
        for index in np.flatnonzero(steps == 0):
            numbers[index] = self._at_corners(corners)
        for index in np.flatnonzero(steps == self.rate):
            numbers[index] = self._at_corners(self.topology.next[corners])
        return np.moveaxis(numbers, 0, -1)

    @cached_property
    def owns_edge(self) -> NDArray[np.bool_]:
        """``(n_h,)`` whether each half-edge's element evaluates the edge: the element of the lower half-edge does."""
        twin = self.topology.twin
        return (twin < 0) | (twin > np.arange(len(twin), dtype=np.int32))

    @cached_property
    def owns_vertex(self) -> NDArray[np.bool_]:
        """``(n_h,)`` whether the element of each corner evaluates the vertex there."""
        owns = np.zeros(self.topology.half_edge_count, dtype=bool)
        owns[self.topology.vertex_half_edge[self._is_used]] = True
        return owns

    def edge_part(self, owners: IntArray, corners: IntArray, samples: IntArray, uv: FloatArray) -> GridPart:
        """The part of the samples inside edges that begin at corners of the patches ``owners``."""
        return GridPart.of(samples, owners, self.edge_start(corners), corners, uv)

    def vertex_part(self, owners: IntArray, corners: IntArray, sample: IntArray) -> GridPart:
        """The part of one sample, at corners of the patches ``owners``."""
        return GridPart.of(sample, owners, self._at_corners(corners), corners, np.zeros((1, 2)))

    def _at_corners(self, corners: IntArray) -> NDArray[np.uint32]:
        """Vertices at corners."""
        return self.corner_vertex[self.topology.face_vertices[corners]]

    def side_parts(
        self,
        corners: IntArray,  # (p,) int64: corners at which the patches begin
        # list of (rate + 1,) int64: samples of a patch's sides, counter-clockwise from the corner
        sides: list[IntArray],
        along: FloatArray,  # (rate + 1,) float64: parameters of the samples along a side
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
    """Split indices, each of which represents ``size`` vertices, into slices of about `VERTICES_AT_ONCE` vertices."""
    length = max(1, VERTICES_AT_ONCE // size)
    for begin in range(0, len(indices), length):
        yield indices[begin : begin + length]
