"""The Dr.Jit array types of a backend and a precision, the layout of arrays of vectors, and names for annotations.

The classes of arrays depend on the backend and the precision, and are known at run time only, see `ArrayTypes`. An
array has a number or a vector for each lane; inactive lanes read zeros and write nothing.
"""

from __future__ import annotations

import gc
import sys
import threading
from collections.abc import Callable
from functools import cache, wraps
from typing import Any
from weakref import WeakKeyDictionary, ref

import drjit as dr
import numpy as np
from numpy.typing import NDArray

from ..device_arrays import mapped
from ..llvm import require_llvm
from ..mesh.shared import SharedArray

# A real number: a parameter u or v, a distance, a weight.
Float = Any
# An unsigned 32-bit integer, counted from 0, or four of them: a half-edge, a row of a table.
Index = Any
Index4 = Any
Mask = Any
# Parameters (u, v); a point, a direction or a normal, in `algebra` also a list of three arrays; a packet of a table.
Vector2 = Any
Vector3 = Any
# A 4x4 matrix of Dr.Jit or NumPy, which multiplies points as columns.
Matrix4 = Any
# A value of a surface or of a channel, or its derivative: a number, or a vector of two or three components.
Value = Any
# Numbers or indices in memory, independent of lanes, such as x, y, z of each point. NumPy arrays in scalar variants.
FloatBuffer = Any
IndexBuffer = Any
# An object with an origin ``o`` and a direction ``d``, such as Mitsuba's rays.
Ray = Any

# Mode of scatters to distinct indices. With other modes, Dr.Jit runs a kernel before each further scatter to an array.
NO_CONFLICTS = dr.ReduceMode.NoConflicts
# Mode of sums: by default, what Dr.Jit 1.5 records with one thread and runs again with more writes beyond small arrays.
SUMS = dr.ReduceMode.Local

# Arrays that each thread has computed, by `LaterArrays`.
_of_thread = threading.local()
# Prefixes of modules whose objects contain Dr.Jit arrays.
_PACKAGE = __name__.partition(".")[0]
_PACKAGES = (f"{_PACKAGE}.kernels.", f"{_PACKAGE}.shapes.")
_ARRAY = object()
# Held while a method is `replayed`.
_replaying = threading.Lock()


def replayed(method: Callable[..., Any]) -> Callable[..., Any]:
    """Decorate a method to record its kernels, and to run these again without tracing, which takes far longer.

    For methods of arrays without derivatives, whose results depend on nothing else but the arrays of the object. A
    method that is called within another one, within a frozen function, or outside the main thread, is traced. So is the
    first call of an object: at loading it is the only one, and recording takes longer than tracing.
    """

    @wraps(method)
    def call(self: Any, *arguments: Any) -> Any:
        is_main = threading.current_thread() is threading.main_thread()
        recordings = vars(self).setdefault("_recordings", {})
        is_traced = method not in recordings or not is_main or dr.flag(dr.JitFlag.FreezingScope)
        if is_traced or not _replaying.acquire(blocking=False):
            recordings.setdefault(method)
            return method(self, *arguments)
        was_enabled = gc.isenabled()
        try:
            # Freeing a scene while a function is recorded ends the process.
            gc.disable()
            if recordings[method] is None:
                # Without a reference cycle: objects that the collector frees may end the process later.
                this = ref(self)
                recording = dr.freeze(lambda _, *arguments: method(this(), *arguments))
                recordings[method] = recording, arrays_in(vars(self), set())
            recording, arrays = recordings[method]
            return recording(arrays, *arguments)
        finally:
            _replaying.release()
            if was_enabled:
                gc.enable()

    return call


def arrays_in(value: Any, seen: set[int]) -> list[Any]:
    """The Dr.Jit arrays in a value, in containers, and in objects of kernels and shapes, each once.

    Frozen functions ask each shape eight times for each call.
    """
    found, rest = [], [value]
    while rest:
        value = rest.pop()
        kind: Any = type(value)
        contents = _contents(kind)
        if contents is not None and id(value) not in seen:
            seen.add(id(value))
            if contents is _ARRAY:
                found.append(value)
            else:
                rest.extend(contents(value))
    return found


@cache
def _contents(kind: type) -> Any:
    """Function for the contents of objects of a class; `_ARRAY` for Dr.Jit arrays, and None for all other classes."""
    if dr.is_array_v(kind):
        return _ARRAY if dr.is_jit_v(kind) else None
    if issubclass(kind, dict):
        return dict.values
    if issubclass(kind, (list, tuple)):
        return iter
    if issubclass(kind, SharedArray) or (kind.__module__.startswith(_PACKAGES) and kind.__dictoffset__):
        later = getattr(kind, "UPLOADED_LATER", ())
        return lambda value: [*(getattr(value, name) for name in later), *vars(value).values()]
    return None


