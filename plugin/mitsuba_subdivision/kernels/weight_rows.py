"""Blocks of weights times control points, a lane for each block and patch: coefficients of polynomials."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import drjit as dr
import numpy as np

from ..patches.piece_table import PACKET
from .array_types import ArrayTypes
from .types import FloatBuffer, Index, IndexBuffer, Vector3


class WeightRows:
    """Blocks of weights on a device, and a lane for each patch of each block."""

    def __init__(
        self,
        types: ArrayTypes,
        width: int,  # Number of vectors that a row of weights computes
        # (b, 4) int: of each block the index of its first control in `controls`, how far those of a patch are
        # apart, and how many they are; its first row of weights
        columns: np.ndarray,
        # (w, ..) float: a row for each control point of a block, with a number for each vector that it makes
        weights: np.ndarray,
        controls: IndexBuffer,  # Indices of control points
        # (n,) int: of each lane. Lanes of a block come together, if not all, so that they read the same weights.
        block: np.ndarray,
        patch: np.ndarray,
    ) -> None:
        self._types, self.width, self._controls = types, width, controls
        self._row_size, self.count = weights.shape[1], len(block)
        self._lane = types.indices(block), types.indices(patch)
        self._columns, self._weights = types.indices(columns), types.floats(weights)

    def vectors(self, padded: FloatBuffer) -> tuple[list[Vector3], Vector3, Vector3]:
        """Compute the vectors of each lane from the padded control points.

        Also returns the first control point, which the others are relative to, and how far they are from it along each
        axis.
        """
        types = self._types
        control, control_count, row = self._lanes()
        origin = types.packet(padded, control(types.index(0)))

        def add(k, extent, *sums):
            relative = types.packet(padded, control(k)) - origin
            added = (dr.fma(relative, weight, total) for weight, total in zip(self._row(row + k), sums, strict=True))
            return k + 1, dr.maximum(extent, dr.abs(relative)), *added

        zero: Vector3 = dr.zeros(types.vector3, self.count)
        start = (dr.full(types.index, 1, self.count), *(types.vector3(zero) for _ in range(self.width + 1)))
        _, extent, *sums = dr.while_loop(start, lambda k, *_: k < control_count, add, label="coefficients")
        sums[0] = sums[0] + origin
        return sums, origin, extent

    def add_transposed(self, vectors: Sequence[Vector3], sums: FloatBuffer) -> None:
        """Scatter-add vectors of each lane, times the weights, to the control points' packets."""
        types = self._types
        control, control_count, row = self._lanes()

        def add(k):
            total = vectors[0] * 0
            for vector, weight in zip(vectors, self._row(row + k), strict=True):
                total = dr.fma(vector, weight, total)
            dr.scatter_add(sums, types.vector4(total.x, total.y, total.z, 0), control(k))
            return (k + 1,)

        start: tuple[Index] = (dr.zeros(types.index, self.count),)
        dr.while_loop(start, lambda k: k < control_count, add, label="transposed_coefficients")

    def _lanes(self) -> tuple[Callable[[Index], Index], Index, Index]:
        """Per lane: a function that finds its control points; their number, and its first row of weights."""
        types = self._types
        lane: Index = dr.arange(types.index, self.count)
        block, patch = (types.fetch(types.index, each, lane) for each in self._lane)
        first_control, apart, control_count, row = types.fetch(types.index4, self._columns, block)
        at = first_control + patch

        def control(k: Index) -> Index:
            return types.fetch(types.index, self._controls, dr.fma(k, apart, at))

        return control, control_count, row

    def _row(self, row: Index) -> list:
        """A row of weights, one for each vector."""
        return self._types.row(self._weights, self._row_size, row)[: self.width]


def padded_rows(blocks: Sequence[np.ndarray], dtype: type) -> np.ndarray:
    """Blocks ``(b, m, K)``, in which the first control point is the origin, as rows of `WeightRows`.

    Rows are those of all control points of a block, then of the next one. Weights of the origin are those of the
    transposed map, which make sums one for constants and zero for other coefficients.
    """
    size = -(-blocks[0].shape[1] // PACKET) * PACKET
    found = np.zeros((sum(len(block) * block.shape[2] for block in blocks), size), dtype=dtype)
    end = 0
    for block in blocks:
        begin, end = end, end + len(block) * block.shape[2]
        own = found[begin:end].reshape(len(block), block.shape[2], size)[:, :, : block.shape[1]]
        own[:] = block.swapaxes(1, 2)
        own[:, 0] = -block[:, :, 1:].sum(axis=2)
        own[:, 0, 0] += 1
    return found
