"""Triangles of tiles: a regular grid inside each, and strips that join it to the samples on the tile's sides.

Samples lie along the sides of a tile, counter-clockwise from its first corner. Where it has at least two segments in
each direction (over triangles, three), its inner samples are a grid, and a strip of triangles lies between each side
and the grid's first row. In a tile without inner samples one strip joins a side to all others.

In a strip between two rows of samples there is a triangle for each segment of either row. Their order is that of the
middles of these segments, so that no triangle is longer than the longer segment. All are counter-clockwise in
parameters, and none is flat: they do not fold.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from ..mesh import ragged
from ..mesh.connectivity import IndexArray, IntArray
from ..schemes.domain import FloatArray

# Tolerance when comparing parameters.
PARAMETER_ROUNDING = 1e-9


@dataclass(frozen=True, eq=False)
class SideSamples:
    """Samples along the sides of tiles."""

    # (m t + 1,) int32: the first sample of each side of each tile; the last one of a side is the first one of the
    # next
    side_start: IntArray
    along: FloatArray  # (n,) float64: position of each sample along its side, in [0, 1)
    corner_count: int

    @cached_property
    def counts(self) -> IntArray:
        """``(t, m)`` segments on each side."""
        return np.diff(self.side_start).reshape(-1, self.corner_count)

    def start(self) -> IntArray:
        """``(t,)`` first sample of each tile."""
        return self.side_start[: -1 : self.corner_count]

    @cached_property
    def middles(self) -> FloatArray:
        """``(n,)`` middle of the segment that begins at each sample, along its side."""
        following = np.append(self.along[1:], 0)
        following[self.side_start[1:] - 1] = 1
        return (self.along + following) / 2


def has_inner(rates: IntArray, corner_count: int) -> NDArray[np.bool_]:
    """``(t,)`` whether tiles of ``(t, 2)`` rates have inner samples."""
    return np.minimum(*rates.T) >= (3 if corner_count == 3 else 2)


def inner_counts(rates: IntArray, corner_count: int) -> IntArray:
    """``(t,)`` number of inner samples."""
    n_u, n_v = rates.T
    counts = (n_u - 1) * (n_u - 2) // 2 if corner_count == 3 else (n_u - 1) * (n_v - 1)
    return np.where(has_inner(rates, corner_count), counts, 0)


def inner_steps(rates: IntArray, corner_count: int) -> IntArray:
    """``(n, 2)`` steps along u and v of the inner samples of all tiles, row by row, u fastest."""
    counts = inner_counts(rates, corner_count)
    at = ragged.index_in_row(counts)
    if corner_count == 4:
        width = np.repeat(rates[:, 0] - 1, counts)
        v, u = np.divmod(at, width)
        return np.stack([u + 1, v + 1], axis=1)
    # Rows have n - 2 samples, n - 3, and so on.
    width = np.repeat(rates[:, 0] - 2, counts)
    v = np.floor((2 * width + 1 - np.sqrt((2 * width + 1) ** 2 - 8 * at)) / 2).astype(np.int64)
    return np.stack([at - (v * width - v * (v - 1) // 2) + 1, v + 1], axis=1)


def stitched(
    rates: IntArray,  # (t, 2) int64
    sides: SideSamples,
    # (t, m) bool: corners that no triangle cuts off, of tiles with inner samples
    keeps_corner: NDArray[np.bool_] | None = None,
) -> IndexArray:
    """Join the samples of tiles by triangles.

    Returns (n, 3) int32: tile by tile, the samples of each triangle: those along the sides of all tiles are numbered
    first, then those inside.
    """
    is_inner = has_inner(rates, sides.corner_count)
    is_plain = np.diff(sides.side_start[:: sides.corner_count]) == sides.corner_count
    first_inner = len(sides.along) + ragged.starts(inner_counts(rates, sides.corner_count))
    plain, inner, others = map(np.flatnonzero, (is_plain, is_inner, ~is_inner & ~is_plain))
    found = _plain(sides, plain)
    if len(inner):
        found += _strips(rates, sides, inner, first_inner, keeps_corner)
        found += _inner(rates, inner, first_inner, sides.corner_count)
    if len(others):
        found += _strips_across(rates, sides, others)
    triangles, tile = (np.concatenate(each, dtype=np.int32) for each in zip(*found, strict=True))
    return triangles.take(np.argsort(tile, kind="stable"), axis=0)


def _plain(sides: SideSamples, tiles: IntArray) -> list[tuple[IntArray, IntArray]]:
    """Triangles of tiles whose only samples are their corners."""
    corners = [[0, 1, 2]] if sides.corner_count == 3 else [[0, 1, 3], [1, 2, 3]]
    return [(sides.start()[tiles, None] + np.array(own, dtype=np.int32), tiles) for own in corners]


def _inner_sample(rates: IntArray, first: IntArray, u: IntArray, v: IntArray, corner_count: int) -> IntArray:
    """Inner samples after steps along u and v."""
    if corner_count == 4:
        return first + (v - 1) * (rates[:, 0] - 1) + u - 1
    return first + (v - 1) * (rates[:, 0] - 2) - (v - 1) * (v - 2) // 2 + u - 1


def _strips(
    rates: IntArray, sides: SideSamples, tiles: IntArray, first_inner: IntArray, keeps_corner: NDArray[np.bool_] | None
) -> list[tuple[IntArray, IntArray]]:
    """Triangles between the sides of tiles and the first row of their inner samples."""
    m, found = sides.corner_count, []
    counts, middles = sides.counts, sides.middles
    # That of each segment of a side, by its first sample.
    outer_triangles = np.empty((len(sides.along), 3), dtype=np.int64)
    for corner in range(m):
        own, first = rates[tiles], first_inner[tiles]
        n = own[:, corner % 2] if m == 4 else own[:, 0]
        # Samples 1 to `most` of the inner row; sample k lies at (k + shift) / n along the side.
        most, shift = (n - 1, 0) if m == 4 else (n - 2, 0.5)
        start, count = sides.side_start[m * tiles + corner], counts[tiles, corner]

        def row(
            which: IntArray, k: IntArray, corner: int = corner, own: IntArray = own, first: IntArray = first
        ) -> IntArray:
            n_u, n_v = own[which].T
            if m == 4:
                u, v = ((k, 1 + 0 * k), (n_u - 1, k), (n_u - k, n_v - 1), (1 + 0 * k, n_v - k))[corner]
            else:
                u, v = ((k, 1 + 0 * k), (n_u - 1 - k, k), (1 + 0 * k, n_u - 1 - k))[corner]
            return _inner_sample(own[which], first[which], u, v, m)

        # Each segment of the side has the inner sample as its tip that follows the inner segments before its middle.
        which, outer = np.repeat(np.arange(len(tiles)), count), ragged.ranges(start, count)
        before = np.ceil(middles[outer] * n[which] - shift - 0.5).astype(np.int64)
        tip = np.clip(before, 1, most[which])
        outer_triangles[outer] = np.stack([outer, _after(sides, outer, tiles[which]), row(which, tip)], axis=1)
        # Each inner segment that sample of the side which follows the side's segments before it.
        width = int(most.max(initial=0)) + 2
        keys = which * width + tip
        inner_which, k = np.repeat(np.arange(len(tiles)), most - 1), ragged.index_in_row(most - 1) + 1
        passed = np.searchsorted(keys, inner_which * width + k, side="right") - ragged.starts(count)[inner_which]
        outer = start[inner_which] + passed
        outer = np.where(passed == count[inner_which], _end(sides, tiles[inner_which], corner), outer)
        found.append((np.stack([outer, row(inner_which, k + 1), row(inner_which, k)], axis=1), tiles[inner_which]))
    if m == 3:
        for corner in range(m):
            cut = tiles if keeps_corner is None else tiles[~keeps_corner[tiles, corner]]
            _cut_corners(rates, sides, cut, corner, outer_triangles)
    lengths = counts[tiles].sum(axis=1)
    every = ragged.ranges(sides.start()[tiles], lengths)
    return [*found, (outer_triangles[every], np.repeat(tiles, lengths))]


def _cut_corners(rates: IntArray, sides: SideSamples, tiles: IntArray, corner: int, triangles: IntArray) -> None:
    """Let triangles at a corner of triangular tiles lie across it, up to the distance of the inner samples.

    From the corner to the first inner sample is further than any side of the lattice. So near the corner a strip joins
    the tile's two sides, and one triangle joins its end to the inner sample.

    Parameters
    ----------
    triangles : (n, 3) int64
        That of each segment, by its first sample; changed.
    """
    m, every = sides.corner_count, np.arange(len(tiles))
    here, before = m * tiles + corner, m * tiles + (corner - 1) % m
    begin, end = sides.side_start[here], sides.side_start[before + 1]
    inner, reach = triangles[begin, 2], 1 / rates[tiles, 0] + PARAMETER_ROUNDING
    keys = np.repeat(np.arange(len(sides.side_start) - 1), np.diff(sides.side_start)) + sides.along
    # So many segments of the side that begins here, and of the one that ends here.
    first = np.searchsorted(keys, here + reach, side="right") - begin - 1
    last = end - np.searchsorted(keys, before + 1 - reach)

    def on_first(which: IntArray, k: IntArray) -> IntArray:
        return begin[which] + k

    def on_last(which: IntArray, k: IntArray) -> IntArray:
        return np.where(k == 0, begin[which], end[which] - k)

    of_first, k = np.repeat(every, first - 1), ragged.index_in_row(first - 1) + 1
    of_last, j = np.repeat(every, last - 1), ragged.index_in_row(last - 1) + 1
    middles = sides.middles
    middle_first = 2 * of_first + middles[on_first(of_first, k)]
    middle_last = 2 * of_last + 1 - middles[on_last(of_last, j + 1)]
    passed = np.searchsorted(middle_last, middle_first) - ragged.starts(last - 1)[of_first]
    crossed = np.searchsorted(middle_first, middle_last, side="right") - ragged.starts(first - 1)[of_last]
    triangles[on_first(of_first, k), 2] = on_last(of_first, 1 + passed)
    triangles[on_last(of_last, j + 1), 2] = on_first(of_last, 1 + crossed)
    triangles[begin] = np.stack([begin, begin + 1, end - 1], axis=1)
    triangles[end - 1] = np.stack([on_first(every, first), inner, on_last(every, last)], axis=1)


def _after(sides: SideSamples, samples: IntArray, tiles: IntArray) -> IntArray:
    """The samples after some, around their tiles."""
    m = sides.corner_count
    following = samples + 1
    return np.where(following == sides.side_start[m * tiles + m], sides.side_start[m * tiles], following)


def _end(sides: SideSamples, tiles: IntArray, corner: int) -> IntArray:
    """The last sample of a side."""
    m = sides.corner_count
    return sides.side_start[m * tiles + (corner + 1) % m]


def _strips_across(rates: IntArray, sides: SideSamples, tiles: IntArray) -> list[tuple[IntArray, IntArray]]:
    """Triangles of tiles without inner samples: between one side, the base, and all others."""
    m = sides.corner_count
    counts, total = sides.counts[tiles], sides.counts[tiles].sum(axis=1)
    # A long side, along the direction in which the tile has more segments.
    may_be_base = np.full((len(tiles), m), True)
    if m == 4:
        u, v = rates[tiles].T
        may_be_base[:, 1::2] = (u <= v)[:, None] | (v > 1)[:, None]
        may_be_base[:, 0::2] = (v <= u)[:, None] | (u > 1)[:, None]
    base = np.argmax(np.where(may_be_base, counts, 0), axis=1)
    every = np.arange(len(tiles))
    length = counts[every, base]
    before, after = counts[every, (base - 1) % m], counts[every, (base + 1) % m]
    start, base_start = sides.start()[tiles], sides.side_start[m * tiles + base]

    def sample(which: IntArray, place: IntArray) -> IntArray:
        """The sample so many places after the base's first one."""
        return start[which] + (base_start[which] - start[which] + place) % total[which]

    # Across from the base, samples follow each other from the one before its first to the one after its last.
    across = total - length - 2
    which, q = np.repeat(every, across), ragged.index_in_row(across)
    ends = sample(which, total[which] - 1 - q), sample(which, total[which] - 2 - q)
    of_ends = [_along_base(sides, tiles[which], base[which], end) for end in ends]
    middle = (of_ends[0] + of_ends[1]) / 2
    of_base, place = np.repeat(every, length), ragged.index_in_row(length)
    middles = sides.middles[base_start[of_base] + place]
    passed = np.searchsorted(2 * of_base + middles, 2 * which + middle, side="right") - ragged.starts(length)[which]
    # Where the neighbouring side has samples of its own, triangles with the base's end would be flat.
    passed = np.clip(passed, (before > 1)[which], (length - (after > 1))[which])
    found = [(np.stack([sample(which, passed), ends[1], ends[0]], axis=1), tiles[which])]
    width = int(length.max(initial=0)) + 1
    crossed = (
        np.searchsorted(width * which + passed, width * of_base + place, side="right") - ragged.starts(across)[of_base]
    )
    tip = sample(of_base, total[of_base] - 1 - crossed)
    found.append((np.stack([sample(of_base, place), sample(of_base, place + 1), tip], axis=1), tiles[of_base]))
    return found


