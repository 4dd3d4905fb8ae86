"""Choice of the evaluator of a shape's vertices."""

from __future__ import annotations

from typing import TYPE_CHECKING

import drjit as dr
import numpy as np

from ..llvm import llvm_problem
from .vertices import KernelVertices, SampledVertices, SplitVertices, TableVertices, Vertices, split_weld_targets

if TYPE_CHECKING:
    from ..tessellation import AttributeTable, VertexTable
    from .displacement import ShapeDisplacement
    from .parameters import Parameters

# Above this many vertices, scalar variants evaluate them with LLVM: compiling a kernel may take a tenth of a second.
WORTH_A_KERNEL = 300_000


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
    table : VertexTable
    attributes : AttributeTable
    parameters : Parameters
    displacement : ShapeDisplacement, optional
    float_type : type or None
        Flat Dr.Jit array of a JIT variant; None in scalar variants.
    is_exact : bool
        Whether shading is exact.
    """
    surface, is_jit = parameters.surface, float_type is not None
    split = attributes
    if displacement is not None:
        # Copies along seams: their displacements differ, and are averaged.
        split = surface.attribute_table(table)
    vertices: Vertices
    if parameters.evaluator != "stabilized" or parameters.sample_offset:
        vertices = SampledVertices(table, parameters, float_type)
    elif float_type is not None:
        vertices = KernelVertices(table, float_type)
    elif table.vertex_count > WORTH_A_KERNEL and llvm_problem() is None:
        float_type = dr.llvm.Float
        vertices = KernelVertices(table, float_type)
    else:
        vertices = TableVertices(table)
    if split.surface_vertex is not None:
        vertices = SplitVertices(vertices, split.surface_vertex, float_type)
    if displacement is None:
        return vertices
    from .displaced_vertices import DisplacedKernelVertices, DisplacedTableVertices, VertexLocations

    found = split_weld_targets(table, split)
    weld_target = np.arange(table.vertex_count) if found is None else found.astype(np.int64)
    locations = VertexLocations(*(split.locate or table.locations)(), weld_target)
    slopes = locations.follow_slopes(surface, displacement.channel)
    has_normals = not (is_exact or parameters.face_normals)
    if displacement.kernel is not None and is_jit and float_type is not None:
        vertices = DisplacedKernelVertices(
            vertices, locations, slopes, displacement.kernel, float_type, has_normals=has_normals
        )
    else:
        vertices = DisplacedTableVertices(vertices, locations, slopes, surface, displacement, has_normals=has_normals)
        float_type = None
    if is_exact and split.surface_vertex is not None:
        # With exact shading, vertices have no copies along seams.
        _, first = np.unique(split.surface_vertex, return_index=True)
        vertices = SplitVertices(vertices, first, float_type)
    return vertices
