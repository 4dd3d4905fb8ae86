"""Sampling weights times control points: one kernel for a whole tessellation, differentiable, on any Dr.Jit backend."""

from __future__ import annotations

import sys
from typing import TYPE_CHECKING, Any

import drjit as dr
import numpy as np

if TYPE_CHECKING:
    from ..tessellation import SamplingTable

# Tangents are divided by their longest component before their cross product, which else could under- or overflow. A
# component shorter than this means that the patch has collapsed to a point or a curve.
SHORTEST = 1e-30


class WeightKernel:
    """The weights of a sampling table on the device, applied whenever the control points move.

    Building uploads the table; applying it is one kernel, whatever the number of blocks. Points and tangents are linear
    in the control points, so that their forward derivatives are the same map, and their reverse ones its transpose.
    That is computed with one lane per control point of a patch, over the patch's samples, and so needs one atomic
    addition where a lane per sample would need as many as the patch has samples.

    Parameters
    ----------
    table : SamplingTable
    float_type : type
        Flat Dr.Jit array of the control points, such as ``drjit.llvm.ad.Float``. Weights get its precision.
    """

    def __init__(self, table: SamplingTable, float_type: type) -> None:
        arrays = sys.modules[float_type.__module__]
        double = dr.type_v(float_type) == dr.VarType.Float64
        suffix = "64" if double else ""
        self.vector3 = getattr(arrays, f"Array3f{suffix}")
        self.vertex_count = table.vertex_count
        self.control_count = table.control_count
        self._float = float_type
        self._vector3 = self.vector3
        self._vector4 = getattr(arrays, f"Array4f{suffix}")
        self._index = arrays.UInt32

        # Patches lie one after the other, each with its controls, its vertices and the place of its class's weights.
        # These are padded to four numbers for every sample and control point, which one packet load fetches.
        blocks = table.blocks
        patches, samples, controls = np.array([(len(b.controls), *b.weights.shape[1:]) for b in blocks]).T
        weights = np.zeros((int((samples * controls).sum()), 4), dtype=np.float64 if double else np.float32)
        weights_at = _starts(samples * controls)
        for block, begin in zip(blocks, weights_at, strict=True):
            rows = block.weights.transpose(1, 2, 0).copy()
            # The origin's own weight does not count, as its difference from itself is zero; the transposed map wants
            # the one that makes rows sum to one for points, to zero for tangents.
            rows[:, 0] = (1, 0, 0) - rows[:, 1:].sum(axis=1)
            weights[begin : begin + rows.shape[0] * rows.shape[1], :3] = rows.reshape(-1, 3)
        samples, controls = np.repeat(samples, patches), np.repeat(controls, patches)

        self._weights = self._float(weights.ravel())
        self._controls = self._index(np.concatenate([b.controls.ravel() for b in blocks]))
        self._vertices = self._index(np.concatenate([b.vertices.ravel() for b in blocks]))
        self._weights_at = self._index(np.repeat(weights_at, patches))
        self._sample_count = self._index(samples)
        self._control_count = self._index(controls)
        self._samples_at = self._index(_starts(samples))
        self._controls_at = self._index(_starts(controls))
        copies = table.welded != np.arange(table.vertex_count)
        self._welded = self._index(table.welded.astype(np.uint32)) if copies.any() else None
        self._patch_of_sample = self._index(np.repeat(np.arange(len(samples)), samples))
        self._patch_of_control = self._index(np.repeat(np.arange(len(controls)), controls))

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
        points, du, dv = dr.custom(_LinearMap, self, control_points)
        if self._welded is not None:
            points = self.vector3(*(dr.gather(self._float, component, self._welded) for component in points))
        return dr.ravel(points), dr.ravel(_unit_normal(du, dv))

    def apply(self, control_points: Any) -> tuple[Any, Any, Any]:
        """Apply the linear map: points and two tangents of every vertex, as detached 3-vectors."""
        packed = self._packed(control_points)
        lane = dr.arange(self._index, self.vertex_count)
        patch = dr.gather(self._index, self._patch_of_sample, lane)
        count = dr.gather(self._index, self._control_count, patch)
        sample = lane - dr.gather(self._index, self._samples_at, patch)
        weight = dr.gather(self._index, self._weights_at, patch) + sample * count
        control = dr.gather(self._index, self._controls_at, patch)
        origin = self._packet(packed, dr.gather(self._index, self._controls, control))

        def step(weight, control, remaining, point, du, dv):
            w = dr.gather(self._vector4, self._weights, weight)
            p = self._packet(packed, dr.gather(self._index, self._controls, control)) - origin
            return (
                weight + 1,
                control + 1,
                remaining - 1,
                dr.fma(p, w.x, point),
                dr.fma(p, w.y, du),
                dr.fma(p, w.z, dv),
            )

        zero = dr.zeros(self._vector3, self.vertex_count)
        *_, point, du, dv = dr.while_loop(
            (weight, control, count, zero, zero, zero),
            lambda *state: state[2] > 0,
            step,
            label="apply_weights",
        )
        vertex = dr.gather(self._index, self._vertices, lane)
        return self._scattered((point + origin, du, dv), vertex)

    def apply_transposed(self, point: Any, du: Any, dv: Any) -> Any:
        """Apply the transposed map: sum over vertices of weights times 3-vectors, per control point, flat."""
        packed = [self._packed(dr.ravel(value)) for value in (point, du, dv)]
        lane = dr.arange(self._index, dr.width(self._controls))
        patch = dr.gather(self._index, self._patch_of_control, lane)
        stride = dr.gather(self._index, self._control_count, patch)
        count = dr.gather(self._index, self._sample_count, patch)
        control = lane - dr.gather(self._index, self._controls_at, patch)
        weight = dr.gather(self._index, self._weights_at, patch) + control
        sample = dr.gather(self._index, self._samples_at, patch)

        def step(weight, sample, remaining, total):
            w = dr.gather(self._vector4, self._weights, weight)
            vertex = dr.gather(self._index, self._vertices, sample)
            for row, values in zip((w.x, w.y, w.z), packed, strict=True):
                total = dr.fma(self._packet(values, vertex), row, total)
            return weight + stride, sample + 1, remaining - 1, total

        *_, total = dr.while_loop(
            (weight, sample, count, dr.zeros(self._vector3, dr.width(lane))),
            lambda *state: state[2] > 0,
            step,
            label="apply_transposed_weights",
        )
        # As rows sum to one for points and to zero for tangents, no term for the origin remains.
        sums = dr.zeros(self._float, 3 * self.control_count)
        vertex = dr.gather(self._index, self._controls, lane)
        dr.scatter_add(sums, total, vertex)
        return sums

    def _packed(self, flat: Any) -> Any:
        """Pad flat 3-vectors to four numbers, which one packet load fetches."""
        v = dr.unravel(self._vector3, flat)
        return dr.ravel(self._vector4(v.x, v.y, v.z, 0))

    def _packet(self, packed: Any, index: Any) -> Any:
        value = dr.gather(self._vector4, packed, index)
        return self._vector3(value.x, value.y, value.z)

    def _scattered(self, values: tuple, vertex: Any) -> tuple:
        """Put values in the order of vertices. All writes come before the first read, so that they share one kernel."""
        buffers = tuple(dr.empty(self._float, 3 * self.vertex_count) for _ in values)
        for buffer, value in zip(buffers, values, strict=True):
            dr.scatter(buffer, value, vertex)
        return tuple(dr.unravel(self._vector3, buffer) for buffer in buffers)


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
    return tangent / dr.maximum(longest, SHORTEST)


def _starts(counts: np.ndarray) -> np.ndarray:
    return np.cumsum(counts) - counts
