"""Linear maps from control values to what kernels read, with their transposes: sparse matrices, and blocks of weights.

- `SparseMatrix` interpolates values, or refines control points once.
- `WeightBlocks` makes the polynomials of patches. Patches of a class share weights; each has control points of its own.
- `CoefficientMap` stores the polynomials of a whole piece table, for hits and samples. `VertexKernel` needs each of
  its polynomials for the vertices on it only, and stores none.
- `ControlValues` holds what such a map makes of the values of a cage, for kernels to gather from.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import cached_property, partial
from itertools import groupby
from typing import TYPE_CHECKING, Any

import drjit as dr
import numpy as np
from numpy.typing import NDArray

from ..evaluation.polynomials import polynomial_basis
from ..mesh import ragged
from ..mesh.shared import Content, shared, shared_by_key
from ..patches.piece_table import PACKET, PieceTable, piece_packets, tree_arrays
from ..schemes import StencilTable
from .array_types import (
    NO_CONFLICTS,
    SUMS,
    ArrayTypes,
    FloatBuffer,
    Index,
    IndexBuffer,
    LaterArrays,
    Mask,
    Value,
    Vector3,
    replayed,
)

if TYPE_CHECKING:
    from scipy import sparse


def attached(values: Any, argument: Any, forward: Callable[..., Any], backward: Callable[..., Any]) -> Any:
    """Attach detached values to the argument that they were computed from, if it is differentiated.

    ``forward`` returns the change of the values for a change of the argument; ``backward`` the gradient by the argument
    from those by the values. Dr.Jit's own derivatives cannot replace these transposes: in version 1.5, its reverse mode
    ends the process at loops whose terms are relative to a gathered origin.
    """
    return dr.custom(_Attached, values, argument, forward, backward) if dr.grad_enabled(argument) else values


class _Attached(dr.CustomOp):
    def eval(self, values, argument, forward, backward):  # noqa: ARG002 - the argument of the derivatives
        self._forward, self._backward = forward, backward
        # Copies, because Dr.Jit attaches derivatives to the returned arrays themselves.
        return tuple(type(x)(x) for x in values) if isinstance(values, tuple) else type(values)(values)

    def forward(self):
        self.set_grad_out(self._forward(self.grad_in("argument")))

    def backward(self):
        gradients = self.grad_out()
        self.set_grad_in("argument", self._backward(*(gradients if isinstance(gradients, tuple) else [gradients])))


class SparseMatrix:
    """A sparse matrix on the device, whose products are differentiable, forward and backward."""

    # Properties that upload arrays at their first use; see `shapes.device_state`.
    UPLOADED_LATER = ("transposed_rows",)

    def __init__(
        self,
        matrix: sparse.csr_array | StencilTable,  # (n, m); a table is sorted by rows
        float_type: type,  # Flat Dr.Jit array of the values, such as `drjit.llvm.ad.Float`; entries have its precision
        *,
        # Whether rows sum to one. Sums are then relative to the first value of each row, which reduces rounding errors.
        is_relative: bool = True,
    ) -> None:
        self._types, self._is_relative = ArrayTypes(float_type), is_relative
        self._table = matrix if isinstance(matrix, StencilTable) else StencilTable.from_matrix(matrix)
        self._rows = self._uploaded(self._table)

    def __call__(
        self,
        values: FloatBuffer,  # m values of ``size`` components, flat
        size: int,  # At most 4
        known: FloatBuffer | None = None,  # A known product, which is then only attached to the values
    ) -> FloatBuffer:
        """Multiply values by the matrix; returns ``n`` values, flat."""
        product = self.product(dr.detach(values), size) if known is None else known
        return attached(product, values, partial(self.product, size=size), partial(self.transposed, size=size))

    def product(self, flat: FloatBuffer, size: int = 3) -> FloatBuffer:
        """The product without derivatives."""
        return self._product(self._rows, flat, size, self._is_relative)

    def transposed(self, flat: FloatBuffer, size: int = 3) -> FloatBuffer:
        """The product with the transposed matrix, without derivatives."""
        return self._product(self.transposed_rows, flat, size, is_relative=False)

    @cached_property
    def transposed_rows(self) -> tuple:
        return self._uploaded(StencilTable.from_matrix(self._table.matrix.T.tocsr()))

    def _uploaded(self, table: StencilTable) -> tuple:
        """Number of rows; start of each row; columns and entries."""
        types, starts = self._types, ragged.offsets(np.bincount(table.rows, minlength=table.row_count))
        return table.row_count, types.indices(starts), types.indices(table.columns), types.floats(table.weights)

    def _product(self, rows: tuple, flat: FloatBuffer, size: int, is_relative: bool) -> FloatBuffer:
        types = self._types
        vector, (row_count, starts, columns, entries) = types.vector(size), rows
        row: Index = dr.arange(types.index, row_count)
        start: Index = dr.gather(types.index, starts, row)
        end: Index = dr.gather(types.index, starts, row + 1)
        zero: Value = dr.zeros(vector, row_count)

        def value(index: Index, active: Mask = True) -> Value:
            """The value that an entry of the matrix is multiplied by."""
            column: Index = dr.gather(types.index, columns, index, active)
            return dr.gather(vector, flat, column, active)

        origin = value(start, start < end) if is_relative else zero

        def add(index, total):
            entry = dr.gather(types.float, entries, index)
            return index + 1, dr.fma(value(index) - origin, entry, total)

        _, total = dr.while_loop((start, zero), lambda index, _: index < end, add, label="sparse_matrix")
        return dr.ravel(origin + total)


class WeightBlocks:
    """Blocks of weights on the device, each a matrix that makes vectors of the control points of a patch.

    There is a lane for each patch of each block. Weights sum to one for the first vector, and to zero for the others,
    so vectors are relative to the first control point, whose weights only the transposed map reads.
    """

    def __init__(
        self,
        types: ArrayTypes,
        weights: Sequence[np.ndarray],  # Blocks (b, m, K) for K control points: m vectors of the same number in all
        # (n, 4) int: for each block the index of its first control in ``controls``, the stride and the number of the
        # controls of a patch, and its first row of weights, of which each control point has one
        columns: np.ndarray,
        controls: IndexBuffer,  # Indices of control points
        # (l,) int: block and patch of each lane. Lanes of a block are mostly consecutive, and read the same weights.
        block: np.ndarray,
        patch: np.ndarray,
        # (l,) int: which piece each lane writes, in an array of pieces of this many vectors
        piece: np.ndarray | None = None,
    ) -> None:
        self._types, self._controls = types, controls
        self._piece: IndexBuffer = None if piece is None else types.indices(piece)
        self.width, self.count = weights[0].shape[1], len(block)
        self._row_size = -(-self.width // PACKET) * PACKET
        rows = np.zeros((sum(len(part) * part.shape[2] for part in weights), self._row_size), types.numpy_float)
        end = 0
        for _, parts in groupby(weights, lambda part: part.shape[2]):
            part = np.concatenate([*parts], dtype=rows.dtype, casting="same_kind")
            begin, end = end, end + len(part) * part.shape[2]
            rows[begin:end].reshape(len(part), part.shape[2], -1)[:, :, : self.width] = part.swapaxes(1, 2)
        self._lane = types.indices(block), types.indices(patch)
        self._columns, self._weights = types.indices(columns), types.floats(rows)

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
            index = PACKET * control(k)
            for axis, number in enumerate(total):
                dr.scatter_add(sums, number, index + axis, mode=SUMS)
            return (k + 1,)

        start: tuple[Index] = (dr.zeros(types.index, self.count),)
        dr.while_loop(start, lambda k: k < control_count, add, label="transposed_coefficients")

    def write(self, padded: FloatBuffer, results: FloatBuffer, size: int = 3) -> None:
        """Compute all vectors from the padded control points, and scatter ``size`` components of each as pieces."""
        numbers = [number for vector in self.vectors(padded)[0] for number in [*vector][:size]]
        numbers += [self._types.float(0)] * (-len(numbers) % PACKET)
        for i in range(0, len(numbers), PACKET):
            packet = self._types.vector4(*numbers[i : i + PACKET])
            index = self._piece * (len(numbers) // PACKET) + i // PACKET
            dr.scatter(results, packet, index, mode=NO_CONFLICTS)

    def write_transposed(self, gradient: FloatBuffer, sums: FloatBuffer, size: int = 3) -> None:
        """Scatter-add the gradients by all pieces, times the weights, to the control points' packets."""
        numbers = self._types.row(gradient, PACKET * piece_packets(self.width, size), self._piece)
        vectors = (numbers[size * m : size * (m + 1)] + [0] * (3 - size) for m in range(self.width))
        self.add_transposed([self._types.vector3(*vector) for vector in vectors], sums)

    def _lanes(self) -> tuple[Callable[[Index], Index], Index, Index]:
        """A function that returns the k-th control point of each lane; their number; the first row of weights."""
        types = self._types
        lane: Index = dr.arange(types.index, self.count)
        block, patch = (dr.gather(types.index, indices, lane) for indices in self._lane)
        first_control, stride, control_count, row = dr.gather(types.index4, self._columns, block)
        patch_control = first_control + patch

        def control(k: Index) -> Index:
            return dr.gather(types.index, self._controls, dr.fma(k, stride, patch_control))

        return control, control_count, row

    def _row(self, row: Index) -> list:
        return self._types.row(self._weights, self._row_size, row)[: self.width]


