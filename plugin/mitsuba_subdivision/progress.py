"""How far long work has come, on a terminal."""

from __future__ import annotations

import sys
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import TypeVar

# Seconds of work before it is worth a line, and between two updates of the line.
PATIENCE = 1.0
INTERVAL = 0.1

T = TypeVar("T")


def counted(items: Sequence[T], what: str) -> Iterator[T]:
    """Hand out items; if these take long, a line on standard error counts them, which is wiped at the end.

    Only a terminal gets the line, no pipe or file.

    Parameters
    ----------
    items : sequence
    what : str
        What the items are, with a capital letter.
    """
    wait_until, is_shown = time.monotonic() + PATIENCE, False
    is_terminal = _is_terminal()
    try:
        for done, item in enumerate(items):
            if is_terminal and time.monotonic() >= wait_until:
                _write(f"\r{what}: {done} of {len(items)}")
                wait_until, is_shown = time.monotonic() + INTERVAL, True
            yield item
    finally:
        if is_shown:
            # Also where the work is interrupted.
            wipe()


@contextmanager
def timed(what: str) -> Iterator[Callable[[str], None]]:
    """Tell on a terminal, in a line as `counted` writes, for how many seconds something has been going on.

    For work of few long steps; the function that is given out puts a word on the step behind ``what``.
    """
    done, start, step = threading.Event(), time.monotonic(), [""]

    def at(text: str) -> None:
        step[0] = f" {text}"

    def tick() -> None:
        is_shown = False
        while not done.wait(PATIENCE):
            _write(f"\r{what}{step[0]}: {time.monotonic() - start:.0f} s\x1b[K")
            is_shown = True
        if is_shown:
            wipe()

    if not _is_terminal():
        yield at
        return
    thread = threading.Thread(target=tick, daemon=True)
    thread.start()
    try:
        yield at
    finally:
        done.set()
        thread.join()


def wipe() -> None:
    """Clear the line, if there is a terminal."""
    if _is_terminal():
        _write("\r\x1b[K")


def _is_terminal() -> bool:
    return sys.stderr is not None and sys.stderr.isatty()


def _write(text: str) -> None:
    sys.stderr.write(text)
    sys.stderr.flush()
