"""Sampling weights times control points: a few kernels for a whole tessellation, differentiable, on any backend."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import drjit as dr
import numpy as np

from .sparse_matrix import SparseMatrix

if TYPE_CHECKING:
    from ..tessellation import SampledClass, SamplingTable

# Tangents are divided by their longest component before their cross product, which else could under- or overflow. A
# component shorter than this means that the patch has collapsed to a point or a curve.
SHORTEST = 1e-30
# One-rings are filled up to a multiple of this many control points, so that few kernels serve all cages.
CONTROL_STEP = 4
# Fewer samples than this do not get a kernel of their own: its start would take longer.
FEW_SAMPLES = 1 << 17


class WeightKernel:
    """The weights of a sampling table on the device, applied whenever the control points move.

    Building uploads the table; applying it takes one kernel for each size of one-ring that many patches have. A lane
    holds the control points of one patch and runs over the samples of one of its parts. All lanes of a class are at the
    same weights at the same time, and write vertices that follow each other. Points and tangents are linear in the
    control points, so that their forward derivatives are the same map, and their reverse ones its transpose. That is
    computed with one lane per control point of a patch, over the patch's samples, and so needs one atomic addition
    where a lane per sample would need as many as the patch has samples.

    Parameters
    ----------
    table : SamplingTable
    float_type : type
        Flat Dr.Jit array of the control points, such as ``drjit.llvm.ad.Float``. Weights get its precision.
    """

    def __init__(self, table: SamplingTable, float_type: type) -> None:
        arrays = sys.modules[float_type.__module__]
        suffix = "64" if dr.type_v(float_type) == dr.VarType.Float64 else ""
        self.vector3 = getattr(arrays, f"Array3f{suffix}")
        self.vertex_count = table.vertex_count
        self.control_count = table.control_count
        self._float = float_type
        self._vector4 = getattr(arrays, f"Array4f{suffix}")
        self._index = arrays.UInt32
        self._batches = [_Batch(table, classes, float_type, self._index) for classes in _batched(table.classes)]
        self._class_point_count = table.control_count
        self._refine, self._refine_transposed = None, None
        if table.matrix is not None:
            self._class_point_count = table.matrix.shape[0]
            self._refine = SparseMatrix(table.matrix, float_type, is_relative=True)
            self._refine_transposed = SparseMatrix(table.matrix.T.tocsr(), float_type, is_relative=False)
        self._welded = self._index(table.welded.astype(np.uint32)) if table.copies.size else None

    def __call__(self, control_points: Any) -> tuple[Any, Any]:
        """Evaluate every vertex of the tessellation.

        Parameters
        ----------
        control_points : flat Dr.Jit float array, (3 control_count)
            x, y, z of each control point.

        Returns
        -------
        positions, normals : flat Dr.Jit float arrays, (3 vertex_count)
            Points, and unit normals along the cross product of the tangents, zero where a patch has collapsed.
            Differentiable with respect to the control points, forward and backward.

        Raises
        ------
        ValueError
            If the number of control points is not that of the table.
        """
        if dr.width(control_points) != 3 * self.control_count:
            raise ValueError(coordinates_expected(dr.width(control_points), self.control_count))
        if dr.grad_enabled(control_points):
            points, du, dv = dr.custom(_LinearMap, self, control_points)
            positions, normals = dr.ravel(points), dr.ravel(_unit_normal(du, dv))
        else:
            # Tangents that no derivative needs are not written.
            positions, normals = self._sampled(control_points, 2, lambda point, du, dv: (point, _unit_normal(du, dv)))
        if self._welded is not None:
            positions = dr.ravel(dr.gather(self.vector3, positions, self._welded))
        return positions, normals

    def apply(self, control_points: Any) -> tuple[Any, Any, Any]:
        """Apply the linear map: points and two tangents of every vertex, as detached 3-vectors."""
        values = self._sampled(control_points, 3, lambda *values: values)
        return tuple(dr.unravel(self.vector3, value) for value in values)

    def _sampled(self, control_points: Any, count: int, finish: Callable[..., tuple]) -> tuple:
        """Evaluate ``count`` vectors, which ``finish`` makes of point and tangents, at every vertex; flat arrays."""
        packed = self._packed(control_points if self._refine is None else self._refine(control_points))
        buffers = tuple(dr.empty(self._float, 3 * self.vertex_count) for _ in range(count))
        for batch in self._batches:
            lane = dr.arange(self._index, batch.lane_count)
            row = dr.gather(self._index, batch.row, lane)
            origin, *others = (self._packet(packed, batch.control(row, k)) for k in range(batch.width))
            relative = [other - origin for other in others]
            samples = batch.samples(lane, row)

            def evaluate(sample, batch=batch, samples=samples, origin=origin, relative=relative):
                weights = samples.weights(sample)
                point, du, dv = origin, dr.zeros(self.vector3), dr.zeros(self.vector3)
                for k, control in enumerate(relative, start=1):
                    w = dr.gather(self._vector4, batch.weights, weights + k)
                    point = dr.fma(control, w.x, point)
                    du = dr.fma(control, w.y, du)
                    dv = dr.fma(control, w.z, dv)
                for buffer, value in zip(buffers, finish(point, du, dv), strict=True):
                    dr.scatter(buffer, value, samples.first_vertex + sample)
                return (sample + 1,)

            _run(samples, (dr.zeros(self._index, batch.lane_count),), evaluate, "apply_weights")
        return buffers

    def apply_transposed(self, point: Any, du: Any, dv: Any) -> Any:
        """Apply the transposed map: sum over vertices of weights times 3-vectors, per control point, flat."""
        packed = [self._packed(dr.ravel(value)) for value in (point, du, dv)]
        # As rows sum to one for points and to zero for tangents, no term for the origin remains.
        sums = dr.zeros(self._float, 3 * self._class_point_count)
        for batch in self._batches:
            index = dr.arange(self._index, batch.lane_count * batch.width)
            lane = index // batch.width
            control = index - lane * batch.width
            row = dr.gather(self._index, batch.row, lane)
            samples = batch.samples(lane, row)

            def add(sample, total, batch=batch, samples=samples, control=control):
                w = dr.gather(self._vector4, batch.weights, samples.weights(sample) + control)
                vertex = samples.first_vertex + sample
                for weight, values in zip((w.x, w.y, w.z), packed, strict=True):
                    total = dr.fma(self._packet(values, vertex), weight, total)
                return sample + 1, total

            count = dr.width(lane)
            start = (dr.zeros(self._index, count), dr.zeros(self.vector3, count))
            _, total = _run(samples, start, add, "apply_transposed_weights")
            dr.scatter_add(sums, total, batch.control(row, control))
        return sums if self._refine is None else self._refine_transposed(sums)

    def _packed(self, flat: Any) -> Any:
        """Pad flat 3-vectors to four numbers, which one packet load fetches."""
        v = dr.unravel(self.vector3, flat)
        return dr.ravel(self._vector4(v.x, v.y, v.z, 0))

    def _packet(self, packed: Any, index: Any) -> Any:
        value = dr.gather(self._vector4, packed, index)
        return self.vector3(value.x, value.y, value.z)


class _Batch:
    """Successive classes of a table on the device; their one-rings are filled up to the same size.

    Attributes
    ----------
    width : int
        Control points of a patch.
    lane_count : int
        One lane for each part of each patch that the patch evaluates.
    row : (lane_count,)
        Patch of each lane.
    weights : flat, four numbers for every sample and control point of a class, which one packet load fetches
    """

    def __init__(self, table: SamplingTable, classes: list[SampledClass], float_type: type, index_type: type) -> None:
        first, last = classes[0].patches.start, classes[-1].patches.stop
        self.width = _filled(max(members.controls.shape[1] for members in classes))
        controls = np.empty((self.width, last - first), dtype=np.uint32)
        weights = np.zeros((sum(c.weights.shape[1] for c in classes), self.width, 4), dtype=_numpy_type(float_type))
        weights_at = np.empty(last - first, dtype=np.uint32)
        begin = 0
        for members in classes:
            _, sample_count, count = members.weights.shape
            rows = slice(members.patches.start - first, members.patches.stop - first)
            controls[:count, rows] = members.controls.T
            controls[count:, rows] = members.controls[:, 0]
            weights_at[rows] = begin * self.width
            own = weights[begin : begin + sample_count]
            own[:, :count, :3] = members.weights.transpose(1, 2, 0)
            # The origin's own weight does not count, as its difference from itself is zero; the transposed map wants
            # the one that makes rows sum to one for points, to zero for tangents.
            own[:, 0, :3] = (1, 0, 0) - own[:, 1:, :3].sum(axis=1)
            begin += sample_count
        parts = list(table.parts_of(slice(first, last)))
        counts = np.array([len(part.samples) for part, _ in parts])

        self._index = index_type
        self._patch_count = dr.opaque(index_type, last - first)
        self.weights = float_type(weights.ravel())
        self._controls = index_type(controls.ravel())
        self._weights_at = index_type(weights_at)
        self._order = self._uploaded(part.samples for part, _ in parts)
        self._order_at = self._uploaded([np.cumsum(counts) - counts])
        self._counts = self._uploaded([counts])
        self.row = self._uploaded(part.patches[rows] - first for part, rows in parts)
        self._first_vertex = self._uploaded(part.first_vertex[rows] for part, rows in parts)
        self._part = self._uploaded(np.full(rows.stop - rows.start, i) for i, (_, rows) in enumerate(parts))
        self.lane_count = dr.width(self.row)

    def _uploaded(self, arrays: Iterable[np.ndarray]) -> Any:
        return self._index(np.concatenate([array.astype(np.uint32) for array in arrays]))

    def control(self, row: Any, place: Any) -> Any:
        """Control point at a place in the one-ring of a patch."""
        return dr.gather(self._index, self._controls, row + place * self._patch_count)

    def samples(self, lane: Any, row: Any) -> _LaneSamples:
        """The samples that a lane runs over."""
        part = dr.gather(self._index, self._part, lane)
        return _LaneSamples(
            self,
            dr.gather(self._index, self._counts, part),
            dr.gather(self._index, self._order_at, part),
            dr.gather(self._index, self._weights_at, row),
            dr.gather(self._index, self._first_vertex, lane),
        )

    def order(self, place: Any) -> Any:
        """Sample of a class that comes at a place among the samples of all parts."""
        return dr.gather(self._index, self._order, place)


@dataclass(frozen=True)
class _LaneSamples:
    """The samples that a lane runs over, counted from 0."""

    batch: _Batch
    count: Any
    order_at: Any
    weights_at: Any
    first_vertex: Any

    def weights(self, sample: Any) -> Any:
        """Place of the sample's weights."""
        return self.weights_at + self.batch.order(self.order_at + sample) * self.batch.width


