"""Patches of a class whose weights are products of one-dimensional ones: a few times less work for every sample."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any

import drjit as dr
import numpy as np

from .array_types import ArrayTypes
from .lanes import Emit, Lanes

if TYPE_CHECKING:
    from ..tessellation import ClassPart

# One-dimensional weights come in packets of this many.
PACKET = 4


class ProductBatch:
    """The patches of one class, see `Batch` and `ProductPatch`.

    A lane goes over the rows of its part. It first sums over v, which leaves a few points and derivatives by v, and
    these over u for each sample of the row.
    """

    def __init__(self, types: ArrayTypes, runs: Sequence[ClassPart], controls: Any) -> None:
        members = runs[0].members
        product = members.product
        self._types, self._count = types, product.places.shape[1]
        self._lanes = Lanes(types, runs, controls)
        self._places = types.indices(product.places)
        rows = [product.rows(members.uv[run.part.samples]) for run in runs]
        # Parameters along u of all runs, then those along v.
        parameters = [r.u for r in rows] + [r.v for r in rows]
        lengths = np.array([len(p) for p in parameters])
        begins = np.cumsum(lengths) - lengths
        self._corner = types.indices(np.array([r.corner for r in rows]))
        self._begin_u, self._begin_v = (types.indices(values) for values in np.split(begins, 2))
        self._end_u, self._end_v = (types.indices(values) for values in np.split(begins + lengths, 2))
        # For each parameter values and then derivatives, both filled up to whole packets.
        self._packets = -(-self._count // PACKET)
        lines = np.zeros((lengths.sum(), 2, self._packets * PACKET))
        lines[:, :, : self._count] = product.line_weights(np.concatenate(parameters)).transpose(1, 0, 2)
        self._lines = types.float(lines.ravel())

    def sample(self, padded: Any, emit: Emit) -> None:
        """See `Batch.sample`."""
        types, every = self._types, range(self._count)
        patch, run, first_vertex = self._lanes.at(dr.arange(types.index, self._lanes.count))
        control = self._lattice(patch, run)
        controls = [[types.packet(padded, control(j * self._count + i)) for i in every] for j in every]
        origin = controls[0][0]
        relative = [[control - origin for control in row] for row in controls]

        def row(v, vertex):
            values, slopes = self._line(v)
            across = [_combined(values, [relative[j][i] for j in every]) for i in every]
            across_v = [_combined(slopes, [relative[j][i] for j in every]) for i in every]

            def along(u, vertex):
                values, slopes = self._line(u)
                emit(vertex, _combined(values, across, origin), _combined(slopes, across), _combined(values, across_v))
                return u + 1, vertex + 1

            _, vertex = self._loop(run, self._begin_u, self._end_u, (vertex,), along, "apply_products_in_row")
            return v + 1, vertex

        self._loop(run, self._begin_v, self._end_v, (first_vertex,), row, "apply_products")

    def add_transposed(self, padded: Sequence[Any], sums: Any) -> None:
        """See `Batch.add_transposed`."""
        types, count = self._types, self._count
        index = dr.arange(types.index, self._lanes.count * count**2)
        lane = index // count**2
        place = index - lane * count**2
        place_v = place // count
        place_u = place - place_v * count
        patch, run, first_vertex = self._lanes.at(lane)
        zero = dr.zeros(types.vector3, dr.width(lane))

        def row(v, vertex, total):
            def along(u, vertex, by_value, by_slope):
                value, slope = self._weight(u, place_u)
                point, du, dv = (types.packet(values, vertex) for values in padded)
                return u + 1, vertex + 1, dr.fma(point, value, dr.fma(du, slope, by_value)), dr.fma(dv, value, by_slope)

            start = (vertex, types.vector3(zero), types.vector3(zero))
            _, vertex, by_value, by_slope = self._loop(
                run, self._begin_u, self._end_u, start, along, "apply_transposed_products_in_row"
            )
            value, slope = self._weight(v, place_v)
            return v + 1, vertex, dr.fma(by_value, value, dr.fma(by_slope, slope, total))

        start = (first_vertex, types.vector3(zero))
        _, _, total = self._loop(run, self._begin_v, self._end_v, start, row, "apply_transposed_products")
        dr.scatter_add(sums, total, self._lattice(patch, run)(place))

    def _lattice(self, patch: Any, run: Any) -> Callable[[Any], Any]:
        """Function from places in the lattices of patches, as their runs see them, to control points."""
        index, control = self._types.index, self._lanes.one_rings(patch, run)
        first = dr.gather(index, self._corner, run) * self._count**2
        return lambda place: control(dr.gather(index, self._places, first + place))

    def _line(self, parameter: Any) -> tuple[list[Any], list[Any]]:
        """All one-dimensional weights and their derivatives at a parameter."""
        packets = [
            dr.gather(self._types.vector4, self._lines, 2 * self._packets * parameter + packet)
            for packet in range(2 * self._packets)
        ]
        weights = [weight for packet in packets for weight in packet]
        slopes = weights[self._packets * PACKET :]
        return weights[: self._count], slopes[: self._count]

    def _weight(self, parameter: Any, place: Any) -> tuple[Any, Any]:
        """One of these weights and its derivative."""
        width = self._packets * PACKET
        at = 2 * width * parameter + place
        return dr.gather(self._types.float, self._lines, at), dr.gather(self._types.float, self._lines, at + width)

    def _loop(self, run: Any, begin: Any, end: Any, start: tuple, body: Callable[..., tuple], label: str) -> tuple:
        """Loop over a run's parameters; the first state variable is their place."""
        first, last = dr.gather(self._types.index, begin, run), dr.gather(self._types.index, end, run)
        return dr.while_loop((first, *start), lambda at, *_: at < last, body, label=label)


def _combined(weights: list[Any], vectors: list[Any], start: Any | None = None) -> Any:
    """Sum of weights times vectors, added to a start."""
    total = weights[0] * vectors[0] if start is None else dr.fma(vectors[0], weights[0], start)
    for weight, vector in zip(weights[1:], vectors[1:], strict=True):
        total = dr.fma(vector, weight, total)
    return total
