"""Refined vertices as weighted sums of the vertices before."""

from __future__ import annotations

from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from ..mesh import ragged
from ..mesh.connectivity import IntArray
from .domain import FloatArray

if TYPE_CHECKING:
    # SciPy's sparse arrays take a tenth of a second and 20 MB to import, and local meshes do without them.
    from scipy import sparse


class StencilTable:
    """Stencils of refined vertices, as a sparse table of weights.

    Parameters
    ----------
    row_count, column_count : int
        Number of vertices after the refinement, and before it.
    rows, columns : (n,) int
        For each entry, the refined vertex and the vertex before that it weights. Entries with the same two add up.
    weights : (n,) float64
        The entries' weights. Those of a row sum to one.
    """

    def __init__(
        self, row_count: int, column_count: int, rows: IntArray, columns: IntArray, weights: FloatArray
    ) -> None:
        self.row_count, self.column_count = row_count, column_count
        self.rows, self.columns, self.weights = rows, columns, weights

    @classmethod
    def of(cls, row_count: int, column_count: int, *entries: tuple[NDArray, NDArray, NDArray | float]) -> StencilTable:
        """Make a table of several (rows, columns, weights). Entries with the same row and column add up."""
        # Faces of n corners have stencils of n² entries: half of the memory, and of what `matrix` would convert.
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
        """Make a table of the rows of a sparse array."""
        entries = matrix.tocoo()
        row_count, column_count = entries.shape
        return cls(row_count, column_count, entries.row, entries.col, entries.data)

    @cached_property
    def matrix(self) -> sparse.csr_array:
        """``(row_count, column_count)`` stencils as the rows of a sparse array."""
        from scipy import sparse

        shape = self.row_count, self.column_count
        is_short = max(*shape, len(self.rows)) <= np.iinfo(np.int32).max
        rows, columns = (each.astype(np.int32, copy=False) if is_short else each for each in (self.rows, self.columns))
        return sparse.coo_array((self.weights, (rows, columns)), shape=shape).tocsr()

    def chosen(self, rows: IntArray) -> StencilTable:
        """Stencils of some refined vertices, as a table of as many rows."""
        order, first = self._by_row
        counts = np.diff(first)[rows]
        entries = order[ragged.ranges(first[rows], counts)]
        own = np.repeat(np.arange(len(rows), dtype=self.rows.dtype), counts)
        return StencilTable(len(rows), self.column_count, own, self.columns[entries], self.weights[entries])

    def only(self, rows: IntArray) -> StencilTable:
        """The same stencils of some refined vertices, without weights of the others."""
        is_kept = np.zeros(self.row_count, dtype=bool)
        is_kept[rows] = True
        own = np.flatnonzero(is_kept[self.rows])
        kept = self.rows[own], self.columns[own], self.weights[own]
        return StencilTable(self.row_count, self.column_count, *kept)

    @cached_property
    def _by_row(self) -> tuple[IntArray, IntArray]:
        """Entries sorted by their rows, and where those of each row begin, and after them, where the last ends."""
        first = ragged.offsets(np.bincount(self.rows, minlength=self.row_count))
        # Few bits sort in linear time.
        return np.argsort(self.rows.astype(np.min_scalar_type(self.row_count)), kind="stable"), first

    def dense(self, rows: IntArray) -> FloatArray:
        """Stencils of some refined vertices, ``(len(rows), column_count)``."""
        number = np.full(self.row_count, -1)
        number[rows] = np.arange(len(rows))
        # A row that is wanted twice is summed at the last of its places, and copied to the others.
        kept = number[self.rows]
        own = kept >= 0
        flat = kept[own] * self.column_count + self.columns[own]
        sums = np.bincount(flat, self.weights[own], minlength=len(rows) * self.column_count).astype(np.float64)
        return sums.reshape(-1, self.column_count)[number[rows]]
