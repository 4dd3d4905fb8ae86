"""Division of patches into tiles, and choice of their rates, for an error criterion."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from itertools import chain
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..cage.errors import warn
from ..evaluation.divided_tile import DividedTile, part_of_tile
from ..evaluation.patch_tree import patch_trees
from ..evaluation.polynomials import times
from ..mesh.connectivity import IntArray
from ..patches import PatchTable
from ..progress import counted
from ..schemes.domain import FloatArray
from . import HIGHEST_RATE
from .criterion import Criterion, Measure, dot
from .memory import require_memory_for_triangles
from .tile_rates import TileRates
from .tiles import DEEPEST, PatchFrames, Tiles, child, tile_type, whole_patches

# Tiles of a kind that are processed together, whose bounds stay in a core's cache; and most tiles that wait for more of
# their kind. Both bound temporary memory; smaller numbers would take more time.
TILES_AT_ONCE, MOST_WAITING = 1 << 10, 1 << 15
# Most triangles of a piece, or segments on a feature edge, above which the piece is divided, because its parts have
# tighter bounds. The limit is lower for outlines, as few of the parts may be at one.
MOST_TRIANGLES, MOST_TRIANGLES_AT_OUTLINE = 32, 18
# Largest cosine of the angle between the normals of the elements beside a fold.
FOLD_COSINE = -0.1


class _Part(NamedTuple):
    """Tiles of one kind, whose children have the same matrices."""

    kind: DividedTile
    tiles: Tiles
    values: FloatArray  # (K, 3, t) float64: control points


def choose_tiles(
    patches: PatchTable,
    frames: PatchFrames,  # Of ``patches``
    control_points: FloatArray,  # (n, 3) float64
    control_of_vertex: IntArray,  # (n_v,) int64: 0-based control point at each mesh vertex
    criterion: Criterion,
    # Most segments along an edge of the cage, and along each ring around an extraordinary point; rounded down to a
    # power of two
    max_rate: int,
    cage_name: str,  # For warnings
) -> Tiles:
    """Divide the patches of a cage into tiles, in the order of the elements, and choose their rates.

    Raises MemoryError if the triangles would not fit into memory. Warns if ``max_rate`` is too low for the criterion,
    unless that is for outlines.
    """
    points = control_points[control_of_vertex]
    rates = TileRates(patches.scheme, frames, criterion, max_rate)
    features = feature_edges(patches, frames, points, criterion)
    none = np.empty(0, dtype=tile_type(patches.scheme.domain.corner_count))
    needed = np.concatenate([none, *_chosen(rates, _whole_patches(patches, frames, points, features))])
    u, v = needed["origin"].T
    needed = needed[np.lexsort((needed["is_flipped"], u, v, needed["depth"], needed["corner"]))]
    tiles = rates.clipped(needed)
    if criterion.outline is None:
        _warn_of_coarse(patches, needed, tiles, max_rate, cage_name)
    return tiles


def _warn_of_coarse(patches: PatchTable, needed: Tiles, tiles: Tiles, max_rate: int, cage_name: str) -> None:
    """Warn if the rates of tiles are lower than needed."""
    is_coarse = (needed["rates"] != tiles["rates"]).any(axis=1) | (needed["sides"] != tiles["sides"]).any(axis=1)
    if not is_coarse.any():
        return
    coarse, t = needed[is_coarse], patches.elements
    tile_rate = np.maximum(coarse["rates"].max(axis=1), coarse["sides"].max(axis=1)).astype(np.int64)
    most = (tile_rate << coarse["halvings"]).max()
    # Rates along an edge of the cage are powers of two, as tiles arise by halving.
    rate = 1 << int(most - 1).bit_length()
    count, total = len(np.unique(t.face[coarse["corner"]])), int(np.count_nonzero(t.face_sizes))
    kind, larger = "faces" if patches.scheme.element == "face" else "vertices", "a larger error"
    warn(
        f"{cage_name}: with a max_rate of {max_rate}, the adaptive tessellation is coarser than asked for at "
        f"{count} of {total} {kind}, which need up to about {rate} segments along an edge; expected "
        + (f"a max_rate of {rate}, or {larger}" if rate <= HIGHEST_RATE else larger)
    )


def _whole_patches(
    patches: PatchTable,
    frames: PatchFrames,
    points: FloatArray,  # (n_v, 3) float64: at the vertices of the mesh
    features: NDArray[np.bool_],  # (n_h,) bool: `feature_edges`
) -> Iterator[_Part]:
    """Iterate over all patches, each as one tile."""
    refined = patches.refined
    table, points = (patches, points) if refined is None else (refined.table, refined.matrix @ points)
    coordinates = np.ascontiguousarray(points.T)
    elements = patch_trees(table.scheme, [patch_class.signature for patch_class in table.classes])
    pairs = list(zip(table.classes, elements, strict=True))
    for patch_class, element in counted(pairs, "Tiles of patch classes"):
        identity = np.eye(element.control_count)
        kind, rows = part_of_tile(element, identity)
        corners = patch_class.corners if refined is None else refined.corners(patch_class)
        tiles = whole_patches(corners, sides_on(features, frames, corners))
        for begin in range(0, len(corners), TILES_AT_ONCE):
            block = slice(begin, begin + TILES_AT_ONCE)
            controls = patch_class.controls[block].T
            values = np.stack([axis.take(controls, mode="clip") for axis in coordinates], axis=1)
            values = values if rows is identity else times(rows, values)
            yield _Part(kind, tiles[block], values)


def _chosen(rates: TileRates, patches: Iterable[_Part]) -> Iterator[Tiles]:
    """Iterate over the tiles of all patches, with their rates. Raises MemoryError if there are too many triangles."""
    # Tiles wait by kind, as one call bounds many tiles of a kind in little more time than one of them.
    waiting: dict[DividedTile, list[_Part]] = {}
    triangle_count = waiting_count = 0
    for part in chain(patches, [None]):
        if part is not None:
            waiting.setdefault(part.kind, []).append(part)
            waiting_count += len(part.tiles)
            if waiting_count < MOST_WAITING:
                continue
        waiting_count = 0
        while waiting:
            # Pieces wait until there are enough of them. Larger tiles come first, to detect too many triangles early.
            not_pieces = [kind for kind in waiting if not kind.is_piece]
            piece_count = sum(len(part.tiles) for kind in waiting if kind.is_piece for part in waiting[kind])
            for kind in list(waiting) if piece_count > TILES_AT_ONCE or not not_pieces else not_pieces:
                taken = _taken(waiting[kind])
                if not waiting[kind]:
                    del waiting[kind]
                done, undecided = _decided(rates, taken)
                triangle_count += int(rates.triangle_counts(done).sum())
                if taken.kind.is_piece:
                    # The counts of undecided tiles are upper bounds, as division makes fewer triangles.
                    require_memory_for_triangles(triangle_count + int(rates.triangle_counts(undecided.tiles).sum()))
                yield done
                for divided in _divided(rates, undecided) if len(undecided.tiles) else ():
                    waiting.setdefault(divided.kind, []).append(divided)


def _taken(parts: list[_Part]) -> _Part:
    """Remove about `TILES_AT_ONCE` tiles from the end of a list, and return them."""
    taken, count = [], 0
    while parts and count < TILES_AT_ONCE:
        taken.append(parts.pop())
        count += len(taken[-1].tiles)
    if len(taken) == 1:
        return taken[0]
    values = np.concatenate([part.values for part in taken], axis=2)
    return _Part(taken[0].kind, np.concatenate([part.tiles for part in taken]), values)


def _decided(rates: TileRates, part: _Part) -> tuple[Tiles, _Part]:
    """Separate the tiles that need no division, with their rates, from all others."""
    kind, tiles, values = part
    heights = rates.heights(tiles)
    # The depth ends division around extraordinary points. Elsewhere, rates decrease with every division.
    is_flat = rates.are_flat(kind, tiles, values, heights) | (tiles["depth"] >= DEEPEST - 1)
    flat, tiles, values = tiles[is_flat], tiles[~is_flat], values[..., ~is_flat]
    if not len(tiles):
        return flat, _Part(kind, tiles, values)
    if kind.is_piece:
        tiles = rates.rated(tiles, values, None if heights is None else heights[..., ~is_flat])
        along_sides = np.minimum(tiles["sides"].max(axis=1), rates.most(tiles))
        most = MOST_TRIANGLES if rates.criterion.outline is None else MOST_TRIANGLES_AT_OUTLINE
        is_done = np.maximum(rates.triangle_counts(tiles), along_sides) <= most
        done = _without_pairs(rates, tiles[is_done])
    else:
        is_done = (rates.most(tiles) == 1) & (not kind.is_self_similar)
        done = tiles[is_done]
        # The tile needs more than one segment, but the number is unknown.
        done["rates"] *= 2
    return np.concatenate([flat, done]), _Part(kind, tiles[~is_done], values[..., ~is_done])


def _divided(rates: TileRates, part: _Part) -> Iterator[_Part]:
    """Divide tiles. Iterates over their first children, their second children, and so on."""
    kind, tiles, values = part
    tiles["rates"], tiles["sides"] = 1, np.minimum(tiles["sides"], 1)
    for number, (child_kind, rows) in enumerate(kind.children):
        children = child(tiles, number, rates.domain)
        if child_kind is kind and kind.is_self_similar:
            # Each ring around an extraordinary point may have as many segments as the next larger one.
            children["halvings"] = tiles["halvings"]
        yield _Part(child_kind, children, times(rows, values))


def _without_pairs(rates: TileRates, tiles: Tiles) -> Tiles:
    """Divide triangular tiles of two segments, whose only inner edges join the midpoints of the sides."""
    is_pair = (np.minimum(tiles["rates"][:, 0], rates.most(tiles)) == 2) & (rates.domain.corner_count == 3)
    parts = [tiles[~is_pair], *(child(tiles[is_pair], number, rates.domain) for number in range(4))]
    for children in parts[1:]:
        children["rates"] = -(-children["rates"] // 2)
    return np.concatenate(parts)


def feature_edges(
    patches: PatchTable,
    frames: PatchFrames,
    points: FloatArray,  # (n_v, 3) float64: control points at the vertices of the mesh
    criterion: Criterion,
) -> NDArray[np.bool_]:
    """``(n_h,)`` whether the curve along each half-edge must itself hold to the limit.

    These are folds and, for outlines, open borders: a flat surface may end there along a curve. Along other edges, the
    adjacent surfaces keep the curve within the limit, unless they may be coarse.
    """
    t, names = frames.topology, frames.edge
    if criterion.measure is Measure.EDGE:
        return np.zeros(t.half_edge_count, dtype=bool)
    # Squared length of the sum of the normals of the elements beside each edge.
    squares = sum(np.square(np.bincount(names, x.take(t.face))) for x in _normals(patches, points))
    is_fold = (np.bincount(names) != 2) | (squares < 2 + 2 * FOLD_COSINE)
    return is_fold[names] | ((t.twin < 0) & (criterion.outline is not None))


def _normals(patches: PatchTable, points: FloatArray) -> FloatArray:
    """``(3, n_e)`` approximate unit normals of elements, or zero."""
    t = patches.topology
    normals: FloatArray = np.empty((3, t.face_count))
    for axis in range(3):
        # Coordinates of the half-edges' vertices along the two other axes.
        y, z = (points[:, (axis + step) % 3].take(t.face_vertices) for step in (1, 2))
        normals[axis] = np.bincount(t.face, y * z.take(t.next) - z * y.take(t.next), t.face_count)
    if patches.scheme.element == "vertex":
        corner_normals, t = normals[:, t.face[patches.half_edge_of_corner]], patches.elements
        normals = np.stack([np.bincount(t.face, x, t.face_count) for x in corner_normals])
    length: FloatArray = np.sqrt(dot(normals, normals))
    return normals / np.where(length > 0, length, 1)


def sides_on(edges: NDArray[np.bool_], frames: PatchFrames, corners: IntArray) -> NDArray[np.bool_]:
    """``(p, m)`` whether the sides of the patches that begin at ``corners`` lie on the marked ``edges``, ``(n_h,)``."""
    t, m = frames.topology, frames.domain.corner_count
    is_whole = frames.is_whole[t.face[corners]]
    is_on = np.zeros((len(corners), m), dtype=bool)
    half_edge = corners
    for side in range(m):
        is_on[:, side] = is_whole & edges[half_edge]
        half_edge = t.next[half_edge]
    # The first and the last side of a patch at a corner of a polygon are halves of edges.
    is_on[:, 0] |= edges[corners]
    is_on[:, -1] |= ~is_whole & edges[t.prev[corners]]
    return is_on
