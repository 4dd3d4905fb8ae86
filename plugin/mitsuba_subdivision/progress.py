"""Progress of long work, as a line on a terminal that is erased at the end; a pipe or a file gets none."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import TypeVar

# Seconds before a line appears.
PATIENCE = 1.0

T = TypeVar("T")


def counted(items: Sequence[T], what: str) -> Iterator[T]:
    """Iterate over items, and count them; ``what`` they are begins with a capital letter."""
    if not _is_terminal():
        return iter(items)
    # Only here, as it takes some time to import.
    from tqdm import tqdm

    return iter(tqdm(items, desc=what, leave=False, delay=PATIENCE))


@contextmanager
def timed(what: str) -> Iterator[Callable[[str], None]]:
    """Show a line for work of few long steps. The function handed out names the current step, after ``what``."""
    if not _is_terminal():
        yield lambda step: None  # noqa: ARG005
        return
    from tqdm import tqdm

    with tqdm(desc=what, bar_format="{desc} ({elapsed})", leave=False) as line:
        yield lambda step: line.set_description_str(f"{what} {step}")


def wipe() -> None:
    """Clear the line of the terminal, if there is one, for a message in its place."""
    if _is_terminal():
        sys.stderr.write("\r\x1b[K")
        sys.stderr.flush()


def _is_terminal() -> bool:
    return sys.stderr is not None and sys.stderr.isatty()
