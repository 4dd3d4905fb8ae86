"""Vertices of the shape from its control points and ``to_world``: in JIT variants, in scalar ones, and by other forms.

Each is called with the flat control points in object space and the matrix of ``to_world``, None where it does not move
them, and returns flat positions and normals in the world. Normals follow the cross product of tangents, so that
reflections turn them over.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import drjit as dr
import numpy as np
from numpy.typing import NDArray

from ..kernels import EvaluatedVertices, Placement, VertexGather, WeightKernel
from ..kernels.apply_weights import coordinates_expected
from ..llvm import llvm_problem
from ..surface import LimitSurface
from .placement import FarPoints, placed

if TYPE_CHECKING:
    from ..tessellation import AttributeTable, SamplingTable
    from .parameters import Parameters

# Above so many vertices, scalar variants evaluate them by LLVM: compiling a kernel may take a tenth of a second.
WORTH_A_KERNEL = 300_000

Vertices = tuple[Any, Any]
OnBackward = Callable[[Any], None] | None


class DeviceVertices:
    """By `WeightKernel`, differentiable with respect to control points and ``to_world``.

    Values come from object space, where float32 is exact enough for normals.
    """

    def __init__(self, table: SamplingTable, positions: NDArray[np.float64], float_type: type) -> None:
        self._kernel = WeightKernel(table, float_type)
        self._evaluated: EvaluatedVertices | None = None
        self._far = FarPoints.of(positions, float_type)
        if self._far is not None:
            vector3 = self._kernel.vector3
            self._axes = tuple(vector3(*axis) for axis in np.eye(3).tolist())
            # No constants of kernels, which would be compiled for each cage.
            self._centre = vector3(*self._far.centre.tolist())
            dr.make_opaque(self._centre)

    def __call__(self, control_points: Any, to_world: Any, on_backward: OnBackward = None) -> Vertices:
        """See the module.

        Parameters
        ----------
        on_backward : callable, optional
            Called when gradients have come from the vertices; `attached` then makes a new way for others.
        """
        points, place = dr.detach(control_points), self._place(to_world)
        # Before they meet others of the right number.
        if dr.width(points) != 3 * self._kernel.control_count:
            raise ValueError(coordinates_expected(dr.width(points), self._kernel.control_count))
        points = points if self._far is None else self._far(points)
        # Tangents of the last time can go before there are others.
        self._evaluated = None
        if not dr.grad_enabled(control_points, to_world):
            return self._kernel(points, place)
        self._evaluated = self._kernel.evaluated(points, place)
        return self.attached(control_points, to_world, on_backward)

    def _place(self, to_world: Any) -> Placement | None:
        place = None if to_world is None else Placement.of(dr.detach(to_world), self._kernel.vector3)
        if self._far is None:
            return place
        return Placement(self._axes, self._centre) if place is None else place.from_centre(self._centre)

    def attached(self, control_points: Any, to_world: Any, on_backward: OnBackward = None) -> Vertices:
        """The vertices as they were evaluated, with derivatives by control points and ``to_world``."""
        return self._evaluated.attached(control_points, to_world, on_backward)


class HostVertices:
    """For scalar variants: by `WeightKernel` if that pays and LLVM is there, else by NumPy."""

    def __init__(self, table: SamplingTable, positions: NDArray[np.float64]) -> None:
        self._table = table
        self._far = FarPoints.of(positions, dr.scalar.ArrayXf)
        self._device = None
        if table.vertex_count > WORTH_A_KERNEL and llvm_problem() is None:
            self._device = DeviceVertices(table, positions, dr.llvm.Float)

    def __call__(self, control_points: Any, to_world: Any) -> Vertices:
        points = checked_points(control_points, self._table.control_count)
        if self._device is not None:
            if to_world is not None:
                to_world = dr.llvm.Matrix4f(np.array(to_world))
                dr.make_opaque(to_world)
            found = self._device(dr.llvm.Float(points), to_world)
            return tuple(np.array(value, copy=False) for value in found)
        centre = None
        if self._far is not None:
            centre, points = self._far.centre, np.array(self._far(control_points), dtype=np.float64)
        return placed_vertices(*self._table.apply(points.reshape(-1, 3), np.float32), to_world, centre)


class SampledVertices:
    """By another evaluator than the weights, sample by sample in float32, to show what it does."""

    def __init__(self, table: SamplingTable, parameters: Parameters) -> None:
        self._table = table
        self._parameters = parameters

    def __call__(self, control_points: Any, to_world: Any) -> Vertices:
        given, cage = self._parameters, self._parameters.surface.cage
        points = checked_points(control_points, cage.vertex_count)
        surface = LimitSurface(cage.with_positions(points.reshape(-1, 3)), given.surface.scheme)
        found = surface.sample_vertices(self._table, given.evaluator, np.float32, given.sample_offset)
        return placed_vertices(*found, to_world)


class SplitVertices:
    """Those of another, with copies, as the seams of attributes want them."""

    def __init__(self, vertices: Any, table: AttributeTable, float_type: type | None) -> None:
        self._vertices = vertices
        self._table = table
        self._gather = self._gathered if float_type is None else VertexGather(table.vertex, float_type)

    def __call__(self, *arguments: Any) -> Vertices:
        return tuple(self._gather(each) for each in self._vertices(*arguments))

    def attached(self, *arguments: Any) -> Vertices:
        """See `DeviceVertices.attached`."""
        return tuple(self._gather(each) for each in self._vertices.attached(*arguments))

    def _gathered(self, flat: NDArray) -> NDArray:
        return self._table.gathered(flat.reshape(-1, 3)).ravel()


def require_finite(control_points: Any) -> None:
    """Check flat coordinates, on whatever device they are.

    Raises
    ------
    ValueError
        If one is not a finite number.
    """
    if dr.all(dr.isfinite(control_points)):
        return
    points = np.array(control_points)
    bad = np.unique(np.flatnonzero(~np.isfinite(points)) // 3)
    coordinates = tuple(points[3 * bad[0] : 3 * bad[0] + 3].tolist())
    raise ValueError(
        f"vertex {bad[0]} has the coordinates {coordinates}; expected finite numbers "
        f"({len(bad)} such {'vertex' if len(bad) == 1 else 'vertices'} in all)"
    )


def checked_points(control_points: Any, count: int) -> NDArray[np.float64]:
    """Flat coordinates in double precision.

    Raises
    ------
    ValueError
        If they are not those of ``count`` control points.
    """
    points = np.array(control_points, dtype=np.float64)
    if points.size != 3 * count:
        raise ValueError(coordinates_expected(points.size, count))
    return points


def placed_vertices(
    positions: NDArray[np.float32],
    normals: NDArray[np.float32],
    to_world: Any,
    centre: NDArray[np.float64] | None = None,
) -> Vertices:
    """Flat positions and normals in the world; where points coincide, the kernel has no normal either."""
    normals = np.nan_to_num(normals)
    if to_world is not None or centre is not None:
        matrix = np.eye(4) if to_world is None else np.array(to_world, dtype=np.float64).reshape(4, 4)
        positions, normals = placed(positions, normals, matrix, centre)
    return positions.ravel(), normals.ravel()


def same_places(table: SamplingTable, attributes: AttributeTable) -> NDArray[np.uint32] | None:
    """For each vertex of the mesh, the first one in the same place; None where no vertices have copies."""
    if attributes.vertex is None and not table.copies.size:
        return None
    place = attributes.gathered(table.welded)
    first = np.empty(table.vertex_count, dtype=np.uint32)
    vertices = np.arange(len(place), dtype=np.uint32)
    first[place[::-1]] = vertices[::-1]
    return first[place]
