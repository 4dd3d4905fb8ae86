"""The linear map from control points to coefficients of polynomials, applied when control points move."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

import drjit as dr
import numpy as np

from ..mesh import ragged
from ..mesh.shared import Shared
from ..patches.piece_table import NOTHING, PACKET, piece_packets
from .array_types import NO_CONFLICTS, ArrayTypes, FloatBuffer, Index, IndexBuffer, Vector3, Vector4
from .control_values import WeightedValues

if TYPE_CHECKING:
    from ..patches import PieceTable


class CoefficientMap:
    """The map of a piece table from control values to coefficients; differentiable, forward and backward."""

    # See `WeightedValues`.
    UPLOADED_LATER = ("_steps",)

    def __init__(
        self,
        table: PieceTable,
        float_type: type,  # Flat Dr.Jit array, such as `drjit.llvm.ad.Float`
    ) -> None:
        self._table, self._types = table, ArrayTypes.of(float_type)

    @classmethod
    def shared(cls, table: PieceTable, float_type: type) -> CoefficientMap:
        """The map of a table, shared by all callers."""
        return _MAPS.get((table, float_type), lambda: cls(table, float_type))

    def __call__(
        self,
        points: FloatBuffer,  # x, y, z of each control point of the cage
        made: FloatBuffer | None = None,  # Known coefficients, which are then only attached to the points
    ) -> FloatBuffer:
        """Compute the coefficients, see `PieceTable`."""
        return dr.custom(_Coefficients, self, points, made)

    def apply(self, points: FloatBuffer) -> FloatBuffer:
        """Compute the coefficients, without derivatives."""
        types, steps = self._types, self._steps
        padded = types.padded(points if steps.refinement is None else steps.refinement.product(points))
        if steps.parts is not None:
            refined, padded = padded, dr.zeros(types.float, PACKET * steps.point_count)
            index: Index = dr.arange(types.index, steps.refined_count)
            dr.scatter(padded, types.fetch(types.vector4, refined, index), index, mode=NO_CONFLICTS)
            steps.parts.write(refined, padded)
        coefficients: FloatBuffer = dr.zeros(types.float, PACKET * self._table.packet_count)
        if steps.rings is not None:
            control, first, packet = steps.rings
            origin = types.fetch(types.vector4, padded, first, first != NOTHING)
            dr.scatter(coefficients, types.fetch(types.vector4, padded, control) - origin, packet, mode=NO_CONFLICTS)
        if steps.pieces is not None:
            steps.pieces.write(padded, coefficients)
        return coefficients

    def apply_transposed(self, gradient: FloatBuffer) -> FloatBuffer:
        """Gradient by the control points, from the gradient by the coefficients."""
        types, steps = self._types, self._steps
        sums: FloatBuffer = dr.zeros(types.float, PACKET * steps.point_count)
        if steps.rings is not None:
            control, first, packet = steps.rings
            ring_gradient: Vector4 = types.fetch(types.vector4, gradient, packet)
            dr.scatter_add(sums, ring_gradient, control)
            dr.scatter_add(sums, -ring_gradient, first, first != NOTHING)
        if steps.pieces is not None:
            steps.pieces.add_transposed(gradient, sums)
        if steps.parts is not None:
            dr.eval(sums)
            steps.parts.add_transposed(type(sums)(sums), sums)
        points_gradient = types.unpadded(sums, steps.refined_count)
        return points_gradient if steps.refinement is None else steps.refinement.transposed(points_gradient)

    @cached_property
    def _steps(self) -> _Steps:
        return _Steps(self._table, self._types)


class _Steps:
    """Stages of the map on the device: refinement, control points of parts, coefficients."""

    def __init__(self, table: PieceTable, types: ArrayTypes) -> None:
        refinement = table.refinement
        # Number of control points of the patches, and the map to these if the patches are those of the refined cage
        self.refined_count = table.control_count if refinement is None else refinement.shape[0]
        self.refinement = None if refinement is None else WeightedValues.shared(refinement, types.float)
        controls = table.controls
        monomial_count = next((maps[0].pieces.shape[1] for maps in table.maps if maps), 1)
        packets_of_piece = table.packets_of_piece
        parts, pieces = _Blocks(1), _Blocks(monomial_count)
        self.point_count = self.refined_count  # Including the control points of parts
        for maps, (first, count, control_count, first_piece, piece_count, _, _) in zip(
            table.maps, table.classes.tolist(), strict=True
        ):
            for begin, stencils, weights in maps:
                part_first, part_size = first, control_count
                if stencils is not None:
                    # Control points of parts are stored after all others, and so are their indices.
                    part_first, part_size = len(controls) + self.point_count - self.refined_count, len(stencils)
                    parts.add(stencils[:, None], first, count, control_count, self.point_count, count, 1)
                    self.point_count += count * part_size
                packet, step = packets_of_piece * (first_piece + begin), packets_of_piece * piece_count
                pieces.add(weights, part_first, count, part_size, packet, packets_of_piece, step)
        all_controls = types.indices(controls, np.arange(self.refined_count, self.point_count))
        self.parts, self.pieces = (
            blocks.rows(types, all_controls) if blocks.added else None for blocks in (parts, pieces)
        )
        # Control points stored among the coefficients: their indices; the indices of their origins, or `NOTHING`; and
        # their packets.
        self.rings = None
        if table.classes[:, 6].any():
            rings = []
            for first, n, k, _, _, first_ring, ring in table.classes.tolist():
                if ring:
                    ring_controls = controls[first : first + n * k].reshape(k, n).T
                    origin = np.where(np.arange(k) == 0, NOTHING, ring_controls[:, :1])
                    rings.append(np.stack([ring_controls, origin, first_ring + np.arange(n * k).reshape(n, k)]))
            self.rings = tuple(types.indices(*(ring[i].ravel() for ring in rings)) for i in range(3))


class _Blocks:
    """Builds blocks: rows of weights shared by all patches of a class."""

    def __init__(
        self,
        width: int,  # Number of vectors that a row of weights computes
    ) -> None:
        self.width = width
        # For each call of `add`: numbers of blocks and of patches; index of the first control, and number of controls
        # of a patch; first row of weights; first packet of the results, and its distance from one block to the next,
        # and from one patch to the next
        self.added: list[tuple[int, ...]] = []
        self._weights: dict[int, tuple[np.ndarray, int]] = {}
        self._row_count = 0

    def add(
        self,
        weights: np.ndarray,
        first: int,
        count: int,
        control_count: int,
        packet: int,
        block_step: int,
        patch_step: int,
    ) -> None:
        """Add blocks of weights, ``(b, width, K)``."""
        key = id(weights)
        if key not in self._weights:
            self._weights[key] = weights, self._row_count
            self._row_count += len(weights) * control_count
        row = self._weights[key][1]
        self.added.append((len(weights), count, first, control_count, row, packet, block_step, patch_step))

    def rows(self, types: ArrayTypes, controls: IndexBuffer) -> _Packets:
        """Upload the blocks."""
        weights = padded_rows([block for block, _ in self._weights.values()], types.numpy_float)
        added = np.array(self.added)
        index = ragged.index_in_row(added[:, 0])
        _, count, first, control_count, row, first_packet, block_step, patch_step = np.repeat(
            added, added[:, 0], axis=0
        ).T
        # Successive controls of a patch are as far apart as the class has patches.
        columns = np.stack([first, count, control_count, row + index * control_count], axis=1)
        block, patch = np.repeat(np.arange(len(count)), count), ragged.index_in_row(count)
        packet = (first_packet + index * block_step)[block] + patch * patch_step[block]
        rows = WeightRows(types, self.width, columns, weights, controls, block, patch)
        return _Packets(rows, types, types.indices(packet))


@dataclass(frozen=True, eq=False)
class _Packets:
    """Blocks of weights, and the packets that their vectors are written to."""

    rows: WeightRows
    types: ArrayTypes
    first: IndexBuffer  # First packet of each lane

    def write(self, padded: FloatBuffer, coefficients: FloatBuffer) -> None:
        """Compute all vectors from the padded control points, and scatter them as packets."""
        vectors, _, _ = self.rows.vectors(padded)
        numbers = [number for vector in vectors for number in vector]
        numbers += [self.types.float(0)] * (-len(numbers) % PACKET)
        for i in range(0, len(numbers), PACKET):
            packet = self.types.vector4(*numbers[i : i + PACKET])
            dr.scatter(coefficients, packet, self.first + i // PACKET, mode=NO_CONFLICTS)

    def add_transposed(self, gradient: FloatBuffer, sums: FloatBuffer) -> None:
        """Scatter-add the gradients by all vectors, times the weights, to the control points' packets."""
        packets_of_lane = piece_packets(self.rows.width)
        numbers = self.types.row(gradient, PACKET * packets_of_lane, self.first // packets_of_lane)
        vectors = [self.types.vector3(*numbers[3 * m : 3 * m + 3]) for m in range(self.rows.width)]
        self.rows.add_transposed(vectors, sums)


class _Coefficients(dr.CustomOp):
    """A linear map: forward mode applies the same map, reverse mode its transpose."""

    def eval(self, coefficient_map, points, made):
        self.map = coefficient_map
        # A copy, because Dr.Jit attaches derivatives to the returned array itself.
        return coefficient_map.apply(points) if made is None else type(made)(made)

    def forward(self):
        self.set_grad_out(self.map.apply(self.grad_in("points")))

    def backward(self):
        self.set_grad_in("points", self.map.apply_transposed(self.grad_out()))

    def name(self):
        return "CoefficientMap"


_MAPS: Shared[CoefficientMap] = Shared()


class WeightRows:
    """Blocks of weights on a device, and a lane for each patch of each block."""

    def __init__(
        self,
        types: ArrayTypes,
        width: int,  # Number of vectors that a row of weights computes
        # (b, 4) int: for each block the index of its first control in ``controls``, the stride and the number of the
        # controls of a patch, and its first row of weights
        columns: np.ndarray,
        # (w, ..) float: a row for each control point of a block, with a weight for each vector
        weights: np.ndarray,
        controls: IndexBuffer,  # Indices of control points
        # (n,) int: block and patch of each lane. Lanes of a block are mostly consecutive, so that they read the same
        # weights.
        block: np.ndarray,
        patch: np.ndarray,
    ) -> None:
        self._types, self.width, self._controls = types, width, controls
        self._row_size, self.count = weights.shape[1], len(block)
        self._lane = types.indices(block), types.indices(patch)
        self._columns, self._weights = types.indices(columns), types.floats(weights)

    def vectors(self, padded: FloatBuffer) -> tuple[list[Vector3], Vector3, Vector3]:
        """Compute the vectors of each lane from the padded control points.

        Also returns the first control point of each lane, and the largest distance of the others from it along each
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
        """A function that returns the k-th control point of each lane; their number; the first row of weights."""
        types = self._types
        lane: Index = dr.arange(types.index, self.count)
        block, patch = (types.fetch(types.index, indices, lane) for indices in self._lane)
        first_control, stride, control_count, row = types.fetch(types.index4, self._columns, block)
        patch_control = first_control + patch

        def control(k: Index) -> Index:
            return types.fetch(types.index, self._controls, dr.fma(k, stride, patch_control))

        return control, control_count, row

    def _row(self, row: Index) -> list:
        """Fetch a row of weights, one for each vector."""
        return self._types.row(self._weights, self._row_size, row)[: self.width]


def padded_rows(blocks: Sequence[np.ndarray], dtype: type) -> np.ndarray:
    """Rows of `WeightRows` from blocks ``(b, m, K)``, whose first control point is the origin of the others.

    Rows are ordered by block, then by control point. Weights of the origin are those of the transposed map: the weights
    of the constant coefficient sum to one, those of the others to zero.
    """
    size = -(-blocks[0].shape[1] // PACKET) * PACKET
    rows = np.zeros((sum(len(block) * block.shape[2] for block in blocks), size), dtype=dtype)
    end = 0
    for block in blocks:
        begin, end = end, end + len(block) * block.shape[2]
        block_rows = rows[begin:end].reshape(len(block), block.shape[2], size)[:, :, : block.shape[1]]
        block_rows[:] = block.swapaxes(1, 2)
        block_rows[:, 0] = -block[:, :, 1:].sum(axis=2)
        block_rows[:, 0, 0] += 1
    return rows
