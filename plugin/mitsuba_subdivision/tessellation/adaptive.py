"""Adaptive tessellations, refined until an error criterion holds."""

from __future__ import annotations

import numpy as np

from ..mesh import ragged
from ..mesh.connectivity import IntArray
from ..patches import PatchTable
from ..schemes.domain import FloatArray
from . import HIGHEST_RATE
from .adaptive_grid import AdaptiveGrid
from .criterion import Criterion
from .patch_frames import UNIT, PatchFrames
from .tile_choice import choose_tiles
from .uniform import checked_rate
from .vertex_polynomials import VertexPolynomials, VertexRuns, vertex_polynomials
from .vertex_table import VertexTable


def adaptive_table(
    patches: PatchTable,
    control_of_vertex: IntArray,  # (n_v,) int64: 0-based control point at each mesh vertex
    # (n, 3) float64: control points for which the criterion is met. The table can be applied to others.
    control_points: FloatArray,
    criterion: Criterion,
    max_rate: int,  # Most segments along an edge of the cage, 1 to `HIGHEST_RATE`; see `choose_tiles`
    cage_name: str,  # For a warning
) -> VertexTable:
    """Prepare the adaptive tessellation of a cage's patches.

    Raises ValueError if ``max_rate`` is anything else. Raises MemoryError, and warns, as `choose_tiles` does.
    """
    max_rate = checked_rate(max_rate, "max_rate")
    if max_rate > HIGHEST_RATE:
        raise ValueError(f"max_rate {max_rate}; expected at most {HIGHEST_RATE} segments per edge")
    frames = PatchFrames.of(patches, control_of_vertex)
    tiles = choose_tiles(patches, frames, control_points, control_of_vertex, criterion, max_rate, cage_name)
    grid = AdaptiveGrid.of(tiles, frames)
    controls, refinement = patches.control_rows(control_of_vertex, len(control_points))
    polynomials = _polynomials(patches, grid)
    return VertexTable(len(control_points), patches.patch_count, grid, polynomials, controls, grid.copies(), refinement)


def _polynomials(patches: PatchTable, grid: AdaptiveGrid) -> tuple[VertexPolynomials, ...]:
    """What the vertices lie on. Vertices of patches of a class at the same parameters are one sample."""
    refined = patches.refined
    table = patches if refined is None else refined.table
    tile, parameters = grid.vertex_parameters()
    corner = grid.tiles["corner"][tile]
    # Face h of the cage refined once lies at half-edge h of the cage, and begins there.
    patch_class, patch, _ = table.patch_at(corner if refined is None else table.topology.face_offsets[corner])
    uv = parameters / UNIT
    order = np.lexsort((*uv, patch_class))
    is_new = np.ones(len(order), dtype=bool)
    is_new[1:] = (np.diff(uv[:, order]) != 0).any(axis=0) | (np.diff(patch_class[order]) != 0)
    different = order[is_new]
    counts = np.bincount(patch_class[different], minlength=len(table.classes))
    own_uv = np.split(np.ascontiguousarray(uv[:, different].T), np.cumsum(counts)[:-1])
    # Runs of one vertex each.
    kind = np.cumsum(is_new) - 1
    samples, ones = ragged.index_in_row(counts), np.ones_like(different)
    runs = VertexRuns(patch_class[different], ones, samples, kind, patch[order], order)
    return vertex_polynomials(table.scheme, table.classes, own_uv, runs)