class CoefficientMap:
    """The map of a piece table from control values to coefficients; differentiable, forward and backward."""

    def __init__(self, table: PieceTable, float_type: type) -> None:
        self._types = types = ArrayTypes(float_type)
        controls, refinement = table.patches.control_rows(table.control_of_vertex, table.control_count)
        self._piece_count, self._width = table.piece_count, len(polynomial_basis(table.patches.scheme).powers)
        # To the control points of the patches, if these are those of the cage refined once
        self._refinement = None if refinement is None else shared(SparseMatrix, refinement, float_type)
        self._refined_count = table.control_count if refinement is None else refinement.row_count
        # Parts of patches have control points of their own, stored after all others, and so are their indices.
        point_count, parts, pieces = self._refined_count, [], []
        classes = zip(table.elements, table.classes.tolist(), strict=True)
        for element, (first, count, control_count, first_piece, piece_count) in classes:
            for begin, stencils, weights in tree_arrays(element, table.piece_levels).maps:
                part_first, part_size = first, control_count
                if stencils is not None:
                    part_first, part_size = len(controls) + point_count - self._refined_count, len(stencils)
                    parts.append((stencils[:, None], first, count, control_count, point_count, count, 1))
                    point_count += count * part_size
                pieces.append((weights, part_first, count, part_size, first_piece + begin, 1, piece_count))
        self._point_count = point_count
        all_controls = types.indices(controls, np.arange(self._refined_count, point_count))
        self._parts, self._pieces = (_piece_blocks(types, added, all_controls) for added in (parts, pieces))

    def __call__(
        self,
        values: FloatBuffer,  # Control values of ``size`` components, flat
        size: int = 3,  # At most 3
        known: FloatBuffer | None = None,  # Known coefficients, which are then only attached to the values
    ) -> FloatBuffer:
        """Compute the coefficients, see `PieceTable`."""
        points, types = values, self._types
        if size < 3:
            components = [values] if size == 1 else [*dr.unravel(types.vector(size), values)]
            points = dr.ravel(types.vector3(*components, *[0] * (3 - size)))
        coefficients = self._applied(size, dr.detach(points)) if known is None else known
        return attached(coefficients, points, partial(self._applied, size), partial(self._transposed, size))

    @replayed
    def _applied(self, size: int, points: FloatBuffer) -> FloatBuffer:
        """Coefficients of ``size`` components, from control points of three."""
        types = self._types
        padded = types.padded(points if self._refinement is None else self._refinement.product(points))
        if self._parts is not None:
            refined, padded = padded, dr.zeros(types.float, PACKET * self._point_count)
            index: Index = dr.arange(types.index, self._refined_count)
            dr.scatter(padded, dr.gather(types.vector4, refined, index), index, mode=NO_CONFLICTS)
            self._parts.write(refined, padded)
        packet_count = self._piece_count * piece_packets(self._width, size)
        coefficients: FloatBuffer = dr.empty(types.float, PACKET * packet_count)
        if self._pieces is not None:
            self._pieces.write(padded, coefficients, size)
        return coefficients

    @replayed
    def _transposed(self, size: int, gradient: FloatBuffer) -> FloatBuffer:
        """Gradient by the control points, from the gradient by the coefficients."""
        types = self._types
        sums: FloatBuffer = dr.zeros(types.float, PACKET * self._point_count)
        if self._pieces is not None:
            self._pieces.write_transposed(gradient, sums, size)
        if self._parts is not None:
            dr.eval(sums)
            self._parts.write_transposed(type(sums)(sums), sums)
        points_gradient = types.unpadded(sums, self._refined_count)
        return points_gradient if self._refinement is None else self._refinement.transposed(points_gradient)


