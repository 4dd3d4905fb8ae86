"""Buffers of the shape's mesh: vertices, which follow control points and placement, and triangles."""

from __future__ import annotations

from functools import cached_property, partial
from typing import TYPE_CHECKING, NamedTuple
from weakref import WeakMethod

import drjit as dr
import numpy as np
from numpy.typing import NDArray

from ..device_arrays import mapped
from ..kernels.array_types import ArrayTypes, FloatBuffer, IndexBuffer, LaterArrays
from ..mesh import IntArray, ragged
from ..mesh.shared import Content, SharedArray, shared, shared_by_key
from ..schemes.domain import FloatArray
from ..surface import LimitSurface
from ..variants import Variant
from .derivatives import BackwardPasses
from .placement import Placement

if TYPE_CHECKING:
    from ..kernels.surface_kernel import SurfaceKernel
    from ..kernels.vertex_kernel import VertexKernel
    from ..tessellation.attribute_table import AttributeLayout
    from ..tessellation.vertex_table import VertexTable
    from .displacement import DisplacedVertices, ShapeDisplacement
    from .exact_shading import ExactShading
    from .parameters import Parameters

# Largest number of vertices, in object space and of loaded control points, that shapes of equal cages share. Small
# shapes take longer to trace than to compute; vertices of large ones would take memory.
MOST_SHARED = 1 << 16


class Triangles(NamedTuple):
    """The triangles of a shape."""

    table: VertexTable
    layout: AttributeLayout  # Vertices of the mesh, which have copies along seams of attributes
    attributes: dict[str, FloatArray]  # (n, k) float64: values at these vertices, by name
    kept: IntArray | None  # (n,) int64: indices of the triangles of the mesh; None for all


