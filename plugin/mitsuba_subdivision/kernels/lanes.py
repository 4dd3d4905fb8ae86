"""Lanes, one for each patch and part of its grid: what the kernels over patches share."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from functools import reduce
from typing import TYPE_CHECKING, Any, Protocol

import drjit as dr
import numpy as np

from .array_types import ArrayTypes
from .unit_normal import COLLAPSED, ROUNDED, Terms

if TYPE_CHECKING:
    from ..tessellation import ClassPart

# Takes for every lane a vertex, its point, its two tangents, and the terms that these are sums of.
Emit = Callable[[Any, Any, Any, Any, Terms], None]
# Takes for every lane a vertex, and gives vectors in place of its point and its two tangents.
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
        """Add to every control point's sum the vectors of all samples, times the point's weights in them.

        Parameters
        ----------
        fetch : callable
            Gives a sample's three vectors, one for its point and one for each tangent. Called within a loop over the
            samples of every lane.
        sums : flat Dr.Jit float array, 3 for each control point
        """
        ...


class Lanes:
    """The lanes that evaluate some parts, and the control points of their patches, on the device.

    Parameters
    ----------
    types : ArrayTypes
    parts : list of ClassPart
        Of one class or several. Each has a lane for each of its patches, one after the other.
    controls : Dr.Jit index array
        `SamplingTable.controls` on the device.
    are_rounded : bool
        Whether the control points are sums of others, and so have been rounded.

    Attributes
    ----------
    count : int
        Number of lanes.
    """

    def __init__(self, types: ArrayTypes, parts: Sequence[ClassPart], controls: Any, are_rounded: bool) -> None:
        lengths = [len(each.patches) for each in parts]
        self.count = sum(lengths)
        self._index = types.index
        self._controls = controls
        self._rounding = ROUNDED[dr.type_v(types.float)] if are_rounded else 0
        self._patch = types.indices(*(each.patches for each in parts))
        self._first_vertex = types.indices(*(each.first_vertex for each in parts))
        self._part = types.indices(np.repeat(np.arange(len(lengths), dtype=np.uint32), lengths))
        self._first_control = types.indices(np.array([each.stencils.first_control for each in parts]))
        patch_counts, control_counts = np.array([each.stencils.controls.shape for each in parts]).T
        self._patch_count, self._control_count = types.indices(patch_counts), types.indices(control_counts)
        frame_weights = [np.abs(each.stencils.weights[1:, each.part.samples]).sum(axis=2).max(axis=1) for each in parts]
        self._frame_weights = types.float(COLLAPSED[dr.type_v(types.float)] * np.ravel(frame_weights))
        self._float = types.float

    def at(self, lane: Any) -> tuple[Any, Any, Any]:
        """Of some lanes the patch, counted from the first of its class, the index of the part, and the first vertex."""
        patch: Any = dr.gather(self._index, self._patch, lane)
        part: Any = dr.gather(self._index, self._part, lane)
        first_vertex: Any = dr.gather(self._index, self._first_vertex, lane)
        return patch, part, first_vertex

    def terms(self, part: Any, origin: Any, relative: Iterable[Any], is_turned: bool = False) -> Terms:
        """The terms that the two tangents are sums of, see `Terms`.

        Parameters
        ----------
        part : index array
        origin : 3-vector
            A control point of each lane's patch.
        relative : iterable of 3-vectors
            Its other control points relative to the origin.
        is_turned : bool
            Whether the first tangent may be the one by v, and the second the one by u.
        """
        u: Any
        v: Any
        u, v = (dr.gather(self._float, self._frame_weights, 2 * part + i) for i in (0, 1))
        if is_turned:
            u = v = dr.maximum(u, v)
        reach = reduce(dr.maximum, map(dr.abs, relative))
        if self._rounding:
            reach = dr.maximum(reach, dr.abs(origin) * self._rounding)
        return Terms(u, v, reach)

    def one_rings(self, patch: Any, part: Any) -> Callable[[Any], Any]:
        """Function that finds the control points of some patches by their column in `ClassStencils.controls`.

        For columns past the last one, it finds the first control point.
        """
        per_part = (self._first_control, self._patch_count, self._control_count)
        first: Any
        patch_count: Any
        control_count: Any
        first, patch_count, control_count = (dr.gather(self._index, values, part) for values in per_part)

        def control(column: Any) -> Any:
            inside = dr.select(self._index(column) < control_count, column, 0)
            return dr.gather(self._index, self._controls, first + inside * patch_count + patch)

        return control