def _piece_blocks(
    types: ArrayTypes,
    # Blocks of weights (b, m, K); index of the first control, number of patches, number of controls of a patch; first
    # piece of the results, its distance from one block to the next, and from one patch to the next
    added: list[tuple[np.ndarray, int, int, int, int, int, int]],
    controls: IndexBuffer,
) -> WeightBlocks | None:
    """Blocks of weights for all patches of classes; None if there are none."""
    weights, table, row_count = {}, [], 0
    for block_weights, first, count, control_count, *pieces in added:
        if id(block_weights) not in weights:
            weights[id(block_weights)] = block_weights, row_count
            row_count += len(block_weights) * control_count
        _, row = weights[id(block_weights)]
        table.append((len(block_weights), first, count, control_count, row, *pieces))
    if not table:
        return None
    block_counts, *data = np.array(table, dtype=np.uint32).T
    index = ragged.index_in_row(block_counts).astype(np.uint32)
    first, count, control_count, row, piece, block_step, patch_step = np.repeat(data, block_counts, axis=1)
    # Successive controls of a patch are as far apart as the class has patches.
    columns = np.stack([first, count, control_count, row + index * control_count], axis=1)
    block, patch = np.repeat(np.arange(len(count)), count), ragged.index_in_row(count).astype(np.uint32)
    places = (piece + index * block_step)[block] + patch * patch_step[block]
    return WeightBlocks(types, [part for part, _ in weights.values()], columns, controls, block, patch, places)


