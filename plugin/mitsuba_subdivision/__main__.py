"""The command line: ``mitsuba-subdivision`` or ``python -m mitsuba_subdivision``."""

from __future__ import annotations

import os
import signal
import sys
from collections.abc import Sequence

from .cage import CageWarning
from .commands.command_line import parsed
from .interruption import Abandoned, interruptible
from .messages import USER_ERRORS, flushed_output, print_error, print_remark, printed_warnings
from .whole_file import remove_unfinished

INTERRUPTED = 130


def main(arguments: Sequence[str] | None = None) -> int:
    """Run one command and return the exit status; after Ctrl-C, end the process if its work cannot be stopped."""
    with flushed_output():
        try:
            options = parsed(None if arguments is None else [*arguments])
            try:
                with printed_warnings(CageWarning):
                    return interruptible(lambda: options.run(options)) or 0
            except USER_ERRORS as error:
                print_error(error)
                return options.error_status
        except KeyboardInterrupt as stop:
            return _interrupted(stop)


def _interrupted(stop: KeyboardInterrupt) -> int:
    is_abandoned = isinstance(stop, Abandoned)
    if is_abandoned:
        signal.signal(signal.SIGINT, signal.SIG_IGN)
        remove_unfinished()
    print_remark("interrupted")
    if is_abandoned:
        os._exit(INTERRUPTED)
    return INTERRUPTED


if __name__ == "__main__":
    sys.exit(main())
