"""Vertices and triangles of uniform tessellations over unit squares."""

from __future__ import annotations

from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from ..mesh import ragged
from ..mesh.connectivity import IntArray
from ..schemes.domain import FloatArray
from .uniform_grid import GridPart, UniformGrid, slices_of


class QuadGrid(UniformGrid):
    """Numbering of a tessellation over unit squares, see `UniformGrid`.

    A quadrilateral is one grid of ``rate x rate`` cells. Any other polygon has a grid at each of its corners, which
    reaches half way along the corner's two edges. For an even rate, these grids meet along spokes, which run from the
    midpoints of the edges to the polygon's centre. For an odd rate, strips of triangles join them, and a fan of
    triangles closes the middle.
    """

    whole_size = 4

    @property
    def half(self) -> int:
        """Whole cells from a corner of a polygon to the midpoints of its edges."""
        return self.rate // 2

    @property
    def is_odd(self) -> bool:
        return self.rate % 2 == 1

    @property
    def inner_counts(self) -> IntArray:
        """See `UniformGrid`."""
        sizes = self.topology.face_sizes
        # At rate 1, the grids of a polygon's corners have no inner samples, and only the centre is left.
        per_corner = self.half**2 if self.is_odd else self.half * (self.half - 1)
        return np.where(sizes == 4, (self.rate - 1) ** 2, sizes * per_corner + (sizes > 0))

    def quad_vertices(self, faces: IntArray) -> NDArray[np.uint32]:
        """Vertices of quadrilaterals: ``(e, rate + 1, rate + 1)``, indexed ``[:, v, u]``."""
        t, r = self.topology, self.rate
        # Faces are the last axis, so that NumPy's inner loops are long.
        numbers = np.empty((r + 1, r + 1, len(faces)), dtype=np.uint32)
        inner = np.arange((r - 1) ** 2, dtype=np.uint32).reshape(r - 1, r - 1)
        np.add(inner[..., None], self.inner_start(faces).astype(np.uint32), out=numbers[1:-1, 1:-1])
        corners = np.add.outer(np.arange(4, dtype=np.int32), t.face_offsets[faces])
        # Each side ends where the next one begins.
        sides = self.along(corners, np.arange(r)).transpose(0, 2, 1)
        targets = numbers[0], numbers[:, -1], numbers[-1, ::-1], numbers[::-1, 0]
        for side, target in zip(sides, targets, strict=True):
            target[:-1] = side
        return np.ascontiguousarray(numbers.reshape(-1, len(faces)).T).reshape(-1, r + 1, r + 1)

    def corner_vertices(self, corners: IntArray) -> NDArray[np.uint32]:
        """Vertices of the grids at corners of polygons: ``(e, half + 1, half + 1)``, indexed ``[:, v, u]``."""
        t, h = self.topology, self.half
        numbers = np.empty((len(corners), h + 1, h + 1), dtype=np.uint32)
        steps = np.arange(h + 1)
        inner = self._corner_start(corners)
        if self.is_odd:
            numbers[:, 1:, 1:] = inner[:, None, None] + np.arange(h**2).reshape(h, h)
        else:
            numbers[:, 1:-1, 1:-1] = inner[:, None, None] + np.arange((h - 1) ** 2).reshape(h - 1, h - 1)
            # Two adjacent corners share a spoke.
            numbers[:, 1:-1, -1] = self._spoke_start(corners)[:, None] + np.arange(h - 1)
            numbers[:, -1, 1:-1] = self._spoke_start(t.prev[corners])[:, None] + np.arange(h - 1)
            numbers[:, -1, -1] = self.centre_vertices(corners)
        numbers[:, 0, :] = self.along(corners, steps)
        numbers[:, :, 0] = self.along(t.prev[corners], self.rate - steps)
        return numbers

    def centre_vertices(self, corners: IntArray) -> IntArray:
        """Vertex at the centre of each corner's polygon: ``(e,)``."""
        return self.inner_start(self.topology.face[corners])

    def _corner_start(self, corners: IntArray) -> IntArray:
        """First vertex inside the grid of each polygon corner. The polygon's centre comes before all grids."""
        t, size = self.topology, self.half if self.is_odd else self.half - 1
        return self.centre_vertices(corners) + 1 + (corners - t.face_offsets[t.face[corners]]) * size**2

    def _spoke_start(self, corners: IntArray) -> IntArray:
        """First vertex inside the spoke from the midpoint of the edge at each polygon corner, for an even rate."""
        t, inside = self.topology, self.half - 1
        face = t.face[corners]
        # Spokes come after the centre and all grids.
        return self.inner_start(face) + 1 + t.face_sizes[face] * inside**2 + (corners - t.face_offsets[face]) * inside

    @cached_property
    def triangle_counts(self) -> IntArray:
        """``(n_f,)`` triangles of each face."""
        sizes = self.topology.face_sizes
        return np.where(sizes == 4, 2 * self.rate**2, sizes * self._corner_triangles)

    @property
    def _corner_triangles(self) -> int:
        """Triangles of one corner of a polygon."""
        return 2 * self.half**2 + (2 * self.half + 1 if self.is_odd else 0)

    def triangles(self) -> NDArray[np.uint32]:
        """``(m, 3)`` counter-clockwise from outside, in the order of the faces."""
        t = self.topology
        counts = self.triangle_counts
        start = ragged.starts(counts)
        triangles = np.empty((int(counts.sum()), 3), dtype=np.uint32)
        cells = _cut_cells(self.rate + 1, self.rate + 1)
        for faces in slices_of(np.flatnonzero(t.face_sizes == 4), self.rate**2):
            numbers = self.quad_vertices(faces).reshape(len(faces), -1)
            if faces[-1] - faces[0] + 1 == len(faces):
                # The faces' triangles are contiguous in memory, as on a cage of quadrilaterals only.
                target = triangles[start[faces[0]] :][: len(faces) * len(cells)].reshape(len(faces), -1)
                np.take(numbers, cells.ravel(), axis=1, out=target, mode="clip")
            else:
                triangles[start[faces][:, None] + np.arange(len(cells))] = numbers[:, cells]
        for corners in slices_of(t.half_edges_of(t.face_sizes != 4), self.half**2 + 1):
            face = t.face[corners]
            first = start[face] + (corners - t.face_offsets[face]) * self._corner_triangles
            triangles[first[:, None] + np.arange(self._corner_triangles)] = self._triangles_of_corners(corners)
        return triangles

    def triangle_parameters(self) -> tuple[FloatArray, FloatArray]:
        """Parameters at the corners of triangles, see `UniformGrid.triangle_parameters`."""
        count, whole = self.half + 1, _lattice(self.rate + 1, 1, self.rate)
        grid = _lattice(count, 2, self.rate)
        parts = [grid[_cut_cells(count, count)]]
        if self.is_odd:
            # In this corner's parameters, the last row of the next corner's grid is a column beyond u = 1.
            rows = grid.reshape(count, count, 2)
            beyond = np.stack([2 - rows[-1, :, 1], rows[-1, :, 0]], axis=1)
            strip = np.stack([rows[:, -1], beyond], axis=1).reshape(-1, 2)
            parts += [strip[_cut_cells(count, 2)], np.stack([rows[-1, -1], beyond[-1], np.ones(2)])[None]]
        return whole[_cut_cells(self.rate + 1, self.rate + 1)], np.concatenate(parts)

    def _triangles_of_corners(self, corners: IntArray) -> NDArray[np.uint32]:
        """Triangles of each polygon corner: ``(e, n, 3)``."""
        grids = self.corner_vertices(corners)
        count = self.half + 1
        parts = [grids.reshape(len(corners), -1)[:, _cut_cells(count, count)]]
        if self.is_odd:
            # A strip across the midpoint of the common edge joins the next corner's grid.
            following = self.corner_vertices(self.topology.next[corners])[:, -1, :]
            strip = np.stack([grids[:, :, -1], following], axis=2).reshape(len(corners), -1)
            centre = self.centre_vertices(corners).astype(np.uint32)
            parts.append(strip[:, _cut_cells(count, 2)])
            parts.append(np.stack([grids[:, -1, -1], following[:, -1], centre], axis=1)[:, None])
        return np.concatenate(parts, axis=1)

    def layout(self, corners: IntArray) -> tuple[FloatArray, list[GridPart]]:
        """See `UniformGrid`: one grid for a quadrilateral, one at each corner of others."""
        if self.topology.face_sizes[self.topology.face[corners[0]]] != 4:
            return self.corner_layout(corners)
        index = np.arange((self.rate + 1) ** 2).reshape(self.rate + 1, self.rate + 1)
        inside = [np.rot90(index, -turn)[1:-1, 1:-1].ravel() for turn in range(4)]
        sides = [index[0], index[:, -1], index[-1, ::-1], index[::-1, 0]]
        return self.whole_layout(corners, _lattice(self.rate + 1, 1, self.rate), inside, sides)

    def corner_layout(self, corners: IntArray) -> tuple[FloatArray, list[GridPart]]:
        """Grids of patches that lie at single corners of elements, which are all quadrilaterals or all not.

        A patch reaches half way along its corner's two edges, and to the element's centre, which is (1, 1).
        """
        t, count = self.topology, self.half + 1
        previous = t.prev[corners]
        is_quad = t.face_sizes[t.face[corners[0]]] == 4
        # The element's centre is an additional sample after the grid. For an even rate, some samples of the grid are
        # evaluated otherwise: the last row, with the midpoint of the preceding edge, by the preceding corner's patch,
        # and the last sample of the grid is the centre itself.
        uv = np.concatenate([_lattice(count, 2, self.rate), [[1.0, 1.0]]])
        index = np.arange(count**2).reshape(count, count)
        # Along the preceding edge, vertex numbers increase towards the corner.
        back, at_back = index[self._inside, 0][::-1], np.flatnonzero(self.owns_edge[previous])
        first = self.edge_start(previous[at_back]) + (self.rate - 1 - len(back))
        parts = self.side_parts(corners, index[0], uv[:count, 0])
        parts.append(GridPart(back, at_back, first, corners[at_back], uv[back]))
        parts += self._parts_inside_quads(corners, uv) if is_quad else self._parts_inside_polygons(corners, uv)
        if is_quad:
            # The centre has parameters of 1 in a patch, and of 1/2 in the quadrilateral.
            parts = [part._replace(uv=part.uv / 2) for part in parts]
        return uv, parts

    @property
    def _inside(self) -> slice:
        """Steps from a corner without those on the element's edge and, for an even rate, on the border of patches."""
        return slice(1, None) if self.is_odd else slice(1, -1)

    def _parts_inside_polygons(self, corners: IntArray, uv: FloatArray) -> list[GridPart]:
        """Parts inside polygons, of patches at their corners."""
        t, count = self.topology, self.half + 1
        index = np.arange(count**2).reshape(count, count)
        patches = np.arange(len(corners))
        first = np.flatnonzero(t.face_offsets[t.face[corners]] == corners)
        grid, spoke, centre = index[self._inside, self._inside].ravel(), index[self._inside, -1], np.array([count**2])
        parts = [
            GridPart(grid, patches, self._corner_start(corners), corners, uv[grid]),
            GridPart(centre, first, self.centre_vertices(corners[first]), corners[first], uv[centre]),
        ]
        if not self.is_odd:
            parts.append(GridPart(spoke, patches, self._spoke_start(corners), corners, uv[spoke]))
        return parts

    def _parts_inside_quads(self, corners: IntArray, uv: FloatArray) -> list[GridPart]:
        """Parts inside quadrilaterals, of patches at their corners."""
        t, r = self.topology, self.rate
        face = t.face[corners]
        turns = corners - t.face_offsets[face]
        index = np.arange((self.half + 1) ** 2).reshape(self.half + 1, self.half + 1)
        # A patch evaluates the samples that are nearest to its corner and, for an even rate, those on its spoke; the
        # first corner's patch evaluates the centre. Vertices are numbered along the rows of the quadrilateral, which
        # are columns of the patches at every other corner. Each row is a part.
        samples = index[self._inside, 1:].ravel()
        v, u = np.divmod(samples, self.half + 1)
        parts = []
        for turn, (x, y) in enumerate(((u, v), (r - v, u), (r - u, r - v), (v, r - u))):
            patches = np.flatnonzero(turns == turn)
            for row in np.flatnonzero(np.bincount(y)):
                along = np.flatnonzero(y == row)
                along = along[np.argsort(x[along])]
                first = self.inner_start(face[patches]) + (row - 1) * (r - 1) + x[along[0]] - 1
                parts.append(GridPart(samples[along], patches, first, corners[patches], uv[samples[along]]))
        if not self.is_odd:
            centre, patches = index[-1, -1:], np.flatnonzero(turns == 0)
            first = self.inner_start(face[patches]) + (self.half - 1) * r
            parts.append(GridPart(centre, patches, first, corners[patches], uv[centre]))
        return parts


