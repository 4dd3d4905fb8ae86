"""Triangles of tiles: a regular grid inside each, and strips that join it to the samples on the tile's sides.

Samples lie along the sides of a tile, counter-clockwise from its first corner. Where it has at least two segments in
each direction (over triangles, three), its inner samples are a grid, and a strip of triangles lies between the grid's
rim and the sides. In a tile without inner samples a strip joins one side to all others.

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

    counts: IntArray  # (t, m) int64: segments on each side, which has as many samples: it ends where the next begins
    along: FloatArray  # (n,) float64: position of each sample along its side, in [0, 1)

    @cached_property
    def first(self) -> IntArray:
        """``(t, m)`` first sample of each side."""
        return ragged.starts(self.counts.ravel()).reshape(self.counts.shape)

    @cached_property
    def totals(self) -> IntArray:
        """``(t,)`` samples of each tile."""
        found: IntArray = self.counts.sum(axis=1)
        return found

    @cached_property
    def side(self) -> IntArray:
        """``(n,)`` the side that each sample lies on or begins."""
        t, m = self.counts.shape
        return np.repeat(np.tile(np.arange(m), t), self.counts.ravel())

    @cached_property
    def following(self) -> FloatArray:
        """``(n,)`` position of the next sample along the same side; one at its end."""
        found = np.append(self.along[1:], 0)
        found[(self.first + self.counts).ravel() - 1] = 1
        return found

    @cached_property
    def middles(self) -> FloatArray:
        """``(n,)`` middle of the segment that begins at each sample, along its side."""
        found: FloatArray = (self.along + self.following) / 2
        return found

    def around(self, tile: IntArray, place: IntArray) -> IntArray:
        """The samples so many places after the first one of tiles, in a circle."""
        found: IntArray = self.first[tile, 0] + place % self.totals[tile]
        return found


def inner_counts(rates: IntArray, corner_count: int) -> IntArray:
    """``(t,)`` number of inner samples of tiles of ``(t, 2)`` rates."""
    n_u, n_v = np.asarray(rates, dtype=np.int64).T
    return (n_u - 1) * (n_u - 2) // 2 if corner_count == 3 else (n_u - 1) * (n_v - 1)


def inner_steps(rates: IntArray, corner_count: int) -> IntArray:
    """``(n, 2)`` steps along u and v of the inner samples of all tiles, row by row, u fastest."""
    counts = inner_counts(rates, corner_count)
    at = ragged.index_in_row(counts)
    if corner_count == 4:
        v, u = np.divmod(at, np.repeat(rates[:, 0] - 1, counts))
        return np.stack([u + 1, v + 1], axis=1)
    # Rows have n - 2 samples, n - 3, and so on.
    width = np.repeat(rates[:, 0] - 2, counts)
    v = np.floor((2 * width + 1 - np.sqrt((2 * width + 1) ** 2 - 8 * at)) / 2).astype(np.int64)
    return np.stack([at - (v * width - v * (v - 1) // 2) + 1, v + 1], axis=1)


def _inner_sample(rates: IntArray, u: IntArray, v: IntArray, corner_count: int) -> IntArray:
    """Which inner samples of their tiles lie after steps along u and v."""
    if corner_count == 4:
        return (v - 1) * (rates[:, 0] - 1) + u - 1
    return (v - 1) * (rates[:, 0] - 2) - (v - 1) * (v - 2) // 2 + u - 1


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
    m, counts = sides.counts.shape[1], inner_counts(rates, sides.counts.shape[1])
    first_inner = len(sides.along) + ragged.starts(counts)
    found, tiles = _across(rates, sides, np.flatnonzero(counts == 0)), np.flatnonzero(counts)
    if len(tiles):
        is_cut = np.zeros(sides.counts.shape, dtype=bool)
        if m == 3:
            # From a corner to the first inner sample is further than any side of the lattice.
            is_cut[tiles] = True if keeps_corner is None else ~keeps_corner[tiles]
        found += _around_inner(rates, sides, tiles, first_inner, is_cut) + _inside(rates, first_inner, m)
    triangles, tile = (np.concatenate(each, dtype=np.int32) for each in zip(*found, strict=True))
    return triangles.take(np.argsort(tile, kind="stable"), axis=0)


def _strips(
    tiles: IntArray,  # (r,) of each strip
    right: IntArray,  # samples of the right row of each strip, one strip after the other
    right_counts: IntArray,  # (r,) their segments, one less than samples
    left: IntArray,  # likewise of the left row, in the same direction
    left_counts: IntArray,
    passed: IntArray,  # for each segment of left rows, the right row's segments before it; ascending in each strip
) -> list[tuple[IntArray, IntArray]]:
    """Triangles between rows of samples, and their tiles: one for each segment of either row."""
    strip, at = np.repeat(np.arange(len(tiles)), left_counts), ragged.index_in_row(left_counts)
    at += ragged.starts(left_counts + 1)[strip]
    first_right = ragged.starts(right_counts + 1)
    found = [(np.stack([right[first_right[strip] + passed], left[at + 1], left[at]], axis=1), tiles[strip])]
    width = int(right_counts.max(initial=0)) + 1
    keys = width * strip + passed
    strip, place = np.repeat(np.arange(len(tiles)), right_counts), ragged.index_in_row(right_counts)
    # A right row's segment has that sample as its tip to which the left row's segments before it lead.
    tip = np.searchsorted(keys, width * strip + place, side="right") - ragged.starts(left_counts)[strip]
    tip += ragged.starts(left_counts + 1)[strip]
    at = first_right[strip] + place
    return [*found, (np.stack([right[at], right[at + 1], left[tip]], axis=1), tiles[strip])]


def _passed(
    middles: FloatArray,  # positions of the middles of right rows' segments
    counts: IntArray,  # (r,) numbers of these
    left_middles: FloatArray,  # positions of the middles of left rows' segments
    left_counts: IntArray,
) -> IntArray:
    """Segments of right rows before each segment of left rows; positions are below four."""
    keys = 4 * np.repeat(np.arange(len(counts)), counts) + middles
    strip = np.repeat(np.arange(len(counts)), left_counts)
    return np.searchsorted(keys, 4 * strip + left_middles, side="right") - ragged.starts(counts)[strip]


def _around_inner(
    rates: IntArray, sides: SideSamples, tiles: IntArray, first_inner: IntArray, is_cut: NDArray[np.bool_]
) -> list[tuple[IntArray, IntArray]]:
    """Triangles between the sides of tiles and the rim of their inner samples; and those that cut corners off.

    Near a corner that is cut off, up to the distance of the inner samples, a strip joins the tile's two sides.
    """
    m, number = sides.counts.shape[1], np.full(len(rates), -1)
    number[tiles] = np.arange(len(tiles))
    of_sample = np.repeat(np.arange(len(rates)), sides.totals)
    reach = 1 / rates[of_sample, 0] + PARAMETER_ROUNDING
    before = np.append(-1, sides.along[:-1])
    before[sides.first.ravel()] = -1
    # Those nearer to the corner where their side begins, or to the one where it ends.
    is_first = is_cut[of_sample, sides.side] & (sides.following <= reach)
    is_last = is_cut[of_sample, (sides.side + 1) % m] & (before >= 1 - reach)
    outer = np.flatnonzero((number[of_sample] >= 0) & ~is_first & ~is_last)
    outer_counts = np.bincount(number[of_sample[outer]], minlength=len(tiles))
    position = (sides.side + sides.along)[outer]
    following, begins = np.append(position[1:], 0), ragged.starts(outer_counts)
    following[begins + outer_counts - 1] = position[begins] + m
    # Each row of inner samples along a side, but for its last one, with which the next row begins.
    n = rates[tiles][:, [0, 1, 0, 1] if m == 4 else [0, 0, 0]]
    lengths = n - (2 if m == 4 else 3)
    rim_counts = lengths.sum(axis=1)
    side = np.repeat(np.tile(np.arange(m), len(tiles)), lengths.ravel())
    own, k = np.repeat(tiles, rim_counts), ragged.index_in_row(lengths.ravel()) + 1
    n_u, n_v = rates[own].T
    if m == 4:
        u, v = np.choose(side, [k, n_u - 1, n_u - k, 1]), np.choose(side, [1, k, n_v - 1, n_v - k])
        middle = side + (k + 0.5) / np.where(side % 2, n_v, n_u)
    else:
        u, v = np.choose(side, [k, n_u - 1 - k, 1]), np.choose(side, [1, k, n_u - 1 - k])
        middle = side + (k + 1) / n_u
    rim = _closed(first_inner[own] + _inner_sample(rates[own], u, v, m), rim_counts, first_inner[tiles])
    passed = _passed((position + following) / 2, outer_counts, middle, rim_counts)
    found = _strips(tiles, _closed(outer, outer_counts, outer[begins]), outer_counts, rim, rim_counts, passed)
    return found + _corners(sides, is_first, is_last, np.argwhere(is_cut))


def _closed(samples: IntArray, counts: IntArray, last: IntArray) -> IntArray:
    """Rows of samples, each with one more at its end."""
    return np.insert(samples, np.cumsum(counts), last)


def _corners(
    sides: SideSamples, is_first: NDArray[np.bool_], is_last: NDArray[np.bool_], corners: IntArray
) -> list[tuple[IntArray, IntArray]]:
    """Triangles between the first samples of a side and the last ones of the side before, of tiles and corners."""
    tile, corner = corners.T
    previous = (corner - 1) % sides.counts.shape[1]
    near = ragged.offsets(is_first), ragged.offsets(is_last)
    begin, end = sides.first[tile, corner], sides.first[tile, previous] + sides.counts[tile, previous]
    counts = near[0][begin + sides.counts[tile, corner]] - near[0][begin]
    # Not the corner itself, which is the right row's.
    left_counts = near[1][end] - near[1][sides.first[tile, previous]]
    right = ragged.ranges(begin, counts + 1)
    left = np.repeat(end - 1, left_counts + 1) - ragged.index_in_row(left_counts + 1)
    passed = _passed(
        sides.middles[ragged.ranges(begin, counts)],
        counts,
        1 - sides.middles[np.repeat(end - 2, left_counts) - ragged.index_in_row(left_counts)],
        left_counts,
    )
    return _strips(tile, right, counts, left, left_counts, np.maximum(passed, 1))


def _across(rates: IntArray, sides: SideSamples, tiles: IntArray) -> list[tuple[IntArray, IntArray]]:
    """Triangles of tiles without inner samples: between one side, the base, and all others."""
    m, counts, total = sides.counts.shape[1], sides.counts[tiles], sides.totals[tiles]
    # A long side, along the direction in which the tile has more segments.
    may_be_base = np.full((len(tiles), m), True)
    if m == 4:
        u, v = rates[tiles].T
        may_be_base[:, 1::2] = (u <= v)[:, None] | (v > 1)[:, None]
        may_be_base[:, 0::2] = (v <= u)[:, None] | (u > 1)[:, None]
    base, every = np.argmax(np.where(may_be_base, counts, 0), axis=1), np.arange(len(tiles))
    length, begin = counts[every, base], sides.first[tiles, base] - sides.first[tiles, 0]
    before, after = counts[every, (base - 1) % m], counts[every, (base + 1) % m]
    strip, place = np.repeat(every, length + 1), ragged.index_in_row(length + 1)
    right = sides.around(tiles[strip], begin[strip] + place)
    # Across from the base, samples follow each other from the one before its first to the one after its last.
    across = total - length - 2
    strip, place = np.repeat(every, across + 1), ragged.index_in_row(across + 1)
    left = sides.around(tiles[strip], begin[strip] - 1 - place)
    turn, along = (sides.side[left] - base[strip]) % m, sides.along[left]
    if m == 3:
        position = np.where(turn == 1, 1 - along / 2, (1 - along) / 2)
    else:
        position = np.choose(turn, [along, 1.0, 1 - along, 0.0])
    segment = np.flatnonzero(place < across[strip])
    middles = sides.middles[ragged.ranges(sides.first[tiles, base], length)]
    passed = _passed(middles, length, (position[segment] + position[segment + 1]) / 2, across)
    # Where the neighbouring side has samples of its own, triangles with the base's end would be flat.
    strip = strip[segment]
    passed = np.clip(passed, (before > 1)[strip], (length - (after > 1))[strip])
    return _strips(tiles, right, length, left, across, passed)


def _inside(rates: IntArray, first_inner: IntArray, corner_count: int) -> list[tuple[IntArray, IntArray]]:
    """Triangles between inner samples: two, or one up and one down, for each that has neighbours on both sides."""
    tile = np.repeat(np.arange(len(rates)), inner_counts(rates, corner_count))
    (u, v), (n_u, n_v) = inner_steps(rates, corner_count).T, rates[tile].T
    if corner_count == 4:
        room = np.minimum(n_u - u, n_v - v)
        cells = (((0, 0), (1, 0), (1, 1)), 1), (((0, 0), (1, 1), (0, 1)), 1)
    else:
        room = n_u - u - v
        cells = (((0, 0), (1, 0), (0, 1)), 1), (((1, 0), (1, 1), (0, 1)), 2)
    found: list[tuple[IntArray, IntArray]] = []
    for places, needed in cells:
        at = np.flatnonzero(room > needed)
        own = tile[at]
        corners = [_inner_sample(rates[own], u[at] + i, v[at] + j, corner_count) for i, j in places]
        found.append((first_inner[own][:, None] + np.stack(corners, axis=1), own))
    return found
