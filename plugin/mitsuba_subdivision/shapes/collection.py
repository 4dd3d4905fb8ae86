"""Python's cyclic garbage collector, paused where much is made that stays.

It starts by the number of objects that were made. Modules of this package and tables of a small cage are some ten
thousand, which all stay, and so can set off a collection that frees nothing: it walks through every object of the
process, those of Mitsuba, too, and takes half as long as loading the cage.
"""

from __future__ import annotations

import gc
from collections.abc import Iterator
from contextlib import contextmanager


@contextmanager
def paused_collection() -> Iterator[None]:
    """Pause the collector; also for a function, as its decorator.

    It stays off where it was off. Threads may overlap: at the latest, it runs again when all of them are done.
    """
    was_enabled = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if was_enabled:
            gc.enable()
