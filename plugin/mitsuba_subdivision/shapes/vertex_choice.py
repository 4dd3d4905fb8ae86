"""Choice of the evaluator of a shape's vertices."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import TYPE_CHECKING

import drjit as dr
import numpy as np
from numpy.typing import NDArray

from ..device_arrays import mapped
from ..kernels.types import FloatBuffer
from ..mesh.shared import Shared
from ..surface import LimitSurface
from .vertices import Vertices, split_weld_targets

if TYPE_CHECKING:
    from ..kernels import EvaluatedVertices, VertexKernel
    from ..tessellation import AttributeTable, VertexTable
    from .displacement import ShapeDisplacement
    from .parameters import Parameters


def vertices_of(
    table: VertexTable,
    attributes: AttributeTable,
    parameters: Parameters,
    displacement: ShapeDisplacement | None,
    float_type: type | None,
    *,
    is_exact: bool,
) -> Vertices:
    """Choose the evaluator of the shape's vertices.

    Parameters
    ----------
    float_type : type or None
        Flat Dr.Jit array of a JIT variant; None in scalar variants.
    is_exact : bool
        Whether shading is exact.
    """
    split = attributes
    if displacement is not None:
        # Copies along seams: their displacements differ, and are averaged.
        split = parameters.surface.attribute_table(table)
    evaluate, evaluate_tangents = _evaluators(table, parameters, float_type)
    if displacement is None:
        return Vertices(evaluate, evaluate_tangents, copied=split.surface_vertex, float_type=float_type)
    from .displaced_vertices import DeviceDisplacement, HostDisplacement, VertexLocations

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
        evaluate_tangents,
        copied=split.surface_vertex,
        displacement=displaced,
        kept=kept,
        float_type=float_type,
    )


def _evaluators(
    table: VertexTable, parameters: Parameters, float_type: type | None
) -> tuple[Callable[[FloatBuffer], tuple[FloatBuffer, FloatBuffer]], Callable[[FloatBuffer], EvaluatedVertices] | None]:
    """What evaluates the tessellation's vertices, and, where there are derivatives, also what these need."""
    if parameters.evaluator != "stabilized" or parameters.sample_offset:
        return partial(_sampled, table, parameters, float_type), None
    if float_type is None:
        return partial(_in_numpy, table), None
    from ..kernels import VertexKernel

    kernel = _KERNELS.get((table, float_type), lambda: VertexKernel(table, float_type))
    return kernel, kernel.evaluated if dr.is_diff_v(float_type) else None


def _in_numpy(table: VertexTable, points: FloatBuffer) -> tuple[FloatBuffer, FloatBuffer]:
    positions, normals = table.apply(_rows(points, table.control_count))
    return positions.astype(np.float32).ravel(), normals.astype(np.float32).ravel()


def _sampled(
    table: VertexTable, parameters: Parameters, float_type: type | None, points: FloatBuffer
) -> tuple[FloatBuffer, FloatBuffer]:
    """Vertices sample by sample in float32, by another evaluator, for comparison."""
    cage = parameters.surface.cage
    surface = LimitSurface(cage.with_positions(_rows(points, cage.vertex_count)), parameters.surface.scheme)
    positions, normals = surface.sample_vertices(table, parameters.evaluator, np.float32, parameters.sample_offset)
    # The published forms may return NaN for the normal of parallel tangents; the kernel returns zero.
    found = positions.ravel(), np.nan_to_num(normals).ravel()
    return found if float_type is None else (mapped(float_type, found[0]), mapped(float_type, found[1]))


def _rows(points: FloatBuffer, count: int) -> NDArray[np.float64]:
    """Flat control points as ``(count, 3)``. Raises ValueError if their number is not `count`."""
    found = np.array(points, dtype=np.float64)
    if found.size != 3 * count:
        from ..kernels.vertex_kernel import coordinates_expected

        raise ValueError(coordinates_expected(found.size, count))
    return found.reshape(-1, 3)


# Kernels, shared by shapes of one table.
_KERNELS: Shared[VertexKernel] = Shared()
