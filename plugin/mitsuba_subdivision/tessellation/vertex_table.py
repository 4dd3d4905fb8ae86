"""A tessellation: limit stencils of every vertex, made once and applied whenever the control points move."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from functools import cached_property
from typing import TYPE_CHECKING, Any, NamedTuple, Protocol

import numpy as np
from numpy.typing import DTypeLike, NDArray

from ..evaluation.normals import LEAST_EXTENT, unit_normals
from ..mesh import ragged
from ..mesh.connectivity import IntArray, Topology
from ..schemes.domain import FloatArray
from .vertex_stencils import ClassStencils, VertexStencils

if TYPE_CHECKING:
    from pathlib import Path

    from scipy import sparse

    from ..patches import StencilRows

# Vertices are evaluated in blocks of about this many weights, whose arrays stay in a core's cache.
BLOCK_WEIGHTS = 1 << 16
# And of about this many samples.
BLOCK_SAMPLES = 1 << 14
# Where so many vertices have the same samples, one product of matrices evaluates them.
SHARED = 1 << 10


@dataclass(frozen=True, eq=False)
class VertexTable:
    """A tessellation: its vertices as weights over control points, its triangles, and their elements.

    A vertex is a limit stencil of a class of patches times the control points of one of these patches. Weights do not
    depend on where control points are; of an adaptive tessellation, the triangles do.
    """

    control_count: int
    patch_count: int
    grid: Grid  # Numbers the vertices and triangles, and says where on the surface they lie
    vertex_stencils: VertexStencils  # The stencil and the patch of each vertex
    # (n,) uint32: `ClassStencils.controls` of all classes: control points or, if there is a ``refinement``, refined
    # ones
    controls: NDArray[np.uint32]
    # (2, n) int64: vertices that take their position from another one, and that one. Along a crease, either side has
    # vertices of its own, with normals of their own but the same positions, bit by bit.
    copies: IntArray
    # (n, control_count) sparse array or None: makes refined control points of the cage's, where the patches are those
    # of the cage refined once
    refinement: sparse.csr_array | None = None

    @property
    def classes(self) -> tuple[ClassStencils, ...]:
        """The classes that have samples to evaluate."""
        return self.vertex_stencils.classes

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
    def weld_target(self) -> IntArray:
        """``(vertex_count,)`` the vertex whose position each vertex has: itself, or the one that it is a copy of."""
        target = np.arange(self.vertex_count)
        target[self.copies[0]] = self.copies[1]
        return target

    def locations(self) -> tuple[IntArray, FloatArray]:
        """Where each vertex lies on the surface: see `Grid.locations`."""
        return self.grid.locations()

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
        positions, normals = (np.empty((self.vertex_count, 3), dtype=dtype) for _ in range(2))
        coordinates = np.ascontiguousarray(self.refined(control_points).T)
        for block in self._blocks():
            values, origin, extent = block.sums(coordinates, dtype)
            if self.refinement is not None:
                # Refined control points are rounded before they are seen from the origin.
                extent = np.maximum(extent, LEAST_EXTENT[64] * np.abs(origin))
            frame_weights = block.of_vertices(block.frame_weights.astype(dtype))
            positions[block.vertices] = (values[0] + block.of_patches(origin)).T
            normals[block.vertices] = unit_normals(values[1:3], frame_weights, block.of_patches(extent)).T
        positions[self.copies[0]] = positions[self.copies[1]]
        return positions, normals

    def interpolated(self, values: FloatArray) -> FloatArray:
        """``(vertex_count, k)`` points of the surface that ``(control_count, k)`` values make, also of copies."""
        found = np.empty((self.vertex_count, values.shape[1]))
        coordinates = np.ascontiguousarray(self.refined(values).T)
        for block in self._blocks():
            (points,), origin, _ = block.sums(coordinates, np.float64, 1)
            found[block.vertices] = (points + block.of_patches(origin)).T
        return found

    def stencil_rows(self) -> Iterator[StencilRows]:
        """Weights of every vertex and its two tangents over `refined` control points, some vertices at a time.

        Each vertex has its own, also where its position is taken from another one (`weld_target`).
        """
        from ..patches import StencilRows

        for block in self._blocks():
            weights = block.of_vertices(block.weights).transpose(0, 2, 1)
            yield StencilRows(block.vertices, block.of_patches(block.controls).T, weights)

    def matrices(self) -> VertexMatrices:
        """The same weights as sparse matrices, of positions and of tangents."""
        from ..patches.stencil_matrices import joined_matrices

        width = self.control_count if self.refinement is None else self.refinement.shape[0]
        matrices = joined_matrices(self.stencil_rows(), 3, (self.vertex_count, width))
        if self.refinement is not None:
            matrices = [matrix @ self.refinement for matrix in matrices]
        points, *tangents = matrices
        return VertexMatrices(points[self.weld_target], *tangents)

    def _blocks(self) -> Iterator[_Block]:
        """All vertices, in blocks that bound temporary memory."""
        vertex_stencils = self.vertex_stencils
        vertex_counts = vertex_stencils.counts * vertex_stencils.run_counts
        is_shared = vertex_counts >= SHARED
        sizes = np.array([stencils.controls.shape[1] for stencils in self.classes], dtype=np.int64)[
            vertex_stencils.class_of_kind
        ]
        first_runs = ragged.starts(vertex_stencils.run_counts)
        for kind in np.flatnonzero(is_shared).tolist():
            count = int(vertex_stencils.counts[kind])
            length = max(1, min(BLOCK_SAMPLES // count, BLOCK_WEIGHTS // int(sizes[kind])))
            end = int(first_runs[kind] + vertex_stencils.run_counts[kind])
            for begin in range(int(first_runs[kind]), end, length):
                yield self._product_block(kind, slice(begin, min(begin + length, end)))
        for size in np.unique(sizes[~is_shared]).tolist():
            kinds = np.flatnonzero(~is_shared & (sizes == size))
            number = (np.cumsum(vertex_counts[kinds]) - 1) // max(1, BLOCK_WEIGHTS // size)
            for own in np.split(kinds, np.flatnonzero(np.diff(number)) + 1):
                yield self._gathered_block(own, first_runs[own])

    def _product_block(self, kind: int, own: slice) -> _Block:
        """Some runs of one kind."""
        vertex_stencils = self.vertex_stencils
        stencils, samples = self.classes[int(vertex_stencils.class_of_kind[kind])], vertex_stencils.samples_of(kind)
        weights = stencils.weights[:, samples].transpose(0, 2, 1)
        vertices = np.add.outer(np.arange(len(samples)), vertex_stencils.first_vertex[own])
        return _Block(vertices.ravel(), weights, stencils.controls[vertex_stencils.patch[own]].T, None)

    def _gathered_block(self, kinds: IntArray, first_runs: IntArray) -> _Block:
        """All runs of some kinds, on patches with as many control points."""
        vertex_stencils = self.vertex_stencils
        # Of each run.
        run, kind = (
            ragged.ranges(first_runs, vertex_stencils.run_counts[kinds]),
            np.repeat(kinds, vertex_stencils.run_counts[kinds]),
        )
        number, counts = vertex_stencils.class_of_kind[kind], vertex_stencils.counts[kind]
        classes, used = np.unique(vertex_stencils.class_of_kind[kinds], return_index=True)
        first_control = np.zeros(len(self.classes), dtype=np.int64)
        patch_count = np.zeros(len(self.classes), dtype=np.int64)
        first_control[classes] = [self.classes[index].first_control for index in classes]
        patch_count[classes] = [len(self.classes[index].controls) for index in classes]
        at = np.multiply.outer(np.arange(self.classes[classes[0]].controls.shape[1]), patch_count[number])
        at += first_control[number] + vertex_stencils.patch[run]
        sample_starts = ragged.starts(vertex_stencils.counts[kinds])
        samples = vertex_stencils.samples[ragged.ranges(vertex_stencils.starts[kinds], vertex_stencils.counts[kinds])]
        of_classes = np.split(samples, sample_starts[used[1:]])
        weights = [self.classes[index].weights[:, own] for index, own in zip(classes, of_classes, strict=True)]
        sample = ragged.ranges(np.repeat(sample_starts, vertex_stencils.run_counts[kinds]), counts)
        vertices = ragged.ranges(vertex_stencils.first_vertex[run].astype(np.int64), counts)
        controls = np.repeat(self.controls.take(at), counts, axis=1)
        return _Block(vertices, np.concatenate(weights, axis=1).transpose(0, 2, 1), controls, sample)


class VertexMatrices(NamedTuple):
    """The vertices of a tessellation as weights over the cage's control points.

    Attributes
    ----------
    p : (n, n_v) CSR array of float64
        Times ``(n_v, k)`` control points: the vertices. Rows sum to one.
    tangent_u, tangent_v : (n, n_v) CSR array of float64
        Tangents whose cross product is along the normal. Rows sum to zero. They are the derivatives by u and v of a
        patch, but for a positive factor that differs from vertex to vertex, and but for extraordinary points, borders
        and sharp features, where derivatives may vanish and these do not. `LimitSurface.matrix` has the derivatives.
    """

    p: sparse.csr_array
    tangent_u: sparse.csr_array
    tangent_v: sparse.csr_array


class _Block(NamedTuple):
    """Vertices on patches with as many control points. Vertices and patches come last: NumPy's loops are then long."""

    vertices: IntArray  # (n,) int64
    weights: FloatArray  # (3, K, S) float64: of some samples
    controls: NDArray[np.uint32]  # (K, p) uint32: of some patches
    # (n,) int64 or None: of each vertex, which has a column of ``controls`` of its own. If None, there is a vertex
    # for each sample on each of the patches: those of the first sample come first.
    sample: IntArray | None

    @property
    def frame_weights(self) -> FloatArray:
        """``(2, S)`` sums of the absolute weights of each tangent."""
        return np.abs(self.weights[1:]).sum(axis=1)

    def of_vertices(self, values: NDArray) -> NDArray:
        """``(.., n)`` from values ``(.., S)`` of samples."""
        if self.sample is None:
            return values.repeat(self.controls.shape[1], axis=-1)
        return values.take(self.sample, axis=-1)

    def of_patches(self, values: NDArray) -> NDArray:
        """``(.., n)`` from values ``(.., p)`` of patches."""
        return values if self.sample is not None else np.tile(values, self.weights.shape[2])

    def sums(
        self, coordinates: FloatArray, dtype: DTypeLike, row_count: int = 3
    ) -> tuple[NDArray, FloatArray, NDArray]:
        """Weights times control points, of which coordinates ``(k, control_count)`` come first.

        Returns
        -------
        values : (row_count, k, n)
            Points, seen from the origin of their patch, and tangents.
        origin : (k, p) float64
            A control point of each patch.
        extent : (k, p)
            How far the others are from it along each axis.
        """
        points = coordinates.take(self.controls, axis=1)
        origin = points[:, 0].copy()
        points -= origin[:, None]
        relative, weights = points.astype(dtype, copy=False), self.weights[:row_count].astype(dtype)
        if self.sample is None:
            matrix = weights.swapaxes(1, 2).reshape(-1, weights.shape[1])
            values = (matrix @ relative).reshape(len(relative), row_count, -1).swapaxes(0, 1)
        else:
            values = np.einsum("dkn,xkn->dxn", weights.take(self.sample, axis=2), relative)
        return values, origin, np.abs(relative).max(axis=1)