def _along_base(sides: SideSamples, tiles: IntArray, base: IntArray, samples: IntArray) -> FloatArray:
    """Positions of the samples of other sides along the base."""
    m = sides.corner_count
    side = np.searchsorted(sides.side_start, samples, side="right") - 1 - m * tiles
    turn, along = (side - base) % m, sides.along[samples]
    if m == 3:
        return np.where(turn == 1, 1 - along / 2, (1 - along) / 2)
    return np.choose(turn, [along, np.ones_like(along), 1 - along, np.zeros_like(along)])


def _inner(
    rates: IntArray, tiles: IntArray, first_inner: IntArray, corner_count: int
) -> list[tuple[IntArray, IntArray]]:
    """Triangles between inner samples."""
    own, first = rates[tiles], first_inner[tiles]
    if corner_count == 3:
        # Of a lattice that is three segments shorter: for each sample but those of the last row one, and one between.
        rest = np.stack([own[:, 0] - 3] * 2, axis=1)
        return [*_lattice(tiles, own, first, rest, 0), *_lattice(tiles, own, first, rest, 1)]
    n_u, n_v = np.maximum(own - 2, 0).T
    which, at = np.repeat(np.arange(len(tiles)), n_u * n_v), ragged.index_in_row(n_u * n_v)
    v, u = np.divmod(at, np.maximum(n_u, 1)[which])
    a, b, c, d = (_inner_sample(own[which], first[which], u + i, v + j, 4) for i, j in ((1, 1), (2, 1), (2, 2), (1, 2)))
    return [(np.stack(corners, axis=1), tiles[which]) for corners in ((a, b, c), (a, c, d))]


def _lattice(
    tiles: IntArray, own: IntArray, first: IntArray, rest: IntArray, is_down: int
) -> list[tuple[IntArray, IntArray]]:
    """Triangles of the inner lattice of triangles, which stand up or, between these, hang down."""
    shorter = rest[:, 0] - is_down
    counts = np.where(shorter > 0, shorter * (shorter + 1) // 2, 0)
    # The steps of samples of a lattice that is three longer are those of its inner samples.
    u, v = inner_steps(np.stack([shorter + 2] * 2, axis=1)[counts > 0], 3).T
    which = np.repeat(np.arange(len(tiles)), counts)
    places = ((1, 0), (1, 1), (0, 1)) if is_down else ((0, 0), (1, 0), (0, 1))
    corners = [_inner_sample(own[which], first[which], u + i, v + j, 3) for i, j in places]
    return [(np.stack(corners, axis=1), tiles[which])]
