"""Adaptive tessellations, refined until an error criterion holds: choice of tiles, and the table of their vertices."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import islice

import numpy as np

from ..cage.errors import warn
from ..evaluation.divided_tile import DividedTile, part_of_tile
from ..evaluation.polynomials import times
from ..mesh import ragged
from ..messages import counted
from ..patches.patch_table import PatchTable
from ..schemes.domain import FloatArray
from . import HIGHEST_RATE
from .adaptive_grid import AdaptiveGrid, PatchFrames, Tiles, sides_of, tile_type, whole_patches
from .criterion import Criterion
from .memory import require_memory_for_triangles
from .tile_rates import Part, TileRates, feature_edges
from .uniform import checked_rate
from .vertex_table import VertexPolynomials, VertexRuns, VertexTable, vertex_polynomials

# Tiles of a kind that are processed together, whose bounds stay in a core's cache; and parts of as many patches, which
# are divided together. Both bound temporary memory; smaller numbers would take more time.
TILES_AT_ONCE, PARTS_AT_ONCE = 1 << 10, 1 << 7


def adaptive_table(
    patches: PatchTable,
    # (n, 3) float64: control points at which the criterion holds. The table can be applied to others.
    control_points: FloatArray,
    criterion: Criterion,
    # Most segments along an edge of the cage, and along each ring around an extraordinary point, 1 to `HIGHEST_RATE`;
    # rounded down to a power of two
    max_rate: int,
    cage_name: str,  # For warnings
) -> VertexTable:
    """Prepare the adaptive tessellation of a cage's patches, divided into tiles in the order of the elements.

    Raises ValueError if ``max_rate`` is out of range. Raises MemoryError if the triangles would not fit into memory.
    Warns if ``max_rate`` is too low for the criterion, unless that is for outlines.
    """
    max_rate = checked_rate(max_rate, "max_rate")
    if max_rate > HIGHEST_RATE:
        raise ValueError(f"max_rate {max_rate}; expected at most {HIGHEST_RATE} segments per edge")
    frames = PatchFrames.of(patches)
    rates = TileRates(patches.scheme, frames, criterion, max_rate)
    grid = AdaptiveGrid.of(_chosen(patches, rates, control_points[patches.control_of_vertex], cage_name), frames)
    polynomials, (controls, refinement) = _polynomials(patches, grid), patches.control_rows()
    counts = patches.control_count, patches.patch_count
    return VertexTable(*counts, grid, polynomials, controls, grid.copies(), refinement)


def _polynomials(patches: PatchTable, grid: AdaptiveGrid) -> tuple[VertexPolynomials, ...]:
    """The polynomials on which vertices lie. Vertices at equal parameters of patches of one class share a sample."""
    table, (tile, uv) = patches.evaluated, grid.parameters()
    patch_class, patch, _ = patches.evaluated_at(grid.tiles["corner"][tile])
    order = np.lexsort((*uv, patch_class))
    is_new = (np.diff(uv[:, order], prepend=-1) != 0).any(axis=0) | (np.diff(patch_class[order], prepend=-1) != 0)
    distinct = order[is_new]
    counts = np.bincount(patch_class[distinct], minlength=len(table.classes))
    uv_of_class = np.split(np.ascontiguousarray(uv[:, distinct].T), np.cumsum(counts)[:-1])
    # Runs of one vertex each.
    kind = np.cumsum(is_new) - 1
    samples, ones = ragged.index_in_row(counts), np.ones_like(distinct)
    runs = VertexRuns(patch_class[distinct], ones, samples, 0 * ones, kind, patch[order], order)
    return vertex_polynomials(table.scheme, table.classes, uv_of_class, runs)


def _chosen(
    patches: PatchTable,
    rates: TileRates,
    points: FloatArray,  # (n_v, 3) float64: at the vertices of the mesh
    cage_name: str,
) -> Tiles:
    """Divide the patches of a cage into tiles, in the order of the elements, and choose their rates."""
    none = np.empty(0, dtype=tile_type(patches.scheme.domain.corner_count))
    needed = np.concatenate([none, *_divided(rates, _whole_patches(patches, rates, points))])
    u, v = needed["origin"].T
    needed = needed[np.lexsort((needed["is_flipped"], u, v, needed["depth"], needed["corner"]))]
    tiles, most = needed.copy(), rates.most(needed)[:, None]
    tiles["rates"], tiles["sides"] = np.minimum(needed["rates"], most), np.minimum(needed["sides"], most)
    if rates.criterion.outline is None:
        _warn_of_coarse(patches, needed, tiles, rates.max_rate, cage_name)
    return tiles


def _warn_of_coarse(patches: PatchTable, needed: Tiles, tiles: Tiles, max_rate: int, cage_name: str) -> None:
    """Warn if the rates of tiles are lower than needed."""
    is_coarse = (needed["rates"] != tiles["rates"]).any(axis=1) | (needed["sides"] != tiles["sides"]).any(axis=1)
    if not is_coarse.any():
        return
    coarse, t = needed[is_coarse], patches.elements
    tile_rate = np.maximum(coarse["rates"].max(axis=1), coarse["sides"].max(axis=1)).astype(np.int64)
    # Rates along an edge of the cage are powers of two, as tiles arise by halving.
    rate = 1 << int((tile_rate << coarse["halvings"]).max() - 1).bit_length()
    count, total = len(np.unique(t.face[coarse["corner"]])), int(np.count_nonzero(t.face_sizes))
    kind, larger = "faces" if patches.scheme.element == "face" else "vertices", "a larger error"
    warn(
        f"{cage_name}: with a max_rate of {max_rate}, the adaptive tessellation is coarser than asked for at "
        f"{count} of {total} {kind}, which need up to about {rate} segments along an edge; expected "
        + (f"a max_rate of {rate}, or {larger}" if rate <= HIGHEST_RATE else larger)
    )


def _whole_patches(patches: PatchTable, rates: TileRates, points: FloatArray) -> Iterator[Part]:
    """Iterate over all patches, each as one tile."""
    table, features = patches.evaluated, feature_edges(patches, rates.frames, points, rates.criterion)
    coordinates = np.ascontiguousarray(patches.evaluated_points(points).T)
    pairs = list(zip(table.classes, table.trees, strict=True))
    tiles = whole_patches(np.concatenate(list(map(patches.places, table.classes))), rates.frames.domain.corner_count)
    half_edge = sides_of(tiles, rates.frames, 0).half_edge.reshape(tiles["sides"].shape)
    tiles["sides"] = (half_edge >= 0) & features[half_edge]
    for patch_class, element in counted(pairs, "Tiles of patch classes"):
        identity = np.eye(element.control_count)
        kind, rows = part_of_tile(element, identity)
        for begin in range(0, len(patch_class.controls), TILES_AT_ONCE):
            controls = patch_class.controls[begin : begin + TILES_AT_ONCE].T
            values = np.stack([axis.take(controls, mode="clip") for axis in coordinates], axis=1)
            block, tiles = tiles[: controls.shape[1]], tiles[controls.shape[1] :]
            yield Part(kind, block, values if rows is identity else times(rows, values))


def _divided(rates: TileRates, patches: Iterator[Part]) -> Iterator[Tiles]:
    """Iterate over the tiles of all patches, with their rates. Raises MemoryError if there are too many triangles."""
    # Tiles wait by kind, as one call bounds many tiles of a kind in little more time than one of them.
    waiting: dict[DividedTile, list[Part]] = {}
    triangle_count = 0

    def priority(kind: DividedTile) -> int:
        # Pieces, which are all of one kind, wait until there are enough of them. Larger tiles come before few pieces,
        # to detect too many triangles early.
        return 1 if not kind.is_piece else 2 * (sum(len(part.tiles) for part in waiting[kind]) > TILES_AT_ONCE)

    while parts := list(islice(patches, PARTS_AT_ONCE)):
        for part in parts:
            waiting.setdefault(part.kind, []).append(part)
        while waiting:
            kind = max(waiting, key=priority)
            taken = _taken(waiting[kind])
            if not waiting[kind]:
                del waiting[kind]
            done, undecided = rates.decided(taken)
            triangle_count += int(rates.triangle_counts(done).sum())
            if kind.is_piece:
                # The counts of undecided tiles are upper bounds, as division makes fewer triangles.
                require_memory_for_triangles(triangle_count + int(rates.triangle_counts(undecided.tiles).sum()))
            yield done
            for divided in rates.divided(undecided) if len(undecided.tiles) else ():
                waiting.setdefault(divided.kind, []).append(divided)


def _taken(parts: list[Part]) -> Part:
    """Remove about `TILES_AT_ONCE` tiles from the end of a list of parts of one kind, and return them."""
    taken, count = [], 0
    while parts and count < TILES_AT_ONCE:
        taken.append(parts.pop())
        count += len(taken[-1].tiles)
    if len(taken) == 1:
        return taken[0]
    kinds, tiles, values = zip(*taken, strict=True)
    return Part(kinds[0], np.concatenate(tiles), np.concatenate(values, axis=2))
