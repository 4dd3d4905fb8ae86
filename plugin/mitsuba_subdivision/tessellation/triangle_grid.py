"""Vertices and triangles of uniform tessellations over triangular domains."""

from __future__ import annotations

from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from ..mesh import ragged
from ..mesh.connectivity import IntArray
from ..schemes.domain import FloatArray
from .uniform_grid import GridPart, UniformGrid, slices_of


class TriangleGrid(UniformGrid):
    """Numbering of a tessellation over unit triangles, see `UniformGrid`.

    Each element is divided into ``rate^2`` triangles. The samples of an element are ordered by v, then by u.
    """

    whole_size = 3

    @property
    def _inner_count(self) -> int:
        return (self.rate - 1) * (self.rate - 2) // 2

    @cached_property
    def _inner_start(self) -> IntArray:
        """``(n_f,)`` number of the first vertex inside each face."""
        counts = np.where(self.topology.face_sizes > 0, self._inner_count, 0)
        return self.inner_begin + ragged.starts(counts)

    @cached_property
    def vertex_count(self) -> int:
        """Vertices of the tessellation."""
        return self.inner_begin + int(np.count_nonzero(self.topology.face_sizes)) * self._inner_count

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
        """Grids of triangles, see `UniformGrid.layout`."""
        t = self.topology
        u, v = self._steps
        uv = np.stack([u, v], axis=1) / self.rate
        u, v = u[self._inner], v[self._inner]
        w = self.rate - u - v
        face = t.face[corners]
        turns = corners - t.face_offsets[face]
        parts = []
        # Inner vertices are numbered from the face's first corner, whichever corner the patch begins at.
        for turn, (along_u, along_v) in enumerate(((u, v), (v, w), (w, u))):
            patches = np.flatnonzero(turns == turn)
            faces = face[patches]
            turned = self._index(along_u, along_v)
            parts.append(GridPart.of(turned, patches, self._inner_start[faces], t.face_offsets[faces], uv[self._inner]))
        along = np.arange(self.rate + 1) / self.rate
        return uv, parts + self.side_parts(corners, self._sides, along)

    def _vertices(self, faces: IntArray) -> NDArray[np.uint32]:
        """``(e, S)`` vertices of all samples of the faces."""
        numbers = np.empty((len(faces), len(self._steps[0])), dtype=np.uint32)
        numbers[:, self._inner] = self._inner_start[faces][:, None] + np.arange(self._inner_count)
        steps = np.arange(self.rate + 1)
        for corner, side in enumerate(self._sides):
            numbers[:, side] = self.along(self.topology.face_offsets[faces] + corner, steps)
        return numbers

    @cached_property
    def _cells(self) -> IntArray:
        """``(rate^2, 3)`` samples at the corners of each triangle."""
        u, v = self._steps
        up = np.flatnonzero(u + v < self.rate)
        down = np.flatnonzero(u + v < self.rate - 1)
        return np.concatenate(
            [
                np.stack([self._index(u[up] + i, v[up] + j) for i, j in ((0, 0), (1, 0), (0, 1))], axis=1),
                np.stack([self._index(u[down] + i, v[down] + j) for i, j in ((1, 0), (1, 1), (0, 1))], axis=1),
            ]
        )

    @property
    def triangle_counts(self) -> IntArray:
        """``(n_f,)`` triangles of each face."""
        return np.where(self.topology.face_sizes > 0, self.rate**2, 0)

    def triangle_parameters(self) -> tuple[FloatArray, FloatArray]:
        """Parameters at the corners of triangles, see `UniformGrid.triangle_parameters`."""
        uv = np.stack(self._steps, axis=1) / self.rate
        return uv[self._cells], np.empty((0, 3, 2))

    def triangles(self) -> NDArray[np.uint32]:
        """``(m, 3)`` counter-clockwise from outside, in the order of the faces."""
        cells = self._cells
        elements = np.flatnonzero(self.topology.face_sizes)
        triangles = np.empty((len(elements), cells.size), dtype=np.uint32)
        begin = 0
        for faces in slices_of(elements, self.rate**2):
            target = triangles[begin : begin + len(faces)]
            np.take(self._vertices(faces), cells.ravel(), axis=1, out=target, mode="clip")
            begin += len(faces)
        return triangles.reshape(-1, 3)

    def element(self) -> NDArray[np.uint32]:
        """``(m,)`` face of each triangle."""
        return np.repeat(np.flatnonzero(self.topology.face_sizes).astype(np.uint32), self.rate**2)
