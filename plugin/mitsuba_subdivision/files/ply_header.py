"""Headers of PLY files, checked before memory is reserved for the rows that they announce."""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from ..cage.errors import CageError, shortened

EXPECTED = "expected a PLY file"

# Types by their names in files: the original ones, and those with a number of bits or bytes.
_TYPES = {
    name: np.dtype(code)
    for code, names in {
        "i1": "char int8 i1",
        "u1": "uchar uint8 u1",
        "i2": "short int16 i2",
        "u2": "ushort uint16 u2",
        "i4": "int int32 i4",
        "u4": "uint uint32 u4",
        "f4": "float float32 f4",
        "f8": "double float64 f8",
    }.items()
    for name in names.split()
}
# Byte orders by their lines in files.
_FORMATS: dict[str, Literal["<", ">"] | None] = {
    "format ascii 1.0": None,
    "format binary_little_endian 1.0": "<",
    "format binary_big_endian 1.0": ">",
}
_COUNT = re.compile("[0-9]{1,18}")


@dataclass(frozen=True)
class PlyProperty:
    """A number, or a list of numbers, in each row of an element."""

    name: str
    type: np.dtype  # Of the number, or of the length of the list.
    items: np.dtype | None = None  # Of the numbers in the list.

    @property
    def is_list(self) -> bool:
        return self.items is not None


@dataclass(frozen=True)
class PlyElement:
    """An element of a PLY file: a table of rows, as the header announces it."""

    name: str
    count: int  # Number of rows.
    line: int  # 1-based line in the header.
    properties: list[PlyProperty] = field(default_factory=list)

    def least_bytes(self, is_ascii: bool) -> int:
        """Fewest bytes that the rows can take, with all lists empty."""
        # In ASCII, a number takes a digit and a space or line break.
        row = sum(2 if is_ascii else each.type.itemsize for each in self.properties)
        return self.count * max(row, 1)


@dataclass(frozen=True)
class PlyHeader:
    """Header of a PLY file."""

    name: str  # Name of the file in messages.
    byte_order: Literal["<", ">"] | None  # None for an ASCII file.
    line_count: int  # Lines of the header.
    size: int  # Bytes of the header.
    elements: dict[str, PlyElement]  # By name, in the order of the file.

    @classmethod
    def read(cls, content: bytes, name: str) -> PlyHeader:
        """Read the header of a file, and check that the rest of the file can hold the rows that it announces.

        The order of the header's lines is not checked here, but by plyfile.

        Raises
        ------
        CageError
            If the header has no beginning or end, bytes that are not ASCII, a malformed line, or more rows than the
            rest of the file can hold.
        """
        newline = b"\r\n" if content[3:5] == b"\r\n" else content[3:4]
        if content[:3] != b"ply" or newline not in (b"\n", b"\r", b"\r\n"):
            raise CageError(f'{name}, line 1: the file does not begin with the line "ply"; {EXPECTED}')
        end = content.find(newline + b"end_header" + newline)
        if end < 0:
            raise CageError(f'{name}: there is no line "end_header" (is the file cut short?); {EXPECTED}')
        try:
            lines = content[:end].decode("ascii").split(newline.decode())
        except UnicodeDecodeError as error:
            line = content.count(newline, 0, error.start) + 1
            raise CageError(f"{name}, line {line}: the header has bytes that are not ASCII; {EXPECTED}") from None
        words = [line.split() for line in lines]
        line = next((number for number, line in enumerate(words) if line[:1] == ["format"]), 1)
        form = " ".join(words[line]) if line < len(words) else ""
        if form not in _FORMATS:
            raise CageError(f'{name}, line {line + 1}: "{shortened(form)}"; expected one of {", ".join(_FORMATS)}')
        size = end + len(newline + b"end_header" + newline)
        header = cls(name, _FORMATS[form], len(lines) + 1, size, _elements(words, name))
        header._require_bytes(len(content) - size)
        return header

    @property
    def is_ascii(self) -> bool:
        """Whether the file is text."""
        return self.byte_order is None

    @property
    def has_signed_lengths(self) -> bool:
        """Whether the length of a list can be negative."""
        return any(
            each.is_list and each.type.kind == "i" for element in self.elements.values() for each in element.properties
        )

    def lists(self, element: str) -> list[str]:
        """Names of the properties of an element that are lists."""
        return [each.name for each in self.elements[element].properties if each.is_list]

    def tables(self, content: bytes) -> tuple[dict[str, dict[str, int]], int]:
        """Length of each list of those first elements of a binary file that are tables, and where these end.

        Returns
        -------
        lengths : dict of str to dict of str to int
            By elements and their properties: of all elements before the first one that has lists of other lengths, or
            more rows than fit into the file. Empty for ASCII files.
        end : int
            First byte after these elements.
        """
        found: dict[str, dict[str, int]] = {}
        begin = self.size
        for element in self.elements.values():
            table = self._table(element, begin, content)
            if table is None:
                break
            found[element.name], row = table
            begin += element.count * row
        return found, begin

    def lines(self, element: str) -> NDArray[np.int64] | None:
        """1-based line of each row of an element of an ASCII file; None for a binary file."""
        if not self.is_ascii:
            return None
        above = list(self.elements)[: list(self.elements).index(element)]
        first = 1 + self.line_count + sum(self.elements[name].count for name in above)
        return first + np.arange(self.elements[element].count)

    def out_of_range(self, content: bytes) -> str | None:
        """Message about the first integer of an ASCII file that is out of its type's range; None if there is none.

        Slow, called when there is one.
        """
        lines, row = content[self.size :].decode("ascii", "replace").splitlines(), 0
        for element in self.elements.values():
            for number in range(row, min(row + element.count, len(lines))):
                problem = _out_of_range(element.properties, iter(lines[number].split()))
                if problem:
                    return f'line {self.line_count + 1 + number}: element "{shortened(element.name)}": {problem}'
            row += element.count
        return None

    def _table(self, element: PlyElement, begin: int, content: bytes) -> tuple[dict[str, int], int] | None:
        """Length of each list and bytes of each row of an element that begins at a offset; None if it is no table."""
        if self.byte_order is None:
            return None
        if not element.count:
            return dict.fromkeys(self.lists(element.name), 0), 0
        lengths, row, columns = {}, 0, []
        for each in element.properties:
            if each.items is not None:
                column_type, offset = each.type.newbyteorder(self.byte_order), begin + row
                if offset + column_type.itemsize > len(content):
                    return None
                lengths[each.name] = length = int(np.frombuffer(content, column_type, 1, offset)[0])
                columns.append((column_type, offset, length))
                row += max(length, 0) * each.items.itemsize
            row += each.type.itemsize
        if not row or begin + element.count * row > len(content):
            return None
        for column_type, offset, length in columns:
            column: NDArray = np.ndarray(element.count, column_type, content, offset, (row,))
            if length < 0 or (column != length).any():
                return None
        return lengths, row

    def _require_bytes(self, available: int) -> None:
        needed = 0
        for element in self.elements.values():
            needed += element.least_bytes(self.is_ascii)
            # The last row of an ASCII file may have no line break.
            if needed > available + self.is_ascii:
                raise CageError(
                    f'{self.name}, line {element.line}: element "{shortened(element.name)}" is said to have '
                    f"{element.count} rows, with which the data would take {needed} bytes or more, but {available} "
                    f"bytes follow the header (is the file cut short?); {EXPECTED}"
                )


