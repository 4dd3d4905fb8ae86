"""Ragged arrays: rows of different lengths, concatenated to one flat array.

An example are the faces of a polygon mesh, whose entries are the vertices at their corners. For the rows ``[a b c]``,
``[]`` and ``[d e]``, with lengths 3, 0 and 2:

============================  =============  ======================================
``starts(lengths)``           ``0 3 3``      where each row begins
``offsets(lengths)``          ``0 3 3 5``    the same, then where the last row ends
``index_in_row(lengths)``     ``0 1 2 0 1``  the index of each entry in its row
``rows(values, lengths)``                    a list of the rows
``ranges(first, lengths)``                   ``first, first + 1, ...`` in every row
============================  =============  ======================================

``np.repeat(values, lengths)`` converts a value for each row to a value for each entry.
"""

from __future__ import annotations

from collections.abc import Iterator
from itertools import pairwise
from typing import Any, TypeVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

# Integers of any width; docstrings state the width where it matters.
IntArray = NDArray[np.integer]
Rows = TypeVar("Rows", NDArray[Any], list[int])

# Number of entries of a chunk of `chunks_of`.
CHUNK_LENGTH = 1 << 14


def starts(lengths: IntArray) -> NDArray[np.int64]:
    """Return ``(n,)`` flat index at which each row begins."""
    return np.cumsum(lengths, dtype=np.int64) - lengths


def offsets(lengths: ArrayLike, dtype: type[np.signedinteger] = np.int64) -> NDArray[np.signedinteger]:
    """Return ``(n + 1,)`` offsets: the entries of row ``i`` are ``offsets[i]`` up to ``offsets[i + 1]``."""
    lengths = np.asarray(lengths)
    row_offsets = np.zeros(len(lengths) + 1, dtype=dtype)
    np.cumsum(lengths, out=row_offsets[1:])
    return row_offsets


def index_in_row(lengths: IntArray) -> NDArray[np.int64]:
    """Return ``(lengths.sum(),)`` the 0-based index of each entry in its row."""
    index = np.repeat(starts(lengths), lengths)
    return np.subtract(np.arange(len(index)), index, out=index)


def reversed_order(lengths: IntArray) -> NDArray[np.int64]:
    """Return ``(lengths.sum(),)``: the order of entries that reverses all rows and keeps their first entries."""
    index = index_in_row(lengths)
    return np.arange(len(index)) - index + -index % np.repeat(lengths, lengths)


def rows(values: Rows, lengths: ArrayLike) -> list[Rows]:
    """Return the rows, of an array as views. `numpy.split` takes ten times as long."""
    return [values[begin:end] for begin, end in pairwise(offsets(lengths).tolist())]


def ranges(first: IntArray, lengths: IntArray) -> NDArray[np.int64]:
    """Return ``(lengths.sum(),)``: row ``i`` is ``first[i]`` up to ``first[i] + lengths[i]``."""
    values = np.repeat(first - starts(lengths), lengths)
    values += np.arange(len(values))
    return values


def chunks_of(count: int, parts: int = 1) -> Iterator[slice]:
    """Yield slices of ``count`` entries to bound temporary memory; shorter ones of entries of many ``parts``."""
    length = max(1, CHUNK_LENGTH // parts)
    for begin in range(0, count, length):
        yield slice(begin, min(begin + length, count))


def runs_of(lengths: ArrayLike, total: int) -> list[slice]:
    """Return slices of successive rows, of about ``total`` entries each, to bound temporary memory."""
    number = np.cumsum(lengths, dtype=np.int64) // total
    bounds = [0, *(np.flatnonzero(np.diff(number)) + 1).tolist(), len(number)]
    return [slice(begin, end) for begin, end in pairwise(bounds) if begin < end]


def sorted_order(keys: IntArray) -> tuple[NDArray[np.int32], NDArray[np.bool_]]:
    """Return the stable sort order ``(n,)`` of non-negative keys, and whether each sorted key differs from the last."""
    bits = len(keys).bit_length()
    if int(keys.max(initial=0)) < 1 << (63 - bits):
        # A key and its index fit into 63 bits. Sorting numbers is several times faster than `argsort`.
        sorted_keys: IntArray = np.left_shift(keys, bits, dtype=np.int64)
        sorted_keys |= np.arange(len(keys))
        sorted_keys.sort()
        order = (sorted_keys & ((1 << bits) - 1)).astype(np.int32)
        sorted_keys >>= bits
    else:
        order = np.argsort(keys, kind="stable").astype(np.int32)
        sorted_keys = keys[order]
    is_new = np.ones(len(keys), dtype=bool)
    np.not_equal(sorted_keys[1:], sorted_keys[:-1], out=is_new[1:])
    return order, is_new


def first_indices(values: IntArray, count: int) -> NDArray[np.int32]:
    """Return ``(count,)``: the lowest index of each of the values ``0 .. count - 1``, -1 for a missing value."""
    first = np.full(count, -1, dtype=np.int32)
    # Assigned backwards, as the last assignment to an entry is kept.
    first[values[::-1]] = np.arange(len(values) - 1, -1, -1, dtype=np.int32)
    return first
