"""The Dr.Jit array types of a backend and a precision, the layout of arrays of vectors, and names for annotations.

The classes of arrays depend on the backend and the precision, and are known at run time only, see `ArrayTypes`. An
array has a number or a vector for each lane. Scalar variants have one lane, and their numbers are Python's float, int
and bool. Annotations use these names:

Float
    A real number: a parameter u or v, a distance, a weight.
Index
    An unsigned 32-bit integer, counted from 0: a half-edge, an element, a row of a table.
Mask
    A truth value. Inactive lanes read zeros and write nothing.
Vector2, Vector3, Vector4
    For example parameters (u, v); a point, a direction or a normal, in `vectors` also a list of three arrays; a packet
    of four numbers of a table.
Index4
    Four indices, such as a row of `PieceTable.half_edges` or `PieceTable.nodes`.
Matrix4
    A 4x4 matrix of Dr.Jit or NumPy, which multiplies points as columns.
Value
    A value of a surface or of a channel, or its derivative: a number, or a vector of two or three components.
FloatBuffer, IndexBuffer
    Numbers or indices in memory, independent of the lanes, such as x, y, z of each point. NumPy arrays in scalar
    variants.
Ray
    An object with an origin ``o`` and a direction ``d``, such as Mitsuba's rays.
"""

from __future__ import annotations

import sys
from dataclasses import dataclass
from functools import cached_property
from types import ModuleType
from typing import Any
from typing import Any as Float
from typing import Any as FloatBuffer
from typing import Any as Index
from typing import Any as Index4
from typing import Any as IndexBuffer
from typing import Any as Mask
from typing import Any as Matrix4
from typing import Any as Ray
from typing import Any as Value
from typing import Any as Vector2
from typing import Any as Vector3
from typing import Any as Vector4

import drjit as dr
import numpy as np
from numpy.typing import NDArray

from ..device_arrays import mapped
from ..llvm import require_llvm
from ..mesh.shared import Content, Shared, SharedArray

# Mode of scatters to distinct indices. With other modes, Dr.Jit runs a kernel before each further scatter to an array.
NO_CONFLICTS = dr.ReduceMode.NoConflicts
_UPLOADED: Shared[SharedArray] = Shared()


@dataclass(frozen=True)
class ArrayTypes:
    """Types of one backend and precision."""

    # ``index``, ``index2`` and ``index4`` are unsigned 32-bit integers and vectors of these
    float: type
    index: type
    vector2: type
    vector3: type
    vector4: type
    index2: type
    index4: type

    @cached_property
    def is_double(self) -> bool:
        """Whether floats have 64 bits."""
        return bool(dr.type_v(self.float) == dr.VarType.Float64)

    @property
    def numpy_float(self) -> type:
        """The NumPy type of the same precision."""
        return np.float64 if self.is_double else np.float32

    @classmethod
    def of(cls, float_type: type) -> ArrayTypes:
        """The types of the same backend and precision as a flat array, such as ``drjit.llvm.ad.Float``.

        Raises RuntimeError if kernels of the backend would end the process.
        """
        if dr.backend_v(float_type) == dr.JitBackend.LLVM:
            require_llvm()
        arrays = sys.modules[float_type.__module__]
        suffix = "64" if dr.type_v(float_type) == dr.VarType.Float64 else ""
        vector2, vector3, vector4 = (getattr(arrays, f"Array{size}f{suffix}") for size in (2, 3, 4))
        return cls(float_type, arrays.UInt32, vector2, vector3, vector4, arrays.Array2u, arrays.Array4u)

    @property
    def _module(self) -> ModuleType:
        """The Dr.Jit module of the types."""
        return sys.modules[self.float.__module__]

    @property
    def _many(self) -> type:
        """Vectors of any number of floats."""
        return self._module.ArrayXf64 if self.is_double else self._module.ArrayXf

    @property
    def index64(self) -> type:
        """Unsigned 64-bit integers."""
        return self._module.UInt64

    @property
    def matrix4(self) -> type:
        """4x4 matrices."""
        return self._module.Matrix4f64 if self.is_double else self._module.Matrix4f

    def vector(self, size: int) -> type:
        """The type of vectors of 2, 3 or 4 components; for size 1, the type of numbers."""
        return (self.float, self.vector2, self.vector3, self.vector4)[size - 1]

    def indices(self, *parts: NDArray[np.integer]) -> IndexBuffer:
        """Upload integer arrays, flattened and concatenated."""
        return mapped(self.index, *parts)

    def floats(self, values: NDArray[np.floating]) -> FloatBuffer:
        """Upload an array of numbers, flattened."""
        return mapped(self.float, values)

    def shared_floats(self, values: NDArray[np.floating]) -> SharedArray:
        """Upload an array of numbers, flattened. Equal arrays share their memory while one is referenced."""
        # Copied to memory of Dr.Jit, as frozen functions may replace the array.
        return _UPLOADED.get((self.float, Content(values)), lambda: SharedArray(dr.opaque(self.floats(values))))

    def converted(self, kind: type, values: Any) -> Any:
        """Convert a user's values to one of these types; a NumPy array of vectors has a row for each component."""
        return mapped(kind, values.T) if isinstance(values, np.ndarray) else kind(values)

    def fetch(
        self,
        kind: type,  # One of the attributes. Components of a vector are consecutive in memory.
        buffer: FloatBuffer | IndexBuffer,
        index: Index,
        active: Mask = True,  # Inactive lanes read zero
    ) -> Any:
        """Gather a number or a vector from an array that `indices` or `floats` uploaded."""
        return dr.gather(kind, buffer, index, active)

    def row(self, buffer: FloatBuffer, size: int, index: Index, active: Mask = True) -> list[Float]:
        """Gather a row of ``size`` numbers, at least two, from an array of such rows.

        Uses one operation, which reads the largest packets that the backend supports.
        """
        return [*dr.gather(self._many, buffer, index, active, shape=(size, dr.width(index)))]

    def padded(self, flat: FloatBuffer) -> FloatBuffer:
        """Pad flat 3-vectors to packets of four components."""
        v: Vector3 = dr.unravel(self.vector3, flat)
        return dr.ravel(self.vector4(v.x, v.y, v.z, 0))

    def unpadded(self, padded: FloatBuffer, count: int) -> FloatBuffer:
        """The first ``count`` padded 3-vectors, flat and without padding."""
        v: Vector3 = dr.gather(self.vector4, padded, dr.arange(self.index, count))
        return dr.ravel(self.vector3(v.x, v.y, v.z))

    def packet(self, padded: FloatBuffer, index: Index, active: Mask = True) -> Vector3:
        """Fetch a padded 3-vector."""
        value = self.fetch(self.vector4, padded, index, active)
        return self.vector3(value.x, value.y, value.z)

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


__all__ = [
    "Float",
    "FloatBuffer",
    "Index",
    "Index4",
    "IndexBuffer",
    "Mask",
    "Matrix4",
    "Ray",
    "Value",
    "Vector2",
    "Vector3",
    "Vector4",
]
