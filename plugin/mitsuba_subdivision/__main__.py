"""The command line: ``mitsuba-subdivision`` or ``python -m mitsuba_subdivision``."""

from __future__ import annotations

import contextvars
import os
import signal
import sys
import threading
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor, wait
from typing import TypeVar

from .cage import CageWarning
from .commands import parser
from .messages import USER_ERRORS, flushed_output, print_error, print_remark, printed_warnings
from .whole_file import remove_unfinished

INTERRUPTED = 130

T = TypeVar("T")
INTERVAL = 0.1  # Seconds between checks of the work


def main(arguments: Sequence[str] | None = None) -> int:
    """Run a command and return the exit status; after Ctrl-C, end the process if its work cannot be stopped."""
    words = sys.argv[1:] if arguments is None else arguments
    with flushed_output():
        try:
            options, unknown = parser(words).parse_known_args(words)
            if unknown:
                # The command's parser reports them, with its usage and exit status.
                options.parser.error(f"unrecognized arguments: {' '.join(unknown)}")
            try:
                with printed_warnings(CageWarning):
                    return interruptible(lambda: options.run(options)) or 0
            except USER_ERRORS as error:
                print_error(error)
                return options.error_status
        except KeyboardInterrupt:
            print_remark("interrupted")
            return INTERRUPTED


def _abandon() -> None:
    # Interrupted work continues in its thread until the process ends.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    remove_unfinished()
    print_remark("interrupted")
    os._exit(INTERRUPTED)


def interruptible(work: Callable[[], T]) -> T:
    """Run a function in another thread; Ctrl-C before its end ends the process.

    Python handles Ctrl-C only between two of its instructions, and one can be a render of hours.
    """
    if threading.current_thread() is not threading.main_thread():
        return work()
    executor, handler = ThreadPoolExecutor(1), signal.getsignal(signal.SIGINT)
    try:
        future = executor.submit(contextvars.copy_context().run, work)
        while wait([future], INTERVAL).not_done:
            if handler is not None:  # During a render, Mitsuba installs a handler that waits for the end of the render
                signal.signal(signal.SIGINT, handler)
    except KeyboardInterrupt:
        _abandon()
    executor.shutdown()
    try:
        return future.result()
    finally:
        del future  # An error's traceback would keep the objects of the work alive


if __name__ == "__main__":
    sys.exit(main())
