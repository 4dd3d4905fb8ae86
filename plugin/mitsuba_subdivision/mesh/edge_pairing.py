"""Edges and twins of half-edges, found by sorting."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from .chunks import chunks_of

IntArray = NDArray[np.integer]
IndexArray = NDArray[np.int32]


def paired(keys_of: Callable[[slice], IntArray], count: int, key_count: int) -> tuple[IndexArray, IndexArray, int]:
    """Join half-edges of equal keys into edges.

    Parameters
    ----------
    keys_of : callable
        Keys of some half-edges: a number below ``key_count`` that a half-edge shares with the others of its edge alone.
    count, key_count : int
        Number of half-edges, and of keys that there may be.

    Returns
    -------
    edge : (count,) int32
        0-based edge of each half-edge, in the order of the keys.
    twin : (count,) int32
        The other half-edge of the edge, -1 if there is none. Where an edge has more than two, one of them.
    edge_count : int
    """
    order, begins = _sorted_half_edges(keys_of, count, key_count)
    edge, twin = np.empty_like(order), np.full_like(order, -1)
    edge_count = 0
    for chunk in chunks_of(count):
        number = np.cumsum(begins[chunk], dtype=np.int32)
        edge[order[chunk]] = number + (edge_count - 1)
        edge_count += int(number[-1])
        second = chunk.start + np.flatnonzero(~begins[chunk])
        one, other = order[second - 1], order[second]
        twin[one], twin[other] = other, one
    return edge, twin, edge_count


def _sorted_half_edges(
    keys_of: Callable[[slice], IntArray], count: int, key_count: int
) -> tuple[IndexArray, NDArray[np.bool_]]:
    """Half-edges sorted by key, then by number, and whether each of them is the first of its key."""
    begins = np.ones(count, dtype=bool)
    half_edge_bits = np.uint64(count.bit_length())
    if key_count << int(half_edge_bits) <= 1 << 64:
        # A key and a half-edge fit into 64 bits. Numbers sort several times faster than indices into them.
        keys = np.empty(count, dtype=np.uint64)
        for chunk in chunks_of(count):
            np.left_shift(keys_of(chunk).astype(np.uint64), half_edge_bits, out=keys[chunk])
            keys[chunk] |= np.arange(chunk.start, chunk.stop, dtype=np.uint64)
        keys.sort()
        order = np.empty(count, dtype=np.int32)
        half_edge_mask = (np.uint64(1) << half_edge_bits) - np.uint64(1)
        np.bitwise_and(keys, half_edge_mask, out=order, casting="unsafe")
        keys >>= half_edge_bits
    else:
        keys = np.concatenate([keys_of(chunk) for chunk in chunks_of(count)])
        order = np.argsort(keys, kind="stable").astype(np.int32)
        keys = keys[order]
    np.not_equal(keys[1:], keys[:-1], out=begins[1:])
    return order, begins
