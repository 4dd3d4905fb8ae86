"""Errors and warnings about control cages, and the names of a cage, its vertices and its faces in these."""

from __future__ import annotations

import sys
import warnings
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass, field
from types import FrameType

import numpy as np
from numpy.typing import ArrayLike

from ..mesh.connectivity import IntArray

_PACKAGE = __name__.partition(".")[0]
_noted: ContextVar[list[str]] = ContextVar("noted")
_warns: ContextVar[bool] = ContextVar("warns", default=True)


class CageError(ValueError):
    """A control cage that cannot be used. The message names the problem, its location and the expected value."""


class CageWarning(UserWarning):
    """A control cage that can be used, but is probably not as its author intended."""


def warn(message: str) -> None:
    """Issue a `CageWarning` that points to the line of the user's code that called this package."""
    _noted.get([]).append(message)
    if not _warns.get():
        return
    level = 1
    frame: FrameType | None = sys._getframe()
    # The stack may end inside this package, as Mitsuba loads shapes in its own threads.
    while frame is not None and frame.f_globals.get("__name__", "").partition(".")[0] == _PACKAGE:
        level, frame = level + 1, frame.f_back
    warnings.warn(message, CageWarning, stacklevel=level)


@contextmanager
def noting_warnings() -> Iterator[list[str]]:
    """Collect the messages of `warn` in a list, in addition to warning."""
    noted: list[str] = []
    token = _noted.set(noted)
    try:
        yield noted
    finally:
        _noted.reset(token)


@contextmanager
def without_warnings() -> Iterator[None]:
    """Suppress the warnings of `warn`, for operations whose warnings were already issued."""
    token = _warns.set(False)
    try:
        yield
    finally:
        _warns.reset(token)


def shortened(text: str, length: int = 80) -> str:
    """Truncate text from a file or a library for a message, with an ellipsis."""
    return text if len(text) <= length else f"{text[:length]}..."


def in_digits(numbers: ArrayLike) -> str:
    """Format a number, or a tuple of numbers, for a message, with all digits that distinguish it from others."""
    array = np.asarray(numbers)
    if array.ndim:
        return f"({', '.join(map(in_digits, array))})"
    return str(array[()]).removesuffix(".0")


def number_of(count: int, noun: str) -> str:
    """Format a count with its noun: "1 vertex", "2 vertices"."""
    plurals = {"vertex": "vertices", "index": "indices"}
    return f"{count} {noun if count == 1 else plurals.get(noun, f'{noun}s')}"


def number_of_such(count: int, noun: str) -> str:
    """Format a count of items with the same problem: "1 such vertex", "2 such vertices"."""
    return number_of(count, noun).replace(" ", " such ")


@dataclass(frozen=True, eq=False)
class CageSource:
    """Origin of a control cage, which names it, its vertices and its faces in messages, from 0-based indices."""

    name: str = "control cage"  # Name of the cage; for a file, its quoted path
    index_base: int = 0  # Number of the first vertex and face in messages: 0 for arrays, 1 for OBJ files
    # (n_v,), (n_f,) int: 1-based line of each vertex and face in the file; None if the file has no lines
    vertex_lines: IntArray | None = None
    face_lines: IntArray | None = None
    # 1-based lines of "creases", "corners" and "holes", if the file has lines
    tag_lines: Mapping[str, Sequence[int]] = field(default_factory=dict)

    def at_face(self, face: int) -> str:
        """Return the beginning of a message about a face: ``"cube.obj", line 17: face 5``."""
        return f"{self._line_prefix(self.face_lines, face)}: face {face + self.index_base}"

    def at_vertex(self, vertex: int) -> str:
        """Return the beginning of a message about a vertex."""
        return f"{self._line_prefix(self.vertex_lines, vertex)}: {self.vertex(vertex)}"

    def at_tag(self, kind: str, row: int) -> str:
        """Return the beginning of a message about a row of "creases", "corners" or "holes"."""
        return self._line_prefix(self.tag_lines.get(kind), row)

    def vertex(self, vertex: int) -> str:
        """Return the name of a vertex within a message."""
        return f"vertex {vertex + self.index_base}"

    def edge(self, start: int, end: int) -> str:
        """Return the name of the edge between two vertices within a message."""
        return f"edge ({start + self.index_base}, {end + self.index_base})"

    def faces(self, faces: IntArray, shown: int = 6) -> str:
        """Return the names of the first few faces, with their lines, within a message, and the number of the rest."""
        names = [
            f"{face + self.index_base}" + ("" if self.face_lines is None else f" (line {self.face_lines[face]})")
            for face in faces[:shown].tolist()
        ]
        more = f" and {len(faces) - shown} more" if len(faces) > shown else ""
        return ("faces " if len(faces) > 1 else "face ") + ", ".join(names) + more

    def error(self, where: str, problem: str, expected: str, count: int, noun: str) -> CageError:
        """Return an error about the first of several vertices, faces, edges or indices with the same problem.

        ``where``, from `at_face` or `at_vertex`, begins the message; ``count`` is the number of items, ``noun`` their
        kind ("vertex").
        """
        such = number_of_such(count, noun)
        return CageError(f"{where} {problem}; expected {expected} ({such}; numbers count from {self.index_base})")

    def _line_prefix(self, lines: IntArray | Sequence[int] | None, index: int) -> str:
        return self.name if lines is None else f"{self.name}, line {lines[index]}"
