"""Progress of long work, shown on a terminal."""

from __future__ import annotations

import sys
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import TypeVar

BAR_WIDTH = 30
# Seconds before a line appears, and between two updates of the line.
PATIENCE = 1.0
INTERVAL = 0.1

T = TypeVar("T")


def counted(items: Sequence[T], what: str) -> Iterator[T]:
    """Iterate over items; after a while, count them in a line on standard error, and erase it at the end.

    Only a terminal gets the line; a pipe or a file does not.

    Parameters
    ----------
    items : sequence
    what : str
        What the items are, beginning with a capital letter.
    """
    wait_until, is_shown = time.monotonic() + PATIENCE, False
    is_terminal = _is_terminal()
    try:
        for done, item in enumerate(items):
            if is_terminal and time.monotonic() >= wait_until:
                _write(f"\r{what} [{_bar(done, len(items))}] {done} of {len(items)}")
                wait_until, is_shown = time.monotonic() + INTERVAL, True
            yield item
    finally:
        if is_shown:
            # Reached also when the work is interrupted.
            wipe()


@contextmanager
def timed(what: str) -> Iterator[Callable[[str], None]]:
    """Show a line as `counted` does, with the seconds elapsed.

    This is for work of few long steps. The function handed out names the current step; its words stand after ``what``.
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


def draw_bar(what: str, done: int, total: int) -> None:
    """Draw a progress bar over the terminal's last line, and erase it at the end."""
    if not _is_terminal():
        return
    bar = f"{what} [{_bar(done, total)}] {100 * done // total} %"
    _write(f"\r{bar}" if done < total else f"\r{' ' * len(bar)}\r")


def _bar(done: int, total: int) -> str:
    filled = BAR_WIDTH * done // total
    return "#" * filled + "." * (BAR_WIDTH - filled)


def wipe() -> None:
    """Clear the line of the terminal, if there is one."""
    if _is_terminal():
        _write("\r\x1b[K")


def _is_terminal() -> bool:
    return sys.stderr is not None and sys.stderr.isatty()


def _write(text: str) -> None:
    sys.stderr.write(text)
    sys.stderr.flush()