def _run(samples: _LaneSamples, start: tuple, body: Callable[..., tuple], label: str) -> tuple:
    """Run a loop over a lane's samples; the first state variable counts them."""
    return dr.while_loop(start, lambda sample, *_: sample < samples.count, body, label=label)


def _batched(classes: tuple[SampledClass, ...]) -> Iterator[list[SampledClass]]:
    """Runs of classes that share a kernel: with one-rings of about the same size, or too small for one of their own."""
    batch: list[SampledClass] = []
    for members in classes:
        samples = sum(len(c.controls) * c.weights.shape[1] for c in batch)
        if samples > FEW_SAMPLES and _filled(members.controls.shape[1]) != _filled(batch[-1].controls.shape[1]):
            yield batch
            batch = []
        batch.append(members)
    yield batch


def _filled(count: int) -> int:
    return -(-count // CONTROL_STEP) * CONTROL_STEP


def _numpy_type(float_type: type) -> type:
    return np.float64 if dr.type_v(float_type) == dr.VarType.Float64 else np.float32


class _LinearMap(dr.CustomOp):
    """Control points to points and tangents, with the derivatives of a linear map."""

    def eval(self, kernel, control_points):
        self.kernel = kernel
        return kernel.apply(control_points)

    def forward(self):
        self.set_grad_out(self.kernel.apply(self.grad_in("control_points")))

    def backward(self):
        self.set_grad_in("control_points", self.kernel.apply_transposed(*self.grad_out()))

    def name(self):
        return "WeightKernel"


def coordinates_expected(count: int, control_count: int) -> str:
    """Say that ``count`` coordinates do not fit ``control_count`` control points."""
    return f"{count} coordinates; expected {3 * control_count}, x, y, z of {control_count} control points"


def _unit_normal(du: Any, dv: Any) -> Any:
    normal = dr.cross(_scaled(du), _scaled(dv))
    squared = dr.squared_norm(normal)
    # The inner selection keeps derivatives finite where the outer one takes zero.
    return dr.select(squared > 0, normal * dr.rsqrt(dr.select(squared > 0, squared, 1)), 0)


def _scaled(tangent: Any) -> Any:
    """Tangent with a longest component of one; the factor does not matter to the normal, nor to its derivative."""
    longest = dr.max(dr.abs(dr.detach(tangent)))
    return tangent * dr.rcp(dr.maximum(longest, SHORTEST))
