"""Displaced vertices of the shape; see `shapes.displacement`.

The only input from the tessellation is the location of each vertex on the surface. Copies of a vertex along creases and
seams are displaced by the mean of their displacements, so that they stay bitwise equal. Each copy has the normal of its
side.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import drjit as dr
import numpy as np
from numpy.typing import NDArray

from ..device_arrays import mapped
from ..evaluation.equations import AT_EXTRAORDINARY_POINT
from ..kernels.algebra import unit
from ..kernels.array_types import ArrayTypes, Float, FloatBuffer, Vector3
from ..kernels.displacement import displaced
from ..kernels.linear_maps import SparseMatrix
from ..kernels.locations import Location
from ..kernels.piece_kernel import PatchValues
from ..patches import PatchSampler, contracts_alike
from ..schemes.domain import FloatArray

if TYPE_CHECKING:
    from scipy import sparse

    from ..surface import LimitSurface
    from ..tessellation.attribute_table import AttributeTable
    from .displacement import ShapeDisplacement


class DisplacedVertices:
    """Displaces the vertices of a tessellation on the host; `DisplacedOnDevice` on a device."""

    def __init__(
        self,
        split: AttributeTable,  # Vertices with copies along seams, whose different displacements are averaged
        weld_target: NDArray[np.uint32] | None,  # Their `split_weld_targets`
        surface: LimitSurface,
        displacement: ShapeDisplacement,
        types: ArrayTypes | None,  # Types of a JIT variant; None in scalar variants
        *,
        has_normals: bool,  # Whether normals are needed
    ) -> None:
        self._surface, self._displacement, self._has_normals = surface, displacement, has_normals
        self._types: Any = types
        # (n,) int64: corner of an element from which parameters are seen, a half-edge of `PatchTable.elements`; and
        # (n, 2) float64: parameters. Samples at corners of elements have (0, 0).
        self._corner, self._uv = corner, uv = split.layout.locate()
        self._mean: Any = None if weld_target is None else _mean_over_copies(weld_target)
        # (n,) bool: whether the slope of heights along the surface exists. It does not exist at an extraordinary point
        # where a seam ends, as positions and values contract at different rates.
        self._has_slope: Any = np.ones(len(corner), dtype=bool)
        corners = np.flatnonzero((uv == 0).all(axis=1))
        samples = self._sampler(surface.cage.positions).evaluate(corner[corners], uv[corners])
        points = corners[samples.level == AT_EXTRAORDINARY_POINT]
        self._has_slope[points] = contracts_alike(displacement.channel, surface.patches, corner[points])
        # What `_read_values` has read: a channel, or its values on the device.
        self._read: Any = None

    def __call__(
        self,
        positions: FloatBuffer,
        normals: FloatBuffer,
        points: FloatBuffer,  # Control points of the surface
    ) -> tuple[FloatBuffer, FloatBuffer]:
        """Displace flat positions and normals."""
        self._read_values()
        positions, normals = (np.array(flat).reshape(-1, 3) for flat in (positions, normals))
        heights, scale = self._displacement.heights, self._displacement.host_scale
        steps = np.array(heights.height(self._values[0]))[:, None] * scale * normals
        positions = positions + (steps if self._mean is None else self._mean @ steps).astype(np.float32)
        if self._has_normals:
            h, h_u, h_v = (scale * component for component in heights(*self._values))
            displaced_normal = _rows(unit(displaced(self._limit(points), (h, h_u, h_v)).normal))
            exists = self._has_slope & normals.any(axis=1) & displaced_normal.any(axis=1)
            normals = np.where(exists[:, None], displaced_normal, normals).astype(np.float32)
        return positions.ravel(), normals.ravel()

    def _read_values(self) -> None:
        """Evaluate the channel of the heights if its values have changed."""
        channel = self._displacement.channel
        if channel is not self._read:
            values = channel.with_derivatives(self._corner, self._uv)
            self._values = [_columns(rows) if rows.shape[1] > 1 else _columns(rows)[0] for rows in values]
            self._read = channel

    def _limit(self, points: FloatBuffer) -> PatchValues:
        """Evaluate the undisplaced limit surface at the vertices."""
        sampler = self._sampler(np.array(points, dtype=np.float64).reshape(-1, 3))
        samples = sampler.evaluate(self._corner, self._uv, derivatives=2)
        # Second derivatives do not exist at extraordinary points.
        value, du, dv, *second = (_columns(rows) for rows in np.nan_to_num([*samples[:3], *samples[5:8]]))
        return PatchValues(value, du, dv, _columns(samples.n), tuple(second))

    def _sampler(self, points: FloatArray) -> PatchSampler:
        return PatchSampler(self._surface.patches, points, self._surface.cage.cut_mesh.vertex)


class DisplacedOnDevice(DisplacedVertices):
    """Displaces vertices on a device.

    Differentiable with respect to control points, the scale, and the texture or control values of the heights.
    """

    def __init__(self, *arguments: Any, **options: Any) -> None:
        super().__init__(*arguments, **options)
        types = self._types
        # The displaced surface, with the control points of the vertices.
        self._kernel: Any = self._displacement.kernel
        u, v = (types.floats(column) for column in self._uv.T)
        self._location = Location(types.indices(self._corner), u, v)
        self._has_slope = types.indices(self._has_slope.astype(np.uint32)) != 0
        dr.eval(self._has_slope)
        if self._mean is not None:
            self._mean = SparseMatrix(self._mean, types.float)
        self._read_values()

    def __call__(
        self,
        positions: FloatBuffer,
        normals: FloatBuffer,
        points: FloatBuffer,  # noqa: ARG002
    ) -> tuple[FloatBuffer, FloatBuffer]:
        """See `DisplacedVertices`."""
        n: Vector3 = dr.unravel(self._types.vector3, normals)
        self._read_values()
        displacement = self._kernel.displacement
        steps = dr.ravel(displacement.heights.height(self._value) * displacement.scale * n)
        positions = positions + (steps if self._mean is None else self._mean(steps, 3))
        if self._has_normals:
            displaced_normal = self._kernel.at(self._location).n
            exists = self._has_slope & (dr.squared_norm(n) > 0) & (dr.squared_norm(displaced_normal) > 0)
            normals = dr.ravel(dr.select(exists, displaced_normal, n))
        return positions, normals

    def _read_values(self) -> None:
        channel = self._kernel.displacement.channel
        values, read = channel.values.flat, self._read
        # Equal values may be attached to other variables.
        if read is None or (values.index, values.index_ad) != (read.index, read.index_ad):
            # Keep a reference, so that Dr.Jit assigns its indices to no other array.
            self._read, self._value = type(values)(values), channel(self._location)[0]
            dr.eval(self._value)


def _mean_over_copies(weld_target: NDArray[np.uint32]) -> sparse.csr_array:
    """Matrix that replaces the vector of each vertex by the mean over its copies, from the first copy of each."""
    from scipy import sparse

    count = len(weld_target)
    first_copy = sparse.csr_array((np.ones(count), weld_target, np.arange(count + 1)), (count, count))
    copies = (first_copy @ first_copy.T).sorted_indices()
    return sparse.csr_array(sparse.diags_array(1 / copies.sum(axis=1)) @ copies)


def _columns(rows: NDArray) -> list[Float]:
    """Columns of an array: vector components for `displaced`."""
    return [mapped(dr.scalar.ArrayXf64, column) for column in rows.T]


def _rows(columns: list[Float]) -> FloatArray:
    return np.stack([np.array(column) for column in columns], axis=1)
