"""Numbers of the vertices on the elements' edges, which all grids share, and the parts that a patch's grid consists of.

Every edge carries the same samples seen from both sides, and each vertex of the tessellation has one number, so that
nothing can crack. Corners of the elements are numbered first, then samples inside edges, then samples inside elements.
The samples inside one edge, and those inside one element, have successive numbers.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from ..mesh.chunks import gathered
from ..mesh.connectivity import IntArray, Topology
from ..schemes.domain import FloatArray

# Triangles are made in runs of about this many vertices, which stay in a core's cache.
RUN = 1 << 16


@dataclass(frozen=True, eq=False)
class GridPart:
    """A part of the grids of some patches, such as their inside or one of their sides.

    In every patch, the samples of the part are successive vertices. Where patches share samples, at corners and along
    edges, only one of the patches is in the part: the one that evaluates them.

    Attributes
    ----------
    samples : (S,) int64
        Indices into `GridLayout.uv`.
    patches : (P,) int32
        Ascending.
    first_vertex : (P,) uint32
        Vertex of the first sample in each patch; sample ``samples[i]`` is vertex ``first_vertex + i``.
    corners : (P,) int32
        A corner of each patch's element, not always the one that the patch begins at.
    uv : (S, 2) float64
        The samples' parameters, seen from these corners.
    """

    samples: IntArray
    patches: IntArray
    first_vertex: IntArray
    corners: IntArray
    uv: FloatArray

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

    def shifted(self, count: int) -> GridPart:
        """The part, for patches that are numbered after ``count`` others."""
        return replace(self, patches=self.patches + count) if count else self


@dataclass(frozen=True, eq=False)
class GridLayout:
    """The grids of some patches, numbered from 0.

    Attributes
    ----------
    uv : (S, 2) float64
        Parameters of the samples of any patch, seen from the corner that it begins at.
    parts : list of GridPart
        Together they hold every vertex once that is evaluated by these patches, and not by others.
    """

    uv: FloatArray
    parts: list[GridPart]


class Outline:
    """Numbering of the vertices at corners of elements and on edges.

    Parameters
    ----------
    topology : Topology
        Of the elements: each face is an element, and a half-edge stands for the corner where it begins.
    rate : int
        Segments on every edge.
    """

    def __init__(self, topology: Topology, rate: int) -> None:
        self.topology, self.rate = topology, rate

    @cached_property
    def corner_vertex(self) -> NDArray[np.uint32]:
        """``(n_v,)`` number of each vertex of the topology; without meaning where no face uses it."""
        return np.cumsum(self._is_used, dtype=np.uint32) - 1

    def edge_start(self, corners: IntArray) -> IntArray:
        """Number of the first vertex inside each edge that begins at a corner, along the edge's lowest half-edge."""
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

    def along(self, corners: IntArray, steps: IntArray) -> NDArray[np.uint32]:
        """Vertices after so many segments along the edges from corners: ``(*corners.shape, len(steps))``.

        Steps 0 and ``rate`` are the edge's ends.
        """
        is_forward = gathered(self.owns_edge, corners)
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
            numbers[place] = self._at_corners(self.topology.following(corners))
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
        return gathered(self.corner_vertex, gathered(self.topology.face_vertices, corners))

    def parts(self, corners: IntArray, sides: list[IntArray], along: FloatArray) -> list[GridPart]:
        """Parts at the corners and along the sides of patches that are whole elements.

        Parameters
        ----------
        corners : (p,) int64
            Where the patches begin.
        sides : list of (rate + 1,) int64
            Samples of a patch's sides, counter-clockwise from this corner on.
        along : (rate + 1,) float64
            Parameters of these along a side.
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
