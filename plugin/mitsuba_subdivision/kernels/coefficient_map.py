"""From control points to the coefficients of all pieces of a surface: one linear map, applied when the points move."""

from __future__ import annotations

from functools import cached_property
from typing import TYPE_CHECKING, Any

import drjit as dr
import numpy as np

from ..mesh import ragged
from ..patches.piece_table import PACKET, piece_packets
from .array_types import ArrayTypes
from .sparse_matrix import SparseMatrix

if TYPE_CHECKING:
    from ..patches import PieceTable


class CoefficientMap:
    """The map of a piece table from control values to coefficients; differentiable, forward and backward.

    Parameters
    ----------
    table : PieceTable
    float_type : type
        Flat Dr.Jit array, such as ``drjit.llvm.ad.Float``, or ``float``.
    """

    def __init__(self, table: PieceTable, float_type: type) -> None:
        self._table, self._types = table, ArrayTypes.of(float_type)

    def __call__(self, points: Any) -> Any:
        """Make the coefficients, see `PieceTable`.

        Parameters
        ----------
        points : flat array
            x, y, z of each control point of the cage.
        """
        if not self._types.is_jit:
            return self._on_host(np.asarray(points, dtype=np.float64).reshape(-1, 3))
        return dr.custom(_Coefficients, self, points)

    def _on_host(self, points: np.ndarray) -> np.ndarray:
        table = self._table
        if table.refinement is not None:
            points = table.refinement @ points
        found = np.zeros((table.packet_count, PACKET))
        for pieces, (first, count, control_count, packet, size) in zip(
            table.maps, table.classes.astype(np.int64), strict=True
        ):
            controls = points[table.controls[first : first + count * control_count].reshape(control_count, count)]
            coefficients = np.einsum("pmk,knx->npmx", pieces, controls - controls[0], optimize=True)
            coefficients[:, :, 0] += controls[0][:, None]
            own = found[packet : packet + count * size].reshape(count, size, PACKET)
            ring = size - len(pieces) * piece_packets(pieces.shape[1])
            own[:, :ring, :3] = controls.swapaxes(0, 1)[:, :ring]
            rows = own[:, ring:].reshape(count, len(pieces), -1)
            rows[:, :, : 3 * pieces.shape[1]] = coefficients.reshape(count, len(pieces), -1)
        return found.ravel()

    def apply(self, points: Any) -> Any:
        """The coefficients on a device, without derivatives."""
        types, lanes = self._types, self._lanes
        padded = types.padded(points if lanes.refine is None else lanes.refine(points))
        found = dr.zeros(types.float, PACKET * self._table.packet_count)
        if lanes.rings is not None:
            control, packet = lanes.rings
            dr.scatter(found, dr.gather(types.vector4, padded, control), packet)
        if lanes.count:
            lanes.write(padded, found)
        return found

    def apply_transposed(self, gradient: Any) -> Any:
        """Gradient by the control points, from that by the coefficients."""
        types, lanes = self._types, self._lanes
        sums = dr.zeros(types.float, 3 * lanes.point_count)
        if lanes.rings is not None:
            control, packet = lanes.rings
            dr.scatter_add(sums, types.packet(gradient, packet), control)
        if lanes.count:
            lanes.add_transposed(gradient, sums)
        return sums if lanes.refine_transposed is None else lanes.refine_transposed(sums)

    @cached_property
    def _lanes(self) -> _Lanes:
        return _Lanes(self._table, self._types)


