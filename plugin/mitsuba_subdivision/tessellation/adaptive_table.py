"""Limit stencils of every vertex of an adaptive tessellation."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from itertools import groupby
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import DTypeLike, NDArray

from ..evaluation.normals import LEAST_EXTENT, unit_normals
from ..evaluation.stencils_together import stencils_of_samples
from ..mesh import ragged
from ..mesh.connectivity import IndexArray, IntArray
from ..patches import PatchTable, StencilRows
from ..progress import counted
from ..schemes.domain import FloatArray
from .adaptive_grid import AdaptiveGrid
from .class_stencils import WEIGHTS_TOGETHER, ClassStencils
from .criterion import Criterion
from .patch_frames import PatchFrames
from .runs import Runs
from .tile_choice import choose_tiles
from .tile_lines import UNIT

if TYPE_CHECKING:
    from scipy import sparse

# Vertices are evaluated in runs of about this many weights: their arrays stay in a core's cache.
CHUNK = 1 << 16


@dataclass(frozen=True, eq=False)
class AdaptiveTable:
    """An adaptive tessellation: its vertices as weights over control points, its triangles, and their elements.

    It holds to a criterion where the control points were when it was built. Weights do not depend on where they are: it
    can be applied to others.

    Attributes
    ----------
    control_count, patch_count : int
    grid : AdaptiveGrid
    classes : tuple of ClassStencils
        With fewer control points first. Their samples are those that vertices lie at.
    stencil : (vertex_count,) int32
        Of each vertex, counted through the samples of all classes.
    patch : (vertex_count,) int32
        Counted from the first patch of the class.
    controls : (n,) uint32
        As `SamplingTable.controls`.
    refinement : (n, control_count) sparse array or None
        As `SamplingTable.refinement`.
    """

    control_count: int
    patch_count: int
    grid: AdaptiveGrid
    classes: tuple[ClassStencils, ...]
    stencil: IndexArray
    patch: IndexArray
    controls: NDArray[np.uint32]
    refinement: sparse.csr_array | None = None

    @classmethod
    def build(
        cls,
        patches: PatchTable,
        control_of_vertex: IntArray,
        control_points: FloatArray,
        criterion: Criterion,
        max_rate: int,
    ) -> AdaptiveTable:
        """Prepare the adaptive tessellation of a cage's patches.

        Parameters
        ----------
        patches : PatchTable
        control_of_vertex : (n_v,) int64
            0-based control point at each mesh vertex.
        control_points : (n, 3) float64
            For which it holds to the criterion.
        criterion : Criterion
        max_rate : int
            Most segments along an edge of the cage; see `choose_tiles`.

        Raises
        ------
        MemoryError
            If the tessellation would not fit into memory.
        """
        frames = PatchFrames.of(patches, control_of_vertex)
        tiles = choose_tiles(patches, frames, control_points, control_of_vertex, criterion, max_rate)
        grid = AdaptiveGrid.of(tiles, frames)
        controls, refinement = patches.control_rows(control_of_vertex, len(control_points))
        classes, stencil, patch = _stencils(patches, grid, controls)
        return cls(len(control_points), patches.patch_count, grid, classes, stencil, patch, controls, refinement)

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

    @property
    def place(self) -> IntArray:
        """As `SamplingTable.place`."""
        return self.grid.place

    @property
    def copies(self) -> IntArray:
        """As `SamplingTable.copies`."""
        later = np.flatnonzero(self.place != np.arange(self.vertex_count))
        return np.stack([later, self.place[later]])

    def locations(self) -> tuple[IntArray, FloatArray]:
        """As `SamplingTable.locations`."""
        return self.grid.locations()

    def refined(self, control_points: FloatArray) -> FloatArray:
        """As `SamplingTable.refined`."""
        return control_points if self.refinement is None else self.refinement @ control_points

    def apply(self, control_points: FloatArray, dtype: DTypeLike = np.float64) -> tuple[NDArray, NDArray]:
        """Evaluate every vertex; see `SamplingTable.apply`."""
        # In the order of the stencils.
        positions, normals = (np.empty((self.vertex_count, 3), dtype=dtype) for _ in range(2))
        coordinates = np.ascontiguousarray(self.refined(control_points).T)
        for size in self._sizes():
            for own, found, sample, controls in size.runs(self):
                # Vertices come last: NumPy's loops over a last axis should be long.
                weights = np.ascontiguousarray(found.transpose(0, 2, 1), dtype=dtype)
                frame_weights = np.abs(weights[1:]).sum(axis=1)
                points = coordinates.take(controls, axis=1)
                origin = points[:, :1].copy()
                points -= origin
                relative = points.astype(dtype, copy=False)
                values = np.einsum("dkn,xkn->dxn", weights.take(sample, axis=2), relative)
                reach = np.abs(relative).max(axis=1)
                if self.refinement is not None:
                    # Refined control points are rounded before they are seen from the origin.
                    reach = np.maximum(reach, LEAST_EXTENT[64] * np.abs(origin[:, 0]))
                positions[own] = (values[0] + origin[:, 0]).T
                normals[own] = unit_normals(values[1].T, values[2].T, frame_weights.take(sample, axis=1), reach.T)
        rank = np.empty(self.vertex_count, dtype=np.int32)
        rank[self._order] = np.arange(self.vertex_count, dtype=np.int32)
        # One after the other, so that only one of them is there twice.
        positions = positions.take(rank[self.place], axis=0)
        return positions, normals.take(rank, axis=0)

    def stencil_rows(self) -> Iterator[StencilRows]:
        """As `SamplingTable.stencil_rows`."""
        for size in self._sizes():
            for own, weights, sample, controls in size.runs(self):
                yield StencilRows(self._order[own], controls.T, weights[:, sample])

    @cached_property
    def _order(self) -> IndexArray:
        """Vertices in the order of their stencils."""
        stencil = self.stencil.astype(np.min_scalar_type(self.stencil.max(initial=0)), copy=False)
        return np.argsort(stencil, kind="stable").astype(np.int32)

    def _sizes(self) -> Iterator[_Size]:
        """The vertices on patches with as many control points, one size after the other."""
        first = begin = 0
        for _, group in groupby(self.classes, lambda each: each.controls.shape[1]):
            classes = tuple(group)
            last = first + sum(each.weights.shape[1] for each in classes)
            end = int(np.searchsorted(self.stencil, last, sorter=self._order))
            yield _Size(classes, first, slice(begin, end))
            first, begin = last, end

    @cached_property
    def runs(self) -> Runs:
        """All vertices, each once, in the order of the classes; every run is a kind of its own."""
        sample_counts = np.array([each.weights.shape[1] for each in self.classes])
        first = ragged.starts(sample_counts)
        number = np.repeat(np.arange(len(self.classes)), sample_counts)[self.stencil]
        # Vertices that follow each other on a patch are one run.
        begins = np.flatnonzero((np.diff(number, prepend=-1) != 0) | (np.diff(self.patch, prepend=-1) != 0))
        counts = np.diff(begins, append=len(number))
        by_class = np.argsort(number[begins], kind="stable")
        begins, counts = begins[by_class], counts[by_class]
        vertices = ragged.ranges(begins, counts)
        samples = self.stencil[vertices] - first[number[vertices]]
        return Runs(self.classes, number[begins], counts, samples, np.arange(len(begins)), self.patch[begins], begins)


@dataclass(frozen=True, eq=False)
class _Size:
    """The vertices on patches with as many control points.

    Attributes
    ----------
    classes : tuple of ClassStencils
    first : int
        The first stencil of these.
    places : slice
        In the order of the stencils.
    """

    classes: tuple[ClassStencils, ...]
    first: int
    places: slice

    def runs(self, table: AdaptiveTable) -> Iterator[tuple[slice, FloatArray, IndexArray, NDArray[np.uint32]]]:
        """Runs of vertices: places, weights ``(3, S, K)``, which of these they have, and control points ``(K, n)``."""
        firsts = self.first + ragged.offsets([each.weights.shape[1] for each in self.classes])
        first_control = np.array([each.first_control for each in self.classes])
        step, count = np.array([len(each.controls) for each in self.classes]), self.classes[0].controls.shape[1]
        length = max(1, CHUNK // count)
        for begin in range(self.places.start, self.places.stop, length):
            own = slice(begin, min(begin + length, self.places.stop))
            vertices = table._order[own]
            stencil = table.stencil[vertices]
            number = np.searchsorted(firsts, stencil, side="right") - 1
            at = np.multiply.outer(np.arange(count), step[number])
            at += first_control[number] + table.patch[vertices]
            used = range(int(number[0]), int(number[-1]) + 1)
            ranges = [np.clip([stencil[0], stencil[-1] + 1], firsts[i], firsts[i + 1]) - firsts[i] for i in used]
            parts = [self.classes[i].weights[:, slice(*own_range)] for i, own_range in zip(used, ranges, strict=True)]
            yield own, np.concatenate(parts, axis=1), stencil - stencil[0], table.controls.take(at)


def _stencils(
    patches: PatchTable, grid: AdaptiveGrid, controls: NDArray[np.uint32]
) -> tuple[tuple[ClassStencils, ...], IndexArray, IndexArray]:
    """`AdaptiveTable.classes`, `AdaptiveTable.stencil` and `AdaptiveTable.patch`."""
    refined = patches.refined
    table = patches if refined is None else refined.table
    # In the order of their sizes, as `SamplingTable.classes`.
    classes = sorted(table.classes, key=lambda each: each.controls.shape[1])
    corners = np.concatenate([each.corners if refined is None else refined.corners(each) for each in classes])
    patch_counts = np.array([len(each.corners) for each in classes])
    of_corner, patch_of_corner = (np.empty(patches.elements.half_edge_count, dtype=np.int32) for _ in range(2))
    of_corner[corners] = np.repeat(np.arange(len(classes), dtype=np.int32), patch_counts)
    patch_of_corner[corners] = ragged.places(patch_counts)
    tile, places = grid.vertex_places()
    corner = grid.tiles.corner[tile]
    of_class, patch, uv = of_corner[corner], patch_of_corner[corner], places / UNIT
    order, is_new = _by_stencil(of_class, uv)
    stencil = np.empty(len(order), dtype=np.int32)
    stencil[order] = np.cumsum(is_new, dtype=np.int32) - 1
    found = order[is_new]
    own_uv, counts = np.ascontiguousarray(uv[:, found].T), np.bincount(of_class[found], minlength=len(classes))
    first, rows = ragged.starts(counts), []
    sizes = counts * np.array([3 * each.controls.shape[1] for each in classes])
    used = np.flatnonzero(counts)
    groups = np.split(used, np.flatnonzero(np.diff(np.cumsum(sizes[used]) // WEIGHTS_TOGETHER)) + 1)
    for group in counted(groups, "Weights of groups of patch classes"):
        signatures = [classes[index].signature for index in group.tolist()]
        own = own_uv[first[group[0]] : first[group[-1]] + counts[group[-1]]]
        rows += stencils_of_samples(table.scheme, signatures, counts[group].tolist(), own)
    stencils = []
    for index, weights in zip(used.tolist(), rows, strict=True):
        begin, shape = classes[index].first_control, classes[index].controls.shape
        own_controls = controls[begin : begin + classes[index].controls.size].reshape(shape[::-1]).T
        samples = own_uv[first[index] : first[index] + counts[index]]
        stencils.append(ClassStencils(weights, own_controls, begin, samples, 0, None))
    return tuple(stencils), stencil, patch


def _by_stencil(of_class: IndexArray, uv: FloatArray) -> tuple[IntArray, NDArray[np.bool_]]:
    """Vertices by their classes, those in the same place of their patches together, and where places change.

    Vertices of the same class in the same place of their patches have the same stencil.
    """
    u, v = np.ascontiguousarray(uv).view(np.uint64)
    # By a number that nearly always tells places apart: where it does not, some stencil is there more than once.
    keys = u * np.uint64(0x9E3779B97F4A7C15) ^ v * np.uint64(0xC2B2AE3D27D4EB4F)
    bits = np.uint64(int(of_class.max(initial=0)).bit_length())
    keys = keys >> bits | of_class.astype(np.uint64) << (np.uint64(64) - bits)
    order = np.argsort(keys, kind="stable")
    is_new = np.ones(len(order), dtype=bool)
    is_new[1:] = np.any([each[1:] != each[:-1] for each in (of_class[order], u[order], v[order])], axis=0)
    return order, is_new
