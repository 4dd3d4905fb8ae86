"""The text of a Wavefront OBJ file, split into statements by whole-array operations on its bytes."""

from __future__ import annotations

import re
import warnings
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..cage.errors import CageError, shortened
from ..mesh.connectivity import IntArray

SPACE, _NEWLINE = b" \n"
_BYTE_ORDER_MARK = b"\xef\xbb\xbf"
_COMMENT = re.compile(rb"#[^\n]*")
# The name of a material may have a "#" in it, but for one between spaces.
_MATERIAL = re.compile(rb"usemtl[ \t][^\n]*#[^\n]*")
_COMMENT_OF_NAME = re.compile(rb"[ \t]#(?=\s|$)")
_CONTINUATION = rb"\\\r?\n"
# If other statements interrupt those of a kind more often than this, a mask over all bytes is faster than a loop over
# the interruptions.
FEW_BREAKS = 1000
_TOKEN = rb"[^\x00-\x20]+"


# Files that are often named ".obj" but are something else, by their first bytes.
_NO_TEXT = {
    b"\xff\xfe": "text in UTF-16; expected ASCII or UTF-8",
    b"\xfe\xff": "text in UTF-16; expected ASCII or UTF-8",
    b"\x1f\x8b": "compressed with gzip; expected the text, which gunzip makes of it",
    b"PK\x03\x04": "a zip archive; expected the text file in it",
    b"BZh": "compressed with bzip2; expected the text, which bunzip2 makes of it",
}


def require_text(name: str, content: bytes) -> None:
    """Raise CageError, which names the format, for a file that is no text of one byte for each character."""
    for begin, what in _NO_TEXT.items():
        if content.startswith(begin):
            raise CageError(f"{name}: the file is {what}")
    if b"\0" in content[:2]:
        # UTF-16 without a mark has a zero beside each ASCII character.
        raise CageError(f"{name}: the file is binary, or text in UTF-16; expected ASCII or UTF-8")


