"""Lanes of the kernels over patches: one for each patch and part of its grid."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from functools import reduce
from typing import TYPE_CHECKING, Protocol

import drjit as dr
import numpy as np

from .array_types import ArrayTypes
from .types import Float, FloatBuffer, Index, IndexBuffer, Vector3
from .unit_normal import LEAST_EXTENT, TANGENT_ROUNDING, RoundingBound

if TYPE_CHECKING:
    from ..tessellation import VertexStencils

# Receives for every lane a vertex, its point, its two tangents, and the rounding bound of the tangents.
Emit = Callable[[Index, Vector3, Vector3, Vector3, RoundingBound], None]
# Returns for every lane's vertex the vectors that the weights of its point and two tangents multiply.
Fetch = Callable[[Index], tuple[Vector3, Vector3, Vector3]]


class Batch(Protocol):
    """Patches that one kernel evaluates."""

    def sample(self, padded: FloatBuffer, emit: Emit) -> None:
        """Evaluate all samples.

        Parameters
        ----------
        padded : flat Dr.Jit float array
            Control points, see `ArrayTypes.padded`.
        emit : callable
            Called within a loop over the samples of every lane.
        """
        ...

    def add_transposed(self, fetch: Fetch, sums: FloatBuffer) -> None:
        """Apply the transposed map: add the vectors of all samples, times the weights, to the control points' sums.

        Parameters
        ----------
        fetch : callable
            Returns a sample's three vectors, one for its point and one for each tangent. Called within a loop over the
            samples of every lane.
        """
        ...


class Lanes:
    """The lanes that evaluate runs of vertices, one each, and the control points of their patches, on the device.

    Parameters
    ----------
    vertices : VertexStencils
        Of one class or several.
    controls : Dr.Jit index array
        `VertexTable.controls` on the device.
    are_rounded : bool
        Whether the control points are sums of others, and so have been rounded.

    Attributes
    ----------
    count : int
        Number of lanes.
    """

    def __init__(self, types: ArrayTypes, vertices: VertexStencils, controls: IndexBuffer, are_rounded: bool) -> None:
        self.count = len(vertices.kind)
        self._index = types.index
        self._controls = controls
        self._rounding = LEAST_EXTENT[dr.type_v(types.float)] if are_rounded else 0
        self._patch, self._first_vertex = (types.indices(vertices.patch), types.indices(vertices.first_vertex))
        self._kind = types.indices(vertices.kind)
        of_classes = [(each.first_control, *each.controls.shape) for each in vertices.classes]
        of_kinds = np.array(of_classes)[vertices.class_of_kind].T
        self._first_control, self._patch_count, self._control_count = (types.indices(values) for values in of_kinds)
        self._frame_weights = types.floats(TANGENT_ROUNDING[dr.type_v(types.float)] * vertices.frame_weights())
        self._float = types.float

    def at(self, lane: Index) -> tuple[Index, Index, Index]:
        """The patch of each lane, counted from the first of its class, its kind, and its first vertex."""
        patch: Index = dr.gather(self._index, self._patch, lane)
        kind: Index = dr.gather(self._index, self._kind, lane)
        first_vertex: Index = dr.gather(self._index, self._first_vertex, lane)
        return patch, kind, first_vertex

    def rounding_bound(
        self, kind: Index, origin: Vector3, relative: Iterable[Vector3], is_turned: bool = False
    ) -> RoundingBound:
        """Rounding bound of the two tangents.

        Parameters
        ----------
        origin : 3-vector
            A control point of each lane's patch.
        relative : iterable of 3-vectors
            Its other control points relative to the origin.
        is_turned : bool
            Whether the first tangent may be the one by v, and the second the one by u.
        """
        u: Float
        v: Float
        u, v = (dr.gather(self._float, self._frame_weights, 2 * kind + i) for i in (0, 1))
        if is_turned:
            u = v = dr.maximum(u, v)
        extent = reduce(dr.maximum, map(dr.abs, relative))
        return RoundingBound(u, v, dr.maximum(extent, dr.abs(origin) * self._rounding))

    def one_rings(self, patch: Index, kind: Index) -> Callable[[Index], Index]:
        """Function that finds the control points of some patches by their column in `ClassStencils.controls`.

        For columns past the last one, it returns the first control point.
        """
        per_part = (self._first_control, self._patch_count, self._control_count)
        first: Index
        patch_count: Index
        control_count: Index
        first, patch_count, control_count = (dr.gather(self._index, values, kind) for values in per_part)

        def control(column: Index) -> Index:
            inside = dr.select(self._index(column) < control_count, column, 0)
            return dr.gather(self._index, self._controls, first + inside * patch_count + patch)

        return control