class _Lanes:
    """A lane for each piece of each patch, and one for each control point that stays as it is.

    Parameters
    ----------
    table : PieceTable
    types : ArrayTypes

    Attributes
    ----------
    count : int
        Of lanes that make pieces.
    point_count : int
        Of control points, refined ones if there is a refinement.
    refine, refine_transposed : SparseMatrix or None
    rings : tuple of two index arrays, or None
        Of each that stays as it is the control point and the packet; None if there are none.
    """

    def __init__(self, table: PieceTable, types: ArrayTypes) -> None:
        self._types = types
        refinement = table.refinement
        self.point_count = table.control_count if refinement is None else refinement.shape[0]
        self.refine = self.refine_transposed = None
        if refinement is not None:
            self.refine = SparseMatrix(refinement, types.float, is_relative=True)
            self.refine_transposed = SparseMatrix(refinement.T.tocsr(), types.float, is_relative=False)
        self._monomial_count = count = table.maps[0].shape[1]
        self._row_packets = -(-count // PACKET)
        first_control, patch_count, control_count, first_packet, size = table.classes.astype(np.int64).T
        piece_count = np.array([len(pieces) for pieces in table.maps])
        ring = size - piece_count * piece_packets(count)
        row_count = piece_count * control_count
        # One piece of all patches of a class is a block. Its lanes follow each other, so that they read the same weights.
        owner, piece = np.repeat(np.arange(len(piece_count)), piece_count), ragged.places(piece_count)
        lane_count = patch_count[owner]
        self.count = int(lane_count.sum())
        self._block = types.indices(np.repeat(np.arange(len(owner)), lane_count))
        row = ragged.starts(row_count)[owner] + piece * control_count[owner]
        packet = (first_packet + ring)[owner] + piece * piece_packets(count)
        columns = [ragged.starts(lane_count), first_control[owner], lane_count, control_count[owner]]
        columns += [row, packet, size[owner], 0 * row]
        self._blocks = types.indices(np.stack(columns, axis=1))
        weights = np.zeros((row_count.sum(), self._row_packets * PACKET))
        for pieces, row in zip(table.maps, ragged.starts(row_count), strict=True):
            rows = pieces.swapaxes(1, 2).reshape(-1, count)
            own = weights[row : row + len(rows), :count].reshape(len(pieces), pieces.shape[2], count)
            own[:] = rows.reshape(own.shape)
            # The transposed map wants the weights of the first control point, which the others are relative to, so that
            # rows sum to one for constants and to zero for all else.
            own[:, 0] = -own[:, 1:].sum(axis=1)
            own[:, 0, 0] += 1
        self._weights = types.floats(weights)
        self._controls = types.indices(table.controls)
        has_ring = np.flatnonzero(ring)
        controls = [
            table.controls[first : first + n * k].reshape(k, n).T.ravel()
            for first, n, k in zip(first_control[has_ring], patch_count[has_ring], control_count[has_ring], strict=True)
        ]
        packets = [
            (first + step * np.arange(n)[:, None] + np.arange(k)).ravel()
            for first, step, n, k in zip(
                first_packet[has_ring], size[has_ring], patch_count[has_ring], control_count[has_ring], strict=True
            )
        ]
        self.rings = None
        if controls:
            self.rings = types.indices(np.concatenate(controls)), types.indices(np.concatenate(packets))

    def write(self, padded: Any, found: Any) -> None:
        """Write the coefficients of all pieces; ``padded`` are control points."""
        types, count = self._types, self._monomial_count
        control, control_count, row, packet = self._lanes()
        origin = types.packet(padded, control(types.index(0)))

        def add(k, *sums):
            relative = types.packet(padded, control(k)) - origin
            return k + 1, *(
                dr.fma(relative, weight, total) for weight, total in zip(self._row(row + k), sums, strict=True)
            )

        zero = dr.zeros(types.vector3, self.count)
        start = (dr.full(types.index, 1, self.count), *(types.vector3(zero) for _ in range(count)))
        _, *sums = dr.while_loop(start, lambda k, *_: k < control_count, add, label="coefficients")
        sums[0] = sums[0] + origin
        numbers = [number for vector in sums for number in vector]
        numbers += [types.float(0)] * (-len(numbers) % PACKET)
        for i in range(0, len(numbers), PACKET):
            dr.scatter(found, types.vector4(*numbers[i : i + PACKET]), packet + i // PACKET)

    def add_transposed(self, gradient: Any, sums: Any) -> None:
        """Add to every control point's sum the gradients of all coefficients times the point's weights in them."""
        types, count = self._types, self._monomial_count
        control, control_count, row, packet = self._lanes()
        packets = [dr.gather(types.vector4, gradient, packet + i) for i in range(piece_packets(count))]
        numbers = [number for each in packets for number in each]
        vectors = [types.vector3(*numbers[3 * m : 3 * m + 3]) for m in range(count)]

        def add(k):
            total = vectors[0] * 0
            for vector, weight in zip(vectors, self._row(row + k), strict=True):
                total = dr.fma(vector, weight, total)
            dr.scatter_add(sums, total, control(k))
            return (k + 1,)

        start = (dr.zeros(types.index, self.count),)
        dr.while_loop(start, lambda k: k < control_count, add, label="transposed_coefficients")

    def _lanes(self) -> tuple[Any, Any, Any, Any]:
        """What finds the control points of each lane; how many; the first row of weights, and the first packet."""
        types = self._types
        lane = dr.arange(types.index, self.count)
        block = dr.gather(types.index, self._block, lane)
        first_lane, first_control, patch_count, control_count = dr.gather(types.index4, self._blocks, 2 * block)
        first_row, first_packet, size, _ = dr.gather(types.index4, self._blocks, 2 * block + 1)
        patch = lane - first_lane
        at, packet = first_control + patch, dr.fma(patch, size, first_packet)

        def control(k: Any) -> Any:
            return dr.gather(types.index, self._controls, dr.fma(k, patch_count, at))

        return control, control_count, first_row, packet

    def _row(self, row: Any) -> list:
        """A row of weights, one for each monomial."""
        packets = (
            dr.gather(self._types.vector4, self._weights, row * self._row_packets + i) for i in range(self._row_packets)
        )
        return [weight for packet in packets for weight in packet][: self._monomial_count]


class _Coefficients(dr.CustomOp):
    """A linear map: forward derivatives are the same map, reverse ones its transpose."""

    def eval(self, coefficient_map, points):
        self.map = coefficient_map
        return coefficient_map.apply(points)

    def forward(self):
        self.set_grad_out(self.map.apply(self.grad_in("points")))

    def backward(self):
        self.set_grad_in("points", self.map.apply_transposed(self.grad_out()))

    def name(self):
        return "CoefficientMap"
