"""Random points of a surface on the device, nearly uniform by area, with their probability density."""

from __future__ import annotations

from typing import TYPE_CHECKING

import drjit as dr
import numpy as np

from .array_types import ArrayTypes
from .element_walk import ElementWalk, Location
from .types import Float, Index, Mask, Vector2

if TYPE_CHECKING:
    from ..patches import SamplingCells


class AreaSampler:
    """Draws random locations on a surface.

    Parameters
    ----------
    cells : SamplingCells
    types : ArrayTypes
    walk : ElementWalk
        Over the surface's elements.
    """

    def __init__(self, cells: SamplingCells, types: ArrayTypes, walk: ElementWalk) -> None:
        self._types, self._walk = types, walk
        self._count = len(cells.areas)
        if not cells.areas.sum() > 0:
            raise ValueError("the surface has no area; expected one to draw points from")
        precision = np.float64 if types.is_double else np.float32
        # Probabilities are differences of the rounded cumulative sums.
        until = (np.cumsum(cells.areas) / cells.areas.sum()).astype(precision)
        until[-1] = 1
        chances = np.diff(until.astype(np.float64), prepend=0)
        size = np.abs(np.linalg.det(cells.matrices)) * (0.5 if walk.domain.corner_count == 3 else 1)
        self._until = types.floats(until)
        self._start = types.indices(cells.half_edge)
        self._matrices, self._offsets = types.floats(cells.matrices), types.floats(cells.offsets)
        self._density = types.floats(chances / size)

    def drawn(self, choice: Float, inside: Vector2) -> tuple[Location, Float]:
        """Locations, and their density by the parameters of their elements.

        Parameters
        ----------
        choice : float array
            In [0, 1).
        inside : 2-vector
            In [0, 1) each.
        """
        types = self._types

        def is_before(index: Index) -> Mask:
            return types.fetch(types.float, self._until, index) <= choice

        number = types.index(dr.binary_search(0, self._count - 1, is_before))
        x, y = inside[0], inside[1]
        if self._walk.domain.corner_count == 3:
            is_beyond = x + y > 1
            x, y = dr.select(is_beyond, 1 - x, x), dr.select(is_beyond, 1 - y, y)
        a, b, c, d = types.fetch(types.vector4, self._matrices, number)
        offset = types.fetch(types.vector2, self._offsets, number)
        u, v = dr.fma(a, x, dr.fma(b, y, offset[0])), dr.fma(c, x, dr.fma(d, y, offset[1]))
        half_edge = types.fetch(types.index, self._start, number)
        return Location(half_edge, u, v), types.fetch(types.float, self._density, number)
