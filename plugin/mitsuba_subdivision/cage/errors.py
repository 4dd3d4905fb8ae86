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
    # The stack may end inside this package: Mitsuba loads shapes in threads of its own.
    while frame is not None and frame.f_globals.get("__name__", "").partition(".")[0] == _PACKAGE:
        level, frame = level + 1, frame.f_back
    warnings.warn(message, CageWarning, stacklevel=level)


@contextmanager
def noting_warnings() -> Iterator[list[str]]:
    """Collect the messages of `warn` in a list, besides warning."""
    noted: list[str] = []
    token = _noted.set(noted)
    try:
        yield noted
    finally:
        _noted.reset(token)


@contextmanager
def without_warnings() -> Iterator[None]:
    """Have `warn` issue no warnings, where they were issued before."""
    token = _warns.set(False)
    try:
        yield
    finally:
        _warns.reset(token)


def shortened(text: str, length: int = 80) -> str:
    """Text from a file or a library as a message shows it: cut off, with an ellipsis, where it is long."""
    return text if len(text) <= length else f"{text[:length]}..."


def in_digits(numbers: ArrayLike) -> str:
    """A number, or a tuple of numbers, as a message shows it: with all digits that tell it from others."""
    found = np.asarray(numbers)
    if found.ndim:
        return f"({', '.join(map(in_digits, found))})"
    return str(found[()]).removesuffix(".0")


def number_of(count: int, noun: str) -> str:
    """A count with its noun: "1 vertex", "2 vertices"."""
    plurals = {"vertex": "vertices", "index": "indices"}
    return f"{count} {noun if count == 1 else plurals.get(noun, f'{noun}s')}"


def number_of_such(count: int, noun: str) -> str:
    """A count of things with the same problem, with their noun: "1 such vertex", "2 such vertices"."""
    return number_of(count, noun).replace(" ", " such ")
