"""One lane for each part of each patch: what kernels over patches share."""

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

# Takes a vertex of every lane, its point, two tangents, and what these are sums of.
Emit = Callable[[Any, Any, Any, Any, Terms], None]
# Takes a vertex of every lane, gives its point and two tangents.
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
        """Add to the control points' sums the vertices' points and tangents, times the weights.

        Parameters
        ----------
        fetch : callable
            Called within a loop over the samples of every lane.
        sums : flat Dr.Jit float array, 3 for each control point
        """
        ...


class Lanes:
    """The lanes that evaluate the parts of some classes of patches, and these patches' control points, on the device.

    Parameters
    ----------
    types : ArrayTypes
    runs : list of ClassPart
        Lanes of a class that evaluate the same part follow each other.
    controls : Dr.Jit index array
        `SamplingTable.controls` on the device.
    are_rounded : bool
        Whether the control points are sums of others, and so may miss their place by rounding.

    Attributes
    ----------
    count : int
    """

    def __init__(self, types: ArrayTypes, runs: Sequence[ClassPart], controls: Any, are_rounded: bool) -> None:
        lengths = [len(run.patches) for run in runs]
        self.count = sum(lengths)
        self._index = types.index
        self._controls = controls
        self._rounding = ROUNDED[dr.type_v(types.float)] if are_rounded else 0
        self._patch = types.indices(*(run.patches for run in runs))
        self._first_vertex = types.indices(*(run.first_vertex for run in runs))
        self._run = types.indices(np.repeat(np.arange(len(lengths), dtype=np.uint32), lengths))
        self._first_control = types.indices(np.array([run.members.first_control for run in runs]))
        patch_counts, control_counts = np.array([run.members.controls.shape for run in runs]).T
        self._patch_count, self._control_count = types.indices(patch_counts), types.indices(control_counts)
        frame_weights = [np.abs(run.members.weights[1:, run.part.samples]).sum(axis=2).max(axis=1) for run in runs]
        self._frame_weights = types.float(COLLAPSED[dr.type_v(types.float)] * np.ravel(frame_weights))
        self._float = types.float

    def at(self, lane: Any) -> tuple[Any, Any, Any]:
        """Patch, counted from the first of its class, run, and first vertex of some lanes."""
        return tuple(dr.gather(self._index, values, lane) for values in (self._patch, self._run, self._first_vertex))

    def terms(self, run: Any, origin: Any, relative: Iterable[Any], is_turned: bool = False) -> Terms:
        """What the two tangents are sums of.

        Parameters
        ----------
        run : index array
        origin : 3-vector
        relative : iterable of 3-vectors
            Control points relative to the origin.
        is_turned : bool
            Whether the tangents may be by v and u.
        """
        u, v = (dr.gather(self._float, self._frame_weights, 2 * run + i) for i in (0, 1))
        if is_turned:
            u = v = dr.maximum(u, v)
        reach = reduce(dr.maximum, map(dr.abs, relative))
        if self._rounding:
            reach = dr.maximum(reach, dr.abs(origin) * self._rounding)
        return Terms(u, v, reach)

    def one_rings(self, patch: Any, run: Any) -> Callable[[Any], Any]:
        """Function from places in the one-rings of patches to control points; beyond the last place, the first."""
        per_run = (self._first_control, self._patch_count, self._control_count)
        first, patch_count, control_count = (dr.gather(self._index, values, run) for values in per_run)

        def control(place: Any) -> Any:
            inside = dr.select(self._index(place) < control_count, place, 0)
            return dr.gather(self._index, self._controls, first + inside * patch_count + patch)

        return control