class Grid(Protocol):
    """Numbering of a tessellation: the same for all surfaces over the same elements."""

    @property
    def vertex_count(self) -> int:
        """Vertices of the tessellation."""
        ...

    def triangles(self) -> NDArray[np.uint32]:
        """``(m, 3)`` vertices, counter-clockwise from outside, in the order of the elements."""
        ...

    def element(self) -> NDArray[np.uint32]:
        """``(m,)`` element of each triangle."""
        ...

    def locations(self) -> tuple[IntArray, FloatArray]:
        """Locations of the vertices on the surface.

        Returns
        -------
        half_edge : (vertex_count,) int64
            Corner of an element at the origin of the parameters, a half-edge of `PatchTable.elements`.
        uv : (vertex_count, 2) float64
            Samples at corners have (0, 0).
        """
        ...

    def cut(self, topology: Topology) -> Grid:
        """The same triangles over elements with the same half-edges, cut along more edges.

        Vertices on a cut have a copy on each side, and lie on their side of it.
        """
        ...

    def vertices_of(self, other: Any) -> IntArray:
        """``(vertex_count,)`` for each vertex, its original in a grid of which this one is a `cut`."""
        ...


@dataclass(frozen=True, eq=False)
class Tessellation:
    """Triangles on a limit surface.

    Attributes
    ----------
    positions, normals : (n, 3) float64
        Exact points and unit normals of the limit surface.
    triangles : (m, 3) uint32
        0-based vertices, counter-clockwise from outside. Neighbours share vertices: there are no cracks.
    element : (m,) uint32
        0-based element of each triangle.
    texcoords : (n, 2) float64 or None
        Texture coordinates. Along their seams, and those of other attributes, vertices have copies with the same
        position and normal, one for each side.
    attributes : dict of str to (n, k) float64
        The cage's other attributes.
    """

    positions: FloatArray
    normals: FloatArray
    triangles: NDArray[np.uint32]
    element: NDArray[np.uint32]
    texcoords: FloatArray | None = None
    attributes: Mapping[str, FloatArray] = field(default_factory=dict)

    def __repr__(self) -> str:
        data = [*([] if self.texcoords is None else ["texcoords"]), *self.attributes]
        parts = [f"{len(self.positions)} vertices", f"{len(self.triangles)} triangles", *data]
        return f"Tessellation({', '.join(parts)})"

    def save(self, path: str | Path) -> None:
        """Write to a file: ``.obj`` with every digit; ``.ply``, ``.usd``, ``.usda`` or ``.usdc`` in single precision.

        Raises
        ------
        ValueError
            If the format is unknown, or the package that writes it is missing.
        OSError
            If the file cannot be written; an existing one is then left as it was.
        """
        from ..files.triangle_writer import write_triangles

        write_triangles(path, self.positions, self.normals, self.triangles, self.texcoords, self.attributes)
