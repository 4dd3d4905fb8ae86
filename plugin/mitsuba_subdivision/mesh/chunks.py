"""Work on long arrays in chunks that stay in a core's cache."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

# Entries of a chunk.
CHUNK_LENGTH = 1 << 14


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
