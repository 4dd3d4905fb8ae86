"""Positions and normals of the shape's vertices in object space."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

import drjit as dr
import numpy as np
from numpy.typing import NDArray

from ..device_arrays import take_over
from ..kernels.types import FloatBuffer, IndexBuffer
from ..mesh.connectivity import IntArray
from .device_state import is_recording

if TYPE_CHECKING:
    from ..kernels import EvaluatedVertices
    from ..tessellation import AttributeTable, VertexTable
    from .displaced_vertices import DeviceDisplacement, HostDisplacement


class Vertices:
    """Evaluates the vertices of a tessellation, copies them along the seams of attributes, and displaces them.

    Parameters
    ----------
    evaluate : callable
        Flat positions and unit normals of flat control points, both relative to the centre of the control points as
        they were loaded (`RecentredPoints`): arrays of Dr.Jit, or of NumPy.
    evaluate_tangents : callable, optional
        The same with what derivatives by the control points need. Without it, there are no such derivatives.
    copied : (n,) int, optional
        The vertex that `evaluate` returns for each vertex of the shape, where seams have several copies of one.
    displacement : DeviceDisplacement or HostDisplacement, optional
        Of the copied vertices.
    kept : (m,) int, optional
        Displaced vertices that the shape has. Exact shading needs one copy of each.
    float_type : type, optional
        Flat Dr.Jit array of JIT variants.

    Attributes
    ----------
    are_differentiable : bool
        Whether they have derivatives.
    """

    def __init__(
        self,
        evaluate: Callable[[FloatBuffer], tuple[FloatBuffer, FloatBuffer]],
        evaluate_tangents: Callable[[FloatBuffer], EvaluatedVertices] | None = None,
        *,
        copied: IntArray | None = None,
        displacement: DeviceDisplacement | HostDisplacement | None = None,
        kept: IntArray | None = None,
        float_type: type | None = None,
    ) -> None:
        self._evaluate, self._evaluate_tangents = evaluate, evaluate_tangents
        self._copies, self._displacement, self._kept = (
            _Selection(copied, float_type),
            displacement,
            _Selection(kept, float_type),
        )
        self.are_differentiable = evaluate_tangents is not None
        if displacement is not None:
            self.are_differentiable = displacement.is_differentiable
        self._evaluated: EvaluatedVertices | None = None
        # Undisplaced, detached.
        self._found: tuple[FloatBuffer, FloatBuffer] | None = None

    def __call__(self, points: FloatBuffer) -> tuple[FloatBuffer, FloatBuffer]:
        """Positions and normals, flat."""
        # Free the last evaluation before the next one allocates memory.
        self._evaluated = self._found = None
        if self._evaluate_tangents is not None and dr.grad_enabled(points):
            self._evaluated = self._evaluate_tangents(dr.detach(points))
            return self.attached(points)
        found = self._evaluate(points)
        if self._displacement is not None:
            self._found = dr.detach(found[0]), dr.detach(found[1])
        return self._displaced(*found, points)

    def attached(self, points: FloatBuffer) -> tuple[FloatBuffer, FloatBuffer]:
        """The vertices of the last call, attached to the control points and the displacement again."""
        if self._evaluated is not None:
            return self._displaced(*self._evaluated.attached(points), points)
        if self._found is None or (self._evaluate_tangents is not None and dr.grad_enabled(points)):
            raise RuntimeError("vertices were not evaluated with derivatives; expected a call with some before")
        return self._displaced(*self._found, points)

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