def _elements(words: list[list[str]], name: str) -> dict[str, PlyElement]:
    found = {}
    for number, line in enumerate(words, 1):
        if line[:1] == ["element"]:
            if len(line) != 3 or not _COUNT.fullmatch(line[2]):
                shown = shortened(" ".join(line))
                raise CageError(f'{name}, line {number}: "{shown}"; expected "element", a name and a number of rows')
            if line[1] in found:
                raise CageError(f'{name}, line {number}: there are two elements "{shortened(line[1])}"; {EXPECTED}')
            found[line[1]] = element = PlyElement(line[1], int(line[2]), number)
        elif line[:1] == ["property"] and found:
            element.properties.append(_property(line, f"{name}, line {number}"))
    return found


def _property(line: list[str], where: str) -> PlyProperty:
    is_list = line[1:2] == ["list"]
    names = line[1 + is_list : -1]
    types = [_TYPES[name] for name in names if name in _TYPES]
    if not len(types) == len(names) == 1 + is_list or (is_list and types[0].kind == "f"):
        raise CageError(
            f'{where}: "{shortened(" ".join(line))}"; expected "property", a type and a name, or "property list", an '
            "integer type, a type and a name; types are char, uchar, short, ushort, int, uint, float and double"
        )
    return PlyProperty(line[-1], *types)


def _out_of_range(properties: list[PlyProperty], values: Iterator[str]) -> str | None:
    """Message about the first value of a row that is out of its type's range; None if there is none."""
    for each in properties:
        value = next(values, "")
        limits = np.iinfo(each.type) if each.type.kind in "iu" else None
        try:
            number = int(value)
        except ValueError:
            number = 0
        if limits and not limits.min <= number <= limits.max:
            what = "the length of the list" if each.is_list else "the value of"
            return (
                f'{what} "{shortened(each.name)}" is {shortened(value, 30)}; expected {limits.min} to {limits.max}, as '
                f"its type {each.type} has it"
            )
        for _ in range(number if each.is_list else 0):
            if next(values, None) is None:
                break
    return None
