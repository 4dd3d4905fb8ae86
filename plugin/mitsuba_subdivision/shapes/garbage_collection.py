"""Pauses Python's cyclic garbage collector while many long-lived objects are created.

The collector runs after a number of allocations. Importing this package and building the tables of a small cage
allocate some ten thousand objects that all stay alive, and can trigger a collection that frees nothing: it visits
every object of the process, Mitsuba's included, and takes half as long as loading the cage.
"""

from __future__ import annotations

import gc
from collections.abc import Iterator
from contextlib import contextmanager


@contextmanager
def paused_collection() -> Iterator[None]:
    """Pause the collector; a context manager and a decorator.

    A collector that was disabled stays disabled. With overlapping threads, it runs again at the latest when all end.
    """
    was_enabled = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if was_enabled:
            gc.enable()
