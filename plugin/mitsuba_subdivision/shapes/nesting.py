"""Bounds the nesting of shape constructors on one stack.

Mitsuba loads the shapes of a scene as tasks of Dr.Jit's thread pool. A thread that waits for Dr.Jit runs other tasks
meanwhile, on the same stack, in the order in which they were queued: all other shapes' constructors, before any kernel.
Waiting cannot be avoided, as `Mesh.parameters_changed` itself waits, for the mesh's bounding box. So each of a thousand
constructors would begin inside the one before. Here, a constructor that is nested too deeply runs in a thread of its
own, and its caller waits for that thread without running tasks.
"""

from __future__ import annotations

import threading
from collections.abc import Callable
from contextvars import copy_context
from functools import wraps
from typing import Any

# So many constructors may begin inside each other on one stack. Each takes 4 to 15 of the thousand frames that Python
# allows, and less than 8 kB of a stack that has half a megabyte at least.
DEEPEST = 32

_stack = threading.local()


def on_shallow_stack(function: Callable[..., None]) -> Callable[..., None]:
    """Run calls of a function in a new thread if `DEEPEST` of them are on this thread's stack already."""

    @wraps(function)
    def call(*arguments: Any) -> None:
        depth = getattr(_stack, "depth", 0)
        if depth >= DEEPEST:
            _in_own_thread(call, *arguments)
            return
        _stack.depth = depth + 1
        try:
            function(*arguments)
        finally:
            _stack.depth = depth

    return call


def _in_own_thread(function: Callable[..., None], *arguments: Any) -> None:
    errors: list[BaseException] = []

    def run() -> None:
        try:
            function(*arguments)
        except BaseException as error:
            errors.append(error)

    thread = threading.Thread(target=copy_context().run, args=(run,))
    thread.start()
    thread.join()
    if errors:
        # Nothing else keeps the error, which keeps the frames that it came through.
        raise errors.pop()
