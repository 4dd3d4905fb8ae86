"""A sparse matrix times vectors, on any Dr.Jit backend."""

from __future__ import annotations

from typing import TYPE_CHECKING

import drjit as dr

from .array_types import ArrayTypes
from .types import FloatBuffer, Index, Mask, Value

if TYPE_CHECKING:
    from scipy import sparse


class SparseMatrix:
    """A sparse matrix on the device; not differentiable by itself.

    Parameters
    ----------
    matrix : (n, m) sparse array
    float_type : type
        Flat Dr.Jit array of the vectors, such as ``drjit.llvm.ad.Float``. Entries get its precision.
    is_relative : bool
        Whether rows sum to one. Then sums are taken relative to the first vector of each row, and lose fewer digits.
    """

    def __init__(self, matrix: sparse.csr_array, float_type: type, *, is_relative: bool) -> None:
        self._types = types = ArrayTypes.of(float_type)
        self._row_count = matrix.shape[0]
        self._is_relative = is_relative
        self._start, self._columns = types.indices(matrix.indptr), types.indices(matrix.indices)
        self._entries = types.floats(matrix.data)

    def __call__(self, flat: FloatBuffer, size: int = 3) -> FloatBuffer:
        """The product as the flat components of ``n`` vectors, from those of ``m`` vectors.

        Parameters
        ----------
        flat : flat array
        size : int
            Number of components, at most 4.
        """
        types = self._types
        vector = types.vector(size)
        row: Index = dr.arange(types.index, self._row_count)
        start: Index = dr.gather(types.index, self._start, row)
        end: Index = dr.gather(types.index, self._start, row + 1)
        zero: Value = dr.zeros(vector, self._row_count)

        def value(index: Index, active: Mask = True) -> Value:
            """The vector that an entry is multiplied by."""
            column: Index = dr.gather(types.index, self._columns, index, active)
            return dr.gather(vector, flat, column, active)

        origin = value(start, start < end) if self._is_relative else zero

        def add(index, total):
            entry = dr.gather(types.float, self._entries, index)
            return index + 1, dr.fma(value(index) - origin, entry, total)

        _, total = dr.while_loop((start, zero), lambda index, _: index < end, add, label="sparse_matrix")
        return dr.ravel(origin + total)
