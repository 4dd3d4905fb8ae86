"""Restores Python errors that pass through Mitsuba and Dr.Jit.

Dr.Jit raises ``RuntimeError`` from every error that passes through its loops, custom operations and derivatives,
interruptions among them.
"""

from __future__ import annotations

import sys
import traceback
from collections.abc import Iterator
from types import FrameType
from typing import Any

_LIBRARIES = ("mitsuba", "drjit")


def _causes(error: BaseException | None) -> Iterator[BaseException]:
    """An error and its chain of causes."""
    seen: list[BaseException] = []
    while error is not None and error not in seen:
        seen.append(error)
        yield error
        error = error.__cause__ or error.__context__


def origin(error: BaseException) -> BaseException:
    """The error that Dr.Jit has raised ``RuntimeError`` from; the error itself if Dr.Jit did not raise it."""
    while type(error) is RuntimeError and error.__cause__ is not None:
        error = error.__cause__
    return error


def clear_frames(error: BaseException) -> None:
    """Forget the local variables of the functions that an error has ended."""
    for each in _causes(error):
        traceback.clear_frames(each.__traceback__)


def raise_itself(error: BaseException, frame: FrameType | None) -> None:
    """Raise an error itself in the user's code that called Mitsuba, instead of one that was raised from it.

    This uses the trace function: under a debugger, which needs it too, the other error is raised.

    Parameters
    ----------
    error : exception
        About to be raised through C++.
    frame : frame, or None
        Frame that called C++; None in threads that Python did not start.
    """
    caller = _caller(frame)
    if caller is None or sys.gettrace() is not None:
        return

    errors = [error]

    def look(_: FrameType, event: str, argument: Any) -> None:
        # Called for the error, or for the next line if the caller has handled it.
        sys.settrace(None)
        caller.f_trace = None
        error = errors.pop()
        try:
            if event == "exception" and argument[1] is not error and error in _causes(argument[1]):
                raise error
        finally:
            # Its traceback has this frame.
            del error, argument

    caller.f_trace = look
    sys.settrace(lambda *_: None)


def _caller(frame: FrameType | None) -> FrameType | None:
    """The frame outside all those of Mitsuba and Dr.Jit."""
    caller = frame
    while frame is not None:
        if frame.f_globals.get("__name__", "").partition(".")[0] in _LIBRARIES:
            caller = frame.f_back
        frame = frame.f_back
    return caller
