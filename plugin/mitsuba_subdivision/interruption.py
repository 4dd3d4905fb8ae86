"""Ctrl-C ends a command at once, also one that is in the midst of compiled code."""

from __future__ import annotations

import contextvars
import signal
import threading
from collections.abc import Callable
from typing import Any, TypeVar

T = TypeVar("T")

# Seconds between two looks at the work.
INTERVAL = 0.1


class Abandoned(KeyboardInterrupt):
    """Ctrl-C came, and the work goes on in a thread that nothing can stop but the end of the process."""


def interruptible(work: Callable[[], T]) -> T:
    """Do some work in another thread, so that this one can be interrupted.

    Python tells of Ctrl-C between two of its instructions only, and one of these can be a render of hours.

    Raises
    ------
    Abandoned
        If Ctrl-C comes before the work is done.
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
    thread.start()
    try:
        while thread.is_alive():
            thread.join(INTERVAL)
            # Mitsuba puts its own in the place during a render, which lets that go on to its end.
            if handler is not None:
                signal.signal(signal.SIGINT, handler)
    except KeyboardInterrupt:
        raise Abandoned from None
    if "error" in found:
        try:
            raise found["error"]
        finally:
            # Of an error, the traceback keeps what the work had in its hands.
            found.clear()
    return found["result"]
