"""Patches of a class whose weights are products of one-dimensional ones, which take a few times less work."""

from __future__ import annotations

from collections.abc import Callable
from itertools import chain
from typing import TYPE_CHECKING

import drjit as dr
import numpy as np

from .array_types import ArrayTypes
from .lanes import Emit, Fetch, Lanes
from .types import Float, FloatBuffer, Index, IndexBuffer, Vector3

if TYPE_CHECKING:
    from ..tessellation import VertexStencils


class ProductBatch:
    """The patches of one class, see `Batch` and `ProductPatch`.

    A lane loops over the rows of samples in its run. For each row it sums over the columns of control points with the
    weights for v, which leaves a few points and their derivatives by v. For each sample of the row it sums over these
    with the weights for u.
    """

    def __init__(self, types: ArrayTypes, vertices: VertexStencils, controls: IndexBuffer, are_rounded: bool) -> None:
        (stencils,) = vertices.classes
        product = stencils.product
        if product is None:
            raise ValueError("patches whose weights are no products; expected a class with a ProductPatch")
        self._types, self._count = types, product.lattice_index.shape[1]
        self._lanes = Lanes(types, vertices, controls, are_rounded)
        self._lattice_index = types.indices(product.lattice_index)
        rows = [product.rows(stencils.uv[vertices.samples_of(kind)]) for kind in range(len(vertices.counts))]
        # Parameters along u of all kinds, then those along v.
        parameters = [r.u for r in rows] + [r.v for r in rows]
        lengths = np.array([len(p) for p in parameters])
        begins = np.cumsum(lengths) - lengths
        self._corner = types.indices(np.array([r.corner for r in rows]))
        self._begin_u, self._begin_v = (types.indices(values) for values in np.split(begins, 2))
        self._end_u, self._end_v = (types.indices(values) for values in np.split(begins + lengths, 2))
        # For each parameter values and then derivatives.
        lines = product.line_weights(np.concatenate(parameters)).transpose(1, 0, 2)
        self._lines = types.floats(lines)

    def sample(self, padded: FloatBuffer, emit: Emit) -> None:
        """See `Batch.sample`."""
        types, every = self._types, range(self._count)
        patch, kind, first_vertex = self._lanes.at(dr.arange(types.index, self._lanes.count))
        control = self._lattice(patch, kind)
        controls = [[types.packet(padded, control(j * self._count + i)) for i in every] for j in every]
        origin = controls[0][0]
        relative = [[control - origin for control in row] for row in controls]
        bound = self._lanes.rounding_bound(kind, origin, chain(*relative), is_turned=True)

        def row(v, vertex):
            values, slopes = self._line(v)
            across = [_combined(values, [relative[j][i] for j in every]) for i in every]
            across_v = [_combined(slopes, [relative[j][i] for j in every]) for i in every]

            def along(u, vertex):
                values, slopes = self._line(u)
                point, du, dv = (
                    _combined(values, across, origin),
                    _combined(slopes, across),
                    _combined(values, across_v),
                )
                emit(vertex, point, du, dv, bound)
                return u + 1, vertex + 1

            _, vertex = self._loop(kind, self._begin_u, self._end_u, (vertex,), along, "apply_products_in_row")
            return v + 1, vertex

        self._loop(kind, self._begin_v, self._end_v, (first_vertex,), row, "apply_products")

    def add_transposed(self, fetch: Fetch, sums: FloatBuffer) -> None:
        """See `Batch.add_transposed`."""
        types, every = self._types, range(self._count)
        patch, kind, first_vertex = self._lanes.at(dr.arange(types.index, self._lanes.count))
        zero: Vector3 = dr.zeros(types.vector3, self._lanes.count)

        def zeros(count):
            return [types.vector3(zero) for _ in range(count)]

        def row(v, vertex, *totals):
            def along(u, vertex, *sums):
                values, slopes = self._line(u)
                point, du, dv = fetch(vertex)
                across = [dr.fma(point, values[i], dr.fma(du, slopes[i], sums[i])) for i in every]
                across_v = [dr.fma(dv, values[i], sums[self._count + i]) for i in every]
                return u + 1, vertex + 1, *across, *across_v

            start = (vertex, *zeros(2 * self._count))
            _, vertex, *sums = self._loop(
                kind, self._begin_u, self._end_u, start, along, "apply_transposed_products_in_row"
            )
            values, slopes = self._line(v)
            added = [
                dr.fma(sums[i], values[j], dr.fma(sums[self._count + i], slopes[j], totals[j * self._count + i]))
                for j in every
                for i in every
            ]
            return v + 1, vertex, *added

        start = (first_vertex, *zeros(self._count**2))
        _, _, *totals = self._loop(kind, self._begin_v, self._end_v, start, row, "apply_transposed_products")
        control = self._lattice(patch, kind)
        for at, total in enumerate(totals):
            dr.scatter_add(sums, total, control(at))

    def _lattice(self, patch: Index, kind: Index) -> Callable[[Index], Index]:
        """Function that finds the control points of some patches by their index in the lattice, as the kind sees it."""
        index, control = self._types.index, self._lanes.one_rings(patch, kind)
        first = dr.gather(index, self._corner, kind) * self._count**2
        return lambda at: control(dr.gather(index, self._lattice_index, first + at))

    def _line(self, parameter: Index) -> tuple[list[Float], list[Float]]:
        """All one-dimensional weights and their derivatives at a parameter, given by its index."""
        first = 2 * self._count * parameter
        weights: list[Float] = [dr.gather(self._types.float, self._lines, first + i) for i in range(2 * self._count)]
        return weights[: self._count], weights[self._count :]

    def _loop(
        self, kind: Index, begin: IndexBuffer, end: IndexBuffer, start: tuple, body: Callable[..., tuple], label: str
    ) -> tuple:
        """Loop over a kind's parameters; the first state variable is their index."""
        first: Index
        last: Index
        first, last = dr.gather(self._types.index, begin, kind), dr.gather(self._types.index, end, kind)
        return dr.while_loop((first, *start), lambda at, *_: at < last, body, label=label)


def _combined(weights: list[Float], vectors: list[Vector3], start: Vector3 | None = None) -> Vector3:
    """Sum of weights times vectors, added to ``start`` if there is one."""
    total = weights[0] * vectors[0] if start is None else dr.fma(vectors[0], weights[0], start)
    for weight, vector in zip(weights[1:], vectors[1:], strict=True):
        total = dr.fma(vector, weight, total)
    return total
