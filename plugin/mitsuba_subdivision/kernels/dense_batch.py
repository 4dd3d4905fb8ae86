"""Patches of any classes: every sample has a weight for every control point."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import drjit as dr
import numpy as np

from .array_types import ArrayTypes
from .lanes import Emit, Fetch, Lanes

if TYPE_CHECKING:
    from ..tessellation import ClassPart

# One-rings are filled up to a multiple of this many control points, so that few kernels serve all cages.
CONTROL_STEP = 4
# A lane of the transposed map sums for so many control points at most: more would compile slowly.
CONTROL_BLOCK = 24


class DenseBatch:
    """Patches of some classes, see `Batch`; their one-rings are filled up to the same size.

    A lane holds the control points of its patch and runs over the samples of its part. All lanes of a class are at the
    same weights at the same time. So do the lanes of the transposed map, whose sums for the control points take one
    atomic addition each, where a lane per sample would need as many as there are samples.
    """

    def __init__(self, types: ArrayTypes, runs: Sequence[ClassPart], controls: Any, are_rounded: bool) -> None:
        classes = list(dict.fromkeys(run.members for run in runs))
        self._types = types
        self.width = filled(max(members.controls.shape[1] for members in classes))
        self._lanes = Lanes(types, runs, controls, are_rounded)
        sample_counts = [members.weights.shape[1] for members in classes]
        begins = np.cumsum(sample_counts) - sample_counts
        # Three numbers for every sample and control point of a class. Lanes mostly fetch the same ones, which is faster
        # number by number than by packet.
        weights = np.zeros((sum(sample_counts), self.width, 3))
        for begin, members in zip(begins, classes, strict=True):
            _, sample_count, count = members.weights.shape
            own = weights[begin : begin + sample_count]
            own[:, :count] = members.weights.transpose(1, 2, 0)
            # The origin's own weight does not count, as its difference from itself is zero; the transposed map wants
            # the one that makes rows sum to one for points, to zero for tangents.
            own[:, 0] = (1, 0, 0) - own[:, 1:].sum(axis=1)
        weights_at = dict(zip(classes, begins * self.width, strict=True))
        orders = [run.part.samples for run in runs]
        counts = np.array([len(samples) for samples in orders])
        self._weights = types.float(weights.ravel())
        self._weights_at = types.indices(np.array([weights_at[run.members] for run in runs]))
        self._order = types.indices(*orders)
        self._order_at = types.indices(np.cumsum(counts) - counts)
        self._counts = types.indices(counts)

    def sample(self, padded: Any, emit: Emit) -> None:
        """See `Batch.sample`."""
        types = self._types
        patch, run, first_vertex = self._lanes.at(dr.arange(types.index, self._lanes.count))
        control = self._lanes.one_rings(patch, run)
        origin, *others = (types.packet(padded, control(k)) for k in range(self.width))
        relative = [other - origin for other in others]
        terms = self._lanes.terms(run, origin, relative)
        samples = self._samples(run)

        def evaluate(sample):
            weights = samples.weights(sample)
            point, du, dv = origin, dr.zeros(types.vector3), dr.zeros(types.vector3)
            for k, control in enumerate(relative, start=1):
                w = dr.gather(types.vector3, self._weights, weights + k)
                point = dr.fma(control, w.x, point)
                du = dr.fma(control, w.y, du)
                dv = dr.fma(control, w.z, dv)
            emit(first_vertex + sample, point, du, dv, terms)
            return (sample + 1,)

        samples.run((dr.zeros(types.index, self._lanes.count),), evaluate, "apply_weights")

    def add_transposed(self, fetch: Fetch, sums: Any) -> None:
        """See `Batch.add_transposed`."""
        types, block = self._types, min(self.width, CONTROL_BLOCK)
        block_count = -(-self.width // block)
        index = dr.arange(types.index, self._lanes.count * block_count)
        lane = index // block_count
        patch, run, first_vertex = self._lanes.at(lane)
        samples = self._samples(run)
        first = (index - lane * block_count) * block
        # The last block may reach beyond the weights.
        places = [(first + k, first + k < self.width) for k in range(block)]

        def add(sample, *totals):
            weights = samples.weights(sample)
            point, du, dv = fetch(first_vertex + sample)
            added = []
            for (place, is_within), total in zip(places, totals, strict=True):
                # As rows sum to one for points and to zero for tangents, no term for the origin remains.
                w = dr.gather(types.vector3, self._weights, weights + place, is_within)
                added.append(dr.fma(point, w.x, dr.fma(du, w.y, dr.fma(dv, w.z, total))))
            return sample + 1, *added

        start = (dr.zeros(types.index, dr.width(lane)), *(dr.zeros(types.vector3, dr.width(lane)) for _ in places))
        _, *totals = samples.run(start, add, "apply_transposed_weights")
        control = self._lanes.one_rings(patch, run)
        for (place, is_within), total in zip(places, totals, strict=True):
            dr.scatter_add(sums, total, control(place), is_within)

    def _samples(self, run: Any) -> _LaneSamples:
        per_run = (self._counts, self._order_at, self._weights_at)
        return _LaneSamples(self, *(dr.gather(self._types.index, values, run) for values in per_run))

    def order(self, place: Any) -> Any:
        """Sample of a class that comes at a place among the samples of all runs."""
        return dr.gather(self._types.index, self._order, place)


@dataclass(frozen=True)
class _LaneSamples:
    """The samples that a lane runs over, counted from 0."""

    batch: DenseBatch
    count: Any
    order_at: Any
    weights_at: Any

    def weights(self, sample: Any) -> Any:
        """Place of the sample's weights."""
        return self.weights_at + self.batch.order(self.order_at + sample) * self.batch.width

    def run(self, start: tuple, body: Callable[..., tuple], label: str) -> tuple:
        """Run a loop over the samples; the first state variable counts them."""
        return dr.while_loop(start, lambda sample, *_: sample < self.count, body, label=label)


def filled(count: int) -> int:
    """Control points of a one-ring that is filled up."""
    return -(-count // CONTROL_STEP) * CONTROL_STEP