class LaterArrays:
    """A shared value that computes its arrays at their first use in each thread, until they are `settled`.

    Kernels of a thread do not wait for those of another, and waiting would begin other work that Dr.Jit has queued.
    """

    # Without `__dict__`, so that Dr.Jit does not traverse it as a shape's state.
    __slots__ = ("__weakref__", "_settled")

    def __init__(self) -> None:
        self._settled: Any = None

    def settled(self) -> Any:
        """The arrays that all threads use from now on. All kernels of this thread must have ended."""
        own = _of_thread.__dict__.get("arrays", {}).pop(self, None)
        if self._settled is None:
            self._settled = own
        return self._settled

    def get(self, compute: Callable[[], Any]) -> Any:
        """Return the arrays; the first call in a thread computes them."""
        if self._settled is not None:
            return self._settled
        computed = _of_thread.__dict__.setdefault("arrays", WeakKeyDictionary())
        if self not in computed:
            computed[self] = compute()
            dr.eval(computed[self])
        return computed[self]


class ArrayTypes:
    """Types of the same backend and precision as a flat array, such as ``drjit.llvm.ad.Float``.

    Raises RuntimeError if kernels of the backend would end the process.
    """

    def __init__(self, float_type: type) -> None:
        if dr.backend_v(float_type) == dr.JitBackend.LLVM:
            require_llvm()
        self.is_double = bool(dr.type_v(float_type) == dr.VarType.Float64)
        self.numpy_float: type = np.float64 if self.is_double else np.float32
        # Error of the difference of two points, relative to their coordinates: some units in the last place (ulp)
        self.rounding = 2.0**-50 if self.is_double else 2.0**-21
        arrays, suffix = sys.modules[float_type.__module__], "64" if self.is_double else ""
        self.float, self.index, self.index64 = float_type, arrays.UInt32, arrays.UInt64
        self.vector2, self.vector3, self.vector4, self._many = (
            getattr(arrays, f"Array{size}f{suffix}") for size in "234X"
        )
        self.index2, self.index4, self.matrix4 = arrays.Array2u, arrays.Array4u, getattr(arrays, f"Matrix4f{suffix}")

    def vector(self, size: int) -> type:
        """The type of vectors of 2, 3 or 4 components; for size 1, the type of numbers."""
        return (self.float, self.vector2, self.vector3, self.vector4)[size - 1]

    def indices(self, *parts: NDArray[np.integer]) -> IndexBuffer:
        """Upload integer arrays, flattened and concatenated."""
        return mapped(self.index, *parts)

    def floats(self, values: NDArray[np.floating]) -> FloatBuffer:
        """Upload an array of numbers, flattened."""
        return mapped(self.float, values)

    def converted(self, kind: type, values: Any) -> Any:
        """Convert a user's values to one of these types; a NumPy array of vectors has a row for each component."""
        return mapped(kind, values.T) if isinstance(values, np.ndarray) else kind(values)

    def row(self, buffer: FloatBuffer, size: int, index: Index, active: Mask = True) -> list[Float]:
        """Gather a row of ``size`` numbers, at least two, from an array of such rows.

        Uses one operation, which reads the largest packets that the backend supports.
        """
        return [*dr.gather(self._many, buffer, index, active, shape=(size, dr.width(index)))]

    def padded(self, flat: FloatBuffer) -> FloatBuffer:
        """Pad flat 3-vectors to packets of four components."""
        return dr.ravel(self.vector4(*dr.unravel(self.vector3, flat), 0))

    def unpadded(self, padded: FloatBuffer, count: int) -> FloatBuffer:
        """The first ``count`` padded 3-vectors, flat and without padding."""
        return dr.ravel(self.packet(padded, dr.arange(self.index, count)))

    def packet(self, padded: FloatBuffer, index: Index) -> Vector3:
        """Gather a padded 3-vector."""
        x, y, z, _ = dr.gather(self.vector4, padded, index)
        return self.vector3(x, y, z)

    def gathered(self, flat: FloatBuffer, index: IndexBuffer) -> FloatBuffer:
        """Gather flat 3-vectors at given indices; differentiable, forward and backward."""
        return dr.ravel(dr.gather(self.vector3, flat, index))


def float_type_of(
    variant: str,  # Such as "llvm_ad_rgb"
) -> type:
    """The flat float array type of a variant of Mitsuba.

    Raises ValueError if the variant is scalar, or its backend is unknown.
    """
    backend, *features = variant.split("_")
    if backend not in ("llvm", "cuda"):
        raise ValueError(f'variant "{variant}"; expected one of Mitsuba\'s for arrays, which begin with llvm or cuda')
    arrays = getattr(dr, backend)
    if "ad" in features:
        arrays = arrays.ad
    return arrays.Float64 if "double" in features else arrays.Float
