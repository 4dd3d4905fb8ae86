"""One lane for each part of each patch: what kernels over patches share."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from typing import TYPE_CHECKING, Any, Protocol

import drjit as dr
import numpy as np
from numpy.typing import NDArray

from .array_types import ArrayTypes

if TYPE_CHECKING:
    from ..tessellation import SampledClass, SamplingTable
    from ..tessellation.grid import GridPart

# Takes a vertex of every lane, its point, and two tangents.
Emit = Callable[[Any, Any, Any, Any], None]


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

    def add_transposed(self, padded: Sequence[Any], sums: Any) -> None:
        """Add to the control points' sums the vertices' points and tangents, times the weights.

        Parameters
        ----------
        padded : three flat Dr.Jit float arrays
        sums : flat Dr.Jit float array, 3 for each control point
        """
        ...


class Lanes:
    """Patches with their control points, and the lanes that evaluate their parts, on the device.

    Parameters
    ----------
    types : ArrayTypes
    table : SamplingTable
    classes : list of SampledClass
        Successive ones.
    width : int
        Control points of each patch; where there are fewer, the first again.

    Attributes
    ----------
    count : int
    parts : list of (GridPart, slice)
        With the rows of each that are among the patches.
    """

    def __init__(self, types: ArrayTypes, table: SamplingTable, classes: Sequence[SampledClass], width: int) -> None:
        first, last = classes[0].patches.start, classes[-1].patches.stop
        controls = np.empty((width, last - first), dtype=np.uint32)
        for members in classes:
            own, count = slice(members.patches.start - first, members.patches.stop - first), members.controls.shape[1]
            controls[:count, own] = members.controls.T
            controls[count:, own] = members.controls[:, 0]
        self.parts: list[tuple[GridPart, slice]] = list(table.parts_of(slice(first, last)))
        self._index = types.index
        self._patch_count = dr.opaque(types.index, last - first)
        self._controls = types.indices(controls)
        lengths = [rows.stop - rows.start for _, rows in self.parts]
        self.count = sum(lengths)
        self._patch = types.indices(_joined(part.patches[rows] - first for part, rows in self.parts))
        self._first_vertex = types.indices(_joined(part.first_vertex[rows] for part, rows in self.parts))
        self._part = types.indices(np.repeat(np.arange(len(lengths), dtype=np.uint32), lengths))

    def at(self, lane: Any) -> tuple[Any, Any, Any]:
        """Patch, part and first vertex of some lanes."""
        return tuple(dr.gather(self._index, values, lane) for values in (self._patch, self._part, self._first_vertex))

    def control(self, patch: Any, place: Any) -> Any:
        """Control point at a place in the one-ring of a patch."""
        return dr.gather(self._index, self._controls, patch + place * self._patch_count)


def _joined(arrays: Iterator[NDArray[np.integer]]) -> NDArray[np.uint32]:
    return np.concatenate(list(arrays), dtype=np.uint32, casting="unsafe")
