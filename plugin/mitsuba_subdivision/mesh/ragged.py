"""Ragged arrays: rows of different lengths, one after the other in one flat array.

The faces of a polygon mesh are one, and the vertices at their corners its entries. Of the rows ``[a b c]``, ``[]`` and
``[d e]``, with the lengths 3, 0 and 2:

============================  =============  ======================================
``starts(lengths)``           ``0 3 3``      where each row begins
``offsets(lengths)``          ``0 3 3 5``    and, after them, where the last one ends
``index_in_row(lengths)``     ``0 1 2 0 1``  the index of each entry in its row
``ranges(first, lengths)``                   ``first, first + 1, ...`` in every row
============================  =============  ======================================

A value for each row becomes one for each entry by ``np.repeat(values, lengths)``. Long arrays are processed in chunks
(`chunks_of`) and looked up by `gathered`.
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
    begins = np.repeat(starts(lengths), lengths)
    return np.arange(len(begins)) - begins


def ranges(first: IntArray, lengths: IntArray) -> NDArray[np.int64]:
    """``(lengths.sum(),)`` in every row the integers from ``first`` on, as many as the row is long."""
    found = np.repeat(first - starts(lengths), lengths)
    found += np.arange(len(found))
    return found


def chunks_of(count: int, parts: int = 1) -> Iterator[slice]:
    """Successive slices of ``count`` entries, each so short that its temporary arrays stay in a core's cache.

    Where each entry has some parts, so many times shorter.
    """
    length = CHUNK_LENGTH // parts
    for begin in range(0, count, length):
        yield slice(begin, min(begin + length, count))


def gathered(values: NDArray, indices: NDArray[np.integer]) -> NDArray:
    """``values[indices]``; an index that is out of range takes the first or the last value.

    NumPy first converts indices to 64 bits. Those of a chunk stay in the cache.
    """
    if len(indices) <= CHUNK_LENGTH:
        return values.take(indices, mode="clip")
    found = np.empty(indices.shape, dtype=values.dtype)
    for chunk in chunks_of(len(indices)):
        values.take(indices[chunk], out=found[chunk], mode="clip")
    return found


def first_indices(values: NDArray[np.int32], count: int) -> NDArray[np.int32]:
    """``(count,)`` lowest index of each value from 0 on, -1 for a missing value."""
    first = np.full(count, -1, dtype=np.int32)
    # Written backwards, as the last of several writes stays.
    for chunk in reversed(list(chunks_of(len(values)))):
        first[values[chunk][::-1]] = np.arange(chunk.stop - 1, chunk.start - 1, -1, dtype=np.int32)
    return first
