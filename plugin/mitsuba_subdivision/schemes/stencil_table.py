"""Refined vertices as weighted sums of coarse vertices."""

from __future__ import annotations

from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from ..mesh import ragged
from ..mesh.connectivity import IntArray
from .domain import FloatArray

if TYPE_CHECKING:
    # Importing SciPy's sparse arrays takes 0.1 s and 20 MB, and local meshes do not need them.
    from scipy import sparse


class StencilTable:
    """Stencils of refined vertices, as a sparse table of weights.

    Parameters
    ----------
    row_count, column_count : int
        Number of vertices after the refinement, and before it.
    rows, columns : (n,) int
        For each entry, the refined vertex and the coarse vertex. Entries with the same row and column add up.
    weights : (n,) float64
        Weight of each entry. The weights of a row sum to one.
    """

    def __init__(
        self, row_count: int, column_count: int, rows: IntArray, columns: IntArray, weights: FloatArray
    ) -> None:
        self.row_count, self.column_count = row_count, column_count
        self.rows, self.columns, self.weights = rows, columns, weights

    @classmethod
    def of(cls, row_count: int, column_count: int, *entries: tuple[NDArray, NDArray, NDArray | float]) -> StencilTable:
        """Create a table from several (rows, columns, weights). Entries with the same row and column add up."""
        # int32 halves the memory, as faces with n corners have n² entries, and saves a conversion in `matrix`.
        is_short = max(row_count, column_count) <= np.iinfo(np.int32).max
        index_type = np.int32 if is_short else np.int64
        rows: IntArray = np.concatenate([rows for rows, _, _ in entries], dtype=index_type, casting="same_kind")
        columns: IntArray = np.concatenate(
            [columns for _, columns, _ in entries], dtype=index_type, casting="same_kind"
        )
        weights = np.concatenate([np.broadcast_to(weights, rows.shape) for rows, _, weights in entries])
        return cls(row_count, column_count, rows, columns, weights)

    @classmethod
    def from_matrix(cls, matrix: sparse.coo_array | sparse.csc_array | sparse.csr_array) -> StencilTable:
        """Create a table from the rows of a sparse array."""
        entries = matrix.tocoo()
        row_count, column_count = entries.shape
        return cls(row_count, column_count, entries.row, entries.col, entries.data)

    @cached_property
    def matrix(self) -> sparse.csr_array:
        """``(row_count, column_count)`` sparse array with a stencil in each row."""
        from scipy import sparse

        shape = self.row_count, self.column_count
        is_short = max(*shape, len(self.rows)) <= np.iinfo(np.int32).max
        rows, columns = (
            indices.astype(np.int32, copy=False) if is_short else indices for indices in (self.rows, self.columns)
        )
        return sparse.coo_array((self.weights, (rows, columns)), shape=shape).tocsr()

    def chosen(self, rows: IntArray) -> StencilTable:
        """Return the stencils of the refined vertices ``rows``, as a table with ``len(rows)`` rows."""
        order, first = self._by_row
        counts = np.diff(first)[rows]
        entries = order[ragged.ranges(first[rows], counts)]
        new_rows = np.repeat(np.arange(len(rows), dtype=self.rows.dtype), counts)
        return StencilTable(len(rows), self.column_count, new_rows, self.columns[entries], self.weights[entries])

    def only(self, rows: IntArray) -> StencilTable:
        """Return a table of the same size, without the entries of refined vertices not in ``rows``."""
        is_kept = np.zeros(self.row_count, dtype=bool)
        is_kept[rows] = True
        entries = np.flatnonzero(is_kept[self.rows])
        kept = self.rows[entries], self.columns[entries], self.weights[entries]
        return StencilTable(self.row_count, self.column_count, *kept)

    @cached_property
    def _by_row(self) -> tuple[IntArray, IntArray]:
        """Order of the entries sorted by row, and offsets of the rows in this order, see `ragged.offsets`."""
        first = ragged.offsets(np.bincount(self.rows, minlength=self.row_count))
        # NumPy sorts integers of up to 16 bits in linear time.
        return np.argsort(self.rows.astype(np.min_scalar_type(self.row_count)), kind="stable"), first

    def dense(self, rows: IntArray) -> FloatArray:
        """Return the stencils of the refined vertices ``rows``, ``(len(rows), column_count)``."""
        new_row = np.full(self.row_count, -1)
        new_row[rows] = np.arange(len(rows))
        # A row that occurs several times in ``rows`` is summed at its last index, and copied to the others.
        entry_row = new_row[self.rows]
        is_kept = entry_row >= 0
        flat = entry_row[is_kept] * self.column_count + self.columns[is_kept]
        sums = np.bincount(flat, self.weights[is_kept], minlength=len(rows) * self.column_count).astype(np.float64)
        return sums.reshape(-1, self.column_count)[new_row[rows]]
