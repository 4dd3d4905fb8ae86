"""Errors and warnings about control cages."""

from __future__ import annotations

import sys
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from types import FrameType

import numpy as np
from numpy.typing import ArrayLike

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
