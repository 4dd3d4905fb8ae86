"""Text of Wavefront OBJ files, cut into statements by whole-array operations on its bytes."""

from __future__ import annotations

import re
import warnings
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..cage.errors import CageError, shortened
from ..mesh.connectivity import IntArray

SPACE, _NEWLINE = b" \n"
_BYTE_ORDER_MARK = b"\xef\xbb\xbf"
_COMMENT = re.compile(rb"#[^\n]*")
_CONTINUATION = re.compile(rb"\\\r?\n")
# Statements of a kind that lie in more places than these are told apart by a mask over all bytes.
FEW_BREAKS = 1000
_TOKEN = re.compile(rb"[^\x00-\x20]+")


@dataclass(frozen=True, eq=False)
class ObjText:
    """Bytes of an OBJ file, cut into statements (non-empty lines).

    Comments, continuations and keywords are overwritten by spaces and never removed, so that a byte's position always
    tells its line.
    """

    name: str
    text: bytes
    line_end: IntArray  # Byte of each newline in the file.
    statement_start: IntArray  # First byte of each statement's keyword.
    argument_count: IntArray  # Tokens of each statement after its keyword.
    is_cut: bool  # Whether the final newline is missing.

    @classmethod
    def split(cls, name: str, content: bytes) -> ObjText:
        if content.startswith(_BYTE_ORDER_MARK):
            content = b"   " + content[3:]
        if b"\n" not in content:
            content = content.replace(b"\r", b"\n")
        line_end = np.flatnonzero(np.frombuffer(content, np.uint8) == _NEWLINE)
        text, statement_end = _COMMENT.sub(_blank, content), line_end
        if b"\\" in text:
            if text.rstrip().endswith(b"\\"):
                line = np.searchsorted(line_end, len(text.rstrip())) + 1
                raise CageError(f"{name}, line {line}: the file ends in a line continuation; expected another line")
            text = _CONTINUATION.sub(_blank, text)
            statement_end = np.flatnonzero(np.frombuffer(text, np.uint8) == _NEWLINE)
        text += b"\n\n"  # So that two bytes follow every keyword's first.

        token_start = run_starts(np.frombuffer(text, np.uint8) > SPACE)
        first_token = np.append(0, np.searchsorted(token_start, statement_end))
        # Empty lines begin at the token of the next line that has one, or at none.
        first_token = first_token[np.diff(first_token, append=len(token_start)) > 0]
        argument_count = np.diff(first_token, append=len(token_start)) - 1
        return cls(name, text, line_end, token_start[first_token], argument_count, not content.endswith(b"\n"))

    def line(self, position: IntArray) -> IntArray:
        """1-based line of each byte position."""
        return np.searchsorted(self.line_end, position) + 1

    def statements_of(self, keyword: bytes) -> NDArray[np.bool_]:
        """Which statements have this keyword of one or two letters."""
        data, start = np.frombuffer(self.text, np.uint8), self.statement_start
        same = data[start + len(keyword)] <= SPACE
        for place, letter in enumerate(keyword):
            same &= data[start + place] == letter
        return same

    def arguments(self, chosen: NDArray[np.bool_], keyword_length: int = 1) -> Arguments:
        """The text of the chosen statements, at least one, with spaces in place of all that is no argument of them."""
        numbers = np.flatnonzero(chosen)
        bounds = np.append(self.statement_start, len(self.text))
        first, last = bounds[numbers[0]], bounds[numbers[-1] + 1]
        # Control characters count as spaces.
        text = np.maximum(np.frombuffer(self.text, np.uint8)[first:last], np.uint8(SPACE))
        # Of most files, all that is not chosen is in few places.
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
        """Argument counts of the chosen statements, which must have at least so many."""
        counts, start = self.argument_count[chosen], self.statement_start[chosen]
        short = np.flatnonzero(counts < least)
        if len(short):
            raise self.error(start[short[0]], f"{counts[short[0]]} {noun}; expected at least {least}")
        return counts

    def require_tokens(self, arguments: Arguments, form: re.Pattern[bytes], expected: str) -> None:
        """Raise for the first token that has not the given form; slow, called when there is one."""
        for token in _TOKEN.finditer(arguments.text.tobytes()):
            if not form.fullmatch(token[0]):
                shown = shortened(token[0].decode("ascii", "backslashreplace"))
                raise self.error(arguments.first + token.start(), f'malformed number "{shown}"; expected {expected}')

    def error(self, position: int, message: str) -> CageError:
        cut = " (the file ends here without a newline: is it cut short?)"
        is_last = self.is_cut and position >= self.statement_start[-1]
        return CageError(f"{self.name}, line {self.line(position)}: {message}{cut if is_last else ''}")


class Arguments(NamedTuple):
    """Arguments of some statements, with spaces between them, and where in the file the text begins."""

    text: NDArray[np.uint8]
    first: int


def parsed(arguments: NDArray[np.uint8], dtype: type, count: int) -> NDArray | None:
    """All ``count`` numbers of a text, or None where it has anything else."""
    with warnings.catch_warnings():
        # Text that is no number is a DeprecationWarning in older NumPy and an error in newer.
        warnings.simplefilter("error", DeprecationWarning)
        try:
            values = np.fromstring(arguments.tobytes(), dtype=dtype, sep=" ")
        except (DeprecationWarning, ValueError):
            return None
    return values if len(values) == count else None


def run_starts(inside: NDArray[np.bool_]) -> IntArray:
    """Positions where a run of true begins."""
    begins = inside.copy()
    np.greater(inside[1:], inside[:-1], out=begins[1:])
    return np.flatnonzero(begins)


def _blank(match: re.Match[bytes]) -> bytes:
    return b" " * len(match[0])
