"""Limit stencils of every vertex of a tessellation: made once, applied whenever the control points move."""

from __future__ import annotations

import operator
from collections.abc import Iterator
from functools import cached_property
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import DTypeLike, NDArray

from ..evaluation.normals import LEAST_EXTENT, unit_normals
from ..evaluation.product_patch import product_patch
from ..mesh import ragged
from ..mesh.connectivity import IntArray
from ..mesh.shared import Content, Shared
from ..patches import PatchClass, PatchTable
from ..schemes.domain import FloatArray
from .class_stencils import ClassPart, ClassStencils
from .grid import Grid, grid_of
from .memory import require_memory
from .outline import GridLayout, GridPart
from .quad_grid import QuadGrid

if TYPE_CHECKING:
    from scipy import sparse

    from ..patches import StencilRows

# Patches are evaluated in runs of about this many samples, which bounds temporary memory.
CHUNK = 1 << 14
# Tables of so few weights, 2 MB, are evaluated without a loop over their parts.
FEW_WEIGHTS = 1 << 17
# So many take part in a step: their arrays are small enough for memory that the process has at hand.
WEIGHTS_AT_ONCE = 1 << 12
# Buffers have sizes of 32 bits; to each vertex belong two triangles, of three numbers each.
MOST_VERTICES = ((1 << 32) - 1) // 6


