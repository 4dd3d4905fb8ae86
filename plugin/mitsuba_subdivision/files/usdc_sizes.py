"""Numbers of entries that binary USD files announce, checked before the USD library reserves memory for them."""

from __future__ import annotations

import os
import struct
from contextlib import suppress
from pathlib import Path
from typing import BinaryIO

import numpy as np
from numpy.typing import NDArray

from ..cage.errors import CageError

# Beginning of a binary file: its name, its version, the place of its table of contents. A section in the table: name,
# place and size. The number that begins the table, each section and each array.
_NAME, _HEADER, _SECTION, _NUMBER = b"PXR-USDC", struct.Struct("<8s3B5xq"), struct.Struct("<16sqq"), struct.Struct("<Q")
_MOST_SECTIONS = 100
# LZ4 makes 255 bytes of one at most, and an integer is a quarter of a byte before.
_MOST_OF_BLOCK = 255
_MOST_PER_BYTE = 4 * _MOST_OF_BLOCK
# What LZ4 compresses at once.
_LARGEST_BLOCK = 0x7E000000
# The first version that begins arrays with a number of 64 bits.
_LONG_ARRAYS = (0, 7)
# In a field's value: whether it is an array, and its place in the file.
_IS_ARRAY, _PLACE = np.uint64(1 << 63), np.uint64((1 << 48) - 1)


def require_plausible_sizes(path: str | Path, name: str) -> None:
    """Refuse a binary file with a section or an array that announces more entries than it can hold.

    Arrays within time samples are not checked, and others only with the package lz4 of the extra ``usd``.

    Parameters
    ----------
    path : str or Path
        Files of other formats pass.
    name : str
        Beginning of messages.

    Raises
    ------
    CageError
    """
    with suppress(OSError), open(path, "rb") as file:
        size = file.seek(0, os.SEEK_END)
        file.seek(0)
        header = file.read(_HEADER.size)
        if not header.startswith(_NAME) or len(header) < _HEADER.size:
            return
        _, *version, table = _HEADER.unpack(header)
        if not 0 <= table <= size - 8:
            raise CageError(
                f"{name}: the table of contents is outside the file (is it cut short?); expected a USD file"
            )
        sections = _section_table(file, table)
        for label, begin, length in sections:
            what = f'{name}: the section "{label}"'
            if begin < 0 or length < _NUMBER.size or begin + length > size:
                raise CageError(f"{what} is not inside the file (is it cut short?); expected a USD file")
            _require_plausible(_number(file, begin), length, what)
        places = {label: (begin, length) for label, begin, length in sections}
        if "FIELDS" in places and tuple(version) >= _LONG_ARRAYS:
            # An array ends where another, or a section, begins.
            arrays = _array_places(file, *places["FIELDS"])
            arrays = arrays[arrays <= size - _NUMBER.size]
            ends = np.unique([*arrays.tolist(), *(begin for begin, _ in places.values()), size])
            lengths = ends[np.searchsorted(ends, arrays, side="right")] - arrays
            for place, length in zip(arrays.tolist(), lengths.tolist(), strict=True):
                _require_plausible(_number(file, place), length, f"{name}: an array at byte {place}")


def _require_plausible(announced: int, length: int, what: str) -> None:
    if announced > _MOST_PER_BYTE * length:
        raise CageError(f"{what} of {length} bytes announces {announced} entries; expected a USD file (is it damaged?)")


def _section_table(file: BinaryIO, table: int) -> list[tuple[str, int, int]]:
    """Name, place and size of each section."""
    file.seek(table)
    content = file.read(_NUMBER.size + _MOST_SECTIONS * _SECTION.size)
    (count,) = _NUMBER.unpack_from(content)
    count = min(count, (len(content) - _NUMBER.size) // _SECTION.size)
    rows = _SECTION.iter_unpack(content[_NUMBER.size :][: count * _SECTION.size])
    return [(label.rstrip(bytes(1)).decode("ascii", "replace"), begin, length) for label, begin, length in rows]


def _number(file: BinaryIO, place: int) -> int:
    file.seek(place)
    return int(_NUMBER.unpack(file.read(_NUMBER.size))[0])


def _array_places(file: BinaryIO, begin: int, length: int) -> NDArray[np.int64]:
    """Where the arrays of all fields begin; none without the package lz4, or if fields are damaged.

    The USD library reports the latter.
    """
    none = np.empty(0, dtype=np.int64)
    try:
        from lz4.block import LZ4BlockError, decompress
    except ImportError:
        return none
    file.seek(begin)
    section = file.read(length)
    # The number of fields; their names, compressed, after their length; their values likewise.
    try:
        count, names = struct.unpack_from("<2Q", section)
        (values,) = _NUMBER.unpack_from(section, 16 + names)
        block = section[24 + names : 24 + names + values]
        # The number of further blocks comes first.
        if not block or block[0] or _NUMBER.size * count > min(_MOST_OF_BLOCK * len(block), _LARGEST_BLOCK):
            return none
        fields = np.frombuffer(decompress(block[1:], uncompressed_size=_NUMBER.size * count), "<u8")
    except (struct.error, OverflowError, LZ4BlockError, ValueError):
        return none
    places = fields[(fields & _IS_ARRAY) != 0] & _PLACE
    # Empty arrays have no place.
    return np.unique(places[places > 0]).astype(np.int64)
