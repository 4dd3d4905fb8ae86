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
    """Vertices that are not differentiable, with the interface of `EvaluatedVertices`."""

    positions: FloatBuffer
    normals: FloatBuffer

    def attached(self, control_points: FloatBuffer) -> tuple[FloatBuffer, FloatBuffer]:  # noqa: ARG002
        return self.positions, self.normals


# Function of flat, detached control points, relative to the centre of the loaded ones (`RecentredPoints`).
Evaluate = Callable[[FloatBuffer], "EvaluatedVertices | ConstantVertices"]


class Vertices:
    """Evaluates the vertices of a tessellation, copies them along the seams of attributes, and displaces them.

    Arrays are Dr.Jit arrays, or NumPy arrays in scalar variants.
    """

    def __init__(
        self,
        evaluate: Evaluate,
        are_differentiable: bool,  # Whether vertices are differentiable with respect to the control points
        *,
        # (n,) int: index of each vertex of the shape among those that ``evaluate`` returns, if seams have copies
        copied: IntArray | None = None,
        displacement: DeviceDisplacement | HostDisplacement | None = None,  # Applied to the copied vertices
        # (m,) int: indices of the displaced vertices that the shape keeps. Exact shading needs one copy of each vertex.
        kept: IntArray | None = None,
        float_type: type | None = None,  # Flat Dr.Jit array of JIT variants
    ) -> None:
        self._evaluate, self._displacement, self.are_differentiable = evaluate, displacement, are_differentiable
        self._copies, self._kept = _Selection(copied, float_type), _Selection(kept, float_type)
        self._evaluated: EvaluatedVertices | ConstantVertices | None = None

    def __call__(self, points: FloatBuffer, *, keep: bool) -> tuple[FloatBuffer, FloatBuffer]:
        """Evaluate flat positions and normals. ``keep`` stores the evaluation for `attached`."""
        # Free the memory of the last evaluation before the next one.
        self._evaluated = None
        evaluated = self._evaluate(dr.detach(points))
        # Also stored for a displacement, as gradients of heights may be enabled later.
        self._evaluated = evaluated if keep or self._displacement is not None else None
        return self._displaced(*evaluated.attached(points), points)

    def attached(self, points: FloatBuffer) -> tuple[FloatBuffer, FloatBuffer]:
        """Attach the vertices of the last call to the control points and the displacement again."""
        if self._evaluated is None:
            raise RuntimeError("vertices were not kept; expected a call that keeps them before")
        return self._displaced(*self._evaluated.attached(points), points)

    def _displaced(
        self, positions: FloatBuffer, normals: FloatBuffer, points: FloatBuffer
    ) -> tuple[FloatBuffer, FloatBuffer]:
        copied = self._copies(positions), self._copies(normals)
        if self._displacement is None:
            return copied
        positions, normals = self._displacement(*copied, points)
        return self._kept(positions), self._kept(normals)


class _Selection:
    """Selects flat 3-vectors by index; all of them if there is no index."""

    def __init__(self, index: IntArray | None, float_type: type | None) -> None:
        self._index: IntArray | IndexBuffer | None = index
        if index is not None and float_type is not None:
            from ..kernels.array_types import ArrayTypes

            self._types = ArrayTypes(float_type)
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
    """Create the evaluator of the shape's vertices."""
    evaluate, is_differentiable = _evaluator(table, parameters, float_type)
    if displacement is None:
        return Vertices(evaluate, is_differentiable, copied=attributes.surface_vertex, float_type=float_type)
    from .displaced_vertices import DeviceDisplacement, HostDisplacement, VertexLocations

    # With copies along seams, whose different displacements are averaged.
    split = parameters.surface.attribute_table(table)
    split_targets = split_weld_targets(table, split)
    weld_target = np.arange(table.vertex_count) if split_targets is None else split_targets.astype(np.int64)
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
    """The function that evaluates the tessellation's vertices, and whether it is differentiable."""
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
    """Evaluate each vertex as a sample in float32, by the evaluator of the parameters, for comparison."""
    cage = parameters.surface.cage
    surface = LimitSurface(cage.with_positions(_rows(points, cage.vertex_count)), parameters.surface.scheme)
    positions, normals = surface.sample_vertices(table, parameters.evaluator, np.float32, parameters.sample_offset)
    # The published forms may return NaN for the normal of parallel tangents; the kernel returns zero.
    vertices = positions.ravel(), np.nan_to_num(normals).ravel()
    return ConstantVertices(*(vertices if float_type is None else (mapped(float_type, array) for array in vertices)))


