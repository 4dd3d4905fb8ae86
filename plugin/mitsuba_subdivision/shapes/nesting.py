"""Limits the nesting of shape constructors on one stack.

Mitsuba loads the shapes of a scene as tasks of Dr.Jit's thread pool. A thread that waits for Dr.Jit runs other queued
tasks on the same stack: all constructors of other shapes, before any kernel. Waiting cannot be avoided, because
`Mesh.parameters_changed` waits for the mesh's bounding box. So a thousand constructors would be nested in each other.
Here, a constructor that would be nested too deeply runs in a new thread, and its caller waits for this thread without
running tasks.
"""

from __future__ import annotations

import threading
from collections.abc import Callable
from contextvars import copy_context
from functools import wraps
from typing import Any

# Maximum number of nested constructors on one stack. Each takes 4 to 15 of the thousand frames that Python allows, and
# less than 8 kB of a stack of at least half a megabyte.
DEEPEST = 32

_stack = threading.local()


def on_shallow_stack(function: Callable[..., None]) -> Callable[..., None]:
    """Decorate a function to run in a new thread if `DEEPEST` calls are already on this thread's stack."""

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
        # Remove the last reference to the error, whose traceback keeps its frames alive.
        raise errors.pop()
