"""What the command line tells: results on standard output, wrong input on standard error."""

from __future__ import annotations

import os
import re
import sys
import warnings
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from typing import TextIO

PROGRAM = "mitsuba-subdivision"
# What a user's input can be wrong about; anything else is a mistake of ours and keeps its traceback.
USER_ERRORS = (ValueError, OSError, RuntimeError, MemoryError)

# Mitsuba puts the whole traceback of an error in a plugin into its own message.
_TRACEBACK = re.compile(r"Traceback \(most recent call last\):\n(?:[ \t].*\n)*(?:[\w.]+: )?")


def tell(text: object) -> None:
    """Print a result; nobody listening any more is no error, and the work goes on."""
    _print(text, sys.stdout)


def tell_error(error: BaseException) -> None:
    """Print an error, without tracebacks in its text."""
    _print(f"{PROGRAM}: error: {_text_of(error)}", sys.stderr)


def tell_aside(text: str) -> None:
    """Print what is no result and no error, on standard error."""
    _print(f"{PROGRAM}: {text}", sys.stderr)


@contextmanager
def told_warnings(category: type[Warning]) -> Iterator[None]:
    """Print warnings of a category as they come, each time, and all warnings without a place in the code."""

    def show(message: Warning | str, *_place: object) -> None:
        tell_aside(f"warning: {message}")

    with warnings.catch_warnings():
        warnings.simplefilter("always", category)
        warnings.showwarning = show
        yield


@contextmanager
def flushed_output() -> Iterator[None]:
    """Flush the standard streams at the end, which Python does so late that a closed pipe leaves a traceback."""
    try:
        yield
    finally:
        for stream in (sys.stdout, sys.stderr):
            _print(None, stream)


def _text_of(error: BaseException) -> str:
    if isinstance(error, OSError) and error.strerror and error.filename is not None:
        return f'"{error.filename}": {error.strerror}'
    if isinstance(error, OSError) and error.strerror:
        return error.strerror
    if isinstance(error, MemoryError):
        return f"there is not enough memory{': ' if str(error) else ''}{error}"
    return _TRACEBACK.sub("", str(error)).strip()


def _print(text: object, stream: TextIO | None) -> None:
    if stream is None:
        return
    try:
        if text is not None:
            print(text, file=stream)
        stream.flush()
    except BrokenPipeError:
        # Else Python tries once more at its end.
        with suppress(OSError, ValueError):
            os.dup2(os.open(os.devnull, os.O_WRONLY), stream.fileno())
