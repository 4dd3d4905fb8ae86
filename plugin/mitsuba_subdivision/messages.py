"""Messages of the command line: results on standard output, the rest on standard error; progress of long work.

Progress is a line on a terminal, erased at the end; pipes and files get none.
"""

from __future__ import annotations

import os
import re
import sys
import warnings
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from typing import TextIO, TypeVar

PROGRAM = "mitsuba-subdivision"
PATIENCE = 1.0  # Seconds before a line of progress appears
# Errors of wrong input. Any other error is a defect of this package, and keeps its traceback.
USER_ERRORS = (ValueError, OSError, RuntimeError, MemoryError)

# Mitsuba's message about an error in a plugin contains the whole traceback.
_TRACEBACK = re.compile(r"Traceback \(most recent call last\):\n(?:[ \t].*\n)*(?:[\w.]+: )?")

T = TypeVar("T")


def print_result(text: object) -> None:
    """Print a result. A closed standard output is no error."""
    _print(text, sys.stdout)


def print_error(error: BaseException) -> None:
    """Print an error, without the tracebacks in its text."""
    print_remark(f"error: {_text_of(error)}")


def print_remark(text: str) -> None:
    """Print a remark on standard error: neither a result nor an error."""
    _print(f"{PROGRAM}: {text}", sys.stderr)


@contextmanager
def printed_warnings(category: type[Warning]) -> Iterator[None]:
    """Print every warning of a category, also repeated ones, and no warning with a line of code."""
    with warnings.catch_warnings():
        warnings.simplefilter("always", category)
        warnings.showwarning = lambda message, *_place, **_more: print_remark(f"warning: {message}")
        yield


@contextmanager
def flushed_output() -> Iterator[None]:
    """Flush the standard streams at the end: in Python's later flush, a closed pipe would cause a traceback."""
    try:
        yield
    finally:
        for stream in (sys.stdout, sys.stderr):
            _print(None, stream)


def counted(items: Sequence[T], what: str) -> Iterator[T]:
    """Iterate over items, and count them on a terminal after the word ``what``."""
    if not _is_terminal():
        return iter(items)
    from tqdm import tqdm  # Only here, as it takes some time to import

    return iter(tqdm(items, desc=what, leave=False, delay=PATIENCE))


@contextmanager
def timed(what: str) -> Iterator[Callable[[str], None]]:
    """Show a line for few long steps; yield a function that names the current step after ``what``."""
    if not _is_terminal():
        yield lambda step: None  # noqa: ARG005
        return
    from tqdm import tqdm

    with tqdm(desc=what, bar_format="{desc} ({elapsed})", leave=False) as line:
        yield lambda step: line.set_description_str(f"{what} {step}")


def _text_of(error: BaseException) -> str:
    # Dr.Jit's own message refers to the error that caused it.
    while error.__cause__ is not None and "(see above)" in str(error):
        error = error.__cause__
    if isinstance(error, OSError) and error.strerror:
        return error.strerror if error.filename is None else f'"{error.filename}": {error.strerror}'
    if isinstance(error, MemoryError):
        return f"there is not enough memory{': ' if str(error) else ''}{error}"
    return _TRACEBACK.sub("", str(error)).strip()


def _print(text: object, stream: TextIO | None) -> None:
    if stream is None:
        return
    try:
        if text is not None:
            if _is_terminal():
                # A message takes the place of the line of progress.
                print("\r\x1b[K", end="", file=sys.stderr, flush=True)
            print(text, file=stream)
        stream.flush()
    except BrokenPipeError:
        with suppress(OSError, ValueError):  # Otherwise Python tries again when it ends
            os.dup2(os.open(os.devnull, os.O_WRONLY), stream.fileno())


def _is_terminal() -> bool:
    return sys.stderr is not None and sys.stderr.isatty()