def _cut_cells(rows: int, columns: int) -> IntArray:
    """Triangles of a grid of ``rows x columns`` vertices, as indices into it: ``(cells * 2, 3)``.

    Diagonals start at the grid's corners and do not cut these off: two grids that meet in two edges, at a vertex of
    valence 2, would both have the same triangle there.
    """
    index = np.arange(rows * columns).reshape(rows, columns)
    a, b, c, d = (part.ravel() for part in (index[:-1, :-1], index[:-1, 1:], index[1:, 1:], index[1:, :-1]))
    v, u = np.indices((rows - 1, columns - 1)).reshape(2, -1)
    across = (2 * u + 1 > columns - 1) != (2 * v + 1 > rows - 1)
    a, b, c, d = (np.where(across, second, first) for first, second in ((a, b), (b, c), (c, d), (d, a)))
    return np.stack([a, b, c, a, c, d], axis=1).reshape(-1, 3)


def _lattice(count: int, numerator: int, denominator: int) -> FloatArray:
    """Parameters of a ``count x count`` grid, u fastest: ``(count * count, 2)``."""
    along = np.arange(count) * numerator / denominator
    uv = np.empty((count, count, 2))
    uv[..., 0], uv[..., 1] = along, along[:, None]
    return uv.reshape(-1, 2)