class MeshBuffers:
    """Triangles of a shape, and its vertices in world space; updates exact shading with them.

    Surfaces are evaluated in object space, relative to the centre of the loaded control points, and then mapped to
    world space. Arrays are Dr.Jit arrays, or NumPy arrays in scalar variants.

    Dr.Jit removes a computation from its graph once a gradient has passed backwards through it. So the arrays must be
    `attached` to the parameters again before the gradient of another view. If the parameters were themselves computed
    from other variables, that computation is lost: gradients end at the parameters, and `BackwardPasses` warns.
    """

    # See `arrays_in`.
    UPLOADED_LATER = ("_kernel",)

    def __init__(
        self,
        variant: Variant,
        parameters: Parameters,
        placement: Placement,
        surface: SurfaceKernel | None,  # The surface of hits and of displaced normals; None if neither needs it
        shading: ExactShading | None,
        displacement: ShapeDisplacement | None,
        triangles: Triangles,
        # Method that is called with the gradients of the moving arrays, by name, after each reverse-mode pass
        on_backward: WeakMethod,
    ) -> None:
        self._variant, self._parameters, self._placement = variant, parameters, placement
        self._surface, self._shading, self._on_backward = surface, shading, on_backward
        self._displacement = displacement
        self._types = ArrayTypes(variant.Float) if dr.is_jit_v(variant.Float) else None
        self._is_sampled = parameters.is_sampled
        # Whether vertices are differentiable with respect to control points, placement and displacement.
        self.are_differentiable = not self._is_sampled and dr.is_diff_v(variant.Float)
        if self.are_differentiable:
            names = "control_points or to_world" if displacement is None else "control_points, to_world or heights"
            self.passes = BackwardPasses(parameters.source, names, variant.Float)
        self._evaluated: tuple[FloatBuffer, FloatBuffer] | None = None
        self.retessellate(triangles)

    def retessellate(self, triangles: Triangles) -> None:
        """Choose the triangles, and the vertices to evaluate."""
        self.table, self.layout, self._kept = triangles.table, triangles.layout, Content(triangles.kept)
        table, layout = self.table, self.layout
        vars(self).pop("_kernel", None)
        # Used by the first evaluation alone, and kept alive for those of other shapes; None if vertices are not shared.
        self._loaded: LaterArrays | None = None
        if not self._is_sampled and table.vertex_count <= MOST_SHARED:
            key = LaterArrays, table, self._variant.Float, self._parameters.surface.cage
            self._loaded = shared_by_key(key, LaterArrays)
        self._is_loaded = True
        # Index of each vertex of the mesh among those of the tessellation, if seams have copies
        copied = layout.surface_vertex
        self._copied = copied if copied is None or self._types is None else self._types.indices(copied)
        self._displaced: DisplacedVertices | None = None
        if self._displacement is not None:
            from .displacement import DisplacedVertices

            has_normals = self._shading is None and not self._parameters.face_normals
            vertices = layout, split_weld_targets(table, layout)
            self._displaced = DisplacedVertices(
                self._displacement, self._parameters.surface, *vertices, has_normals=has_normals
            )

    def evaluated(
        self,
        control_points: FloatBuffer,  # Parameter of the shape, in object space
        *,
        moves_points: bool,  # Whether control points have changed
    ) -> dict[str, FloatBuffer]:
        """Evaluate the mesh's buffers, and update exact shading. Returns the buffers by name."""
        points, surface = self._placement.relative(control_points), self._surface
        loaded, self._is_loaded = self._loaded if self._is_loaded and not moves_points else None, False
        if surface is not None and moves_points:
            surface.set_control_points(points)
        elif surface is not None and self.are_differentiable and dr.grad_enabled(points):
            surface.values.attach(points)
        heights = [] if self._displacement is None else self._displacement.variables()
        sources = [control_points, self._placement.matrix, *heights]
        moves = self.are_differentiable and dr.grad_enabled(*sources)
        if self.are_differentiable and loaded is None:
            self.passes.begin(sources)
        # Free the memory of the last evaluation before the next one.
        self._evaluated = None
        evaluate = partial(self._vertices, dr.detach(points))
        vertices: tuple[FloatBuffer, FloatBuffer] = evaluate() if loaded is None else loaded.get(evaluate)
        # Also kept for a displacement, as gradients of heights may be enabled later.
        self._evaluated = vertices if moves or self._displacement is not None else None
        return self._placed(points, *vertices)

    def attached(self, control_points: FloatBuffer) -> dict[str, FloatBuffer]:
        """Attach exact shading and the buffers of the last evaluation to the parameters again."""
        points, surface = self._placement.relative(control_points), self._surface
        if surface is not None and dr.grad_enabled(points):
            surface.values.attach(points)
        if self._evaluated is None:
            raise RuntimeError("vertices were not kept; expected an evaluation with derivatives before")
        return self._placed(points, *self._evaluated)

    def settle(self) -> None:
        """Drop what only updates need, after loading. All kernels of this thread must have ended."""
        vars(self).pop("_kernel", None)
        if self._loaded is not None:
            self._loaded.settled()

    @cached_property
    def _kernel(self) -> VertexKernel | None:
        if self._types is None or self._is_sampled:
            return None
        from ..kernels.vertex_kernel import VertexKernel

        return shared(VertexKernel, self.table, self._types.float)

    def _vertices(self, points: FloatBuffer) -> tuple[FloatBuffer, FloatBuffer]:
        return self._on_host(points) if self._kernel is None else self._kernel.evaluated(points)

    def _on_host(self, points: FloatBuffer) -> tuple[FloatBuffer, FloatBuffer]:
        coordinates = np.array(points, dtype=np.float64).reshape(-1, 3)
        if not self._is_sampled:
            positions, normals = self.table.apply(coordinates)
            return positions.astype(np.float32).ravel(), normals.astype(np.float32).ravel()
        # Each vertex as a sample in float32, by the evaluator of the parameters, for comparison.
        given = self._parameters
        cage = given.surface.cage.with_positions(coordinates)
        surface, how = LimitSurface(cage, given.surface.scheme), (given.evaluator, np.float32, given.sample_offset)
        p, n = surface.sample_vertices(self.table, *how)
        # The published forms may return NaN for the normal of parallel tangents; the kernel returns zero.
        n = np.nan_to_num(n)
        return (p.ravel(), n.ravel()) if self._types is None else (self._types.floats(p), self._types.floats(n))

    def _split(self, flat: FloatBuffer) -> FloatBuffer:
        """Flat 3-vectors of all vertices of the mesh, from those of the tessellation."""
        if self._copied is None:
            return flat
        if self._types is None:
            return flat.reshape(-1, 3)[self._copied].ravel()
        return self._types.gathered(flat, self._copied)

    def _placed(self, points: FloatBuffer, positions: FloatBuffer, normals: FloatBuffer) -> dict[str, FloatBuffer]:
        placement, shading = self._placement, self._shading
        if self.are_differentiable and dr.grad_enabled(points) and self._kernel is not None:
            positions, normals = self._kernel.attached(points, positions, normals)
        positions, normals = self._split(positions), self._split(normals)
        if self._displaced is not None:
            positions, normals = self._displaced(positions, normals, points)
        if not placement.is_identity:
            positions, normals = placement.placed(positions, normals)
        moved = {"vertex_positions": positions, "vertex_normals": normals}
        if shading is not None:
            moved |= {"coefficients": shading.kernel.coefficients, "to_world": placement.matrix}
        if self.are_differentiable:
            attached = {name: array for name, array in moved.items() if dr.grad_enabled(array)}
            if attached:
                moved |= self.passes.watched(attached, self._on_backward)
        if shading is not None:
            shading.kernel.values.take(moved.pop("coefficients"))
            shading.update(moved.pop("to_world"), placement)
        return moved

    def faces(self, *, are_turned: bool) -> IndexBuffer:
        """Vertices of all triangles, flat; in reversed order if ``are_turned``."""
        self._faces = shared(_faces, self._variant.UInt32, self.layout, self._kept, are_turned)
        return self._faces.array

    @property
    def element(self) -> FloatBuffer:
        """Element of each triangle; a buffer of floats."""
        self._element = shared(_elements, self._variant.Float, self.table, self._kept)
        return self._element.array

    @property
    def weld_target(self) -> IndexBuffer | None:
        """See `split_weld_targets`; None if no vertex has copies."""
        self._weld_target = shared(_weld_targets, self._variant.UInt32, self.table, self.layout)
        return self._weld_target.array


# Arrays, shared by shapes with the same tessellation.


def _faces(kind: type, layout: AttributeLayout, kept: Content, are_turned: bool) -> SharedArray:
    triangles = layout.triangles if kept.array is None else layout.triangles[kept.array]
    return _array(kind, triangles[:, [0, 2, 1]] if are_turned else triangles)


def _elements(kind: type, table: VertexTable, kept: Content) -> SharedArray:
    return _array(kind, table.element if kept.array is None else table.element[kept.array])


def _weld_targets(kind: type, table: VertexTable, layout: AttributeLayout) -> SharedArray:
    return _array(kind, split_weld_targets(table, layout))


def _array(kind: type, values: NDArray | None) -> SharedArray:
    if values is None:
        return SharedArray(None)
    return SharedArray(mapped(kind, values) if dr.is_jit_v(kind) else values.ravel())


def split_weld_targets(table: VertexTable, layout: AttributeLayout) -> NDArray[np.uint32] | None:
    """For each split vertex, the first split vertex at the same point; None if no vertex has copies."""
    if layout.surface_vertex is None and not table.copies.size:
        return None
    target = layout.gathered(table.weld_target)
    return ragged.first_indices(target, table.vertex_count)[target].view(np.uint32)
