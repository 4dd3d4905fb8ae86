"""Numbering of uniform tessellations: the common base of grids over squares and over triangles, and that of triangles.

The two elements at an edge share the samples on it, so there are no cracks. Corners of the elements are numbered first,
then samples inside edges, then samples inside elements. The samples inside an edge, and those inside an element, have
consecutive numbers.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..mesh import ragged
from ..mesh.connectivity import IntArray, Topology
from ..schemes.domain import FloatArray

# Vertices per slice when computing triangles, so that arrays stay in a core's cache.
VERTICES_AT_ONCE = 1 << 16


class GridPart(NamedTuple):
    """A part of the grids of several patches, such as their inside or one of their sides.

    In every patch, the samples of the part are consecutive vertices. Where patches share samples, at corners and along
    edges, only the patch that evaluates them is in the part.
    """

    samples: IntArray  # (S,) int64: indices into the parameters of `UniformGrid.layout`
    patches: IntArray  # (P,): patches in ascending order
    first_vertex: IntArray  # (P,): vertex of the first sample in each patch; ``samples[i]`` is ``first_vertex + i``
    corners: IntArray  # (P,): a corner of each patch's element, not always the one at which the patch begins
    uv: FloatArray  # (S, 2) float64: parameters of the samples, starting at `corners`

    @property
    def vertices(self) -> IntArray:
        """``(P, S)`` vertices of the samples of each patch."""
        return self.first_vertex.astype(np.int64)[:, None] + np.arange(len(self.samples))


class UniformGrid:
    """Numbering of a uniform tessellation: the same for all surfaces over the same elements.

    `AdaptiveGrid` has the members that `VertexTable` asks for as well.
    """

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
    def inner_counts(self) -> IntArray:
        """``(n_f,)`` vertices strictly inside each element."""
        raise NotImplementedError

    @property
    def triangle_counts(self) -> IntArray:
        """``(n_f,)`` triangles of each element."""
        raise NotImplementedError

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
        raise NotImplementedError

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
        raise NotImplementedError

    def triangles(self) -> NDArray[np.uint32]:
        """``(m, 3)`` vertices, counter-clockwise from outside, in the order of the elements."""
        raise NotImplementedError

    def element(self) -> NDArray[np.uint32]:
        """``(m,)`` element of each triangle."""
        counts = self.triangle_counts
        # `repeat` is faster with a scalar.
        repeats = counts[0] if (counts == counts[0]).all() else counts
        return np.repeat(np.arange(self.topology.face_count, dtype=np.uint32), repeats)

    def at_rate(self, rate: int) -> UniformGrid:
        """A grid of another rate over the same elements."""
        return type(self)(self.topology, rate)

    def cut(self, topology: Topology) -> UniformGrid:
        """The same triangles over elements with the same half-edges, cut along more edges.

        Vertices on a cut have a copy on each side, which is located on that side.
        """
        return type(self)(topology, self.rate)

    def vertices_of(self, other: Any) -> IntArray:
        """``(vertex_count,)`` the original of each vertex in a grid of which this one is a `cut`."""
        t, steps = self.topology, np.arange(1, self.rate)
        originals = np.empty(self.vertex_count, dtype=np.int64)
        originals[self.corner_vertex[t.face_vertices]] = other.corner_vertex[other.topology.face_vertices]
        originals[self.edge_start(t.edge_half_edge)[:, None] + steps - 1] = other.along(t.edge_half_edge, steps)
        originals[self.inner_begin :] = np.arange(other.inner_begin, other.vertex_count)
        return originals

    def locations(self) -> tuple[IntArray, FloatArray]:
        """Locations of the vertices on the surface.

        Returns
        -------
        half_edge : (vertex_count,) int64
            Corner of an element at which the parameters are (0, 0), a half-edge of `PatchTable.elements`.
        uv : (vertex_count, 2) float64
            Parameters. Vertices at corners of elements have (0, 0).
        """
        t = self.topology
        half_edge, uv = np.zeros(self.vertex_count, dtype=np.int64), np.zeros((self.vertex_count, 2))
        is_whole = t.face_sizes == self.whole_size
        for corners in (t.face_offsets[:-1][is_whole], t.half_edges_of(~is_whole)):
            for part in self.layout(corners)[1] if len(corners) else ():
                half_edge[part.vertices] = part.corners[:, None]
                uv[part.vertices] = part.uv
        return half_edge, uv

    @cached_property
    def vertex_count(self) -> int:
        """Vertices of the tessellation."""
        return self.inner_begin + int(self.inner_counts.sum())

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

    def inner_start(self, faces: IntArray) -> IntArray:
        """Number of the first vertex inside each of the faces."""
        return self.inner_begin + self._inner_counts_before[faces]

    @cached_property
    def _inner_counts_before(self) -> IntArray:
        return ragged.starts(self.inner_counts)

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
        if (steps == 0).any():
            numbers[steps == 0] = self._at_corners(corners)
        if (steps == self.rate).any():
            numbers[steps == self.rate] = self._at_corners(self.topology.next[corners])
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

    def _at_corners(self, corners: IntArray) -> NDArray[np.uint32]:
        """Vertices at corners."""
        return self.corner_vertex[self.topology.face_vertices[corners]]

    def side_parts(
        self,
        corners: IntArray,  # (p,): corners at which the patches begin
        samples: IntArray,  # samples of a patch from a corner along the edge that begins there
        along: FloatArray,  # parameters of these samples along the edge
    ) -> list[GridPart]:
        """The part of the samples inside edges, and that of the sample at the corners."""
        uv = np.stack([along, np.zeros_like(along)], axis=1)
        at_edge, at_vertex = np.flatnonzero(self.owns_edge[corners]), np.flatnonzero(self.owns_vertex[corners])
        inside, begin = corners[at_edge], corners[at_vertex]
        return [
            GridPart(samples[1:], at_edge, self.edge_start(inside), inside, uv[1:]),
            GridPart(samples[:1], at_vertex, self._at_corners(begin), begin, uv[:1]),
        ]

    def whole_layout(
        self,
        corners: IntArray,
        uv: FloatArray,
        # For each corner, the samples inside the element in the order in which they are numbered from its first corner,
        # if the patch begins at this one
        inside: Sequence[IntArray],
        sides: Sequence[IntArray],  # Samples along the sides of a patch, counter-clockwise
    ) -> tuple[FloatArray, list[GridPart]]:
        """`layout` of patches that are whole elements."""
        t, parts = self.topology, []
        face = t.face[corners]
        for turn, samples in enumerate(inside):
            patches = np.flatnonzero(corners - t.face_offsets[face] == turn)
            if len(patches):
                faces = face[patches]
                parts.append(GridPart(samples, patches, self.inner_start(faces), t.face_offsets[faces], uv[inside[0]]))
        along = np.arange(self.rate) / self.rate
        for side in sides:
            parts += self.side_parts(corners, side[:-1], along)
            corners = t.next[corners]
        return uv, parts


class TriangleGrid(UniformGrid):
    """Numbering of a tessellation over unit triangles.

    Each element is divided into ``rate^2`` triangles. The samples of an element are ordered by v, then by u.
    """

    whole_size = 3

    @property
    def inner_counts(self) -> IntArray:
        """See `UniformGrid`."""
        return np.where(self.topology.face_sizes > 0, (self.rate - 1) * (self.rate - 2) // 2, 0)

    @property
    def triangle_counts(self) -> IntArray:
        """See `UniformGrid`."""
        return np.where(self.topology.face_sizes > 0, self.rate**2, 0)

    @cached_property
    def _steps(self) -> tuple[IntArray, IntArray]:
        """``(S,)`` grid indices along u and along v of each sample."""
        v, u = np.indices((self.rate + 1, self.rate + 1)).reshape(2, -1)
        inside = u + v <= self.rate
        return u[inside], v[inside]

    def _index(self, u: IntArray, v: IntArray) -> IntArray:
        """The sample with given grid indices along u and v."""
        return v * (self.rate + 1) - v * (v - 1) // 2 + u

    @cached_property
    def _sides(self) -> list[IntArray]:
        along = np.arange(self.rate + 1)
        back, zero = along[::-1], np.zeros_like(along)
        return [self._index(along, zero), self._index(back, along), self._index(zero, back)]

    @cached_property
    def _inner(self) -> IntArray:
        """Samples strictly inside an element."""
        u, v = self._steps
        return np.flatnonzero((u > 0) & (v > 0) & (u + v < self.rate))

    def layout(self, corners: IntArray) -> tuple[FloatArray, list[GridPart]]:
        """See `UniformGrid`."""
        u, v = (steps[self._inner] for steps in self._steps)
        w = self.rate - u - v
        inside = [self._index(u, v), self._index(v, w), self._index(w, u)]
        return self.whole_layout(corners, np.stack(self._steps, axis=1) / self.rate, inside, self._sides)

    @cached_property
    def _cells(self) -> IntArray:
        """``(rate^2, 3)`` samples at the corners of each triangle."""
        u, v = self._steps
        cells = []
        for room, steps in ((0, ((0, 0), (1, 0), (0, 1))), (1, ((1, 0), (1, 1), (0, 1)))):
            at = np.flatnonzero(u + v < self.rate - room)
            cells.append(np.stack([self._index(u[at] + i, v[at] + j) for i, j in steps], axis=1))
        return np.concatenate(cells)

    def triangle_parameters(self) -> tuple[FloatArray, FloatArray]:
        """See `UniformGrid`."""
        uv = np.stack(self._steps, axis=1) / self.rate
        return uv[self._cells], np.empty((0, 3, 2))

    def triangles(self) -> NDArray[np.uint32]:
        """See `UniformGrid`."""
        cells, t, steps = self._cells, self.topology, np.arange(self.rate + 1)
        elements = np.flatnonzero(t.face_sizes)
        triangles, begin = np.empty((len(elements), cells.size), dtype=np.uint32), 0
        for faces in slices_of(elements, self.rate**2):
            vertices = np.empty((len(faces), len(self._steps[0])), dtype=np.uint32)
            vertices[:, self._inner] = self.inner_start(faces)[:, None] + np.arange(len(self._inner))
            for corner, side in enumerate(self._sides):
                vertices[:, side] = self.along(t.face_offsets[faces] + corner, steps)
            np.take(vertices, cells.ravel(), axis=1, out=triangles[begin : begin + len(faces)], mode="clip")
            begin += len(faces)
        return triangles.reshape(-1, 3)


def slices_of(indices: IntArray, size: int) -> Iterator[IntArray]:
    """Split indices, each of which represents ``size`` vertices, into slices of about `VERTICES_AT_ONCE` vertices."""
    length = max(1, VERTICES_AT_ONCE // size)
    for begin in range(0, len(indices), length):
        yield indices[begin : begin + length]


def first_sides(topology: Topology, border: IntArray, start: IntArray) -> IntArray:
    """The first of the half-edges ``border`` that join the same points as each of them, as the sides of a crease do.

    ``start``, ``(n_h,)``, is the point at which half-edges begin. The sides run in opposite directions; there may be
    more of them where the cage is not a manifold.
    """
    ends = np.stack([start[border], start[topology.next[border]]]).astype(np.int64)
    pairs = ends.min(axis=0) * (int(start.max(initial=0)) + 1) + ends.max(axis=0)
    _, first, pair = np.unique(pairs, return_index=True, return_inverse=True)
    return border[first[pair]]
