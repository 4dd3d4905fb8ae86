"""Positions and normals of the shape from its control points and ``to_world``, in four ways.

In JIT variants `DeviceVertices` of `device_vertices.py` evaluate them, in scalar variants `HostVertices`, and by the
published forms `SampledVertices`. `SplitVertices` and `SplitDeviceVertices` copy what these evaluate along the seams of
attributes. Kernels are imported where they are used: a small scene of a scalar variant needs none.

Each is called with the flat control points in object space and the matrix of ``to_world``, or None instead of the
identity. It returns flat positions and normals in the world. Normals follow the cross product of the tangents, so that
reflections turn them over.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Any, Protocol, runtime_checkable

import drjit as dr
import numpy as np
from numpy.typing import NDArray

from ..llvm import llvm_problem
from ..mesh.connectivity import IntArray
from ..surface import LimitSurface
from .placement import FarPoints, placed

if TYPE_CHECKING:
    from ..tessellation import AttributeTable, VertexTable
    from .device_vertices import DeviceVertices
    from .displacement import ShapeDisplacement
    from .parameters import Parameters

# Above so many vertices, scalar variants evaluate them by LLVM: compiling a kernel may take a tenth of a second.
WORTH_A_KERNEL = 300_000

# Called with the gradient by the control points in the world, when a gradient has come from the vertices.
OnBackward = Callable[[Any], None]


class Vertices(Protocol):
    """See the module."""

    def __call__(self, control_points: Any, to_world: Any) -> tuple[Any, Any]:
        """Positions and normals."""
        ...


@runtime_checkable
class DifferentiableVertices(Protocol):
    """Likewise, with derivatives by the control points and ``to_world``; see `DeviceVertices`."""

    def __call__(self, control_points: Any, to_world: Any, on_backward: OnBackward | None = None) -> tuple[Any, Any]:
        """Positions and normals."""
        ...

    def attached(self, control_points: Any, to_world: Any, on_backward: OnBackward | None) -> tuple[Any, Any]:
        """The vertices as the last call evaluated them, with derivatives once more."""
        ...


class HostVertices:
    """For scalar variants: by `WeightKernel` if that pays and LLVM is there, else by NumPy."""

    def __init__(self, table: VertexTable, positions: NDArray[np.float64]) -> None:
        self._table = table
        self._far: FarPoints | None = None
        self._device: DeviceVertices | None = None
        if table.vertex_count > WORTH_A_KERNEL and llvm_problem() is None:
            from .device_vertices import DeviceVertices

            self._device = DeviceVertices(table, positions, dr.llvm.Float)
        else:
            self._far = FarPoints.of(positions, dr.scalar.ArrayXf)

    def __call__(self, control_points: Any, to_world: Any) -> tuple[Any, Any]:
        """Positions and normals."""
        points = checked_points(control_points, self._table.control_count)
        if self._device is not None:
            if to_world is not None:
                to_world = dr.llvm.Matrix4f(np.array(to_world))
                dr.make_opaque(to_world)
            positions, normals = self._device(dr.llvm.Float(points), to_world)
            return np.array(positions, copy=False), np.array(normals, copy=False)
        centre = None
        if self._far is not None:
            centre, points = self._far.centre, np.array(self._far(control_points), dtype=np.float64)
        return placed_vertices(*self._table.apply(points.reshape(-1, 3), np.float32), to_world, centre)


class SampledVertices:
    """By another evaluator than the weights, sample by sample in float32, to show what it does."""

    def __init__(self, table: VertexTable, parameters: Parameters) -> None:
        self._table = table
        self._parameters = parameters

    def __call__(self, control_points: Any, to_world: Any) -> tuple[Any, Any]:
        """Positions and normals."""
        given, cage = self._parameters, self._parameters.surface.cage
        points = checked_points(control_points, cage.vertex_count)
        surface = LimitSurface(cage.with_positions(points.reshape(-1, 3)), given.surface.scheme)
        positions, normals = surface.sample_vertices(self._table, given.evaluator, np.float32, given.sample_offset)
        # The published forms may make a normal of parallel tangents that is not a number; the kernel makes zero.
        return placed_vertices(positions, np.nan_to_num(normals), to_world)


class SplitVertices:
    """Other vertices in NumPy arrays, with copies along the seams of attributes."""

    def __init__(self, vertices: Vertices, surface_vertex: IntArray) -> None:
        self._vertices = vertices
        self._surface_vertex = surface_vertex

    def __call__(self, control_points: Any, to_world: Any) -> tuple[Any, Any]:
        """Positions and normals."""
        positions, normals = self._vertices(control_points, to_world)
        return self._split(positions), self._split(normals)

    def _split(self, flat: NDArray) -> NDArray:
        return flat.reshape(-1, 3)[self._surface_vertex].ravel()


def vertices_of(
    table: VertexTable, attributes: AttributeTable, parameters: Parameters, float_type: type | None
) -> Vertices:
    """Choose how the shape's vertices are evaluated.

    Parameters
    ----------
    table : VertexTable
    attributes : AttributeTable
    parameters : Parameters
    float_type : type or None
        Flat Dr.Jit array of a JIT variant; None in scalar variants.
    """
    positions, surface_vertex = parameters.surface.cage.positions, attributes.surface_vertex
    vertices: Vertices
    if parameters.evaluator != "stabilized" or parameters.sample_offset:
        vertices = SampledVertices(table, parameters)
    elif float_type is not None:
        from .device_vertices import DeviceVertices, SplitDeviceVertices

        device = DeviceVertices(table, positions, float_type)
        return device if surface_vertex is None else SplitDeviceVertices(device, surface_vertex, float_type)
    else:
        vertices = HostVertices(table, positions)
    return vertices if surface_vertex is None else SplitVertices(vertices, surface_vertex)


def displaced_vertices_of(
    table: VertexTable,
    parameters: Parameters,
    displacement: ShapeDisplacement,
    float_type: type | None,
) -> Vertices:
    """The shape's vertices, displaced; see `vertices_of`."""
    from .displaced_vertices import DisplacedDeviceVertices, DisplacedHostVertices, VertexLocations

    surface, is_exact = parameters.surface, parameters.shading == "exact"
    # Copies that seams make: what is displaced differs between them, and is averaged.
    attributes = surface.attribute_table(table)
    vertices: Any = vertices_of(table, attributes, parameters, float_type)
    found = split_places(table, attributes)
    place = np.arange(table.vertex_count) if found is None else found.astype(np.int64)
    locations = VertexLocations(*(attributes.locate or table.locations)(), place)
    slopes = locations.follow_slopes(surface, displacement.channel)
    has_normals = not (is_exact or parameters.face_normals)
    first = None
    if is_exact and attributes.surface_vertex is not None:
        # There, vertices have no copies along seams.
        _, first = np.unique(attributes.surface_vertex, return_index=True)
    if float_type is None:
        host = DisplacedHostVertices(vertices, locations, slopes, surface, displacement, has_normals=has_normals)
        return host if first is None else SplitVertices(host, first)
    from .device_vertices import SplitDeviceVertices

    device = DisplacedDeviceVertices(
        vertices, locations, slopes, displacement.surface, float_type, has_normals=has_normals
    )
    return device if first is None else SplitDeviceVertices(device, first, float_type)


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
        If they do not belong to ``count`` control points.
    """
    points = np.array(control_points, dtype=np.float64)
    if points.size != 3 * count:
        from ..kernels.apply_weights import coordinates_expected

        raise ValueError(coordinates_expected(points.size, count))
    return points


def placed_vertices(
    positions: NDArray[np.float32],
    normals: NDArray[np.float32],
    to_world: Any,
    centre: NDArray[np.float64] | None = None,
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Flat positions and normals in the world, from ``(n, 3)`` ones in object space, relative to a centre if any."""
    if to_world is not None or centre is not None:
        matrix = np.eye(4) if to_world is None else np.array(to_world, dtype=np.float64).reshape(4, 4)
        positions, normals = placed(positions, normals, matrix, centre)
    return positions.ravel(), normals.ravel()


def split_places(table: VertexTable, attributes: AttributeTable) -> NDArray[np.uint32] | None:
    """For each split vertex, the first split vertex in the same place; None where no vertices have copies."""
    if attributes.surface_vertex is None and not table.copies.size:
        return None
    place = attributes.gathered(table.weld_target)
    first = np.empty(table.vertex_count, dtype=np.uint32)
    vertices = np.arange(len(place), dtype=np.uint32)
    # Of several split vertices in a place, the last that is assigned stays: the first one.
    first[place[::-1]] = vertices[::-1]
    return first[place]