def _rows(points: FloatBuffer, count: int) -> NDArray[np.float64]:
    """Reshape flat control points to ``(count, 3)``. Raises ValueError if their number is not ``count``."""
    coordinates = np.array(points, dtype=np.float64)
    if coordinates.size != 3 * count:
        from ..kernels.vertex_kernel import coordinates_expected

        raise ValueError(coordinates_expected(coordinates.size, count))
    return coordinates.reshape(-1, 3)


# Kernels, shared by shapes with the same tessellation.
_KERNELS: Shared[VertexKernel] = Shared()


def require_control_points(control_points: FloatBuffer, count: int) -> None:
    """Check flat coordinates of ``count`` control points on any device, and move them to Dr.Jit's memory.

    Raises ValueError if their number differs, or a coordinate is not finite.
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
    non_finite = np.unique(np.flatnonzero(~np.isfinite(points)) // 3)
    coordinates = tuple(points[3 * non_finite[0] : 3 * non_finite[0] + 3].tolist())
    raise ValueError(
        f"vertex {non_finite[0]} has the coordinates {coordinates}; expected finite numbers "
        f"({len(non_finite)} such {'vertex' if len(non_finite) == 1 else 'vertices'} in all)"
    )


def split_weld_targets(table: VertexTable, attributes: AttributeTable) -> NDArray[np.uint32] | None:
    """For each split vertex, the first split vertex at the same point; None if no vertex has copies."""
    if attributes.surface_vertex is None and not table.copies.size:
        return None
    target = attributes.gathered(table.weld_target)
    first = np.empty(table.vertex_count, dtype=np.uint32)
    vertices = np.arange(len(target), dtype=np.uint32)
    # In repeated assignments the last one counts, so assign in reverse order.
    first[target[::-1]] = vertices[::-1]
    return first[target]


class Triangles:
    """Triangles of a tessellation as Dr.Jit arrays, or as NumPy arrays in scalar variants."""

    def __init__(
        self,
        variant: Variant,
        table: VertexTable,
        attributes: AttributeTable,  # Vertices of the mesh, with or without copies along seams
        kept: IntArray | None = None,  # (n,) int64: indices of the triangles of the mesh; None for all
    ) -> None:
        self._variant, self._is_jit = variant, dr.is_jit_v(variant.Float)
        self._kept = slice(None) if kept is None else kept
        self._name = None if kept is None else Content(kept)
        self.table, self.layout, self._attributes = table, attributes.layout, attributes
        self.patch_count, self.has_texcoords = table.patch_count, "texcoords" in attributes.values
        # References that keep shared arrays alive.
        self._held: dict[str, SharedArray] = {}

    def faces(self, *, are_turned: bool) -> IndexBuffer:
        """Vertices of all triangles, flat; in reversed order if ``are_turned``."""

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
        """See `split_weld_targets`; None if no vertex has copies."""

        def make() -> SharedArray:
            targets = split_weld_targets(self.table, self._attributes)
            return SharedArray(None if targets is None else mapped(self._variant.UInt32, targets))

        return self._shared("weld_target", (self.table, self.layout, self._variant), make)

    def _shared(self, name: str, key: tuple, make: Callable[[], SharedArray]) -> FloatBuffer | IndexBuffer:
        self._held[name] = _SHARED.get((name, *key), make)
        return self._held[name].array


_SHARED: Shared[SharedArray] = Shared()
