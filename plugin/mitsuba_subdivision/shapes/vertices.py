"""Positions and normals of the shape's vertices in object space, and the triangles of its mesh."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import TYPE_CHECKING, NamedTuple

import drjit as dr
import numpy as np
from numpy.typing import NDArray

from ..device_arrays import mapped, take_over
from ..kernels.array_types import FloatBuffer, IndexBuffer
from ..mesh.connectivity import IntArray
from ..mesh.shared import Content, Shared, SharedArray
from ..surface import LimitSurface
from ..variants import Variant
from .device_state import is_recording

if TYPE_CHECKING:
    from ..kernels import EvaluatedVertices, VertexKernel
    from ..mesh.connectivity import IntArray
    from ..tessellation import AttributeTable, VertexTable
    from .displaced_vertices import DeviceDisplacement, HostDisplacement
    from .displacement import ShapeDisplacement
    from .parameters import Parameters


class ConstantVertices(NamedTuple):
    """Vertices without derivatives by the control points, with the interface of `EvaluatedVertices`."""

    positions: FloatBuffer
    normals: FloatBuffer

    def attached(self, control_points: FloatBuffer) -> tuple[FloatBuffer, FloatBuffer]:  # noqa: ARG002
        return self.positions, self.normals


# From flat control points without derivatives, relative to the centre of those that were loaded (`RecentredPoints`).
Evaluate = Callable[[FloatBuffer], "EvaluatedVertices | ConstantVertices"]


class Vertices:
    """Evaluates the vertices of a tessellation, copies them along the seams of attributes, and displaces them.

    Arrays are those of Dr.Jit, or of NumPy in scalar variants.
    """

    def __init__(
        self,
        evaluate: Evaluate,
        are_differentiable: bool,  # Whether vertices have derivatives
        *,
        # (n,) int: the vertex that `evaluate` returns for each vertex of the shape, where seams have several
        # copies of one
        copied: IntArray | None = None,
        displacement: DeviceDisplacement | HostDisplacement | None = None,  # Of the copied vertices
        # (m,) int: displaced vertices that the shape has. Exact shading needs one copy of each.
        kept: IntArray | None = None,
        float_type: type | None = None,  # Flat Dr.Jit array of JIT variants
    ) -> None:
        self._evaluate, self._displacement, self.are_differentiable = evaluate, displacement, are_differentiable
        self._copies, self._kept = _Selection(copied, float_type), _Selection(kept, float_type)
        self._evaluated: EvaluatedVertices | ConstantVertices | None = None

    def __call__(self, points: FloatBuffer, *, keep: bool) -> tuple[FloatBuffer, FloatBuffer]:
        """Evaluate flat positions and normals, and maybe keep what `attached` needs."""
        # Free the last evaluation before the next one allocates memory.
        self._evaluated = None
        evaluated = self._evaluate(dr.detach(points))
        # Heights may get derivatives later.
        self._evaluated = evaluated if keep or self._displacement is not None else None
        return self._displaced(*evaluated.attached(points), points)

    def attached(self, points: FloatBuffer) -> tuple[FloatBuffer, FloatBuffer]:
        """The vertices of the last call, attached to the control points and the displacement again."""
        if self._evaluated is None:
            raise RuntimeError("vertices were not kept; expected a call that keeps them before")
        return self._displaced(*self._evaluated.attached(points), points)

    def _displaced(
        self, positions: FloatBuffer, normals: FloatBuffer, points: FloatBuffer
    ) -> tuple[FloatBuffer, FloatBuffer]:
        found = self._copies(positions), self._copies(normals)
        if self._displacement is None:
            return found
        positions, normals = self._displacement(*found, points)
        return self._kept(positions), self._kept(normals)


class _Selection:
    """Selects rows of flat 3-vectors; all of them without an index."""

    def __init__(self, index: IntArray | None, float_type: type | None) -> None:
        self._index: IntArray | IndexBuffer | None = index
        if index is not None and float_type is not None:
            from ..kernels.array_types import ArrayTypes

            self._types = ArrayTypes.of(float_type)
            self._index = self._types.indices(index)

    def __call__(self, flat: FloatBuffer) -> FloatBuffer:
        if self._index is None:
            return flat
        if isinstance(self._index, np.ndarray):
            return np.reshape(flat, (-1, 3))[self._index].ravel()
        return self._types.gathered(flat, self._index)


def vertices_of(
    table: VertexTable,
    attributes: AttributeTable,
    parameters: Parameters,
    displacement: ShapeDisplacement | None,
    float_type: type | None,  # Flat Dr.Jit array of a JIT variant; None in scalar variants
    *,
    is_exact: bool,  # Whether shading is exact
) -> Vertices:
    """Choose the evaluator of the shape's vertices."""
    evaluate, is_differentiable = _evaluator(table, parameters, float_type)
    if displacement is None:
        return Vertices(evaluate, is_differentiable, copied=attributes.surface_vertex, float_type=float_type)
    from .displaced_vertices import DeviceDisplacement, HostDisplacement, VertexLocations

    # With copies along seams: their displacements differ, and are averaged.
    split = parameters.surface.attribute_table(table)
    found = split_weld_targets(table, split)
    weld_target = np.arange(table.vertex_count) if found is None else found.astype(np.int64)
    locations = VertexLocations(*(split.locate or table.locations)(), weld_target)
    slopes = locations.follow_slopes(parameters.surface, displacement.channel)
    has_normals = not (is_exact or parameters.face_normals)
    displaced: DeviceDisplacement | HostDisplacement
    if displacement.kernel is not None and float_type is not None:
        displaced = DeviceDisplacement(locations, slopes, displacement.kernel, float_type, has_normals=has_normals)
    else:
        displaced = HostDisplacement(locations, slopes, parameters.surface, displacement, has_normals=has_normals)
    kept = None
    if attributes.surface_vertex is None and split.surface_vertex is not None:
        _, kept = np.unique(split.surface_vertex, return_index=True)
    return Vertices(
        evaluate,
        displaced.is_differentiable,
        copied=split.surface_vertex,
        displacement=displaced,
        kept=kept,
        float_type=float_type,
    )


