"""Refined vertices as weighted sums of the vertices before."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from ..mesh.connectivity import IntArray
from .domain import FloatArray

if TYPE_CHECKING:
    # It takes a tenth of a second and 20 MB to import, and local meshes do without.
    from scipy import sparse


@dataclass(frozen=True, eq=False)
class StencilTable:
    """Stencils of refined vertices, entry by entry.

    Attributes
    ----------
    row_count, column_count : int
        Vertices after and before.
    rows, columns : (n,) int
        The refined vertex that each entry adds to, and the vertex that it takes a part of. Entries may share both.
    weights : (n,) float64
        Those of a row sum to one.
    """

    row_count: int
    column_count: int
    rows: IntArray
    columns: IntArray
    weights: FloatArray

    @classmethod
    def of(cls, row_count: int, column_count: int, *entries: tuple[NDArray, NDArray, NDArray | float]) -> StencilTable:
        """Collect (rows, columns, weights) triples; weights at equal places add up."""
        rows = np.concatenate([rows for rows, _, _ in entries])
        columns = np.concatenate([columns for _, columns, _ in entries])
        weights = np.concatenate([np.broadcast_to(weights, rows.shape) for rows, _, weights in entries])
        return cls(row_count, column_count, rows, columns, weights)

    @classmethod
    def from_matrix(cls, matrix: sparse.coo_array | sparse.csc_array | sparse.csr_array) -> StencilTable:
        """Stencils that are the rows of a sparse array."""
        entries = matrix.tocoo()
        row_count, column_count = entries.shape
        return cls(row_count, column_count, entries.row, entries.col, entries.data)

    @cached_property
    def matrix(self) -> sparse.csr_array:
        """``(row_count, column_count)`` stencils as the rows of a sparse array."""
        from scipy import sparse

        shape = self.row_count, self.column_count
        return sparse.coo_array((self.weights, (self.rows, self.columns)), shape=shape).tocsr()

    def dense(self, rows: IntArray) -> FloatArray:
        """Stencils of some refined vertices, ``(len(rows), column_count)``."""
        number = np.full(self.row_count, -1)
        number[rows] = np.arange(len(rows))
        # Of a row that is wanted twice, the last; all take it from there.
        kept = number[self.rows]
        own = kept >= 0
        flat = kept[own] * self.column_count + self.columns[own]
        sums = np.bincount(flat, self.weights[own], minlength=len(rows) * self.column_count).astype(np.float64)
        return sums.reshape(-1, self.column_count)[number[rows]]
