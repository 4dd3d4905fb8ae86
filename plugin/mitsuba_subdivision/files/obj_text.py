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
_COMMENT = re.compile(rb"#[^\n]*")
# The name of a material may have a "#" in it, but for one between spaces.
_MATERIAL, _COMMENT_OF_NAME = re.compile(rb"[ \t]*usemtl[ \t]"), re.compile(rb"[ \t]#(?=\s|$)")
# Files that are often named ".obj" but are something else, by their first bytes.
_NO_TEXT = {
    b"\xff\xfe": "text in UTF-16; expected ASCII or UTF-8",
    b"\xfe\xff": "text in UTF-16; expected ASCII or UTF-8",
    b"\x1f\x8b": "compressed with gzip; expected the text, which gunzip makes of it",
    b"PK\x03\x04": "a zip archive; expected the text file in it",
    b"BZh": "compressed with bzip2; expected the text, which bunzip2 makes of it",
}


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
    is_cut: bool  # Whether the file ends without a newline.

    @classmethod
    def split(cls, name: str, content: bytes) -> ObjText:
        """Raises CageError for a file that is no text of one byte for each character, and names its format."""
        for begin, what in _NO_TEXT.items():
            if content.startswith(begin):
                raise CageError(f"{name}: the file is {what}")
        if b"\0" in content[:2]:
            # UTF-16 without a mark has a zero beside each ASCII character.
            raise CageError(f"{name}: the file is binary, or text in UTF-16; expected ASCII or UTF-8")
        if content.startswith(b"\xef\xbb\xbf"):
            content = b"   " + content[3:]
        if b"\n" not in content:
            content = content.replace(b"\r", b"\n")
        line_end = np.flatnonzero(np.frombuffer(content, np.uint8) == _NEWLINE)
        text, statement_end = content, line_end
        if b"#" in text:
            text = _COMMENT.sub(_without_comment, text)
        if b"\\" in text:
            if text.rstrip().endswith(b"\\"):
                line = np.searchsorted(line_end, len(text.rstrip())) + 1
                raise CageError(f"{name}, line {line}: the file ends in a line continuation; expected another line")
            text = re.sub(rb"\\\r?\n", lambda match: b" " * len(match[0]), text)
            statement_end = np.flatnonzero(np.frombuffer(text, np.uint8) == _NEWLINE)
        # Two bytes more, so that a keyword of two letters can be looked for at every statement.
        text += b"\n\n"

        token_start = run_starts(np.frombuffer(text, np.uint8) > SPACE)
        first_token = np.append(0, np.searchsorted(token_start, statement_end))
        counts = np.diff(first_token, append=len(token_start))
        # An empty line has no token of its own: its first token is that of a later line.
        starts = token_start[first_token[counts > 0]]
        return cls(name, text, line_end, starts, counts[counts > 0] - 1, not content.endswith(b"\n"))

    def lines(self, positions: IntArray | int) -> IntArray:
        """1-based line of each byte position."""
        return np.searchsorted(self.line_end, positions) + 1

    def statements_of(self, keyword: bytes) -> NDArray[np.bool_]:
        """Which statements have this keyword of one or two letters."""
        text = np.frombuffer(self.text, np.uint8)
        same = text[len(keyword) :].take(self.statement_start) <= SPACE
        for place, letter in enumerate(keyword):
            same &= text[place:].take(self.statement_start) == letter
        return same

    def arguments(self, chosen: NDArray[np.bool_], keyword_length: int = 1) -> tuple[NDArray[np.uint8], int]:
        """Arguments of the chosen statements, of which there is one or more.

        As the bytes of the file from the first to the last of these statements, where all else is spaces, and the
        position of their first byte in the file.
        """
        numbers = np.flatnonzero(chosen)
        bounds = np.append(self.statement_start, len(self.text))[numbers[0] : numbers[-1] + 2]
        # Control characters count as spaces.
        text = np.maximum(np.frombuffer(self.text, np.uint8)[bounds[0] : bounds[-1]], np.uint8(SPACE))
        text[np.repeat(~chosen[numbers[0] : numbers[-1] + 1], np.diff(bounds))] = SPACE
        for letter in range(keyword_length):
            text[self.statement_start[numbers] + letter - bounds[0]] = SPACE
        return text, int(bounds[0])

    def require_arguments(self, chosen: NDArray[np.bool_], noun: str, least: int) -> IntArray:
        """Argument counts of the chosen statements. Raise an error if one of them has fewer than ``least``."""
        counts, start = self.argument_count[chosen], self.statement_start[chosen]
        for short in np.flatnonzero(counts < least)[:1]:
            raise self.error(start[short], f"{counts[short]} {noun}; expected at least {least}")
        return counts

    def malformed(self, text: NDArray[np.uint8], first: int, form: bytes, expected: str) -> CageError:
        """An error about the first token of `arguments` that does not match ``form``; slow."""
        for token in re.finditer(rb"[^\x00-\x20]+", text.tobytes()):
            if not re.fullmatch(form, token[0]):
                shown = shortened(token[0].decode("ascii", "backslashreplace"))
                return self.error(first + token.start(), f'malformed number "{shown}"; expected {expected}')
        return CageError(f"{self.name}: malformed numbers; expected {expected}")

    def error(self, position: int, message: str) -> CageError:
        """An error that names the line of a byte position."""
        cut = " (the file ends here without a newline: is it cut short?)"
        is_last = self.is_cut and position >= self.statement_start[-1]
        return CageError(f"{self.name}, line {self.lines(position)}: {message}{cut if is_last else ''}")


def parsed(text: NDArray[np.uint8], dtype: type[np.generic], count: int) -> NDArray | None:
    """The ``count`` numbers of a text, or None if it holds anything else."""
    with warnings.catch_warnings():
        # For text that is no number, older versions of NumPy warn and newer ones raise an error.
        warnings.simplefilter("error", DeprecationWarning)
        try:
            values: NDArray = np.fromstring(text.tobytes(), dtype=dtype, sep=" ")
        except (DeprecationWarning, ValueError):
            return None
    return values if len(values) == count else None


def run_starts(inside: NDArray[np.bool_]) -> IntArray:
    """Positions at which runs of true begin."""
    begins = inside.copy()
    np.greater(inside[1:], inside[:-1], out=begins[1:])
    return np.flatnonzero(begins)


def _without_comment(match: re.Match[bytes]) -> bytes:
    """What comes in place of a comment, or of the name of a material from its first "#" on: most of all, spaces."""
    text, (start, end) = match.string, match.span()
    line = text[text.rfind(b"\n", 0, start) + 1 : end]
    kept = _COMMENT_OF_NAME.split(line)[0] if _MATERIAL.match(line) else b""
    return kept[len(line) - (end - start) :].ljust(end - start)