def _evaluator(table: VertexTable, parameters: Parameters, float_type: type | None) -> tuple[Evaluate, bool]:
    """What evaluates the tessellation's vertices, and whether with derivatives."""
    if parameters.evaluator != "stabilized" or parameters.sample_offset:
        return partial(_sampled, table, parameters, float_type), False
    if float_type is None:
        return partial(_in_numpy, table), False
    from ..kernels import VertexKernel

    kernel = _KERNELS.get((table, float_type), lambda: VertexKernel(table, float_type))
    return kernel.evaluated, dr.is_diff_v(float_type)


def _in_numpy(table: VertexTable, points: FloatBuffer) -> ConstantVertices:
    positions, normals = table.apply(_rows(points, table.control_count))
    return ConstantVertices(positions.astype(np.float32).ravel(), normals.astype(np.float32).ravel())


def _sampled(
    table: VertexTable, parameters: Parameters, float_type: type | None, points: FloatBuffer
) -> ConstantVertices:
    """Vertices sample by sample in float32, by another evaluator, for comparison."""
    cage = parameters.surface.cage
    surface = LimitSurface(cage.with_positions(_rows(points, cage.vertex_count)), parameters.surface.scheme)
    positions, normals = surface.sample_vertices(table, parameters.evaluator, np.float32, parameters.sample_offset)
    # The published forms may return NaN for the normal of parallel tangents; the kernel returns zero.
    found = positions.ravel(), np.nan_to_num(normals).ravel()
    return ConstantVertices(*(found if float_type is None else (mapped(float_type, each) for each in found)))


def _rows(points: FloatBuffer, count: int) -> NDArray[np.float64]:
    """Flat control points as ``(count, 3)``. Raises ValueError if their number is not `count`."""
    found = np.array(points, dtype=np.float64)
    if found.size != 3 * count:
        from ..kernels.vertex_kernel import coordinates_expected

        raise ValueError(coordinates_expected(found.size, count))
    return found.reshape(-1, 3)


