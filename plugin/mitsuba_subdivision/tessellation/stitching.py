"""Triangulation of tiles: a regular grid inside each tile, and strips that join it to the samples on the tile's sides.

Samples on sides are ordered counter-clockwise from the tile's first corner. A tile with at least two segments in each
direction (three over triangles) has a grid of inner samples, and a strip of triangles between the grid's rim and the
sides. In a tile without inner samples, a strip joins one side to all others.

A strip between two rows of samples has a triangle for each segment of either row, ordered by the midpoints of the
segments, so that no triangle is longer than the longer segment. All triangles are counter-clockwise in parameters, and
none is degenerate: they do not fold.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ..mesh import ragged
from ..mesh.connectivity import IndexArray, IntArray
from ..schemes.domain import FloatArray

# Tolerance when comparing parameters.
PARAMETER_ROUNDING = 1e-9
# Triangles, as three samples each, and their tiles.
Triangles = list[tuple[IntArray, IntArray]]


class SideSamples:
    """Samples along the sides of tiles: as many as segments, ``(t, m)``, as the last point belongs to the next side.

    The position of each sample along its side, ``(n,)``, is in [0, 1).
    """

    def __init__(self, counts: IntArray, along: FloatArray) -> None:
        self.counts, self.along = counts, along
        # First sample of each side, and tile and side of each sample.
        self.first = ragged.starts(counts.ravel()).reshape(counts.shape)
        self.tile, self.side = np.divmod(np.repeat(np.arange(counts.size), counts.ravel()), counts.shape[1])
        # Position of the next sample along the same side, and of the middle of the segment before it.
        self.following = np.append(along[1:], 0)
        self.following[(self.first + counts).ravel() - 1] = 1
        self.middles = (along + self.following) / 2


def inner_counts(rates: IntArray, corner_count: int) -> IntArray:
    """``(t,)`` number of inner samples of tiles with ``(t, 2)`` rates."""
    n_u, n_v = np.asarray(rates, dtype=np.int64).T
    return (n_u - 1) * (n_u - 2) // 2 if corner_count == 3 else (n_u - 1) * (n_v - 1)


def inner_steps(rates: IntArray, corner_count: int) -> IntArray:
    """``(n, 2)`` grid indices along u and v of the inner samples of all tiles, row by row, u fastest."""
    counts = inner_counts(rates, corner_count)
    index = ragged.index_in_row(counts)
    if corner_count == 4:
        v, u = np.divmod(index, np.repeat(rates[:, 0] - 1, counts))
        return np.stack([u + 1, v + 1], axis=1)
    # Rows have n - 2 samples, n - 3, and so on.
    width = np.repeat(rates[:, 0] - 2, counts)
    v = np.floor((2 * width + 1 - np.sqrt((2 * width + 1) ** 2 - 8 * index)) / 2).astype(np.int64)
    return np.stack([index - (v * width - v * (v - 1) // 2) + 1, v + 1], axis=1)


def _inner_sample(rates: IntArray, u: IntArray, v: IntArray, corner_count: int) -> IntArray:
    """Indices of inner samples in their tiles, from their grid indices along u and v; inverse of `inner_steps`."""
    if corner_count == 4:
        return (v - 1) * (rates[:, 0] - 1) + u - 1
    return (v - 1) * (rates[:, 0] - 2) - (v - 1) * (v - 2) // 2 + u - 1


def stitched(
    rates: IntArray,  # (t, 2) int64
    side_counts: IntArray,  # (t, m) segments on each side
    along: FloatArray,  # (n,) float64: as for `SideSamples`
    keeps_corner: NDArray[np.bool_],  # (t, m): corners of tiles with inner samples that no triangle may cut off
) -> IndexArray:
    """Triangles ``(n, 3)`` of the samples of tiles, tile by tile. Samples on sides are numbered before inner ones."""
    sides, m = SideSamples(side_counts, along), side_counts.shape[1]
    counts = inner_counts(rates, m)
    first_inner = len(along) + ragged.starts(counts)
    parts, tiles = _across(rates, sides, np.flatnonzero(counts == 0)), np.flatnonzero(counts)
    if len(tiles):
        # A triangle's corner is further from the first inner sample than the spacing of the grid.
        is_cut = ~keeps_corner & (m == 3) & (counts > 0)[:, None]
        parts += _around_inner(rates, sides, tiles, first_inner, is_cut) + _inside(rates, first_inner, m)
    triangles, tile = (np.concatenate(column, dtype=np.int32) for column in zip(*parts, strict=True))
    return triangles.take(np.argsort(tile, kind="stable"), axis=0)


def _strips(
    tiles: IntArray,  # (r,) the tile of each strip
    right: IntArray,  # samples of the right rows of all strips
    right_counts: IntArray,  # (r,) segments of the right rows, one less than samples
    right_middles: FloatArray,  # midpoints of these segments, as positions in [0, 4)
    # The same for the left rows, in the same direction
    left: IntArray,
    left_counts: IntArray,
    left_middles: FloatArray,
    # (r,) right segments that come before all left segments, and after all of them
    least_before: IntArray | int = 0,
    least_after: IntArray | int = 0,
) -> Triangles:
    """Triangulate strips between two rows of samples: a triangle for each segment of either row."""
    strips, first_right, first_left = np.arange(len(tiles)), ragged.starts(right_counts), ragged.starts(left_counts)
    # The base of a triangle on a left segment; its tip is the end of the right segments with middles before its own.
    strip, place = np.repeat(strips, left_counts), ragged.index_in_row(left_counts)
    keys = 4 * np.repeat(strips, right_counts) + right_middles
    passed = np.searchsorted(keys, 4 * strip + left_middles, side="right") - first_right[strip]
    low, high = np.broadcast_to(least_before, strips.shape), right_counts - least_after
    passed = np.clip(passed, low[strip], high[strip])
    base = (first_left + strips)[strip] + place
    tips = right[(first_right + strips)[strip] + passed]
    on_left = np.stack([tips, left[base + 1], left[base]], axis=1), tiles[strip]
    # The tip of a triangle on a right segment is the end of the last left segment before it.
    width = int(right_counts.max(initial=0)) + 1
    keys = width * strip + passed
    strip, place = np.repeat(strips, right_counts), ragged.index_in_row(right_counts)
    tip = np.searchsorted(keys, width * strip + place, side="right") + strips[strip]
    base = (first_right + strips)[strip] + place
    return [on_left, (np.stack([right[base], right[base + 1], left[tip]], axis=1), tiles[strip])]


def _around_inner(
    rates: IntArray, sides: SideSamples, tiles: IntArray, first_inner: IntArray, is_cut: NDArray[np.bool_]
) -> Triangles:
    """Triangles between the sides of tiles and the rim of their inner samples.

    Near a corner that is cut off, within a step of the grid, a strip joins the tile's two sides.
    """
    m, strip_of_tile = sides.counts.shape[1], np.full(len(rates), -1)
    strip_of_tile[tiles] = np.arange(len(tiles))
    reach = 1 / rates[sides.tile, 0] + PARAMETER_ROUNDING
    before = np.append(-1, sides.along[:-1])
    before[sides.first.ravel()] = -1
    # Samples cut off with the corner at the beginning of their side, and with the corner at its end.
    is_first = is_cut[sides.tile, sides.side] & (sides.following <= reach)
    is_last = is_cut[sides.tile, (sides.side + 1) % m] & (before >= 1 - reach)
    outer = np.flatnonzero((strip_of_tile[sides.tile] >= 0) & ~is_first & ~is_last)
    outer_counts = np.bincount(strip_of_tile[sides.tile[outer]], minlength=len(tiles))
    position, begins = (sides.side + sides.along)[outer], ragged.starts(outer_counts)
    following = np.append(position[1:], 0)
    following[begins + outer_counts - 1] = position[begins] + m
    # The rim: inner samples along each side, without the last one, with which the next row begins.
    n = rates[tiles][:, [0, 1, 0, 1] if m == 4 else [0, 0, 0]]
    lengths = n - (2 if m == 4 else 3)
    rim_counts = lengths.sum(axis=1)
    side = np.repeat(np.tile(np.arange(m), len(tiles)), lengths.ravel())
    tile, k = np.repeat(tiles, rim_counts), ragged.index_in_row(lengths.ravel()) + 1
    n_u, n_v = rates[tile].T
    if m == 4:
        u, v = np.choose(side, [k, n_u - 1, n_u - k, 1]), np.choose(side, [1, k, n_v - 1, n_v - k])
        middle = side + (k + 0.5) / np.where(side % 2, n_v, n_u)
    else:
        u, v = np.choose(side, [k, n_u - 1 - k, 1]), np.choose(side, [1, k, n_u - 1 - k])
        middle = side + (k + 1) / n_u
    # Both rows are closed: the first sample comes again at the end.
    outer = np.insert(outer, np.cumsum(outer_counts), outer[begins])
    rim = first_inner[tile] + _inner_sample(rates[tile], u, v, m)
    rim = np.insert(rim, np.cumsum(rim_counts), first_inner[tiles])
    strips = _strips(tiles, outer, outer_counts, (position + following) / 2, rim, rim_counts, middle)
    return strips + _corners(sides, is_first, is_last, np.argwhere(is_cut))


def _corners(
    sides: SideSamples, is_first: NDArray[np.bool_], is_last: NDArray[np.bool_], corners: IntArray
) -> Triangles:
    """Triangles that cut off ``corners``, (n, 2) tile and corner, between the two sides that meet there."""
    tile, corner = corners.T
    previous = (corner - 1) % sides.counts.shape[1]
    near_first, near_last = ragged.offsets(is_first), ragged.offsets(is_last)
    begin, end = sides.first[tile, corner], sides.first[tile, previous] + sides.counts[tile, previous]
    counts = near_first[begin + sides.counts[tile, corner]] - near_first[begin]
    # Without the corner itself, which belongs to the right row.
    left_counts = near_last[end] - near_last[sides.first[tile, previous]]
    left = np.repeat(end - 1, left_counts + 1) - ragged.index_in_row(left_counts + 1)
    left_middles = 1 - sides.middles[np.repeat(end - 2, left_counts) - ragged.index_in_row(left_counts)]
    right, right_middles = ragged.ranges(begin, counts + 1), sides.middles[ragged.ranges(begin, counts)]
    return _strips(tile, right, counts, right_middles, left, left_counts, left_middles, 1)


def _across(rates: IntArray, sides: SideSamples, tiles: IntArray) -> Triangles:
    """Triangles of tiles without inner samples: between one side, the base, and all others."""
    m, counts = sides.counts.shape[1], sides.counts[tiles]
    total, first, strips = counts.sum(axis=1), sides.first[tiles, 0], np.arange(len(tiles))
    # The base runs along the direction in which the tile has more segments.
    may_be_base = np.full((len(tiles), m), True)
    if m == 4:
        u, v = rates[tiles].T
        may_be_base[:, 1::2] = (u <= v)[:, None] | (v > 1)[:, None]
        may_be_base[:, 0::2] = (v <= u)[:, None] | (u > 1)[:, None]
    base = np.argmax(np.where(may_be_base, counts, 0), axis=1)
    length, begin = counts[strips, base], sides.first[tiles, base] - first
    before, after = counts[strips, (base - 1) % m], counts[strips, (base + 1) % m]
    strip, place = np.repeat(strips, length + 1), ragged.index_in_row(length + 1)
    right = first[strip] + (begin[strip] + place) % total[strip]
    # The opposite row leads clockwise from the sample before the base's first to the sample after its last.
    across = total - length - 2
    strip, place = np.repeat(strips, across + 1), ragged.index_in_row(across + 1)
    left = first[strip] + (begin[strip] - 1 - place) % total[strip]
    turn, along = (sides.side[left] - base[strip]) % m, sides.along[left]
    if m == 3:
        position = np.where(turn == 1, 1 - along / 2, (1 - along) / 2)
    else:
        position = np.choose(turn, [along, 1.0, 1 - along, 0.0])
    segment = np.flatnonzero(place < across[strip])
    middles = sides.middles[ragged.ranges(sides.first[tiles, base], length)]
    left_middles = (position[segment] + position[segment + 1]) / 2
    # Next to a side of several segments, a triangle of that side with the base's end would be degenerate.
    return _strips(tiles, right, length, middles, left, across, left_middles, before > 1, after > 1)


def _inside(rates: IntArray, first_inner: IntArray, corner_count: int) -> Triangles:
    """Triangles between inner samples: two per cell of the grid; over triangles, one upright and one inverted."""
    tile = np.repeat(np.arange(len(rates)), inner_counts(rates, corner_count))
    (u, v), (n_u, n_v) = inner_steps(rates, corner_count).T, rates[tile].T
    if corner_count == 4:
        room = np.minimum(n_u - u, n_v - v)
        cells = (((0, 0), (1, 0), (1, 1)), 1), (((0, 0), (1, 1), (0, 1)), 1)
    else:
        room = n_u - u - v
        cells = (((0, 0), (1, 0), (0, 1)), 1), (((1, 0), (1, 1), (0, 1)), 2)
    parts: Triangles = []
    for steps, needed in cells:
        origins = np.flatnonzero(room > needed)
        cell_tile = tile[origins]
        corners = [_inner_sample(rates[cell_tile], u[origins] + i, v[origins] + j, corner_count) for i, j in steps]
        parts.append((first_inner[cell_tile][:, None] + np.stack(corners, axis=1), cell_tile))
    return parts
