"""Adaptive tessellations, refined until an error criterion holds."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ..evaluation.element import stencils_of_samples
from ..mesh import ragged
from ..mesh.connectivity import IndexArray, IntArray
from ..patches import PatchTable
from ..progress import counted
from ..schemes.domain import FloatArray
from . import HIGHEST_RATE
from .adaptive_grid import AdaptiveGrid
from .criterion import Criterion
from .patch_frames import PatchFrames
from .tile_choice import choose_tiles
from .tiles import UNIT
from .uniform import checked_rate
from .vertex_stencils import WEIGHTS_TOGETHER, ClassStencils, VertexStencils
from .vertex_table import VertexTable


def adaptive_table(
    patches: PatchTable,
    control_of_vertex: IntArray,
    control_points: FloatArray,
    criterion: Criterion,
    max_rate: int,
    cage_name: str,
) -> VertexTable:
    """Prepare the adaptive tessellation of a cage's patches.

    Raises ValueError if ``max_rate`` is anything else. Raises MemoryError if the tessellation would not fit into
    memory.

    Parameters
    ----------
    control_of_vertex : (n_v,) int64
        0-based control point at each mesh vertex.
    control_points : (n, 3) float64
        Control points for which the criterion is met. The table can be applied to others.
    max_rate : int
        Most segments along an edge of the cage, 1 to `HIGHEST_RATE`; see `choose_tiles`.
    cage_name : str
        For a warning.

    Warns
    -----
    CageWarning
        As `choose_tiles`.
    """
    max_rate = checked_rate(max_rate, "max_rate")
    if max_rate > HIGHEST_RATE:
        raise ValueError(f"max_rate {max_rate}; expected at most {HIGHEST_RATE} segments per edge")
    frames = PatchFrames.of(patches, control_of_vertex)
    tiles = choose_tiles(patches, frames, control_points, control_of_vertex, criterion, max_rate, cage_name)
    grid = AdaptiveGrid.of(tiles, frames)
    controls, refinement = patches.control_rows(control_of_vertex, len(control_points))
    vertex_stencils = _vertex_stencils(patches, grid, controls)
    return VertexTable(
        len(control_points), patches.patch_count, grid, vertex_stencils, controls, grid.copies(), refinement
    )


def _vertex_stencils(patches: PatchTable, grid: AdaptiveGrid, controls: NDArray[np.uint32]) -> VertexStencils:
    """Runs of one vertex each; vertices of the same stencil are of a kind."""
    refined = patches.refined
    table = patches if refined is None else refined.table
    # In the order of their sizes, so that kernels pad them alike.
    classes = sorted(table.classes, key=lambda each: each.controls.shape[1])
    corners = np.concatenate([each.corners if refined is None else refined.corners(each) for each in classes])
    patch_counts = np.array([len(each.corners) for each in classes])
    of_corner, patch_of_corner = (np.empty(patches.elements.half_edge_count, dtype=np.int32) for _ in range(2))
    of_corner[corners] = np.repeat(np.arange(len(classes), dtype=np.int32), patch_counts)
    patch_of_corner[corners] = ragged.index_in_row(patch_counts)
    tile, parameters = grid.vertex_parameters()
    corner = grid.tiles.corner[tile]
    of_class, patch, uv = of_corner[corner], patch_of_corner[corner], parameters / UNIT
    del tile, parameters, corner, of_corner, patch_of_corner
    order, is_new = _by_stencil(of_class, uv)
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
    stencils = tuple(
        ClassStencils.of(classes[index], own, own_uv[first[index] : first[index] + counts[index]], controls)
        for index, own in zip(used.tolist(), rows, strict=True)
    )
    kinds = len(found)
    run_counts = np.diff(np.flatnonzero(is_new), append=len(order))
    return VertexStencils(
        stencils,
        np.repeat(np.arange(len(used)), counts[used]),
        np.ones(kinds, dtype=np.int64),
        ragged.index_in_row(counts[used]),
        run_counts,
        patch[order],
        order.astype(np.uint32),
    )


def _by_stencil(of_class: IndexArray, uv: FloatArray) -> tuple[IntArray, NDArray[np.bool_]]:
    """Order of vertices by class and by parameters in their patches, and the positions at which these change.

    Vertices of the same class and parameters have the same stencil.
    """
    u, v = np.ascontiguousarray(uv).view(np.uint64)
    # Sorted by a hash of the parameters; on a collision, a stencil is stored more than once.
    keys = u * np.uint64(0x9E3779B97F4A7C15) ^ v * np.uint64(0xC2B2AE3D27D4EB4F)
    bits = np.uint64(int(of_class.max(initial=0)).bit_length())
    keys = keys >> bits | of_class.astype(np.uint64) << (np.uint64(64) - bits)
    order = np.argsort(keys, kind="stable")
    is_new = np.ones(len(order), dtype=bool)
    is_new[1:] = False
    for each in (of_class, u, v):
        in_order = each[order]
        is_new[1:] |= in_order[1:] != in_order[:-1]
    return order, is_new
