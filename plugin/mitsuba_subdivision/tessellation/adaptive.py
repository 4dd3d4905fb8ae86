"""Adaptive tessellations, refined until an error criterion holds."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ..mesh import ragged
from ..mesh.connectivity import IndexArray, IntArray
from ..patches import PatchTable
from ..schemes.domain import FloatArray
from . import HIGHEST_RATE
from .adaptive_grid import AdaptiveGrid
from .criterion import Criterion
from .patch_frames import PatchFrames
from .tile_choice import choose_tiles
from .tiles import UNIT
from .uniform import checked_rate
from .vertex_polynomials import PatchVertices, VertexPolynomials, vertex_polynomials
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
    polynomials = _polynomials(patches, grid)
    return VertexTable(len(control_points), patches.patch_count, grid, polynomials, controls, grid.copies(), refinement)


def _polynomials(patches: PatchTable, grid: AdaptiveGrid) -> tuple[VertexPolynomials, ...]:
    """What the vertices lie on. Vertices of patches of a class at the same parameters are one sample."""
    refined = patches.refined
    table = patches if refined is None else refined.table
    classes = table.classes
    corners = np.concatenate([each.corners if refined is None else refined.corners(each) for each in classes])
    patch_counts = np.array([len(each.corners) for each in classes])
    of_corner, patch_of_corner = (np.empty(patches.elements.half_edge_count, dtype=np.int32) for _ in range(2))
    of_corner[corners] = np.repeat(np.arange(len(classes), dtype=np.int32), patch_counts)
    patch_of_corner[corners] = ragged.index_in_row(patch_counts)
    tile, parameters = grid.vertex_parameters()
    corner = grid.tiles.corner[tile]
    of_class, patch, uv = of_corner[corner], patch_of_corner[corner], parameters / UNIT
    order, is_new = _by_sample(of_class, uv)
    different = order[is_new]
    counts = np.bincount(of_class[different], minlength=len(classes))
    sample = np.empty(len(order), dtype=np.int32)
    sample[order] = ragged.index_in_row(counts)[np.cumsum(is_new) - 1]
    own_uv = np.split(np.ascontiguousarray(uv[:, different].T), np.cumsum(counts)[:-1])
    used = np.flatnonzero(counts)
    number = np.zeros(len(classes), dtype=np.int32)
    number[used] = np.arange(len(used))
    vertices = PatchVertices(number[of_class], patch, sample, np.arange(len(order), dtype=np.uint32))
    return vertex_polynomials(table.scheme, [classes[i] for i in used], [own_uv[i] for i in used], vertices)


def _by_sample(of_class: IndexArray, uv: FloatArray) -> tuple[IntArray, NDArray[np.bool_]]:
    """Order of vertices by class and by parameters in their patches, and the positions at which these change."""
    u, v = np.ascontiguousarray(uv).view(np.uint64)
    # Sorted by a hash of the parameters; on a collision, a sample occurs more than once.
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
