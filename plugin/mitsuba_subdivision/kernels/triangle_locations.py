"""Maps from triangles of a tessellation to elements and parameters."""

from __future__ import annotations

from typing import TYPE_CHECKING, Protocol, cast

import drjit as dr
import numpy as np

from ..tessellation import UniformGrid
from .array_types import Float, FloatBuffer, Index, Mask
from .element_walk import ElementWalk, Location

if TYPE_CHECKING:
    from ..mesh.connectivity import IntArray
    from ..tessellation import VertexTable
    from ..tessellation.adaptive import AdaptiveGrid
    from .array_types import ArrayTypes


class TriangleLocations(Protocol):
    """Map from points of triangles to locations on the surface."""

    def __call__(self, triangle: Index, b1: Float, b2: Float, active: Mask = True) -> Location:
        """The location of a point of a triangle, by interpolating the parameters of its corners.

        ``b1`` and ``b2`` are barycentric coordinates of the triangle's second and third corner.
        """
        ...


def triangle_locations(
    table: VertexTable,
    walk: ElementWalk,  # Elements of the tessellated surface
    types: ArrayTypes,
) -> TriangleLocations:
    """Return the locations on the triangles of a tessellation."""
    if isinstance(table.grid, UniformGrid):
        return UniformLocations(table.grid, walk, types)
    return AdaptiveLocations(cast("AdaptiveGrid", table.grid), walk, types)


class AdaptiveLocations:
    """Locations on the triangles of an adaptive tessellation, stored for each triangle."""

    def __init__(self, grid: AdaptiveGrid, walk: ElementWalk, types: ArrayTypes) -> None:
        self._types, self._walk = types, walk
        corner, uv = grid.triangle_locations
        self._half_edge, self._parameters = types.indices(corner), types.floats(uv)

    def __call__(self, triangle: Index, b1: Float, b2: Float, active: Mask = True) -> Location:
        """See `TriangleLocations`."""
        types = self._types
        half_edge = types.fetch(types.index, self._half_edge, triangle, active)
        u, v = _inside(types, self._parameters, triangle, b1, b2, active)
        return self._walk.carried(Location(half_edge, u, v), active)


class UniformLocations:
    """Locations on the triangles of a uniform tessellation, stored once for whole elements and once for corners."""

    def __init__(self, grid: UniformGrid, walk: ElementWalk, types: ArrayTypes) -> None:
        self._types, self._walk = types, walk
        whole, corner = grid.triangle_parameters()
        self._whole_count, self._corner_count = len(whole), len(corner)
        self._parameters = types.floats(np.concatenate([whole, corner]))
        # At odd rates, triangles extend from one corner of a polygon into the next.
        self._leave_corners = bool((corner > 1).any())
        counts = grid.triangle_counts
        self._element = self._first = None
        if not (counts == len(whole)).all():
            self._element = types.indices(grid.element())
            self._first = types.indices(np.cumsum(counts) - counts)

    def __call__(self, triangle: Index, b1: Float, b2: Float, active: Mask = True) -> Location:
        """See `TriangleLocations`."""
        types = self._types
        if self._element is None:
            element, pattern = triangle // self._whole_count, triangle % self._whole_count
            corner = types.index(0)
        else:
            element = types.fetch(types.index, self._element, triangle, active)
            local = triangle - types.fetch(types.index, self._first, element, active)
            is_whole = self._walk.is_whole(self._walk.at(element, 0, 0, active=active).half_edge, active)
            per_corner = max(self._corner_count, 1)
            corner = dr.select(is_whole, 0, local // per_corner)
            pattern = dr.select(is_whole, local, self._whole_count + local % per_corner)
        u, v = _inside(types, self._parameters, pattern, b1, b2, active)
        location = self._walk.at(element, u, v, corner, active)
        return self._walk.carried(location, active) if self._leave_corners else location


def _inside(
    types: ArrayTypes, parameters: FloatBuffer, triangle: Index, b1: Float, b2: Float, active: Mask
) -> list[Float]:
    """Parameters of a point of a triangle, interpolated from those of its corners."""
    corners = (types.fetch(types.vector2, parameters, 3 * triangle + i, active) for i in range(3))
    return [dr.fma(b1, b - a, dr.fma(b2, c - a, a)) for a, b, c in zip(*corners, strict=True)]


class SomeTriangles:
    """Locations on a subset of the triangles of a tessellation."""

    def __init__(
        self,
        locations: TriangleLocations,  # Of all triangles
        kept: IntArray,  # (n,) int64: indices of the subset among all triangles
        types: ArrayTypes,
    ) -> None:
        self._locations, self._kept, self._types = locations, types.indices(kept), types

    def __call__(self, triangle: Index, b1: Float, b2: Float, active: Mask = True) -> Location:
        """See `TriangleLocations`."""
        number = self._types.fetch(self._types.index, self._kept, triangle, active)
        return self._locations(number, b1, b2, active)
