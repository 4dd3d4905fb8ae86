"""Values of Mitsuba's objects, what threads must not do in them, and support of frozen functions (``@dr.freeze``).

A frozen function must know every array that it reads. Dr.Jit finds the arrays that are attributes of a Python shape,
but does not search objects of other classes. The first call records kernels, which later calls run without Python. So
while a function is recorded, values are neither read back nor checked, and all tables must already be on the device.
"""

from __future__ import annotations

import gc
import threading
import weakref
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from contextvars import copy_context
from functools import cache, wraps
from types import SimpleNamespace
from typing import Any

import drjit as dr
import numpy as np

from ..device_arrays import take_over
from ..kernels.array_types import FloatBuffer, arrays_in
from ..variants import Variant

# Maximum number of nested constructors on one stack. Each takes 4 to 15 of the thousand frames that Python allows, and
# less than 8 kB of a stack of at least half a megabyte.
DEEPEST = 32
_stack = threading.local()


@contextmanager
def paused_collection() -> Iterator[None]:
    """Pause the garbage collector; a context manager and a decorator.

    A collector that was disabled stays disabled. With overlapping threads, it is enabled again at the latest when all
    of them leave the context.
    """
    was_enabled = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if was_enabled:
            gc.enable()


def on_shallow_stack(function: Callable[..., None]) -> Callable[..., None]:
    """Decorate a constructor of shapes to run in a new thread if `DEEPEST` are already on this thread's stack.

    Mitsuba loads the shapes of a scene as tasks of Dr.Jit's thread pool. A thread that waits for Dr.Jit runs other
    queued tasks on the same stack: all constructors of other shapes, before any kernel. Waiting cannot be avoided, as
    `Mesh.parameters_changed` waits for the mesh's bounding box. So a thousand constructors would be nested in each
    other. The caller of one that runs in a new thread waits for this thread without running tasks.
    """

    @wraps(function)
    def call(*arguments: Any) -> None:
        depth = getattr(_stack, "depth", 0)
        if depth >= DEEPEST:
            with ThreadPoolExecutor(1) as thread:
                # Raises an error of the function, and keeps no reference to it.
                thread.submit(copy_context().run, call, *arguments).result()
            return
        _stack.depth = depth + 1
        try:
            function(*arguments)
        finally:
            _stack.depth = depth

    return call


class DeferredCollection:
    """Defers garbage collections from the first hit that a kernel traces to the launch of the kernel.

    A collection may free another scene. If one comes between two virtual function calls of a kernel, Dr.Jit numbers the
    instances of the second call anew, and may define a function twice, which ends the process. Python collects once
    the number of new objects exceeds a threshold. A step of prb leaves many more with hits that are traced in Python
    than with those of `mi.Mesh`. So the count starts again after each hit: the threshold is raised until the next
    collection, or until the first hit after a launch.
    """

    # Bound on the raised threshold, relative to the one of the user: hits may be traced without ever being evaluated.
    MOST = 100

    def __init__(self) -> None:
        self._launches, self._threshold, self._raised = -1, 0, 0
        gc.callbacks.append(self._on_collection)

    @contextmanager
    def while_tracing(self) -> Iterator[None]:
        """Pause the collector while a hit is traced, and defer it afterwards; a context manager."""
        launches, *_ = dr.detail.launch_stats()
        if launches != self._launches and not is_recording():
            # A collection that is due comes now, before anything else is traced.
            self._restore()
        self._launches = launches
        with paused_collection():
            yield
            threshold, *others = gc.get_threshold()
            if threshold != self._raised:
                self._threshold = threshold
            if self._threshold:
                self._raised = min(gc.get_count()[0], self.MOST * self._threshold) + self._threshold
                gc.set_threshold(self._raised, *others)

    def _restore(self) -> None:
        threshold, *others = gc.get_threshold()
        # Unless the user has set another threshold meanwhile.
        if threshold == self._raised:
            gc.set_threshold(self._threshold, *others)
        self._raised = 0

    def _on_collection(self, phase: str, _info: dict[str, int]) -> None:
        if phase == "start":
            self._restore()


def is_recording() -> bool:
    """Whether a frozen function is being recorded, when values of arrays cannot be read."""
    return bool(dr.flag(dr.JitFlag.FreezingScope))


def flat_type(variant: Variant) -> type:
    """Type of a parameter that is a flat array of numbers; Mitsuba has none in scalar variants."""
    return variant.Float if dr.is_jit_v(variant.Float) else dr.scalar.ArrayXf


def traversed(
    variant: Variant,
    traverse: Callable[[Any], None],  # Bound method of an object, such as ``mesh.traverse``
) -> list[tuple[str, Any, Any]]:
    """Parameters that a Mitsuba object exposes to `traverse`: name, value, and the type of C++ members.

    The functions ``get_property`` and ``set_property`` of the variant read and assign such values, while the object is
    alive.
    """
    callback = _collector(variant)()
    traverse(callback)
    return callback.shown


@cache
def _collector(variant: Variant) -> type:
    class Collector(variant.TraversalCallback):
        """Collects these parameters."""

        def __init__(self) -> None:
            super().__init__()
            self.shown: list[tuple[str, Any, Any]] = []

        def put(self, name: str, value: Any, _flags: int, cpp_type: Any = None) -> None:
            self.shown.append((name, value, cpp_type))

    return Collector


def require_values(
    values: FloatBuffer,  # Flat values of a parameter
    count: int,
    size: int,  # Number of components of a value
    kind: str,  # Noun for a value in messages
    *,
    are_new: bool = True,  # Whether they may be others than before
) -> None:
    """Check the number of values, and that new ones are finite; move these to Dr.Jit's memory. Raises ValueError."""
    if dr.width(values) != count * size:
        raise ValueError(f"{dr.width(values)} numbers; expected {count * size}, {size} for each of {count} {kind}s")
    if is_recording() or not are_new:
        return
    take_over(values)
    rows = np.array(dr.detach(values)).reshape(count, size)
    invalid = np.flatnonzero(~np.isfinite(rows).all(axis=1))
    if invalid.size:
        first = ", ".join(map(str, rows[invalid[0]].tolist()))
        raise ValueError(f"{kind} {invalid[0]} is ({first}); expected finite numbers ({len(invalid)} such in all)")


class DeviceState:
    """Exposes all arrays of a shape, including those of its attributes, to Dr.Jit. Each shape keeps one."""

    def __init__(
        self,
        shape: Any,  # Only a weak reference is stored
    ) -> None:
        self._shape = weakref.ref(shape)
        # Whether a frozen function has seen the arrays. It continues to read tables in NumPy's memory, which must not
        # change.
        self.is_frozen = False

    # Freeing a scene during a call of a frozen function ends the process.
    @paused_collection()
    def _traverse_1_cb_ro(self, callback: Callable[..., Any]) -> None:
        dr.detail.traverse_py_cb_ro(self._arrays(), callback)

    @paused_collection()
    def _traverse_1_cb_rw(self, callback: Callable[..., Any]) -> None:
        dr.detail.traverse_py_cb_rw(self._arrays(), callback)

    def _arrays(self) -> SimpleNamespace:
        self.is_frozen, shape = True, self._shape()
        return SimpleNamespace(arrays=[] if shape is None else arrays_in(vars(shape), {id(self)}))
