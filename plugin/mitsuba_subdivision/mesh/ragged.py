"""Ragged arrays: rows of different lengths, one after the other in one flat array.

The faces of a polygon mesh are one, and the vertices at their corners its entries. Of the rows ``[a b c]``, ``[]`` and
``[d e]``, with the lengths 3, 0 and 2:

============================  =============  ======================================
``starts(lengths)``           ``0 3 3``      where each row begins
``offsets(lengths)``          ``0 3 3 5``    and, after them, where the last one ends
``index_in_row(lengths)``     ``0 1 2 0 1``  the index of each entry in its row
``ranges(first, lengths)``                   ``first, first + 1, ...`` in every row
============================  =============  ======================================

A value for each row becomes one for each entry by ``np.repeat(values, lengths)``.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import ArrayLike, NDArray

IntArray = NDArray[np.integer]

# Entries of a chunk.
CHUNK_LENGTH = 1 << 14


def starts(lengths: IntArray) -> NDArray[np.int64]:
    """``(n,)`` flat index at which each row begins."""
    return np.cumsum(lengths, dtype=np.int64) - lengths


def offsets(lengths: ArrayLike, dtype: type[np.signedinteger] = np.int64) -> NDArray[np.signedinteger]:
    """``(n + 1,)``: the entries of row ``i`` are ``offsets[i]`` up to ``offsets[i + 1]``."""
    lengths = np.asarray(lengths)
    found = np.zeros(len(lengths) + 1, dtype=dtype)
    np.cumsum(lengths, out=found[1:])
    return found


def index_in_row(lengths: IntArray) -> NDArray[np.int64]:
    """``(lengths.sum(),)`` the index of each entry in its row, from 0 on."""
    found = np.repeat(starts(lengths), lengths)
    return np.subtract(np.arange(len(found)), found, out=found)


def ranges(first: IntArray, lengths: IntArray) -> NDArray[np.int64]:
    """``(lengths.sum(),)`` in every row the integers from ``first`` on, as many as the row is long."""
    found = np.repeat(first - starts(lengths), lengths)
    found += np.arange(len(found))
    return found


def chunks_of(count: int, parts: int = 1) -> Iterator[slice]:
    """Successive slices of ``count`` entries, which bound temporary memory.

    Where each entry has some parts, so many times shorter.
    """
    length = CHUNK_LENGTH // parts
    for begin in range(0, count, length):
        yield slice(begin, min(begin + length, count))


def sorted_order(keys: IntArray) -> tuple[NDArray[np.int32], NDArray[np.bool_]]:
    """Order ``(n,)`` that sorts integers from 0 on, equal ones by their place; and whether each, sorted, is new."""
    bits = len(keys).bit_length()
    if int(keys.max(initial=0)) < 1 << (63 - bits):
        # A key and its place fit into 63 bits. Numbers sort several times faster than indices into them.
        in_order: IntArray = np.left_shift(keys, bits, dtype=np.int64)
        in_order |= np.arange(len(keys))
        in_order.sort()
        order = (in_order & ((1 << bits) - 1)).astype(np.int32)
        in_order >>= bits
    else:
        order = np.argsort(keys, kind="stable").astype(np.int32)
        in_order = keys[order]
    is_new = np.ones(len(keys), dtype=bool)
    np.not_equal(in_order[1:], in_order[:-1], out=is_new[1:])
    return order, is_new


def first_indices(values: NDArray[np.int32], count: int) -> NDArray[np.int32]:
    """``(count,)`` lowest index of each value from 0 on, -1 for a missing value."""
    first = np.full(count, -1, dtype=np.int32)
    # Written backwards, as the last of several writes stays.
    first[values[::-1]] = np.arange(len(values) - 1, -1, -1, dtype=np.int32)
    return first
