"""Control values on the device: products with sparse matrices, and arrays that kernels gather from."""

from __future__ import annotations

from collections.abc import Callable, Hashable
from functools import cached_property
from typing import TYPE_CHECKING

import drjit as dr
import numpy as np

from ..mesh.shared import Content, LaterArray, Shared
from .array_types import ArrayTypes, FloatBuffer, Index, Mask, Value

if TYPE_CHECKING:
    from numpy.typing import NDArray
    from scipy import sparse

_MADE: Shared[LaterArray] = Shared()


class WeightedValues:
    """Product of sparse weights and values; differentiable, forward and backward."""

    # Properties that upload arrays at their first use; see `shapes.device_state`.
    UPLOADED_LATER = ("product", "transposed")

    def __init__(
        self,
        weights: sparse.csr_array,  # (n, m) sparse array: rows sum to one
        float_type: type,  # Flat Dr.Jit array of the values; weights have its precision
    ) -> None:
        self._weights, self._float = weights, float_type

    @classmethod
    def shared(cls, weights: sparse.csr_array, float_type: type) -> WeightedValues:
        """The object of given weights; equal weights share it while it is referenced."""
        key = float_type, *map(Content, (weights.data, weights.indices, weights.indptr)), weights.shape
        return _WEIGHTED.get(key, lambda: cls(weights, float_type))

    def __call__(self, values: FloatBuffer, size: int) -> FloatBuffer:
        """Weighted values of ``size`` components, flat."""
        return dr.custom(_Product, self, values, size)

    @cached_property
    def product(self) -> SparseMatrix:
        """Product with the weights, not differentiable."""
        return SparseMatrix(self._weights, self._float, is_relative=True)

    @cached_property
    def transposed(self) -> SparseMatrix:
        """Product with the transposed weights, not differentiable."""
        return SparseMatrix(self._weights.T.tocsr(), self._float, is_relative=False)


class _Product(dr.CustomOp):
    """A linear map: forward mode applies the same map, reverse mode its transpose."""

    def eval(self, weighted, values, size):
        self.weighted, self.size = weighted, size
        return weighted.product(values, size)

    def forward(self):
        self.set_grad_out(self.weighted.product(self.grad_in("values"), self.size))

    def backward(self):
        self.set_grad_in("values", self.weighted.transposed(self.grad_out(), self.size))

    def name(self):
        return "WeightedValues"


class ControlValues:
    """Mutable values that kernels gather by index."""

    def __init__(
        self,
        values: NDArray[np.floating],  # (n, k) float64: values of the cage
        types: ArrayTypes,
        # Computes the values to gather from those of the cage, both flat. The default is the identity.
        make: Callable[[FloatBuffer], FloatBuffer] | None = None,
        # Key of ``make``. Objects with equal keys and equal values share the result of ``make`` until `set` is called.
        key: Hashable = None,
    ) -> None:
        self._types, self.size, self._make = types, values.shape[1], make
        # Never replaced, because other objects may hold a reference to the array.
        self.flat: FloatBuffer = types.float()
        # A reference that keeps the shared upload of equal values alive.
        self._given = types.shared_floats(values)
        shared = LaterArray() if key is None else _MADE.get((key, self._given), LaterArray)
        self._shared: LaterArray | None = shared
        self.flat[:] = shared.get(lambda: self._made(self._given.array))

    def set(self, values: FloatBuffer) -> None:
        """Set values of the cage, flat. Later lookups are attached to them."""
        self.flat[:] = self._made(values)
        self._shared = None

    def _made(self, values: FloatBuffer) -> FloatBuffer:
        control_values = values if self._make is None else self._make(values)
        # Dr.Jit compiles literals into kernels.
        dr.make_opaque(control_values)
        return control_values

    @property
    def are_moving(self) -> bool:
        """Whether the values are differentiated."""
        return bool(dr.grad_enabled(self.flat))

    def fetch(self, index: Index, active: Mask = True) -> Value:
        """Gather the value at an index; zero in inactive lanes."""
        return self._types.fetch(self._types.vector(self.size), self.flat, index, active)


_WEIGHTED: Shared[WeightedValues] = Shared()


class SparseMatrix:
    """Sparse matrix on the device; its product is not differentiable."""

    def __init__(
        self,
        matrix: sparse.csr_array,  # (n, m) sparse array
        float_type: type,  # Flat Dr.Jit array of the vectors, such as `drjit.llvm.ad.Float`; entries have its precision
        *,
        # Whether rows sum to one. Sums are then relative to the first vector of each row, which reduces rounding
        # errors.
        is_relative: bool,
    ) -> None:
        self._types = types = ArrayTypes.of(float_type)
        self._row_count = matrix.shape[0]
        self._is_relative = is_relative
        self._start, self._columns = types.indices(matrix.indptr), types.indices(matrix.indices)
        self._entries = types.floats(matrix.data)

    def __call__(
        self,
        flat: FloatBuffer,
        size: int = 3,  # Number of components, at most 4
    ) -> FloatBuffer:
        """Multiply ``m`` vectors by the matrix; returns ``n`` vectors, both flat."""
        types = self._types
        vector = types.vector(size)
        row: Index = dr.arange(types.index, self._row_count)
        start: Index = dr.gather(types.index, self._start, row)
        end: Index = dr.gather(types.index, self._start, row + 1)
        zero: Value = dr.zeros(vector, self._row_count)

        def value(index: Index, active: Mask = True) -> Value:
            """The vector that an entry of the matrix is multiplied by."""
            column: Index = dr.gather(types.index, self._columns, index, active)
            return dr.gather(vector, flat, column, active)

        origin = value(start, start < end) if self._is_relative else zero

        def add(index, total):
            entry = dr.gather(types.float, self._entries, index)
            return index + 1, dr.fma(value(index) - origin, entry, total)

        _, total = dr.while_loop((start, zero), lambda index, _: index < end, add, label="sparse_matrix")
        return dr.ravel(origin + total)
