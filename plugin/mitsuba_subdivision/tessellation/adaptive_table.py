"""Limit stencils of every vertex of an adaptive tessellation."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import DTypeLike, NDArray

from ..evaluation.element import element_stencils
from ..evaluation.normals import ROUNDED, unit_normals
from ..mesh import ragged
from ..mesh.connectivity import IntArray
from ..patches import PatchTable, StencilRows
from ..progress import counted
from ..schemes.domain import FloatArray
from .adaptive_grid import AdaptiveGrid
from .class_stencils import ClassStencils
from .criterion import Criterion
from .patch_frames import PatchFrames
from .runs import Runs
from .tile_choice import choose_tiles

if TYPE_CHECKING:
    from scipy import sparse

# Vertices are evaluated in runs of about this many weights, which bounds temporary memory.
CHUNK = 1 << 19


@dataclass(frozen=True, eq=False)
class AdaptiveTable:
    """An adaptive tessellation: its vertices as weights over control points, its triangles, and their elements.

    It holds to a criterion where the control points were when it was built. Weights do not depend on where they are: it
    can be applied to others.

    Attributes
    ----------
    control_count, patch_count : int
    grid : AdaptiveGrid
    runs : Runs
        All vertices, each once, in the order of the classes; every run is a kind of its own.
    controls : (n,) uint32
        As `SamplingTable.controls`.
    refinement : (n, control_count) sparse array or None
        As `SamplingTable.refinement`.
    """

    control_count: int
    patch_count: int
    grid: AdaptiveGrid
    runs: Runs
    controls: NDArray[np.uint32]
    refinement: sparse.csr_array | None = None

    @classmethod
    def build(
        cls, patches: PatchTable, row: IntArray, control_points: FloatArray, criterion: Criterion, max_rate: int
    ) -> AdaptiveTable:
        """Prepare the adaptive tessellation of a cage's patches.

        Parameters
        ----------
        patches : PatchTable
        row : (n_v,) int64
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
        frames = PatchFrames.of(patches, row)
        tiles = choose_tiles(patches, frames, control_points, row, criterion, max_rate)
        grid = AdaptiveGrid.of(tiles, frames)
        controls, refinement = patches.control_rows(row, len(control_points))
        runs = _runs(patches, grid, controls)
        return cls(len(control_points), patches.patch_count, grid, runs, controls, refinement)

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
        positions = np.empty((self.vertex_count, 3), dtype=dtype)
        normals = np.empty((self.vertex_count, 3), dtype=dtype)
        values = self.refined(control_points)
        for part in self.stencil_rows():
            vertices, weights, points = part.rows, part.weights, values[part.columns]
            origin = points[:, :1]
            relative = (points - origin).astype(dtype)
            point, du, dv = np.einsum("dnk,nkx->dnx", weights.astype(dtype), relative)
            positions[vertices] = point + origin[:, 0]
            reach = np.abs(relative).max(axis=1)
            if self.refinement is not None:
                # Refined control points are rounded before they are seen from the origin.
                reach = np.maximum(reach, ROUNDED[np.dtype(np.float64)] * np.abs(origin[:, 0]))
            normals[vertices] = unit_normals(du, dv, np.abs(weights[1:]).sum(axis=2).astype(dtype), reach)
        return positions[self.place], normals

    def stencil_rows(self) -> Iterator[StencilRows]:
        """As `SamplingTable.stencil_rows`."""
        runs = self.runs
        run = np.repeat(np.arange(len(runs.counts)), runs.counts)
        vertex, patch = ragged.ranges(runs.first_vertex, runs.counts), runs.patch[run]
        bounds = np.searchsorted(runs.class_of_kind[run], np.arange(len(runs.classes) + 1))
        for stencils, first, last in zip(runs.classes, bounds[:-1], bounds[1:], strict=True):
            length = max(1, CHUNK // stencils.weights.shape[2])
            for begin in range(first, last, length):
                own = slice(begin, min(begin + length, last))
                weights = stencils.weights[:, runs.samples[own]]
                yield StencilRows(vertex[own], stencils.controls[patch[own]], weights)


def _runs(patches: PatchTable, grid: AdaptiveGrid, controls: NDArray[np.uint32]) -> Runs:
    """Runs of all vertices, with the stencils of their classes."""
    corner, uv = grid.locations()
    table, refined = patches, patches.refined
    if refined is not None:
        table = refined.table
        # Patches have parameters of their own, and face h of the cage refined once lies at half-edge h of the cage.
        uv = uv / grid.frames.scale[patches.elements.face_of(corner)][:, None]
        corner = table.topology.face_offsets[corner]
    of_class, patch, patch_corner = (found[corner] for found in table.patch_of_corner)
    order = np.lexsort([uv[:, 1], uv[:, 0], patch_corner, of_class])
    # Vertices of the same class in the same place of their patches have the same stencil.
    keys = np.stack([of_class, patch_corner, *uv.T])[:, order]
    is_new = np.concatenate([[True], (np.diff(keys, axis=1) != 0).any(axis=0)])
    row = np.empty(len(order), dtype=np.int64)
    row[order] = np.cumsum(is_new) - 1
    found = order[is_new]
    classes, first_rows = [], np.searchsorted(of_class[found], np.arange(len(table.classes) + 1))
    # In the order of their sizes, as `SamplingTable.classes`.
    used = sorted(np.unique(of_class).tolist(), key=lambda index: table.classes[index].controls.shape[1])
    for index in counted(used, "Weights of patch classes"):
        patch_class, own = table.classes[index], found[first_rows[index] : first_rows[index + 1]]
        weights = element_stencils(table.scheme, patch_class.signature, uv[own], patch_corner[own])
        first, shape = patch_class.first_control, patch_class.controls.shape
        own_controls = controls[first : first + patch_class.controls.size].reshape(shape[::-1]).T
        classes.append(ClassStencils(weights, own_controls, first, uv[own], 0, None))
    number_of_class = np.empty(len(table.classes), dtype=np.int64)
    number_of_class[used] = np.arange(len(used))
    number = number_of_class[of_class]
    sample = row - first_rows[of_class]
    # Vertices that follow each other on a patch are one run.
    begins = np.flatnonzero(np.diff(number * (patch.max() + 1) + patch, prepend=-1))
    counts = np.diff(begins, append=len(number))
    by_class = np.argsort(number[begins], kind="stable")
    begins, counts = begins[by_class], counts[by_class]
    return Runs(
        tuple(classes),
        number[begins],
        counts,
        sample[ragged.ranges(begins, counts)],
        np.arange(len(begins)),
        patch[begins],
        begins,
    )
