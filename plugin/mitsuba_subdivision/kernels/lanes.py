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
    """The lanes that evaluate the parts of some classes of patches, and these patches' control points, on the device.

    Parameters
    ----------
    types : ArrayTypes
    table : SamplingTable
    classes : list of SampledClass
    controls : Dr.Jit index array
        `SamplingTable.controls` on the device.

    Attributes
    ----------
    count : int
    runs : list of (SampledClass, GridPart, slice)
        Lanes of a class that evaluate the same part follow each other; with the rows of the part.
    """

    def __init__(self, types: ArrayTypes, table: SamplingTable, classes: Sequence[SampledClass], controls: Any) -> None:
        self.runs: list[tuple[SampledClass, GridPart, slice]] = [
            (members, part, rows) for members in classes for part, rows in table.parts_of(members.patches)
        ]
        lengths = [rows.stop - rows.start for _, _, rows in self.runs]
        self.count = sum(lengths)
        self._index = types.index
        self._controls = controls
        self._patch = types.indices(_joined(part.patches[rows] - c.first_patch for c, part, rows in self.runs))
        self._first_vertex = types.indices(_joined(part.first_vertex[rows] for _, part, rows in self.runs))
        self._run = types.indices(np.repeat(np.arange(len(lengths), dtype=np.uint32), lengths))
        self._first_control = types.indices(np.array([c.first_control for c, _, _ in self.runs]))
        patch_counts, control_counts = np.array([c.controls.shape for c, _, _ in self.runs]).T
        self._patch_count, self._control_count = types.indices(patch_counts), types.indices(control_counts)

    def at(self, lane: Any) -> tuple[Any, Any, Any]:
        """Patch, counted from the first of its class, run, and first vertex of some lanes."""
        return tuple(dr.gather(self._index, values, lane) for values in (self._patch, self._run, self._first_vertex))

    def one_rings(self, patch: Any, run: Any) -> Callable[[Any], Any]:
        """Function from places in the one-rings of patches to control points; beyond the last place, the first."""
        per_run = (self._first_control, self._patch_count, self._control_count)
        first, patch_count, control_count = (dr.gather(self._index, values, run) for values in per_run)

        def control(place: Any) -> Any:
            inside = dr.select(self._index(place) < control_count, place, 0)
            return dr.gather(self._index, self._controls, first + inside * patch_count + patch)

        return control


def _joined(arrays: Iterator[NDArray[np.integer]]) -> NDArray[np.uint32]:
    return np.concatenate(list(arrays), dtype=np.uint32, casting="unsafe")
