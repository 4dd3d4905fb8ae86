"""A sparse matrix times 3-vectors, on any Dr.Jit backend."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import drjit as dr

from .array_types import ArrayTypes

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
        Whether rows sum to one, so that sums can be relative to the first vector of each row.
    """

    def __init__(self, matrix: sparse.csr_array, float_type: type, *, is_relative: bool) -> None:
        types = ArrayTypes.of(float_type)
        self._vector3, self._index = types.vector3, types.index
        self._row_count = matrix.shape[0]
        self._is_relative = is_relative
        self._start, self._columns = types.indices(matrix.indptr), types.indices(matrix.indices)
        self._entries = float_type(matrix.data)
        self._float = float_type

    def __call__(self, flat: Any) -> Any:
        """Flat x, y, z of the product from those of ``m`` vectors."""
        row = dr.arange(self._index, self._row_count)
        start, end = dr.gather(self._index, self._start, row), dr.gather(self._index, self._start, row + 1)
        zero = dr.zeros(self._vector3, self._row_count)
        origin = self._vector(flat, start, start < end) if self._is_relative else zero

        def add(place, total):
            entry = dr.gather(self._float, self._entries, place)
            return place + 1, dr.fma(self._vector(flat, place) - origin, entry, total)

        _, total = dr.while_loop((start, zero), lambda place, _: place < end, add, label="sparse_matrix")
        return dr.ravel(origin + total)

    def _vector(self, flat: Any, place: Any, active: Any = True) -> Any:
        column = dr.gather(self._index, self._columns, place, active)
        return dr.gather(self._vector3, flat, column, active)