# Kernels, shared by shapes of one table.
_KERNELS: Shared[VertexKernel] = Shared()


def require_control_points(control_points: FloatBuffer, count: int) -> None:
    """Check flat coordinates of so many control points, on any device, and move them to Dr.Jit's memory.

    Raises ValueError if there are more or fewer, or one is not a finite number.
    """
    if len(control_points) != 3 * count:
        from ..kernels.vertex_kernel import coordinates_expected

        raise ValueError(coordinates_expected(len(control_points), count))
    if is_recording():
        return
    take_over(control_points)
    if dr.all(dr.isfinite(control_points)):
        return
    points = np.array(control_points)
    bad = np.unique(np.flatnonzero(~np.isfinite(points)) // 3)
    coordinates = tuple(points[3 * bad[0] : 3 * bad[0] + 3].tolist())
    raise ValueError(
        f"vertex {bad[0]} has the coordinates {coordinates}; expected finite numbers "
        f"({len(bad)} such {'vertex' if len(bad) == 1 else 'vertices'} in all)"
    )


def split_weld_targets(table: VertexTable, attributes: AttributeTable) -> NDArray[np.uint32] | None:
    """For each split vertex, the first split vertex in the same place; None where no vertices have copies."""
    if attributes.surface_vertex is None and not table.copies.size:
        return None
    target = attributes.gathered(table.weld_target)
    first = np.empty(table.vertex_count, dtype=np.uint32)
    vertices = np.arange(len(target), dtype=np.uint32)
    # Of several split vertices of one target, the last that is assigned stays: the first one.
    first[target[::-1]] = vertices[::-1]
    return first[target]


class Triangles:
    """Triangles of a tessellation; arrays of Dr.Jit, or of NumPy in scalar variants."""

    def __init__(
        self,
        variant: Variant,
        table: VertexTable,
        attributes: AttributeTable,  # Its vertices, with copies along seams or without
        kept: IntArray | None = None,  # (n,) int64: the triangles that the mesh has; by default all
    ) -> None:
        self._variant, self._is_jit = variant, dr.is_jit_v(variant.Float)
        self._kept = slice(None) if kept is None else kept
        self._name = None if kept is None else Content(kept)
        self.table, self.layout, self._attributes = table, attributes.layout, attributes
        self.patch_count, self.has_texcoords = table.patch_count, "texcoords" in attributes.values
        # Keeps shared arrays alive.
        self._held: dict[str, SharedArray] = {}

    def faces(self, *, are_turned: bool) -> IndexBuffer:
        """Vertices of all triangles, flat; with reversed orientation on request."""

        def make() -> SharedArray:
            triangles = self.layout.triangles[self._kept]
            triangles = triangles[:, [0, 2, 1]] if are_turned else triangles
            if not self._is_jit:
                return SharedArray(triangles.ravel())
            return SharedArray(mapped(self._variant.UInt32, triangles))

        return self._shared("faces", (self.layout, self._variant, are_turned, self._name), make)

    @property
    def element(self) -> FloatBuffer:
        """Element of each triangle, as floats."""

        def make() -> SharedArray:
            element = self.table.element[self._kept]
            return SharedArray(mapped(self._variant.Float, element) if self._is_jit else element.astype(np.float32))

        return self._shared("element", (self.table, self._variant, self._name), make)

    @property
    def weld_target(self) -> IndexBuffer | None:
        """See `split_weld_targets`; None where no vertices have copies."""

        def make() -> SharedArray:
            found = split_weld_targets(self.table, self._attributes)
            return SharedArray(None if found is None else mapped(self._variant.UInt32, found))

        return self._shared("weld_target", (self.table, self.layout, self._variant), make)

    def _shared(self, name: str, key: tuple, make: Callable[[], SharedArray]) -> FloatBuffer | IndexBuffer:
        self._held[name] = _SHARED.get((name, *key), make)
        return self._held[name].array


_SHARED: Shared[SharedArray] = Shared()
