"""Displaced vertices of the shape; see `shapes.displacement`.

The only input from the tessellation is the location of each vertex on the surface. Copies of a vertex along creases and
seams are displaced by the mean of their displacements, so that they stay bitwise equal. Each copy has the normal of its
side.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import drjit as dr
import numpy as np
from numpy.typing import NDArray

from ..device_arrays import mapped
from ..evaluation.equations import AT_EXTRAORDINARY_POINT
from ..kernels.algebra import unit
from ..kernels.array_types import ArrayTypes, Float, FloatBuffer, Vector3
from ..kernels.displacement import displaced
from ..kernels.locations import Location
from ..kernels.piece_kernel import PatchValues
from ..mesh.connectivity import IntArray
from ..patches import PatchSampler, contracts_alike
from ..schemes.domain import FloatArray

if TYPE_CHECKING:
    from ..kernels.displacement import Displacement
    from ..kernels.surface_kernel import SurfaceKernel
    from ..patches import Channel
    from ..surface import LimitSurface
    from ..tessellation import AttributeTable, VertexTable
    from .displacement import ShapeDisplacement


class VertexLocations(NamedTuple):
    """Locations of the vertices of a tessellation on the surface."""

    # (n,) int64: corner of an element from which parameters are seen, a half-edge of `PatchTable.elements`
    corner: IntArray
    uv: FloatArray  # (n, 2) float64: samples at corners of elements have (0, 0)
    copies: IntArray  # (g, c) int64: vertices at each location with several copies, padded with -1
    group: IntArray  # (n,) int64: row of `copies` of each vertex; -1 for a vertex without copies
    # (n,) bool: whether the slope of heights along the surface exists. It does not exist at an extraordinary point
    # where a seam ends, as positions and values contract at different rates.
    has_slope: NDArray[np.bool_]


def displaced_vertices(
    table: VertexTable,
    split: AttributeTable,  # Vertices with copies along seams, whose different displacements are averaged
    weld_target: NDArray[np.uint32] | None,  # Their `split_weld_targets`
    surface: LimitSurface,
    displacement: ShapeDisplacement,
    types: ArrayTypes | None,  # Types of a JIT variant; None in scalar variants
    *,
    has_normals: bool,  # Whether normals are needed
) -> DeviceDisplacement | HostDisplacement:
    """Create what displaces the vertices of a tessellation."""
    corner, uv = (split.locate or table.locations)()
    copies, group = _copies(weld_target, len(corner))
    has_slope, corners = np.ones(len(corner), dtype=bool), np.flatnonzero((uv == 0).all(axis=1))
    samples = _sampler(surface, surface.cage.positions).evaluate(corner[corners], uv[corners])
    points = corners[samples.level == AT_EXTRAORDINARY_POINT]
    has_slope[points] = contracts_alike(displacement.channel, surface.patches, corner[points])
    locations = VertexLocations(corner, uv, copies, group, has_slope)
    kernel = displacement.kernel
    if types is not None and kernel is not None and kernel.displacement is not None:
        return DeviceDisplacement(locations, kernel, kernel.displacement, types, has_normals=has_normals)
    return HostDisplacement(locations, surface, displacement, has_normals=has_normals)


def _copies(weld_target: NDArray | None, count: int) -> tuple[IntArray, IntArray]:
    """`VertexLocations.copies` and `group`, from the first copy of each vertex; None if there are no copies."""
    group = np.full(count, -1, dtype=np.int64)
    if weld_target is None:
        return np.empty((0, 0), dtype=np.int64), group
    order = np.argsort(weld_target, kind="stable")
    _, begins, counts = np.unique(weld_target[order], return_index=True, return_counts=True)
    has_copies = counts > 1
    begins, counts = begins[has_copies, None], counts[has_copies, None]
    column = np.arange(counts.max(initial=0))
    copies = order[np.minimum(begins + column, len(order) - 1)]
    copies[column >= counts] = -1
    rows, columns = np.nonzero(copies >= 0)
    group[copies[rows, columns]] = rows
    return copies, group


def _sampler(surface: LimitSurface, points: FloatArray) -> PatchSampler:
    return PatchSampler(surface.patches, points, surface.cage.cut_mesh.vertex)


class DeviceDisplacement:
    """Displaces vertices on the device.

    Differentiable with respect to control points, the scale, and the texture or control values of the heights.
    """

    def __init__(
        self,
        locations: VertexLocations,
        surface: SurfaceKernel,  # Displaced surface, with the control points of the vertices
        displacement: Displacement,  # That of the surface
        types: ArrayTypes,
        *,
        has_normals: bool,  # Whether normals are needed
    ) -> None:
        self._surface, self._displacement = surface, displacement
        self._types, self._has_normals = types, has_normals
        u, v = (types.floats(column) for column in locations.uv.T)
        self._location = Location(types.indices(locations.corner), u, v)
        self._read: FloatBuffer = None
        self._read_values()
        copies, group = locations.copies, locations.group
        self._copies = [types.indices(np.maximum(column, 0)) for column in copies.T]
        self._counts = types.floats((copies >= 0).sum(axis=1).astype(np.float64))
        self._group = types.indices(np.maximum(group, 0))
        self._has_slope, self._has_copies = (
            types.indices(mask.astype(np.uint32)) != 0 for mask in (locations.has_slope, group >= 0)
        )
        dr.eval(self._has_slope, self._has_copies)

    def _read_values(self) -> None:
        """Evaluate the channel of the heights if its values have changed."""
        channel = self._displacement.channel
        values, read = channel.values.flat, self._read
        # Equal values may be attached to other variables.
        if read is None or (values.index, values.index_ad) != (read.index, read.index_ad):
            # Keep a reference, so that Dr.Jit assigns its indices to no other array.
            self._read, self._value = type(values)(values), channel(self._location)[0]
            dr.eval(self._value)

    def __call__(
        self,
        positions: FloatBuffer,
        normals: FloatBuffer,
        points: FloatBuffer,  # noqa: ARG002
    ) -> tuple[FloatBuffer, FloatBuffer]:
        """Displace flat positions and normals. ``points`` are the control points of the surface."""
        p: Vector3 = dr.unravel(self._types.vector3, positions)
        n: Vector3 = dr.unravel(self._types.vector3, normals)
        self._read_values()
        height = self._displacement.heights.height(self._value) * self._displacement.scale
        positions = dr.ravel(p + self._mean(height * n))
        if self._has_normals:
            displaced_normal = self._surface.at(self._location).n
            exists = self._has_slope & (dr.squared_norm(n) > 0) & (dr.squared_norm(displaced_normal) > 0)
            normals = dr.ravel(dr.select(exists, displaced_normal, n))
        return positions, normals

    def _mean(self, vectors: Vector3) -> Vector3:
        """Replace the vector of each vertex by the mean over its copies."""
        if not self._copies:
            return vectors
        flat, total = dr.ravel(vectors), self._types.vector3(0)
        for count, copies in enumerate(self._copies, start=1):
            total += dr.gather(self._types.vector3, flat, copies, self._counts >= count)
        mean: Vector3 = dr.gather(self._types.vector3, dr.ravel(total / self._counts), self._group, self._has_copies)
        return dr.select(self._has_copies, mean, vectors)


class HostDisplacement:
    """Displaces vertices on the host."""

    def __init__(
        self,
        locations: VertexLocations,
        surface: LimitSurface,
        displacement: ShapeDisplacement,
        *,
        has_normals: bool,  # Whether normals are needed
    ) -> None:
        self._locations = locations
        self._surface, self._displacement, self._has_normals = surface, displacement, has_normals
        self._read: Channel | None = None

    def __call__(
        self, positions: FloatBuffer, normals: FloatBuffer, points: FloatBuffer
    ) -> tuple[FloatBuffer, FloatBuffer]:
        """Displace flat positions and normals. ``points`` are the control points of the surface."""
        self._read_values()
        positions, normals = (np.array(flat).reshape(-1, 3) for flat in (positions, normals))
        heights, scale = self._displacement.heights, self._displacement.host_scale
        height = np.array(heights.height(self._values[0])) * scale
        positions = positions + self._mean(height[:, None] * normals).astype(np.float32)
        if self._has_normals:
            h, h_u, h_v = (scale * component for component in heights(*self._values))
            displaced_normal = _rows(unit(displaced(self._limit(points), (h, h_u, h_v)).normal))
            exists = self._locations.has_slope & normals.any(axis=1) & displaced_normal.any(axis=1)
            normals = np.where(exists[:, None], displaced_normal, normals).astype(np.float32)
        return positions.ravel(), normals.ravel()

    def _read_values(self) -> None:
        """Evaluate the channel of the heights if its values have changed."""
        channel = self._displacement.channel
        if channel is not self._read:
            values = channel.with_derivatives(self._locations.corner, self._locations.uv)
            self._values = [_columns(rows) if rows.shape[1] > 1 else _columns(rows)[0] for rows in values]
            self._read = channel

    def _limit(self, points: FloatBuffer) -> PatchValues:
        """Evaluate the undisplaced limit surface at the vertices."""
        sampler = _sampler(self._surface, np.array(points, dtype=np.float64).reshape(-1, 3))
        samples = sampler.evaluate(self._locations.corner, self._locations.uv, derivatives=2)
        # Second derivatives do not exist at extraordinary points.
        value, du, dv, *second = (_columns(rows) for rows in np.nan_to_num([*samples[:3], *samples[5:8]]))
        return PatchValues(value, du, dv, _columns(samples.n), tuple(second))

    def _mean(self, vectors: FloatArray) -> FloatArray:
        """Replace the vector of each vertex by the mean over its copies."""
        copies, group = self._locations.copies, self._locations.group
        exists = copies >= 0
        mean = np.where(exists[..., None], vectors[copies], 0).sum(axis=1) / exists.sum(axis=1)[:, None]
        result = vectors.copy()
        result[group >= 0] = mean[group[group >= 0]]
        return result


def _columns(rows: NDArray) -> list[Float]:
    """Columns of an array: vector components for `displaced`."""
    return [mapped(dr.scalar.ArrayXf64, column) for column in rows.T]


def _rows(columns: list[Float]) -> FloatArray:
    return np.stack([np.array(column) for column in columns], axis=1)
