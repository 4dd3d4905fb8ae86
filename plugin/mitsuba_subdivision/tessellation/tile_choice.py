"""Divides patches into tiles and chooses their rates for an error criterion."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from ..cage.errors import warn
from ..evaluation.bernstein import times
from ..evaluation.divided_element import divided_elements
from ..evaluation.divided_tile import DividedTile, part_of_tile
from ..mesh import ragged
from ..mesh.connectivity import IntArray
from ..patches import PatchTable
from ..progress import counted
from ..schemes.domain import FloatArray
from . import HIGHEST_RATE
from .cones import dot
from .criterion import Criterion, Measure
from .flat_tiles import TileParts, are_flat
from .patch_frames import PatchFrames
from .spans import joined
from .tile_rates import TileRates
from .tiles import DEEPEST, Tiles

# Number of patches that are divided together, and of tiles in pieces whose rates are chosen together. They bound
# temporary memory; fewer would take more time.
PATCHES_AT_ONCE, TILES_AT_ONCE = 1 << 12, 1 << 13

# Tiles that lie in pieces, with Bernstein coefficients ``(b, 3, t)`` over them; and others, with their control points.
_Pieces = tuple[Tiles, FloatArray]
_Undecided = tuple[Tiles, list[TileParts]]

# By so many bits the upper half of each group of bits moves, and which bits there are then.
_SPREADING = (
    (16, 0x0000FFFF0000FFFF),
    (8, 0x00FF00FF00FF00FF),
    (4, 0x0F0F0F0F0F0F0F0F),
    (2, 0x3333333333333333),
    (1, 0x5555555555555555),
)
# Cosine of the angle by which elements beside a fold differ in their normals, at most.
FOLDED = -0.1


def choose_tiles(
    patches: PatchTable,
    frames: PatchFrames,
    control_points: FloatArray,
    control_of_vertex: IntArray,
    criterion: Criterion,
    max_rate: int,
    cage_name: str,
) -> Tiles:
    """Divide the patches of a cage into tiles, and choose their rates.

    Returns Tiles: in the order of the elements, and in each along a curve of Morton's. Raises MemoryError if their
    triangles would not fit into memory.

    Parameters
    ----------
    frames : PatchFrames
        Of these.
    control_points : (n, 3) float64
    control_of_vertex : (n_v,) int64
        0-based control point at each mesh vertex.
    max_rate : int
        Most segments along an edge of the cage; around extraordinary points, along each ring.
    cage_name : str
        For a warning.

    Warns
    -----
    CageWarning
        Where ``max_rate`` does not let the criterion hold; not if it is for outlines.
    """
    points = control_points[control_of_vertex]
    rates = TileRates(patches.scheme, frames, criterion, max_rate)
    features = feature_edges(patches, frames, points, criterion)
    needed = Tiles.joined(list(_chosen(rates, _whole_patches(patches, frames, points, features))))
    tiles = rates.clipped(needed)
    if criterion.outline is None:
        _warn_of_coarse(patches, needed, tiles, max_rate, cage_name)
    return tiles[_order(tiles)]


def _warn_of_coarse(patches: PatchTable, needed: Tiles, tiles: Tiles, max_rate: int, cage_name: str) -> None:
    """Warn if tiles have less than the rates that they need."""
    is_coarse = (needed.rates != tiles.rates).any(axis=1) | (needed.sides != tiles.sides).any(axis=1)
    if not is_coarse.any():
        return
    coarse, t = needed[is_coarse], patches.elements
    of_edges = np.maximum(coarse.rates.max(axis=1), coarse.sides.max(axis=1)).astype(np.int64) << coarse.halvings
    most = of_edges.max()
    # Tiles halve their patches.
    rate = 1 << int(most - 1).bit_length()
    count, total = len(np.unique(t.face[coarse.corner])), int(np.count_nonzero(t.face_sizes))
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
) -> Iterator[tuple[Tiles, DividedTile | None, FloatArray]]:
    """All patches, each as one tile, in blocks of one class that bound temporary memory.

    Yields the tiles; how they are divided, or None for pieces; and their control points, or Bernstein coefficients.
    """
    refined = patches.refined
    table, points = (patches, points) if refined is None else (refined.table, refined.matrix @ points)
    coordinates = np.ascontiguousarray(points.T)
    elements = divided_elements(table.scheme, [each.signature for each in table.classes])
    pairs = list(zip(table.classes, elements, strict=True))
    for patch_class, element in counted(pairs, "Tiles of patch classes"):
        every = np.eye(element.control_count)
        tile, rows = part_of_tile(element, every)
        of_class = patch_class.corners if refined is None else refined.corners(patch_class)
        for begin in range(0, len(of_class), PATCHES_AT_ONCE):
            block = slice(begin, begin + PATCHES_AT_ONCE)
            controls = patch_class.controls[block].T
            values = np.stack([axis.take(controls, mode="clip") for axis in coordinates], axis=1)
            values = values if rows is every else times(rows, values)
            yield Tiles.whole(of_class[block], sides_on(features, frames, of_class[block])), tile, values


def _chosen(rates: TileRates, patches: Iterable[tuple[Tiles, DividedTile | None, FloatArray]]) -> Iterator[Tiles]:
    """Tiles of all patches, with their rates. Raises MemoryError if there would be too many triangles."""
    triangle_count = 0
    for tiles, coefficients in _in_runs(_cut(rates, patches)):
        chosen = [tiles] if coefficients is None else rates.rated(tiles, coefficients, triangle_count)
        triangle_count += sum(map(rates.cost, chosen))
        yield from chosen


def _cut(
    rates: TileRates, patches: Iterable[tuple[Tiles, DividedTile | None, FloatArray]]
) -> Iterator[tuple[Tiles, FloatArray | None]]:
    """Tiles of all patches: those with rates; and those that lie in pieces, with Bernstein coefficients over them."""
    # Few tiles of each block are divided again: those of many blocks together.
    waiting: list[_Undecided] = []
    for tiles, tile, values in patches:
        if tile is None:
            yield tiles, values
            continue
        waiting.append((tiles, [TileParts(tile, values, np.arange(len(tiles)))]))
        yield from _divided_until_fewer(PATCHES_AT_ONCE, rates, waiting)
    yield from _divided_until_fewer(1, rates, waiting)


def _divided_until_fewer(
    count: int, rates: TileRates, waiting: list[_Undecided]
) -> Iterator[tuple[Tiles, FloatArray | None]]:
    """Divide the tiles of a list until fewer than so many are left there; decided ones as `_cut`."""
    while sum(len(tiles) for tiles, _ in waiting) >= count:
        *found, undecided = _divided(rates, *_taken(waiting))
        waiting.append(undecided)
        yield from found


def _in_runs(cut: Iterable[tuple[Tiles, FloatArray | None]]) -> Iterator[tuple[Tiles, FloatArray | None]]:
    """The same tiles, those in pieces in runs of `TILES_AT_ONCE`: most blocks have few, and each run takes time."""
    waiting: list[_Pieces] = []
    for tiles, coefficients in cut:
        if coefficients is None:
            yield tiles, None
            continue
        waiting.append((tiles, coefficients))
        if sum(len(each) for each, _ in waiting) >= TILES_AT_ONCE:
            yield from _runs(waiting)
    yield from _runs(waiting)


def _runs(waiting: list[_Pieces]) -> Iterator[_Pieces]:
    """All tiles of a list, which is left empty."""
    if waiting:
        tiles = Tiles.joined([each for each, _ in waiting])
        coefficients = np.concatenate([each for _, each in waiting], axis=2)
        waiting.clear()
        for begin in range(0, len(tiles), TILES_AT_ONCE):
            run = slice(begin, begin + TILES_AT_ONCE)
            yield tiles[run], coefficients[..., run]


def _divided(
    rates: TileRates, tiles: Tiles, parts: list[TileParts]
) -> tuple[tuple[Tiles, None], tuple[Tiles, None], _Pieces, _Undecided]:
    """Divide tiles once, but for those so flat that one pair of triangles suffices.

    Returns
    -------
    flat, coarse : Tiles
        Tiles that are flat, and those that may not be divided.
    pieces : tuple of Tiles and (b, 3, t) float64
        Tiles that lie in a piece, and Bernstein coefficients over these.
    undecided : tuple of Tiles and list of TileParts
        All others.
    """
    # Single precision resolves nothing nearer to an extraordinary point. Elsewhere rates decrease.
    is_done = are_flat(rates, tiles, parts) | (tiles.depth >= DEEPEST - 1)
    flat = tiles[is_done]
    is_last = rates.most(tiles) == 1
    for group in parts:
        if group.tile.is_self_similar:
            is_last[group.owner] = False
    coarse = tiles[is_last & ~is_done]
    is_done |= is_last
    index, tiles = np.cumsum(~is_done) - 1, tiles[~is_done]
    children = [tiles.child(number, rates.domain) for number in range(4)]
    halvings = np.concatenate([each.halvings for each in children])
    pieces: list[tuple[IntArray, FloatArray]] = []
    undecided = []
    for group in parts:
        if is_done[group.owner].all():
            continue
        rest = group.chosen(~is_done[group.owner])
        parents = index[rest.owner]
        for number, (tile, rows) in enumerate(group.tile.children):
            at, points = number * len(tiles) + parents, times(rows, rest.values)
            if tile is None:
                pieces.append((at, points))
                continue
            if tile is group.tile:
                # Each ring around an extraordinary point may have as many segments as the one around it.
                halvings[at] = tiles.halvings[parents]
            undecided.append(TileParts(tile, points, at))
    tiles = replace(Tiles.joined(children), halvings=halvings)
    # More than one segment, and how many more is not known.
    coarse = replace(coarse, rates=2 * coarse.rates)
    return (flat, None), (coarse, None), _in_pieces(rates, tiles, pieces), _numbered(tiles, undecided)


def _in_pieces(rates: TileRates, tiles: Tiles, pieces: list[tuple[IntArray, FloatArray]]) -> _Pieces:
    """Some of the tiles, with their coefficients."""
    at = np.concatenate([np.empty(0, dtype=np.int64), *(own for own, _ in pieces)])
    none = np.empty((len(rates.basis.indices), 3, 0))
    return tiles[at], np.concatenate([none, *(coefficients for _, coefficients in pieces)], axis=2)


def _taken(waiting: list[_Undecided]) -> _Undecided:
    """All tiles of a list together, which is left empty."""
    first = ragged.starts(np.array([len(tiles) for tiles, _ in waiting]))
    alike: dict[DividedTile, list[TileParts]] = {}
    for begin, (_, own) in zip(first.tolist(), waiting, strict=True):
        for part in own:
            alike.setdefault(part.tile, []).append(part._replace(owner=begin + part.owner))
    tiles = Tiles.joined([own for own, _ in waiting])
    waiting.clear()
    values, owners = ([np.concatenate([part[i] for part in own], axis=-1) for own in alike.values()] for i in (1, 2))
    return _numbered(tiles, list(map(TileParts, alike, values, owners)))


def _numbered(tiles: Tiles, groups: list[TileParts]) -> tuple[Tiles, list[TileParts]]:
    """The tiles of some groups only, one group after the other."""
    ends = np.cumsum([len(group.owner) for group in groups]).tolist()
    chosen = tiles[np.concatenate([np.empty(0, dtype=np.int64), *(group.owner for group in groups)])]
    return chosen, [
        group._replace(owner=np.arange(end - len(group.owner), end)) for group, end in zip(groups, ends, strict=True)
    ]


def _order(tiles: Tiles) -> IntArray:
    """Tiles in the order of their patches' corners, and so of the elements, along a curve of Morton's."""
    depth = int(tiles.depth.max(initial=0))
    u, v = (_interleaved(axis.astype(np.int64) << (depth - tiles.depth)) for axis in tiles.origin.T)
    return np.argsort(joined(tiles.corner, (u | v << 1) << 1 | tiles.is_flipped, 2 * depth + 1), kind="stable")


def _interleaved(values: IntArray) -> IntArray:
    """Integers of up to 26 bits with a zero after each bit."""
    found = values.astype(np.uint64)
    for shift, mask in _SPREADING:
        found = (found | (found << np.uint64(shift))) & np.uint64(mask)
    return found.astype(np.int64)


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
    is_fold = (np.bincount(names) != 2) | (squares < 2 + 2 * FOLDED)
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
