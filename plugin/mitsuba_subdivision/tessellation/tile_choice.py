"""Divides patches into tiles and chooses their rates for an error criterion."""

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

# Tiles of a kind that are looked at together, whose bounds stay in a core's cache; and tiles that wait until there are
# as many of their kind. They bound temporary memory; fewer would take more time.
TILES_AT_ONCE, MOST_WAITING = 1 << 10, 1 << 15
# Pieces of more triangles, or of more segments on a feature edge, are divided: their parts have tighter bounds. More so
# for outlines, which few of the parts may have.
MOST_TRIANGLES, MOST_TRIANGLES_AT_OUTLINE = 32, 18
# Cosine of the angle by which elements beside a fold differ in their normals, at most.
FOLD_COSINE = -0.1


class _Part(NamedTuple):
    """Tiles of one kind, which are divided alike."""

    kind: DividedTile
    tiles: Tiles
    values: FloatArray  # (K, 3, t) float64: control points


def choose_tiles(
    patches: PatchTable,
    frames: PatchFrames,  # Of these
    control_points: FloatArray,  # (n, 3) float64
    control_of_vertex: IntArray,  # (n_v,) int64: 0-based control point at each mesh vertex
    criterion: Criterion,
    # Most segments along an edge of the cage, rounded down to a power of two; around extraordinary points, along each
    # ring
    max_rate: int,
    cage_name: str,  # For a warning
) -> Tiles:
    """Divide the patches of a cage into tiles, in the order of the elements, and choose their rates.

    Raises MemoryError if their triangles would not fit into memory. Warns where ``max_rate`` does not let the criterion
    hold; not if it is for outlines.
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
    """Warn if tiles have less than the rates that they need."""
    is_coarse = (needed["rates"] != tiles["rates"]).any(axis=1) | (needed["sides"] != tiles["sides"]).any(axis=1)
    if not is_coarse.any():
        return
    coarse, t = needed[is_coarse], patches.elements
    of_sides = np.maximum(coarse["rates"].max(axis=1), coarse["sides"].max(axis=1)).astype(np.int64)
    most = (of_sides << coarse["halvings"]).max()
    # Tiles halve their patches.
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
    features: NDArray[np.bool_],  # (n_h,) bool: as `feature_edges`
) -> Iterator[_Part]:
    """All patches, each as one tile."""
    refined = patches.refined
    table, points = (patches, points) if refined is None else (refined.table, refined.matrix @ points)
    coordinates = np.ascontiguousarray(points.T)
    elements = patch_trees(table.scheme, [each.signature for each in table.classes])
    pairs = list(zip(table.classes, elements, strict=True))
    for patch_class, element in counted(pairs, "Tiles of patch classes"):
        every = np.eye(element.control_count)
        kind, rows = part_of_tile(element, every)
        of_class = patch_class.corners if refined is None else refined.corners(patch_class)
        tiles = whole_patches(of_class, sides_on(features, frames, of_class))
        for begin in range(0, len(of_class), TILES_AT_ONCE):
            block = slice(begin, begin + TILES_AT_ONCE)
            controls = patch_class.controls[block].T
            values = np.stack([axis.take(controls, mode="clip") for axis in coordinates], axis=1)
            values = values if rows is every else times(rows, values)
            yield _Part(kind, tiles[block], values)


def _chosen(rates: TileRates, patches: Iterable[_Part]) -> Iterator[Tiles]:
    """Tiles of all patches, with their rates. Raises MemoryError if there would be too many triangles."""
    # By kinds, as tiles of a kind are bounded together, and each call takes time.
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
            # Pieces wait until there are enough of them. The largest come first, which may be too many triangles.
            others = [kind for kind in waiting if not kind.is_piece]
            are_many = sum(len(own.tiles) for kind in waiting if kind.is_piece for own in waiting[kind]) > TILES_AT_ONCE
            for kind in list(waiting) if are_many or not others else others:
                taken = _taken(waiting[kind])
                if not waiting[kind]:
                    del waiting[kind]
                done, undecided = _decided(rates, taken)
                triangle_count += int(rates.triangle_counts(done).sum())
                if taken.kind.is_piece:
                    # Divided tiles have fewer triangles.
                    require_memory_for_triangles(triangle_count + int(rates.triangle_counts(undecided.tiles).sum()))
                yield done
                for divided in _divided(rates, undecided) if len(undecided.tiles) else ():
                    waiting.setdefault(divided.kind, []).append(divided)


def _taken(parts: list[_Part]) -> _Part:
    """The last tiles of a list, which are removed there: some `TILES_AT_ONCE`."""
    taken, count = [], 0
    while parts and count < TILES_AT_ONCE:
        taken.append(parts.pop())
        count += len(taken[-1].tiles)
    if len(taken) == 1:
        return taken[0]
    values = np.concatenate([part.values for part in taken], axis=2)
    return _Part(taken[0].kind, np.concatenate([part.tiles for part in taken]), values)


def _decided(rates: TileRates, part: _Part) -> tuple[Tiles, _Part]:
    """Tiles that are not to be divided, with their rates; and all others."""
    kind, tiles, values = part
    heights = rates.heights(tiles)
    # Single precision resolves nothing nearer to an extraordinary point. Elsewhere rates decrease.
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
        # More than one segment, and how many more is not known.
        done["rates"] *= 2
    return np.concatenate([flat, done]), _Part(kind, tiles[~is_done], values[..., ~is_done])


def _divided(rates: TileRates, part: _Part) -> Iterator[_Part]:
    """The four copies of tiles."""
    kind, tiles, values = part
    tiles["rates"], tiles["sides"] = 1, np.minimum(tiles["sides"], 1)
    for number, (own, rows) in enumerate(kind.children):
        copies = child(tiles, number, rates.domain)
        if own is kind and kind.is_self_similar:
            # Each ring around an extraordinary point may have as many segments as the one around it.
            copies["halvings"] = tiles["halvings"]
        yield _Part(own, copies, times(rows, values))


def _without_pairs(rates: TileRates, tiles: Tiles) -> Tiles:
    """The tiles, with triangles of two segments divided: their only inner lines join the middles of the sides."""
    is_pair = (np.minimum(tiles["rates"][:, 0], rates.most(tiles)) == 2) & (rates.domain.corner_count == 3)
    found = [tiles[~is_pair], *(child(tiles[is_pair], number, rates.domain) for number in range(4))]
    for copies in found[1:]:
        copies["rates"] = -(-copies["rates"] // 2)
    return np.concatenate(found)


def feature_edges(
    patches: PatchTable,
    frames: PatchFrames,
    points: FloatArray,  # (n_v, 3) float64: at the vertices of the mesh
    criterion: Criterion,
) -> NDArray[np.bool_]:
    """``(n_h,)`` the half-edges along which curves hold to the limit by themselves.

    On open borders and folds, surfaces may be flat and end along curves all the same. Elsewhere the surface on one side
    of an edge holds the other, unless it may be coarse there.
    """
    t, names = frames.topology, frames.edge
    if criterion.measure is Measure.EDGE:
        return np.zeros(t.half_edge_count, dtype=bool)
    # Of the elements beside each edge.
    squares = sum(np.square(np.bincount(names, x.take(t.face))) for x in _normals(patches, points))
    is_fold = (np.bincount(names) != 2) | (squares < 2 + 2 * FOLD_COSINE)
    return is_fold[names] | ((t.twin < 0) & (criterion.outline is not None))


def _normals(patches: PatchTable, points: FloatArray) -> FloatArray:
    """``(3, n_e)`` about which way elements face: unit vectors, or zero."""
    t = patches.topology
    found: FloatArray = np.empty((3, t.face_count))
    for axis in range(3):
        # Of each half-edge's ends, along the two other axes.
        y, z = (points[:, (axis + step) % 3].take(t.face_vertices) for step in (1, 2))
        found[axis] = np.bincount(t.face, y * z.take(t.next) - z * y.take(t.next), t.face_count)
    if patches.scheme.element == "vertex":
        of_corner, t = found[:, t.face[patches.half_edge_of_corner]], patches.elements
        found = np.stack([np.bincount(t.face, x, t.face_count) for x in of_corner])
    length: FloatArray = np.sqrt(dot(found, found))
    return found / np.where(length > 0, length, 1)


def sides_on(edges: NDArray[np.bool_], frames: PatchFrames, corners: IntArray) -> NDArray[np.bool_]:
    """``(p, m)`` which sides of the patches that begin at these corners lie on some edges, ``(n_h,)``."""
    t, m = frames.topology, frames.domain.corner_count
    is_whole = frames.is_whole[t.face[corners]]
    found = np.zeros((len(corners), m), dtype=bool)
    half_edge = corners
    for side in range(m):
        found[:, side] = is_whole & edges[half_edge]
        half_edge = t.next[half_edge]
    # Patches at corners have half an edge on their first and their last side.
    found[:, 0] |= edges[corners]
    found[:, -1] |= ~is_whole & edges[t.prev[corners]]
    return found