class ControlValues:
    """Result of a linear map of a cage's values, in one array for gathers of kernels."""

    # See `arrays_in`.
    UPLOADED_LATER = ("linear_map",)

    def __init__(
        self,
        types: ArrayTypes,
        size: int,  # Number of components of a value
        # Makes a `SparseMatrix` or a `CoefficientMap` of its table and the type of numbers
        make: Callable[[Any, type], Any],
        table: Any,
    ) -> None:
        self._types, self.size, self._make = types, size, (make, table, types.float)
        # Never replaced, because other objects may hold a reference to the array.
        self.flat: FloatBuffer = types.float()
        # Keeps the array that is shared with objects of equal values.
        self._shared: LaterArrays | None = None

    def load(self, values: NDArray[np.floating]) -> ControlValues:
        """Set the values ``(n, k)`` of the cage, and return this object.

        Objects with equal values and the same map share the array until `set` is called.
        """
        self._shared = shared_by_key((LaterArrays, *self._make, Content(values)), LaterArrays)
        self.take(self._shared.get(lambda: self.linear_map(self._types.floats(values), self.size)))
        return self

    def settle(self) -> None:
        """Keep loaded values only, until others are set. All kernels of this thread must have ended."""
        vars(self).pop("linear_map", None)
        if self._shared is not None:
            self.take(self._shared.settled())

    @cached_property
    def linear_map(self) -> SparseMatrix | CoefficientMap:
        return shared(*self._make)

    def set(self, values: FloatBuffer) -> None:
        """Set the values of the cage, flat. Later lookups are attached to them."""
        self._shared = None
        self.take(self.linear_map(values, self.size))

    def attach(self, values: FloatBuffer) -> None:
        """Attach the array to the values of the cage that it was computed from again."""
        self.take(self.linear_map(values, self.size, dr.detach(self.flat)))

    def take(self, flat: FloatBuffer) -> None:
        """Set the array itself, or attach an equal one to other variables."""
        # Dr.Jit compiles literals into kernels.
        dr.make_opaque(flat)
        self.flat[:] = flat
