"""Locations on the elements of a surface: how they cross to neighbours, and where triangles of a tessellation lie."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import TYPE_CHECKING, cast

import drjit as dr
import numpy as np

from ..patches.piece_table import CODE, CORNERS, FOLLOWING, NOTHING, PRECEDING, TWIN, WHOLE, PieceTable
from ..schemes.domain import ParameterDomain
from ..tessellation.uniform_grid import UniformGrid
from .array_types import ArrayTypes, Float, Index, Index4, Mask

if TYPE_CHECKING:
    from ..tessellation.adaptive_grid import AdaptiveGrid
    from ..tessellation.vertex_table import VertexTable


# Not frozen: Dr.Jit assigns the fields of a loop's state.
@dataclass(eq=False)
class Location:
    """Locations on a surface: parameters in an element, seen from one of its half-edges."""

    half_edge: Index
    u: Float
    v: Float

    def chosen(self, condition: Mask, other: Location) -> Location:
        """Select ``other`` where a condition holds, and this location elsewhere."""
        pairs = (other.half_edge, self.half_edge), (other.u, self.u), (other.v, self.v)
        return Location(*(dr.select(condition, *pair) for pair in pairs))


class ElementWalk:
    """The elements of a piece table on the device, and their adjacency."""

    def __init__(self, table: PieceTable, types: ArrayTypes) -> None:
        self.types = types
        self.domain: ParameterDomain = table.patches.scheme.domain
        self._half_edges = types.indices(table.half_edges)
        self._first = types.indices(table.patches.elements.face_offsets)
        self._all_whole = bool(table.patches.is_whole.all())

    def at(self, element: Index, u: Float, v: Float, corner: Index = 0, active: Mask = True) -> Location:
        """The location in an element, from parameters seen from one of its corners."""
        types = self.types
        # Convert numbers of Python and NumPy, which loops of Dr.Jit reject.
        element, corner = (types.converted(types.index, value) for value in (element, corner))
        u, v = (types.converted(types.float, value) for value in (u, v))
        return Location(dr.gather(types.index, self._first, element, active) + corner, u, v)

    def row(self, half_edge: Index, active: Mask = True) -> Index4:
        """Fetch the row of `PieceTable.half_edges`: twin, following and preceding half-edge, and code."""
        return dr.gather(self.types.index4, self._half_edges, half_edge, active)

    def from_first(self, location: Location, active: Mask = True) -> tuple[Location, Index]:
        """The same locations, seen from the first corner in whole elements; and the corner they were seen from."""
        corner = self.row(location.half_edge, active)[CODE] & CORNERS
        return Location(location.half_edge - corner, *turned(self.domain, location.u, location.v, corner)), corner

    def carried(self, location: Location, active: Mask = True, row: Index4 | None = None) -> Location:
        """Map locations whose parameters are outside of their element to the neighbouring element.

        Parameters are continued as if both elements lay in a plane. They are clamped to a side without a neighbour, on
        a border or a crease, and to the neighbour's sides if they are outside of it, too. ``row`` is the row of the
        half-edges, if known.
        """
        if row is None:
            row = self.row(location.half_edge, active)
        u, v = location.u, location.v
        side, depth, t = self._nearest_side(u, v)
        has_left = active & (depth < 0)
        edge, is_spoke = self._edge_on_side(location.half_edge, row, side)
        carried = location
        if is_spoke is not None:
            is_whole = (row[CODE] & WHOLE) != 0
            t = dr.select(is_whole, t, dr.select(side == 0, u, 2 - v) * 0.5)
            depth = dr.select(is_whole, depth, depth * 0.5)
            is_next = side == 1
            across = Location(
                dr.select(is_next, row[FOLLOWING], row[PRECEDING]),
                dr.select(is_next, v, 2 - v),
                dr.select(is_next, 2 - u, u),
            )
            carried = carried.chosen(has_left & is_spoke, across)
            has_left &= ~is_spoke
        twin = self.row(edge, has_left)[TWIN]
        has_left &= twin != NOTHING
        carried = carried.chosen(has_left, self._entered(twin, 1 - t, -depth, has_left))
        return Location(carried.half_edge, *clamped(self.domain, carried.u, carried.v))

    def is_border(self, location: Location, side: Index, active: Mask = True) -> Mask:
        """Whether a side in the order of `ParameterDomain.edge_distances` has no neighbour, at borders and creases."""
        edge, is_spoke = self._edge_on_side(location.half_edge, self.row(location.half_edge, active), side)
        if is_spoke is not None:
            active = active & ~is_spoke
        return active & (self.row(edge, active)[TWIN] == NOTHING)

    def _nearest_side(self, u: Float, v: Float) -> tuple[Index, Float, Float]:
        """The nearest side of the domain, the signed distance from it, and the position along it."""
        depth, *depths = self.domain.edge_distances(u, v)
        # Positions run from the corner of the same number.
        t, *ts = (u, v, 1 - (u + v)) if self.domain.corner_count == 3 else (u, v, 1 - u, 1 - v)
        side = self.types.index(0)
        for k, (side_depth, side_t) in enumerate(zip(depths, ts, strict=True), start=1):
            is_nearer = side_depth < depth
            side, t = dr.select(is_nearer, self.types.index(k), side), dr.select(is_nearer, side_t, t)
            depth = dr.minimum(depth, side_depth)
        return side, depth, t

    def _edge_on_side(self, half_edge: Index, row: Index4, side: Index) -> tuple[Index, Mask | None]:
        """The half-edge on a side of a whole element, else that on the first or the last side of a corner.

        Also returns where the side is a spoke, between two corners of the same element; None if all elements are whole.
        """
        count, corner = self.domain.corner_count, row[CODE] & CORNERS
        # Half-edges of an element are consecutive.
        end_corner = corner + side
        edge = half_edge - corner + dr.select(end_corner >= count, end_corner - count, end_corner)
        if self._all_whole:
            return edge, None
        is_whole = (row[CODE] & WHOLE) != 0
        edge = dr.select(is_whole, edge, dr.select(side == 0, half_edge, row[PRECEDING]))
        return edge, ~is_whole & ((side == 1) | (side == 2))

    def _entered(self, edge: Index, t: Float, depth: Float, active: Mask) -> Location:
        """The location at a position ``t`` along a half-edge and a distance ``depth`` from it."""
        whole = Location(edge, t, depth)
        if self._all_whole:
            return whole
        row = self.row(edge, active)
        is_near = t <= 0.5
        corner = Location(
            dr.select(is_near, edge, row[FOLLOWING]),
            2 * dr.select(is_near, t, depth),
            2 * dr.select(is_near, depth, 1 - t),
        )
        return corner.chosen((row[CODE] & WHOLE) != 0, whole)


class TriangleLocations:
    """Map from points of the triangles of a tessellation to locations on the surface.

    Parameters are stored for each triangle of an adaptive tessellation; of a uniform one, once for the triangles of all
    whole elements and once for those of all corners of others.
    """

    def __init__(self, table: VertexTable, walk: ElementWalk) -> None:
        types = walk.types
        self._types, self._walk, self._half_edge, self._element = types, walk, None, None
        if not isinstance(table.grid, UniformGrid):
            half_edge, uv = cast("AdaptiveGrid", table.grid).triangle_locations
            self._half_edge, self._parameters, self._leave_elements = types.indices(half_edge), types.floats(uv), True
            return
        whole, corner = table.grid.triangle_parameters()
        self._whole_count, self._corner_count = len(whole), len(corner)
        self._parameters = types.floats(np.concatenate([whole, corner]))
        # At odd rates, triangles extend from one corner of a polygon into the next.
        self._leave_elements = bool((corner > 1).any())
        counts = table.grid.triangle_counts
        if not (counts == len(whole)).all():
            self._element = types.indices(table.grid.element())
            self._first = types.indices(np.cumsum(counts) - counts)

    def __call__(self, triangle: Index, b1: Float, b2: Float, active: Mask = True) -> Location:
        """The location of a point of a triangle, by interpolating the parameters of its corners.

        ``b1`` and ``b2`` are barycentric coordinates of the triangle's second and third corner.
        """
        types = self._types
        half_edge, row = self._row(triangle, active)
        corners = (dr.gather(types.vector2, self._parameters, 3 * row + i, active) for i in range(3))
        u, v = (dr.fma(b1, b - a, dr.fma(b2, c - a, a)) for a, b, c in zip(*corners, strict=True))
        location = Location(half_edge, u, v)
        return self._walk.carried(location, active) if self._leave_elements else location

    def _row(self, triangle: Index, active: Mask) -> tuple[Index, Index]:
        types, walk = self._types, self._walk
        if self._half_edge is not None:
            return dr.gather(types.index, self._half_edge, triangle, active), triangle
        if self._element is None:
            count = self._whole_count
            return walk.at(triangle // count, 0, 0, active=active).half_edge, triangle % count
        element = dr.gather(types.index, self._element, triangle, active)
        number = triangle - dr.gather(types.index, self._first, element, active)
        first = walk.at(element, 0, 0, active=active).half_edge
        is_whole, per_corner = (walk.row(first, active)[CODE] & WHOLE) != 0, max(self._corner_count, 1)
        corner = dr.select(is_whole, 0, number // per_corner)
        return first + corner, dr.select(is_whole, number, self._whole_count + number % per_corner)


def clamped(domain: ParameterDomain, u: Float, v: Float) -> tuple[Float, Float]:
    """Clamp parameters to a domain, approximately to the nearest point."""
    u, v = dr.clip(u, 0, 1), dr.clip(v, 0, 1)
    if domain.corner_count == 4:
        return u, v
    beyond = dr.maximum(u + v - 1, 0) / 2
    return dr.clip(u - beyond, 0, 1), dr.clip(v - beyond, 0, 1)


def doublings(
    types: ArrayTypes,
    x: Float,  # Detached here
    most: Index,  # Upper bound of the result
) -> tuple[Index, Float]:
    """The number of times that a positive number can be doubled until it is at least 1, and two to this power.

    Read from the bits of the exponent, which is exact and takes a tenth of the operations of a logarithm.
    """
    integer, mantissa, bias = (types.index64, 52, 1023) if types.is_double else (types.index, 23, 127)
    bits: Index = dr.reinterpret_array(integer, dr.detach(x))
    count: Index = dr.minimum(bias - 1 - dr.minimum(bits >> mantissa, bias - 1), integer(most))
    return types.index(count), dr.reinterpret_array(types.float, (count + bias) << mantissa)


def turned(domain: ParameterDomain, u: Float, v: Float, turn: Index) -> tuple[Float, Float]:
    """Convert parameters seen from corner ``turn`` to those seen from the first corner."""
    by_one, by_two = turn == 1, turn == 2
    if domain.corner_count == 4:
        by_three, rest_u, rest_v = turn == 3, 1 - u, 1 - v
        return (
            dr.select(by_one, rest_v, dr.select(by_two, rest_u, dr.select(by_three, v, u))),
            dr.select(by_one, u, dr.select(by_two, rest_v, dr.select(by_three, rest_u, v))),
        )
    rest = 1 - (u + v)
    return (dr.select(by_one, rest, dr.select(by_two, v, u)), dr.select(by_one, u, dr.select(by_two, rest, v)))


def turn_matrix(domain: ParameterDomain, types: ArrayTypes, turn: Index) -> list[Float]:
    """Derivatives of the parameters seen from the first corner by those seen from corner ``turn``.

    Returns float arrays a, b, c, d: derivatives of u by u and v, then of v by u and v.
    """
    is_turned = [turn == k for k in range(1, domain.corner_count)]
    entries = []
    for first, *later_entries in _turn_entries(domain):
        value = types.float(first)
        for is_this_turn, entry in zip(is_turned, later_entries, strict=True):
            value = dr.select(is_this_turn, types.float(entry), value)
        entries.append(value)
    return entries


@lru_cache(maxsize=8)
def _turn_entries(domain: ParameterDomain) -> list[tuple[float, ...]]:
    """Entries of the matrices of all turns: a of each turn, then b, c and d."""
    return list(zip(*(domain.rotation(k).matrix.ravel().tolist() for k in range(domain.corner_count)), strict=True))