class SamplingTable:
    """A tessellation: its vertices as weights over control points, its triangles, and their elements.

    Parameters
    ----------
    control_count, patch_count : int
    parts : tuple of GridPart
        Which samples of which patches are evaluated, and for which vertex. Together they hold every vertex once.
    class_parts : tuple of ClassPart
        The parts, class by class in the order of `classes`.
    grid : Grid
    controls : (n,) uint32
        `ClassStencils.controls` of all classes: control points or, if there is a ``refinement``, refined ones.
    copies : (2, n) int64
        Vertices that take their position from another one, and that one. Along a crease, either side has vertices of
        its own, with normals of their own but the same positions, bit by bit.
    refinement : (n, control_count) sparse array or None
        Makes refined control points of the cage's, where the patches are those of the cage refined once.
    """

    def __init__(
        self,
        control_count: int,
        patch_count: int,
        parts: tuple[GridPart, ...],
        class_parts: tuple[ClassPart, ...],
        grid: Grid,
        controls: NDArray[np.uint32],
        copies: IntArray,
        refinement: sparse.csr_array | None = None,
    ) -> None:
        self.control_count, self.patch_count = control_count, patch_count
        self.parts, self.class_parts, self.grid = parts, class_parts, grid
        self.controls, self.copies, self.refinement = controls, copies, refinement

    @classmethod
    def build(
        cls, patches: PatchTable, rate: int, control_of_vertex: IntArray | None = None, control_count: int | None = None
    ) -> SamplingTable:
        """Prepare the uniform tessellation of a cage's patches; the same for equal arguments, while somebody holds it.

        Parameters
        ----------
        patches : PatchTable
        rate : int
            Segments per edge, at least 1.
        control_of_vertex : (n_v,) int64, optional
            0-based control point at each mesh vertex, where the mesh has several copies of some.
        control_count : int, optional
            Number of control points. By default there is one for each mesh vertex.

        Raises
        ------
        ValueError
            If the rate is no integer, below 1, or so high that there are more vertices than buffers hold.
        MemoryError
            If the tessellation would not fit into memory.
        """
        key = patches, _checked_rate(rate), Content(control_of_vertex), control_count
        return _TABLES.get(key, lambda: cls._build(patches, rate, control_of_vertex, control_count))

    @classmethod
    def _build(
        cls, patches: PatchTable, rate: int, control_of_vertex: IntArray | None, control_count: int | None
    ) -> SamplingTable:
        grid = _checked_grid(patches, rate)
        control_count = control_count or patches.topology.vertex_count
        if control_of_vertex is None:
            control_of_vertex = np.arange(control_count)
        controls, refinement = patches.control_rows(control_of_vertex, control_count)
        parts, class_parts = _evaluated_parts(patches, grid, controls)
        copies = _copies(patches, grid, control_of_vertex)
        return cls(control_count, patches.patch_count, parts, class_parts, grid, controls, copies, refinement)

    @cached_property
    def classes(self) -> tuple[ClassStencils, ...]:
        """The classes that have samples to evaluate.

        Patches that are whole elements come before others; of both, those whose weights are products come first, then
        those with fewer control points.
        """
        return tuple(dict.fromkeys(class_part.stencils for class_part in self.class_parts))

    @property
    def vertex_count(self) -> int:
        return self.grid.vertex_count

    @cached_property
    def triangles(self) -> NDArray[np.uint32]:
        """``(m, 3)`` vertices, counter-clockwise from outside, in the order of the elements."""
        return self.grid.triangles()

    @cached_property
    def element(self) -> NDArray[np.uint32]:
        """``(m,)`` element of each triangle."""
        return self.grid.element()

    @cached_property
    def place(self) -> IntArray:
        """``(vertex_count,)`` the vertex whose position each vertex has: itself, or the one that it is a copy of."""
        place = np.arange(self.vertex_count)
        place[self.copies[0]] = self.copies[1]
        return place

    def refined(self, control_points: FloatArray) -> FloatArray:
        """Points that `controls` are indices of, ``(n, k)``, from ``(control_count, k)`` of the cage."""
        return control_points if self.refinement is None else self.refinement @ control_points

    def apply(self, control_points: FloatArray, dtype: DTypeLike = np.float64) -> tuple[NDArray, NDArray]:
        """Evaluate every vertex.

        Parameters
        ----------
        control_points : (control_count, 3) float64
        dtype : float64 or float32
            Of the sums, which are relative to a control point of each patch, and of the result.

        Returns
        -------
        positions, normals : (vertex_count, 3)
            Normals are zero where the surface has none, see `SurfaceSamples`.
        """
        coordinates = np.ascontiguousarray(self.refined(control_points).T)
        if dtype == np.float32 and self._has_few_weights:
            return self._columns.apply(coordinates, self.copies, is_rounded=self.refinement is not None)
        positions = np.empty((self.vertex_count, 3), dtype=dtype)
        normals = np.empty((self.vertex_count, 3), dtype=dtype)
        # Many classes have few samples each, whose normals take less time together.
        waiting, sample_count = [], 0
        for class_part in self.class_parts:
            stencils, samples, patches = class_part.stencils, class_part.part.samples, class_part.patches
            count = len(samples)
            weights = stencils.weights[:, samples]
            matrix = weights.reshape(3 * count, -1).astype(dtype)
            frame_weights = np.abs(weights[1:]).sum(axis=2).astype(dtype)
            run = max(1, CHUNK // count)
            for begin in range(0, len(patches), run):
                # Coordinates come first, then point and tangents, samples, and patches.
                points = coordinates[:, stencils.controls[patches[begin : begin + run]].T]
                origin = points[:, :1]
                relative = (points - origin).astype(dtype)
                values = (matrix @ relative).reshape(3, 3, count, -1)
                vertices = class_part.first_vertex[begin : begin + run] + np.arange(count)[:, None]
                positions[vertices] = (values[:, 0] + origin).transpose(1, 2, 0)
                reach = np.abs(relative).max(axis=1)
                if self.refinement is not None:
                    reach = _with_rounding(reach, origin[:, 0])
                waiting.append(_Tangents.of(vertices, values[:, 1:], frame_weights, reach))
                sample_count += vertices.size
                if sample_count >= CHUNK:
                    _add_normals(normals, waiting)
                    waiting, sample_count = [], 0
        _add_normals(normals, waiting)
        positions[self.copies[0]] = positions[self.copies[1]]
        return positions, normals

    @cached_property
    def _has_few_weights(self) -> bool:
        """Whether `apply` takes about a millisecond, or less, in single precision."""
        return self.vertex_count * self._widest <= FEW_WEIGHTS

    @property
    def _widest(self) -> int:
        return max((stencils.controls.shape[1] for stencils in self.classes), default=0)

    @cached_property
    def _columns(self) -> _VertexColumns:
        """All vertices at once, where they are few: loops over many small parts would take longer."""
        return _VertexColumns.of(self, self._widest)

    def stencil_rows(self) -> Iterator[StencilRows]:
        """Weights of every vertex and its two tangents over `refined` control points, some vertices at a time.

        Each vertex has its own, also where its position is taken from another one (`place`).
        """
        from ..patches import StencilRows

        return (StencilRows(*each) for each in self._rows())

    def _rows(self) -> Iterator[tuple[IntArray, NDArray[np.uint32], FloatArray]]:
        """What `StencilRows` hold."""
        for class_part in self.class_parts:
            stencils, samples, patches = class_part.stencils, class_part.part.samples, class_part.patches
            count, run = len(samples), max(1, CHUNK // len(samples))
            weights = stencils.weights[:, samples]
            for begin in range(0, len(patches), run):
                controls = stencils.controls[patches[begin : begin + run]]
                vertices = class_part.first_vertex[begin : begin + run, None] + np.arange(count)
                yield vertices.ravel(), np.repeat(controls, count, axis=0), np.tile(weights, (1, len(controls), 1))

    def locations(self) -> tuple[IntArray, FloatArray]:
        """Where each vertex lies on the surface.

        Returns
        -------
        corner : (vertex_count,) int64
            The corner of an element that the parameters start from, a half-edge of `PatchTable.elements`.
        uv : (vertex_count, 2) float64
            Samples at corners have (0, 0).
        """
        corner = np.empty(self.vertex_count, dtype=np.int64)
        uv = np.empty((self.vertex_count, 2))
        for part in self.parts:
            vertices = part.first_vertex[:, None] + np.arange(len(part.samples))
            corner[vertices] = part.corners[:, None]
            uv[vertices] = part.uv
        return corner, uv


_TABLES: Shared[SamplingTable] = Shared()


class _VertexColumns(NamedTuple):
    """Weights of all vertices in single precision, padded to the widest one-ring; vertices come last.

    Attributes
    ----------
    controls : (K, n) int64
        Those that are padded are the first one of their vertex.
    weights : (3, K, n) float32
    frame_weights : (2, n) float32
        Sums of the absolute weights of tangents.
    """

    controls: IntArray
    weights: NDArray[np.float32]
    frame_weights: NDArray[np.float32]

    @classmethod
    def of(cls, table: SamplingTable, widest: int) -> _VertexColumns:
        controls = np.zeros((widest, table.vertex_count), dtype=np.int64)
        weights = np.zeros((3, widest, table.vertex_count), dtype=np.float32)
        for vertices, columns, own in table._rows():
            count = columns.shape[1]
            controls[:, vertices] = columns[:, 0]
            controls[:count, vertices] = columns.T
            weights[:, :count, vertices] = own.transpose(0, 2, 1)
        return cls(controls, weights, np.abs(weights[1:]).sum(axis=1))

    def apply(
        self, coordinates: FloatArray, copies: IntArray, *, is_rounded: bool
    ) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """See `SamplingTable.apply`; coordinates come first."""
        width, count = self.controls.shape
        origin = coordinates.take(self.controls[0], axis=1)
        values, reach = np.empty((3, 3, count), dtype=np.float32), np.empty((3, count), dtype=np.float32)
        step = max(1, WEIGHTS_AT_ONCE // width)
        for begin in range(0, count, step):
            own = slice(begin, begin + step)
            points = coordinates.take(self.controls[:, own], axis=1)
            relative = (points - origin[:, None, own]).astype(np.float32)
            values[:, :, own] = np.einsum("dkn,xkn->dxn", self.weights[:, :, own], relative)
            reach[:, own] = np.abs(relative).max(axis=1)
        if is_rounded:
            reach = _with_rounding(reach, origin)
        positions = np.ascontiguousarray((values[0] + origin).T, dtype=np.float32)
        normals = unit_normals(values[1].T, values[2].T, self.frame_weights, reach.T)
        positions[copies[0]] = positions[copies[1]]
        return positions, normals


def _with_rounding(reach: NDArray, origin: NDArray) -> NDArray:
    """How far control points may be from the origin, where they are refined ones: these are rounded before that."""
    return np.maximum(reach, LEAST_EXTENT[64] * np.abs(origin))


class _Tangents(NamedTuple):
    """Tangents at some vertices, and what tells whether they are collapsed; coordinates come first.

    Attributes
    ----------
    vertices : (n,) int
    tangents : (3, 2, n)
    weights : (2, n)
    reach : (3, n)
    """

    vertices: IntArray
    tangents: NDArray
    weights: NDArray
    reach: NDArray

    @classmethod
    def of(cls, vertices: IntArray, tangents: NDArray, weights: NDArray, reach: NDArray) -> _Tangents:
        """Likewise ``(s, p)``, ``(3, 2, s, p)``, ``(2, s)`` and ``(3, p)``: of s samples on each of p patches."""
        samples, patches = vertices.shape
        of_samples, of_patches = weights.repeat(patches, axis=1), reach[:, None].repeat(samples, axis=1)
        return cls(vertices.ravel(), tangents.reshape(3, 2, -1), of_samples, of_patches.reshape(3, -1))


def _add_normals(normals: NDArray, found: list[_Tangents]) -> None:
    """Write unit normals at the vertices of some tangents."""
    if found:
        vertices, tangents, weights, reach = (np.concatenate(arrays, axis=-1) for arrays in zip(*found, strict=True))
        normals[vertices] = unit_normals(tangents[:, 0].T, tangents[:, 1].T, weights, reach.T)


def _checked_grid(patches: PatchTable, rate: int) -> Grid:
    """The grid over the elements of some patches, which is known to fit into buffers and memory.

    Raises
    ------
    ValueError, MemoryError
        As `SamplingTable.build`.
    """
    checked = _checked_rate(rate)
    grid = grid_of(patches, checked)
    if grid.vertex_count > MOST_VERTICES:
        raise ValueError(
            f"tessellation rate {checked} makes {grid.vertex_count} vertices; expected at most {MOST_VERTICES}, whose "
            "triangles fit into a buffer"
        )
    require_memory(patches, grid)
    return grid


def _checked_rate(rate: int) -> int:
    try:
        checked = operator.index(rate)
    except TypeError:
        raise ValueError(f"tessellation rate {rate!r}; expected an integer") from None
    if checked < 1:
        raise ValueError(f"tessellation rate {rate}; expected 1 or more segments per edge")
    return checked


def _evaluated_parts(
    patches: PatchTable, grid: Grid, controls: NDArray[np.uint32]
) -> tuple[tuple[GridPart, ...], tuple[ClassPart, ...]]:
    """`SamplingTable.parts` and `SamplingTable.class_parts`, with the stencils of all classes that have any."""
    parts: list[GridPart] = []
    class_parts: list[ClassPart] = []
    first_patch = 0
    for classes, layout in _layouts(patches, grid):
        found = [part.shifted(first_patch) for part in layout.parts if len(part.samples) and len(part.patches)]
        bounds = first_patch + ragged.offsets([len(patch_class.corners) for patch_class in classes])
        rows_by_class = _rows_by_class(found, bounds)
        # At low rates, patches of other classes may evaluate all samples of a class.
        evaluated = [index for index, rows in enumerate(rows_by_class) if any(own.start < own.stop for own in rows)]
        some = [classes[index] for index in evaluated], bounds[evaluated].tolist()
        for index, stencils in zip(
            evaluated, ClassStencils.of(patches.scheme, some[0], layout.uv, controls, some[1]), strict=True
        ):
            for part, own in zip(found, rows_by_class[index], strict=True):
                if own.start < own.stop:
                    class_parts.append(ClassPart(stencils, part, own))
        parts += found
        first_patch = int(bounds[-1])
    return tuple(parts), tuple(class_parts)


def _layouts(patches: PatchTable, grid: Grid) -> Iterator[tuple[list[PatchClass], GridLayout]]:
    """Classes whose patches have grids of a kind, in the order of `SamplingTable.classes`, and the grids of all these.

    A patch's grid is that of a whole element, or of an element's corner.
    """
    refined = patches.refined
    of_kind: dict[bool, list[tuple[PatchClass, IntArray]]] = {True: [], False: []}
    for patch_class in (patches if refined is None else refined.table).classes:
        corners = patch_class.corners if refined is None else refined.corners(patch_class)
        # The first patch stands for its class. In the cage refined once, too, all patches of a class lie in elements of
        # the same number of corners: it is the valence of the elements' centres.
        element = patches.elements.face_of(corners[:1])
        of_kind[bool(patches.is_whole[element][0])].append((patch_class, corners))
    for found in filter(None, of_kind.values()):
        found.sort(key=lambda each: _order(patches, each[0]))
        corners = np.concatenate([corners for _, corners in found])
        if refined is not None and isinstance(grid, QuadGrid):
            # Even where an element is whole, a patch of the cage refined once covers one of its corners only.
            layout = grid.corner_layout(corners)
        else:
            layout = grid.layout(corners)
        yield [patch_class for patch_class, _ in found], layout


def _order(patches: PatchTable, patch_class: PatchClass) -> tuple[bool, int]:
    """What classes are sorted by: those whose weights are products come first, then those with fewer control points."""
    return product_patch(patches.scheme, patch_class.signature) is None, patch_class.controls.shape[1]


def _rows_by_class(parts: list[GridPart], bounds: IntArray) -> list[list[slice]]:
    """Which rows of each part are patches of each class: one list for each class, of a slice for each part.

    Parameters
    ----------
    parts : list of GridPart
    bounds : (n + 1,) int64
        First patch of each class, and the end of the last one.
    """
    # Bounds of the same type as the patches, or else all patches would be converted.
    ends = [np.searchsorted(part.patches, bounds.astype(part.patches.dtype)).tolist() for part in parts]
    return [[slice(of_part[i], of_part[i + 1]) for of_part in ends] for i in range(len(bounds) - 1)]


def _copies(patches: PatchTable, grid: Grid, control_of_vertex: IntArray) -> IntArray:
    """`SamplingTable.copies`: at the corners of elements, then inside edges.

    The border of the mesh is the boundary of the cage and the sides of its creases.
    """
    t = patches.elements
    border = np.flatnonzero(t.twin < 0)
    if patches.scheme.element == "vertex" or not len(border):
        return np.empty((2, 0), dtype=np.int64)
    used = np.flatnonzero(t.vertex_half_edge >= 0)[::-1]
    # Of several copies of a control point, the last that is assigned stays: the first one.
    first_copy = np.empty(t.vertex_count, dtype=np.int64)
    first_copy[control_of_vertex[used]] = used
    later = used[first_copy[control_of_vertex[used]] != used]
    at_corners = grid.outline.corner_vertex[np.stack([later, first_copy[control_of_vertex[later]]])]
    return np.concatenate([at_corners, _copies_inside_edges(grid, border, control_of_vertex)], axis=1)


def _copies_inside_edges(grid: Grid, border: IntArray, control_of_vertex: IntArray) -> IntArray:
    """Copies inside border edges that join the same control points, as the sides of a crease do.

    They are two edges in opposite directions, or more where the cage is no manifold. A crease of one edge between darts
    has two sides, too, though its ends have no copies.
    """
    t, outline = grid.topology, grid.outline
    start, end = control_of_vertex[t.face_vertices[border]], control_of_vertex[t.face_vertices[t.following(border)]]
    keys = np.minimum(start, end) * t.vertex_count + np.maximum(start, end)
    order = np.argsort(keys, kind="stable")
    begins = np.flatnonzero(np.diff(keys[order], prepend=-1))
    first = np.repeat(order[begins], np.diff(begins, append=len(order)))
    one, other = first[first != order], order[first != order]
    steps = np.arange(1, grid.rate)
    along = outline.along(border[one], steps)
    is_reversed = (start[one] != start[other])[:, None]
    along = np.where(is_reversed, along[:, ::-1], along)
    return np.stack([outline.along(border[other], steps), along]).reshape(2, -1)
