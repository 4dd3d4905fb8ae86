"""What the command line tells of wrong input, on standard error."""

from __future__ import annotations

import re
import sys
import warnings
from collections.abc import Iterator
from contextlib import contextmanager

PROGRAM = "mitsuba-subdivision"
# What a user's input can be wrong about; anything else is a mistake of ours and keeps its traceback.
USER_ERRORS = (ValueError, OSError, RuntimeError, MemoryError)

# Mitsuba puts the whole traceback of an error in a plugin into its own message.
_TRACEBACK = re.compile(r"Traceback \(most recent call last\):\n(?:[ \t].*\n)*(?:[\w.]+: )?")


def tell_error(error: BaseException) -> None:
    """Print an error, without tracebacks in its text."""
    print(f"{PROGRAM}: error: {_TRACEBACK.sub('', str(error)).strip()}", file=sys.stderr)


@contextmanager
def told_warnings(category: type[Warning]) -> Iterator[None]:
    """Print warnings of a category as they come, each time, and all warnings without a place in the code."""

    def show(message: Warning | str, *_place: object) -> None:
        print(f"{PROGRAM}: warning: {message}", file=sys.stderr)

    with warnings.catch_warnings():
        warnings.simplefilter("always", category)
        warnings.showwarning = show
        yield