@dataclass(frozen=True, eq=False)
class ObjText:
    """Bytes of an OBJ file, split into statements, which are its lines that are not empty.

    Comments and line continuations are overwritten by spaces and never removed, so that the position of a byte always
    gives its line in the file.
    """

    name: str
    text: bytes
    line_end: IntArray  # Position of each newline in the file.
    statement_start: IntArray  # Position of the first byte of each statement's keyword.
    argument_count: IntArray  # Number of tokens after each statement's keyword.
    heads: tuple[NDArray[np.uint8], ...]  # First, second and third byte of each statement.
    is_cut: bool  # Whether the file ends without a newline.

    @classmethod
    def split(cls, name: str, content: bytes) -> ObjText:
        if content.startswith(_BYTE_ORDER_MARK):
            content = b"   " + content[3:]
        if b"\n" not in content:
            content = content.replace(b"\r", b"\n")
        line_end = np.flatnonzero(np.frombuffer(content, np.uint8) == _NEWLINE)
        text, statement_end = content, line_end
        if b"#" in text:
            text = _with_names(_COMMENT.sub(_blank, text), text)
        if b"\\" in text:
            if text.rstrip().endswith(b"\\"):
                line = np.searchsorted(line_end, len(text.rstrip())) + 1
                raise CageError(f"{name}, line {line}: the file ends in a line continuation; expected another line")
            text = re.sub(_CONTINUATION, _blank, text)
            statement_end = np.flatnonzero(np.frombuffer(text, np.uint8) == _NEWLINE)
        # Two bytes more, so that a keyword of two letters can be looked for at every statement.
        text += b"\n\n"

        token_start = run_starts(np.frombuffer(text, np.uint8) > SPACE)
        first_token = np.append(0, np.searchsorted(token_start, statement_end))
        counts = np.diff(first_token, append=len(token_start))
        # An empty line has no token of its own: its first token is that of a later line.
        is_statement = counts > 0
        statement_start, argument_count = token_start[first_token[is_statement]], counts[is_statement] - 1
        heads = tuple(np.frombuffer(text, np.uint8)[place:].take(statement_start) for place in range(3))
        return cls(name, text, line_end, statement_start, argument_count, heads, not content.endswith(b"\n"))

    def lines(self, positions: IntArray | int) -> IntArray:
        """1-based line of each byte position."""
        return np.searchsorted(self.line_end, positions) + 1

    def statement_lines(self) -> IntArray:
        """1-based line of each statement."""
        if len(self.statement_start) == len(self.line_end) and not self.is_cut:
            # There is one in every line.
            return np.arange(1, len(self.line_end) + 1)
        return self.lines(self.statement_start)

    def statements_of(self, keyword: bytes) -> NDArray[np.bool_]:
        """Which statements have this keyword of one or two letters."""
        same = self.heads[len(keyword)] <= SPACE
        for head, letter in zip(self.heads, keyword, strict=False):
            same &= head == letter
        return same

    def arguments(self, chosen: NDArray[np.bool_], keyword_length: int = 1) -> Arguments:
        """Arguments of the chosen statements, of which there is one or more."""
        numbers = np.flatnonzero(chosen)
        bounds = np.append(self.statement_start, len(self.text))
        first, last = bounds[numbers[0]], bounds[numbers[-1] + 1]
        # Control characters count as spaces.
        text = np.maximum(np.frombuffer(self.text, np.uint8)[first:last], np.uint8(SPACE))
        # In most files, the statements of a kind follow each other with few interruptions.
        breaks = np.flatnonzero(np.diff(numbers) > 1)
        if len(breaks) < FEW_BREAKS:
            for begin, end in zip(bounds[numbers[breaks] + 1], bounds[numbers[breaks + 1]], strict=True):
                text[begin - first : end - first] = SPACE
        else:
            between = slice(numbers[0], numbers[-1] + 1)
            text[np.repeat(~chosen[between], np.diff(bounds[between.start : between.stop + 1]))] = SPACE
        for letter in range(keyword_length):
            text[bounds[numbers] + letter - first] = SPACE
        return Arguments(text, int(first))

    def require_arguments(self, chosen: NDArray[np.bool_], noun: str, least: int = 3) -> IntArray:
        """Argument counts of the chosen statements. Raise an error if one of them has fewer than ``least``."""
        counts, start = self.argument_count[chosen], self.statement_start[chosen]
        short = np.flatnonzero(counts < least)
        if len(short):
            raise self.error(start[short[0]], f"{counts[short[0]]} {noun}; expected at least {least}")
        return counts

    def require_tokens(self, arguments: Arguments, form: bytes, expected: str) -> None:
        """Raise an error about the first token that does not match ``form``; slow, called when there is one."""
        for token in re.finditer(_TOKEN, arguments.text.tobytes()):
            if not re.fullmatch(form, token[0]):
                shown = shortened(token[0].decode("ascii", "backslashreplace"))
                raise self.error(arguments.first + token.start(), f'malformed number "{shown}"; expected {expected}')

    def error(self, position: int, message: str) -> CageError:
        """An error that names the line of a byte position."""
        cut = " (the file ends here without a newline: is it cut short?)"
        is_last = self.is_cut and position >= self.statement_start[-1]
        return CageError(f"{self.name}, line {self.lines(position)}: {message}{cut if is_last else ''}")


@dataclass(frozen=True, eq=False)
class Arguments:
    """Arguments of some statements of an OBJ file."""

    text: NDArray[np.uint8]  # The file from the first to the last of these statements; all else in it is spaces.
    first: int  # Position of the text in the file.


def parsed(arguments: NDArray[np.uint8], dtype: type[np.generic], count: int) -> NDArray | None:
    """The ``count`` numbers of a text, or None if it holds anything else."""
    with warnings.catch_warnings():
        # For text that is no number, older versions of NumPy warn and newer ones raise an error.
        warnings.simplefilter("error", DeprecationWarning)
        try:
            values: NDArray = np.fromstring(arguments.tobytes(), dtype=dtype, sep=" ")
        except (DeprecationWarning, ValueError):
            return None
    return values if len(values) == count else None


def run_starts(inside: NDArray[np.bool_]) -> IntArray:
    """Positions at which runs of true begin."""
    begins = inside.copy()
    np.greater(inside[1:], inside[:-1], out=begins[1:])
    return np.flatnonzero(begins)


def _blank(match: re.Match[bytes]) -> bytes:
    return b" " * len(match[0])


def _with_names(text: bytes, content: bytes) -> bytes:
    """Text without comments, with the names of materials as they were."""
    found = bytearray(text)
    for statement in _MATERIAL.finditer(content):
        start = statement.start()
        if not content[content.rfind(b"\n", 0, start) + 1 : start].strip():
            name = _COMMENT_OF_NAME.split(statement[0])[0]
            found[start : start + len(name)] = name
    return bytes(found)
