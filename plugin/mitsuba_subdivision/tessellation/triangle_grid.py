"""Vertices and triangles of uniform tessellations over triangular domains."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from ..cage.connectivity import IntArray, Topology
from .grid import GridLayout, GridPart, edge_vertices, outline_parts


@dataclass(frozen=True, eq=False)
class TriangleGrid:
    """Numbering of a tessellation over unit triangles, see `Grid`. Each element is cut into ``rate^2`` triangles.

    Samples of an element are ordered by v, then by u.

    Parameters
    ----------
    topology : Topology
        Of the elements, all triangles.
    rate : int
    """

    topology: Topology
    rate: int

    @property
    def _inner_count(self) -> int:
        return (self.rate - 1) * (self.rate - 2) // 2

    @property
    def vertex_count(self) -> int:
        """Vertices of the tessellation."""
        t = self.topology
        return t.vertex_count + t.edge_count * (self.rate - 1) + t.face_count * self._inner_count

    @cached_property
    def _steps(self) -> tuple[IntArray, IntArray]:
        """Segments along u and along v of each sample: ``(S,)``."""
        v, u = np.indices((self.rate + 1, self.rate + 1)).reshape(2, -1)
        inside = u + v <= self.rate
        return u[inside], v[inside]

    def _index(self, u: IntArray, v: IntArray) -> IntArray:
        """Sample at given steps along u and v."""
        return v * (self.rate + 1) - v * (v - 1) // 2 + u

    @cached_property
    def _sides(self) -> list[IntArray]:
        along = np.arange(self.rate + 1)
        back, nought = along[::-1], np.zeros_like(along)
        return [self._index(along, nought), self._index(back, along), self._index(nought, back)]

    def layout(self, corners: IntArray) -> GridLayout:
        """Grids of triangles."""
        u, v = self._steps
        inner = np.flatnonzero((u > 0) & (v > 0) & (u + v < self.rate))
        uv = np.stack([u, v], axis=1) / self.rate
        parts = [GridPart(inner, np.ones(len(corners), dtype=bool), corners, uv[inner])]
        parts += outline_parts(self.topology, corners, self._sides, np.arange(self.rate + 1) / self.rate)
        return GridLayout(uv, self._vertices(corners), parts)

    def _vertices(self, corners: IntArray) -> IntArray:
        """Vertices of triangles that begin at these corners: ``(p, S)``."""
        t, r = self.topology, self.rate
        u, v = self._steps
        numbers = np.empty((len(corners), len(u)), dtype=np.int64)
        face = t.face[corners]
        inner_start = t.vertex_count + t.edge_count * (r - 1) + face * self._inner_count
        # Inside, numbers follow the face's own first corner, whichever corner it begins at here.
        own = np.full(len(u), -1)
        inner = np.flatnonzero((u > 0) & (v > 0) & (u + v < r))
        own[inner] = np.arange(len(inner))
        w = r - u - v
        turned = {0: (u, v), 1: (w, u), 2: (v, w)}
        for turn, (along_u, along_v) in turned.items():
            at = np.flatnonzero(corners - t.face_offsets[face] == turn)
            places = own[self._index(along_u[inner], along_v[inner])]
            numbers[at[:, None], inner] = inner_start[at][:, None] + places
        steps = np.arange(r + 1)
        for side in self._sides:
            numbers[:, side] = edge_vertices(t, r, corners, steps)
            corners = t.next[corners]
        return numbers

    @cached_property
    def triangles(self) -> NDArray[np.uint32]:
        """``(m, 3)`` counter-clockwise from outside, in the order of the faces."""
        t = self.topology
        u, v = self._steps
        up = np.flatnonzero(u + v < self.rate)
        down = np.flatnonzero(u + v < self.rate - 1)
        cells = np.concatenate(
            [
                np.stack([self._index(u[up] + i, v[up] + j) for i, j in ((0, 0), (1, 0), (0, 1))], axis=1),
                np.stack([self._index(u[down] + i, v[down] + j) for i, j in ((1, 0), (1, 1), (0, 1))], axis=1),
            ]
        )
        numbers = self._vertices(t.face_offsets[:-1])
        return numbers[:, cells].reshape(-1, 3).astype(np.uint32)

    @property
    def element(self) -> NDArray[np.uint32]:
        """``(m,)`` face of each triangle."""
        return np.repeat(np.arange(self.topology.face_count, dtype=np.uint32), self.rate**2)
