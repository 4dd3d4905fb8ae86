"""How far long work has come, on a terminal."""

from __future__ import annotations

import sys
import time
from collections.abc import Iterator, Sequence
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
    is_terminal = sys.stderr is not None and sys.stderr.isatty()
    try:
        for done, item in enumerate(items):
            if is_terminal and time.monotonic() >= wait_until:
                sys.stderr.write(f"\r{what}: {done} of {len(items)}")
                sys.stderr.flush()
                wait_until, is_shown = time.monotonic() + INTERVAL, True
            yield item
    finally:
        if is_shown:
            # Also where the work is interrupted.
            sys.stderr.write("\r\x1b[K")
            sys.stderr.flush()
