"""Lanes of the kernels over patches: one for each patch and part of its grid."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from functools import reduce
from typing import TYPE_CHECKING, Any, Protocol

import drjit as dr
import numpy as np

from .array_types import ArrayTypes
from .unit_normal import LEAST_EXTENT, TANGENT_ROUNDING, RoundingBound

if TYPE_CHECKING:
    from ..tessellation import Runs

# Receives for every lane a vertex, its point, its two tangents, and the rounding bound of the tangents.
Emit = Callable[[Any, Any, Any, Any, RoundingBound], None]
# Returns for every lane's vertex the vectors that the weights of its point and two tangents multiply.
Fetch = Callable[[Any], tuple[Any, Any, Any]]


class Batch(Protocol):
    """Patches that one kernel evaluates."""

    def sample(self, padded: Any, emit: Emit) -> None:
        """Evaluate all samples.

        Parameters
        ----------
        padded : flat Dr.Jit float array
            Control points, see `ArrayTypes.padded`.
        emit : callable
            Called within a loop over the samples of every lane.
        """
        ...

    def add_transposed(self, fetch: Fetch, sums: Any) -> None:
        """Apply the transposed map: add the vectors of all samples, times the weights, to the control points' sums.

        Parameters
        ----------
        fetch : callable
            Returns a sample's three vectors, one for its point and one for each tangent. Called within a loop over the
            samples of every lane.
        sums : flat Dr.Jit float array, 3 for each control point
        """
        ...


class Lanes:
    """The lanes that evaluate some runs, one each, and the control points of their patches, on the device.

    Parameters
    ----------
    types : ArrayTypes
    runs : Runs
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

    def __init__(self, types: ArrayTypes, runs: Runs, controls: Any, are_rounded: bool) -> None:
        self.count = len(runs.kind)
        self._index = types.index
        self._controls = controls
        self._rounding = LEAST_EXTENT[dr.type_v(types.float)] if are_rounded else 0
        self._patch, self._first_vertex = types.indices(runs.patch), types.indices(runs.first_vertex)
        self._kind = types.indices(runs.kind)
        of_classes = [(each.first_control, *each.controls.shape) for each in runs.classes]
        of_kinds = np.array(of_classes)[runs.class_of_kind].T
        self._first_control, self._patch_count, self._control_count = (types.indices(values) for values in of_kinds)
        self._frame_weights = types.float(TANGENT_ROUNDING[dr.type_v(types.float)] * np.ravel(runs.frame_weights()))
        self._float = types.float

    def at(self, lane: Any) -> tuple[Any, Any, Any]:
        """The patch of each lane, counted from the first of its class, its kind, and its first vertex."""
        patch: Any = dr.gather(self._index, self._patch, lane)
        kind: Any = dr.gather(self._index, self._kind, lane)
        first_vertex: Any = dr.gather(self._index, self._first_vertex, lane)
        return patch, kind, first_vertex

    def rounding_bound(self, kind: Any, origin: Any, relative: Iterable[Any], is_turned: bool = False) -> RoundingBound:
        """Rounding bound of the two tangents.

        Parameters
        ----------
        kind : index array
        origin : 3-vector
            A control point of each lane's patch.
        relative : iterable of 3-vectors
            Its other control points relative to the origin.
        is_turned : bool
            Whether the first tangent may be the one by v, and the second the one by u.
        """
        u: Any
        v: Any
        u, v = (dr.gather(self._float, self._frame_weights, 2 * kind + i) for i in (0, 1))
        if is_turned:
            u = v = dr.maximum(u, v)
        extent = reduce(dr.maximum, map(dr.abs, relative))
        if self._rounding:
            extent = dr.maximum(extent, dr.abs(origin) * self._rounding)
        return RoundingBound(u, v, extent)

    def one_rings(self, patch: Any, kind: Any) -> Callable[[Any], Any]:
        """Function that finds the control points of some patches by their column in `ClassStencils.controls`.

        For columns past the last one, it returns the first control point.
        """
        per_part = (self._first_control, self._patch_count, self._control_count)
        first: Any
        patch_count: Any
        control_count: Any
        first, patch_count, control_count = (dr.gather(self._index, values, kind) for values in per_part)

        def control(column: Any) -> Any:
            inside = dr.select(self._index(column) < control_count, column, 0)
            return dr.gather(self._index, self._controls, first + inside * patch_count + patch)

        return control
