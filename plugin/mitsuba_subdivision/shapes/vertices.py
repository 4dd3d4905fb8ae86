"""Positions and normals of the shape's vertices in object space.

Each evaluator is called with flat control points relative to their centre (`RecentredPoints`), and returns flat
positions, relative to it as well, and unit normals: arrays of Dr.Jit, or of NumPy in scalar variants. Kernels are
imported where they are used: a small scene of a scalar variant needs none.
"""

from __future__ import annotations

from functools import cached_property
from typing import TYPE_CHECKING, Protocol, cast

import drjit as dr
import numpy as np
from numpy.typing import NDArray

from ..kernels.types import FloatBuffer, IndexBuffer
from ..mesh.connectivity import IntArray
from ..mesh.shared import Shared
from ..surface import LimitSurface

if TYPE_CHECKING:
    from ..kernels import EvaluatedVertices, WeightKernel
    from ..kernels.array_types import ArrayTypes
    from ..tessellation import AttributeTable, VertexTable
    from .parameters import Parameters


class Vertices(Protocol):
    """Evaluates positions and normals of a tessellation; see the module.

    Attributes
    ----------
    are_differentiable : bool
        Whether they are `DifferentiableVertices`.
    """

    are_differentiable: bool

    def __call__(self, points: FloatBuffer) -> tuple[FloatBuffer, FloatBuffer]:
        """Positions and normals."""
        ...


class DifferentiableVertices(Vertices, Protocol):
    """Vertices with derivatives by the control points."""

    def attached(self, points: FloatBuffer) -> tuple[FloatBuffer, FloatBuffer]:
        """The vertices of the last call, attached to the control points again."""
        ...


class TableVertices:
    """Evaluates vertices with NumPy."""

    are_differentiable = False

    def __init__(self, table: VertexTable) -> None:
        self._table = table

    def __call__(self, points: FloatBuffer) -> tuple[FloatBuffer, FloatBuffer]:
        """See `Vertices`."""
        positions, normals = self._table.apply(_rows(points, self._table.control_count), np.float32)
        return positions.ravel(), normals.ravel()


class SampledVertices:
    """Evaluates vertices sample by sample in float32 by another evaluator than the weights, for comparison."""

    are_differentiable = False

    def __init__(self, table: VertexTable, parameters: Parameters, float_type: type | None) -> None:
        self._table, self._parameters, self._float = table, parameters, float_type

    def __call__(self, points: FloatBuffer) -> tuple[FloatBuffer, FloatBuffer]:
        """See `Vertices`."""
        given, cage = self._parameters, self._parameters.surface.cage
        surface = LimitSurface(cage.with_positions(_rows(points, cage.vertex_count)), given.surface.scheme)
        positions, normals = surface.sample_vertices(self._table, given.evaluator, np.float32, given.sample_offset)
        # The published forms may return NaN for the normal of parallel tangents; the kernel returns zero.
        found = positions.ravel(), np.nan_to_num(normals).ravel()
        return found if self._float is None else (self._float(found[0]), self._float(found[1]))


class KernelVertices:
    """Evaluates vertices with a `WeightKernel`."""

    def __init__(self, table: VertexTable, float_type: type) -> None:
        from ..kernels import WeightKernel

        self._kernel = _KERNELS.get((table, float_type), lambda: WeightKernel(table, float_type))
        self._float = float_type
        self._evaluated: EvaluatedVertices | None = None
        self.are_differentiable = bool(dr.is_diff_v(float_type))

    def __call__(self, points: FloatBuffer) -> tuple[FloatBuffer, FloatBuffer]:
        """See `Vertices`."""
        # Free the last evaluation before the next one allocates memory.
        self._evaluated = None
        if not isinstance(points, self._float):
            points = self._float(np.array(points))
        if not dr.grad_enabled(points):
            return self._kernel(points)
        self._evaluated = self._kernel.evaluated(dr.detach(points))
        return self._evaluated.attached(points)

    def attached(self, points: FloatBuffer) -> tuple[FloatBuffer, FloatBuffer]:
        """See `Vertices`."""
        if self._evaluated is None:
            raise RuntimeError("vertices were not evaluated with derivatives; expected a call with some before")
        return self._evaluated.attached(points)


class SplitVertices:
    """Vertices with copies along the seams of attributes.

    Parameters
    ----------
    vertices : Vertices
    surface_vertex : (n,) int
        Index into `vertices` of each vertex.
    float_type : type or None
        Type of their arrays; None for NumPy arrays.
    """

    def __init__(self, vertices: Vertices, surface_vertex: IntArray, float_type: type | None) -> None:
        self._vertices, self._surface_vertex, self._float = vertices, surface_vertex, float_type
        self.are_differentiable = vertices.are_differentiable

    @cached_property
    def _types(self) -> ArrayTypes:
        from ..kernels.array_types import ArrayTypes

        return ArrayTypes.of(self._float or float)

    @cached_property
    def _index(self) -> IndexBuffer:
        return self._surface_vertex if self._float is None else self._types.indices(self._surface_vertex)

    def __call__(self, points: FloatBuffer) -> tuple[FloatBuffer, FloatBuffer]:
        """See `Vertices`."""
        return self._split(*self._vertices(points))

    def attached(self, points: FloatBuffer) -> tuple[FloatBuffer, FloatBuffer]:
        """See `Vertices`."""
        return self._split(*cast("DifferentiableVertices", self._vertices).attached(points))

    def _split(self, positions: FloatBuffer, normals: FloatBuffer) -> tuple[FloatBuffer, FloatBuffer]:
        if self._float is None:
            return tuple(flat.reshape(-1, 3)[self._index].ravel() for flat in (positions, normals))  # type: ignore[return-value]
        return self._types.gathered(positions, self._index), self._types.gathered(normals, self._index)


def require_finite(control_points: FloatBuffer) -> None:
    """Check flat coordinates on any device.

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


def _rows(points: FloatBuffer, count: int) -> NDArray[np.float64]:
    """Flat control points as ``(count, 3)``.

    Raises
    ------
    ValueError
        If their number is not `count`.
    """
    found = np.array(points, dtype=np.float64)
    if found.size != 3 * count:
        from ..kernels.apply_weights import coordinates_expected

        raise ValueError(coordinates_expected(found.size, count))
    return found.reshape(-1, 3)


# Weights on the device, shared by shapes of one table.
_KERNELS: Shared[WeightKernel] = Shared()
