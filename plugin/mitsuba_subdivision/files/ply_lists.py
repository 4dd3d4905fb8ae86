"""Lists of different lengths in binary PLY files, read by passes over whole arrays."""

from __future__ import annotations

from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..mesh.connectivity import IntArray
from .ply_header import PlyElement, PlyHeader

# Bytes that are searched for rows at once: few enough to stay in a processor's cache.
_WINDOW = 1 << 16


class Lists(NamedTuple):
    """Lists of one property in all rows of an element, numbers beside them, and the file without these rows."""

    sizes: IntArray
    values: NDArray
    rest: bytes
    numbers: NDArray | None


def lists_of_rows(header: PlyHeader, content: bytes, element: str, name: str, beside: str | None) -> Lists | None:
    """Read the lists ``name`` of an element of a binary file that has only tables before it.

    And the numbers ``beside``, another property of the same rows.

    None if the element is a table itself, another one that is none stands before it, or the file is damaged.
    """
    tables, begin = header.tables(content)
    others = [each for each in header.elements if each not in tables]
    if header.byte_order is None or others[:1] != [element]:
        return None
    found = header.elements[element]
    rows = _Rows(found, header.byte_order, content)
    starts = rows.starts(begin)
    if starts is None:
        return None
    first, sizes, ends = rows.lists(starts, name)
    if (sizes < 0).any() or ends[-1] > len(content) or (ends[:-1] != starts[1:]).any():
        return None
    kind = next(each.items for each in found.properties if each.name == name and each.items is not None)
    before = np.cumsum(sizes) - sizes
    within = np.arange(sizes.sum()) - np.repeat(before, sizes)
    values = rows.at(kind, np.repeat(first, sizes) + within * kind.itemsize)
    newline = b"\r\n" if content[: header.size].endswith(b"\r\n") else content[header.size - 1 : header.size]
    lines = content[: header.size].split(newline)
    lines[found.line - 1] = f"element {element} 0".encode()
    rest = newline.join(lines) + content[header.size : begin] + content[ends[-1] :]
    return Lists(sizes, values, rest, None if beside is None else rows.numbers(starts, beside))


class _Rows:
    """The rows of an element, of which each begins where the one before ends."""

    def __init__(self, element: PlyElement, byte_order: Literal["<", ">"], content: bytes) -> None:
        self._element, self._byte_order, self._content = element, byte_order, content

    def at(self, kind: np.dtype, offsets: IntArray) -> NDArray:
        """The numbers that begin at some bytes; beyond the file, the last one of the file."""
        count = len(self._content) - kind.itemsize + 1
        numbers: NDArray = np.ndarray(count, kind.newbyteorder(self._byte_order), self._content, 0, (1,))
        return numbers[np.minimum(offsets, count - 1)].astype(kind)

    def numbers(self, starts: IntArray, name: str) -> NDArray:
        """Values of a property that is one number, for rows that begin at some bytes."""
        at = starts
        for each in self._element.properties:
            if each.name == name:
                return self.at(each.type, at)
            lengths = 0 if each.items is None else self.at(each.type, at).astype(np.int64) * each.items.itemsize
            at = at + each.type.itemsize + lengths
        raise KeyError(name)

    def lists(self, starts: IntArray, name: str | None = None) -> tuple[IntArray, IntArray, IntArray]:
        """Where a list's numbers begin, its length, and where the row ends, for rows that begin at some bytes."""
        at, first, sizes = starts, starts, np.zeros_like(starts)
        for each in self._element.properties:
            if each.items is None:
                at = at + each.type.itemsize
                continue
            lengths = self.at(each.type, at).astype(np.int64)
            at = at + each.type.itemsize
            if each.name == name:
                first, sizes = at, lengths
            at = at + lengths * each.items.itemsize
        return first, sizes, at

    def starts(self, begin: int) -> IntArray | None:
        """Where all rows begin, if the first one begins at a byte; None if they do not fit into the file.

        In a window of bytes, ``after`` maps each byte to the one where the next row would begin if a row began there.
        The map applied to itself leads 2, 4, 8 rows on, and the known starts with it lead to as many again.
        """
        parts, missing = [], self._element.count
        while missing > 0:
            stop = min(begin + _WINDOW, len(self._content))
            size = stop - begin
            if size <= 0:
                return None
            window = np.arange(begin, stop)
            ends = self.lists(window)[2]
            # A damaged list may have a negative length.
            after = np.append(np.clip(ends - begin, np.arange(1, size + 1), size), size)
            found = np.zeros(1, np.int64)
            while found[-1] < size and len(found) < missing:
                found = np.concatenate([found, after[found]])
                after = after[after]
            found = found[found < size][:missing]
            parts.append(begin + found)
            missing -= len(found)
            begin = int(ends[found[-1]])
            if begin <= parts[-1][-1]:
                return None
        return np.concatenate(parts)
