"""Evaluates patches of any class with a weight for every sample and control point."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING

import drjit as dr
import numpy as np

from .array_types import ArrayTypes
from .lanes import Emit, Fetch, Lanes
from .types import FloatBuffer, Index, IndexBuffer, Vector3

if TYPE_CHECKING:
    from ..tessellation import VertexStencils

# One-rings are padded to a multiple of this many control points, so that few kernels serve all cages.
CONTROL_STEP = 4
# A lane of the transposed map sums for this many control points at most: more would compile slowly.
CONTROL_BLOCK = 24


class DenseBatch:
    """Patches of some classes, see `Batch`. Their one-rings are padded to the same size.

    A lane holds the control points of its patch and loops over the samples of its run, so that all lanes of a class
    read the same weights at the same time. So do the lanes of the transposed map. Each sums for a control point
    over all its samples before it adds to that point's total, which takes one atomic addition per control point; a
    lane for each sample would take one for every sample and control point.
    """

    def __init__(self, types: ArrayTypes, vertices: VertexStencils, controls: IndexBuffer, are_rounded: bool) -> None:
        self._types = types
        self.width = padded_size(max(stencils.controls.shape[1] for stencils in vertices.classes))
        self._lanes = Lanes(types, vertices, controls, are_rounded)
        sample_counts = [stencils.weights.shape[1] for stencils in vertices.classes]
        begins = np.cumsum(sample_counts) - sample_counts
        # Three numbers for every sample and control point of a class. Lanes mostly gather the same ones, which is
        # faster by scalar loads than by packet.
        weights = np.zeros((sum(sample_counts), self.width, 3))
        for begin, stencils in zip(begins, vertices.classes, strict=True):
            _, sample_count, count = stencils.weights.shape
            own = weights[begin : begin + sample_count]
            own[:, :count] = stencils.weights.transpose(1, 2, 0)
            # The map itself does not use the origin's weight, as the origin's difference from itself is zero. The
            # transposed map needs the weight that makes rows sum to one for points, and to zero for tangents.
            # NumPy sums faster along the first axis.
            own[:, 0] = (1, 0, 0) - np.ascontiguousarray(own[:, 1:].transpose(1, 0, 2)).sum(axis=0)
        self._weights = types.floats(weights)
        self._weights_at = types.indices((begins * self.width)[vertices.class_of_kind])
        self._order = types.indices(vertices.samples)
        self._order_at, self._counts = types.indices(vertices.starts), types.indices(vertices.counts)

    def sample(self, padded: FloatBuffer, emit: Emit) -> None:
        """See `Batch.sample`."""
        types = self._types
        patch, kind, first_vertex = self._lanes.at(dr.arange(types.index, self._lanes.count))
        control = self._lanes.one_rings(patch, kind)
        origin, *others = (types.packet(padded, control(k)) for k in range(self.width))
        relative = [other - origin for other in others]
        bound = self._lanes.rounding_bound(kind, origin, relative)
        samples = self._samples(kind)

        def evaluate(sample):
            weights = samples.weights(sample)
            point, du, dv = origin, dr.zeros(types.vector3), dr.zeros(types.vector3)
            for k, control in enumerate(relative, start=1):
                w = dr.gather(types.vector3, self._weights, weights + k)
                point = dr.fma(control, w.x, point)
                du = dr.fma(control, w.y, du)
                dv = dr.fma(control, w.z, dv)
            emit(first_vertex + sample, point, du, dv, bound)
            return (sample + 1,)

        samples.loop((dr.zeros(types.index, self._lanes.count),), evaluate, "apply_weights")

    def add_transposed(self, fetch: Fetch, sums: FloatBuffer) -> None:
        """See `Batch.add_transposed`."""
        types, block = self._types, min(self.width, CONTROL_BLOCK)
        block_count = -(-self.width // block)
        index: Index = dr.arange(types.index, self._lanes.count * block_count)
        lane = index // block_count
        patch, kind, first_vertex = self._lanes.at(lane)
        samples = self._samples(kind)
        first = (index - lane * block_count) * block
        # The last block may reach past the last column.
        columns = [(first + k, first + k < self.width) for k in range(block)]

        def add(sample, *totals):
            weights = samples.weights(sample)
            point, du, dv = fetch(first_vertex + sample)
            added = []
            for (column, is_within), total in zip(columns, totals, strict=True):
                # Rows sum to one for points and to zero for tangents, so no term for the origin remains.
                w = dr.gather(types.vector3, self._weights, weights + column, is_within)
                added.append(dr.fma(point, w.x, dr.fma(du, w.y, dr.fma(dv, w.z, total))))
            return sample + 1, *added

        count = dr.width(lane)
        start: tuple[Index | Vector3, ...] = (
            dr.zeros(types.index, count),
            *(dr.zeros(types.vector3, count) for _ in columns),
        )
        _, *totals = samples.loop(start, add, "apply_transposed_weights")
        control = self._lanes.one_rings(patch, kind)
        for (column, is_within), total in zip(columns, totals, strict=True):
            dr.scatter_add(sums, total, control(column), is_within)

    def _samples(self, kind: Index) -> _LaneSamples:
        per_kind = (self._counts, self._order_at, self._weights_at)
        return _LaneSamples(self, *(dr.gather(self._types.index, values, kind) for values in per_kind))

    def order(self, index: Index) -> Index:
        """The sample, as its class counts them, at an index into the samples of all kinds, one after the other."""
        return dr.gather(self._types.index, self._order, index)


@dataclass(frozen=True)
class _LaneSamples:
    """The samples that each lane loops over, counted from 0."""

    batch: DenseBatch
    count: Index
    order_at: Index
    weights_at: Index

    def weights(self, sample: Index) -> Index:
        """Index of a sample's weights."""
        return self.weights_at + self.batch.order(self.order_at + sample) * self.batch.width

    def loop(self, start: tuple, body: Callable[..., tuple], label: str) -> tuple:
        """Run a loop over the samples; the first state variable counts them."""
        return dr.while_loop(start, lambda sample, *_: sample < self.count, body, label=label)


def padded_size(count: int) -> int:
    """Number of control points that a one-ring of ``count`` is padded to."""
    return -(-count // CONTROL_STEP) * CONTROL_STEP
