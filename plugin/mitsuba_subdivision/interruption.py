"""Ctrl-C ends a command at once, also while compiled code runs."""

from __future__ import annotations

import contextvars
import signal
import threading
from collections.abc import Callable
from typing import Any, TypeVar

T = TypeVar("T")

# Seconds between two looks at whether the work is done.
INTERVAL = 0.1


class Abandoned(KeyboardInterrupt):
    """Ctrl-C was pressed, and the work continues in a thread, which only the end of the process stops."""


def interruptible(work: Callable[[], T]) -> T:
    """Run a function in another thread, so that this one can be interrupted.

    Python notices Ctrl-C only between two of its instructions, and a single one can be a render of hours.

    Raises
    ------
    Abandoned
        If Ctrl-C is pressed before the work is done.
    """
    if threading.current_thread() is not threading.main_thread():
        return work()
    found: dict[str, Any] = {}

    def run() -> None:
        try:
            found["result"] = work()
        except BaseException as error:  # Raised below, in the thread that waits.
            found["error"] = error

    context = contextvars.copy_context()
    thread = threading.Thread(target=lambda: context.run(run), name="work", daemon=True)
    handler = signal.getsignal(signal.SIGINT)
    try:
        thread.start()
        while thread.is_alive():
            thread.join(INTERVAL)
            # During a render, Mitsuba installs a handler of its own, which waits for the end of the render.
            if handler is not None:
                signal.signal(signal.SIGINT, handler)
    except KeyboardInterrupt:
        raise Abandoned from None
    if "error" in found:
        try:
            raise found["error"]
        finally:
            # The error's traceback would keep alive the objects that the work used.
            found.clear()
    return found["result"]
