"""Elements on the device: their parameter domains, and transitions of parameters to neighbouring elements."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import TYPE_CHECKING

import drjit as dr

from ..patches.piece_table import CODE, CORNERS, FOLLOWING, NOTHING, PRECEDING, TWIN, WHOLE
from ..schemes.domain import ParameterDomain
from .array_types import ArrayTypes, Float, Index, Index4, Mask

if TYPE_CHECKING:
    from ..patches import PieceTable
    from ..schemes.domain import ParameterDomain


@dataclass(frozen=True, eq=False)
class Location:
    """Locations on a surface: parameters in an element, seen from one of its half-edges."""

    half_edge: Index
    u: Float
    v: Float

    def chosen(self, condition: Mask, other: Location) -> Location:
        """Select ``other`` where a condition holds, and this location elsewhere."""
        pairs = (other.half_edge, self.half_edge), (other.u, self.u), (other.v, self.v)
        return Location(*(dr.select(condition, other_value, value) for other_value, value in pairs))


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
        element, corner = (types.given(types.index, value) for value in (element, corner))
        u, v = (types.given(types.float, value) for value in (u, v))
        return Location(types.fetch(types.index, self._first, element, active) + corner, u, v)

    def row(self, half_edge: Index, active: Mask = True) -> Index4:
        """Fetch the row of `PieceTable.half_edges`: twin, following and preceding half-edge, and code."""
        return self.types.fetch(self.types.index4, self._half_edges, half_edge, active)

    def corner(self, half_edge: Index, active: Mask = True) -> Index:
        """The corner of a whole element where a half-edge begins; 0 in other elements."""
        return self.row(half_edge, active)[CODE] & CORNERS

    def from_first(self, location: Location, active: Mask = True) -> Location:
        """The same locations, seen from the first corner in whole elements."""
        corner = self.corner(location.half_edge, active)
        return Location(location.half_edge - corner, *turned(self.domain, location.u, location.v, corner))

    def is_whole(self, half_edge: Index, active: Mask = True) -> Mask:
        """Whether the element of a half-edge fits the domain."""
        return (self.row(half_edge, active)[CODE] & WHOLE) != 0

    def carried(self, location: Location, active: Mask = True, row: Index4 | None = None) -> Location:
        """Map locations whose parameters are outside of their element to the neighbouring element.

        Parameters are continued as if both elements lay in a plane. They are clamped to a side without a neighbour, on
        a border or a crease, and to the neighbour's sides if they are outside of it, too. ``row`` is the row of the
        half-edges, if known.
        """
        if row is None:
            row = self.row(location.half_edge, active)
        side, depth, t = self._nearest_side(location)
        has_left = active & (depth < 0)
        carried = location
        edge = self._edge_on_side(location, row, side)
        if not self._all_whole:
            is_whole = (row[CODE] & WHOLE) != 0
            is_spoke = (is_whole == False) & ((side == 1) | (side == 2))  # noqa: E712 - an array
            t = dr.select(is_whole, t, dr.select(side == 0, location.u, 2 - location.v) * 0.5)
            depth = dr.select(is_whole, depth, depth * 0.5)
            carried = carried.chosen(has_left & is_spoke, self._across_spoke(location, row, side))
            has_left &= is_spoke == False  # noqa: E712
        twin = self.row(edge, has_left)[TWIN]
        has_left &= twin != NOTHING
        carried = carried.chosen(has_left, self._entered(twin, 1 - t, -depth, has_left))
        u, v = clamped(self.domain, carried.u, carried.v)
        return Location(carried.half_edge, u, v)

    def is_border(self, location: Location, side: Index, active: Mask = True) -> Mask:
        """Whether a side of elements, in the order of `distances`, has no neighbour: on borders and creases."""
        row = self.row(location.half_edge, active)
        if not self._all_whole:
            # Spokes lie inside an element, between its corners.
            is_spoke = ((row[CODE] & WHOLE) == 0) & ((side == 1) | (side == 2))
            active = active & (is_spoke == False)  # noqa: E712 - an array
        return active & (self.row(self._edge_on_side(location, row, side), active)[TWIN] == NOTHING)

    def _nearest_side(self, location: Location) -> tuple[Index, Float, Float]:
        """The nearest side of the domain, the signed distance from it, and the position along it."""
        u, v = location.u, location.v
        (depth, *depths), (t, *ts) = distances(self.domain, u, v), along_sides(self.domain, u, v)
        side = self.types.index(0)
        for k, (side_depth, side_t) in enumerate(zip(depths, ts, strict=True), start=1):
            is_nearer = side_depth < depth
            side, t = dr.select(is_nearer, self.types.index(k), side), dr.select(is_nearer, side_t, t)
            depth = dr.minimum(depth, side_depth)
        return side, depth, t

    def _edge_on_side(self, location: Location, row: Index4, side: Index) -> Index:
        """The half-edge on a side of a whole element; else that on the first or the last side of a corner."""
        count = self.domain.corner_count
        corner = row[CODE] & CORNERS
        # Half-edges of an element are consecutive.
        end_corner = corner + side
        edge = location.half_edge - corner + dr.select(end_corner >= count, end_corner - count, end_corner)
        if self._all_whole:
            return edge
        corner_edge = dr.select(side == 0, location.half_edge, row[PRECEDING])
        return dr.select((row[CODE] & WHOLE) != 0, edge, corner_edge)

    def _across_spoke(self, location: Location, row: Index4, side: Index) -> Location:
        """Locations in the next or the previous corner of the same element."""
        is_next = side == 1
        return Location(
            dr.select(is_next, row[FOLLOWING], row[PRECEDING]),
            dr.select(is_next, location.v, 2 - location.v),
            dr.select(is_next, 2 - location.u, location.u),
        )

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


def distances(domain: ParameterDomain, u: Float, v: Float) -> tuple[Float, ...]:
    """Signed distances of parameters from each side of a domain, positive inside."""
    return (v, 1 - (u + v), u) if domain.corner_count == 3 else (v, 1 - u, 1 - v, u)


def along_sides(domain: ParameterDomain, u: Float, v: Float) -> tuple[Float, ...]:
    """Positions of parameters along each side of a domain, from the corner of the same number."""
    return (u, v, 1 - (u + v)) if domain.corner_count == 3 else (u, v, 1 - u, 1 - v)


def clamped(domain: ParameterDomain, u: Float, v: Float) -> tuple[Float, Float]:
    """Clamp parameters to a domain, approximately to the nearest point."""
    u, v = dr.clip(u, 0, 1), dr.clip(v, 0, 1)
    if domain.corner_count == 4:
        return u, v
    beyond = dr.maximum(u + v - 1, 0) / 2
    return dr.clip(u - beyond, 0, 1), dr.clip(v - beyond, 0, 1)


def in_child(domain: ParameterDomain, types: ArrayTypes, u: Float, v: Float) -> tuple[Index, Float, Float, Float]:
    """Find the child domain that contains given parameters.

    This is not the first child where `ParameterDomain.extent` is at least 0.5.

    Returns its index in `ParameterDomain.children`; parameters in the child; and their derivatives by the given
    parameters: 2, or -2 in the middle child of a triangle, which is rotated by 180 degrees.
    """
    right, upper = u >= 0.5, v >= 0.5
    one, index_type = types.float(1), types.index
    is_middle = None
    if domain.corner_count == 3:
        # Not both at the midpoint of the third side.
        upper = upper & (right == False)  # noqa: E712 - an array
        is_middle = ((right | upper) == False) & (u + v >= 0.5)  # noqa: E712
        first_or_middle = dr.select(is_middle, index_type(3), index_type(0))
        number = dr.select(right, index_type(1), dr.select(upper, index_type(2), first_or_middle))
    else:
        number = dr.select(upper, dr.select(right, index_type(2), 3), dr.select(right, index_type(1), 0))
    inner_u, inner_v, scale = 2 * u - dr.select(right, one, 0), 2 * v - dr.select(upper, one, 0), 2 * one
    if is_middle is not None:
        inner_u, inner_v = dr.select(is_middle, one - 2 * u, inner_u), dr.select(is_middle, one - 2 * v, inner_v)
        scale = dr.select(is_middle, -scale, scale)
    return number, inner_u, inner_v, scale


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


def turn_matrix(domain: ParameterDomain, types: ArrayTypes, turn: Index) -> tuple[Float, Float, Float, Float]:
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
    a, b, c, d = entries
    return a, b, c, d


@lru_cache(maxsize=8)
def _turn_entries(domain: ParameterDomain) -> list[tuple[float, ...]]:
    """Entries of the matrices of all turns: a of each turn, then b, c and d."""
    return list(zip(*(domain.rotation(k).matrix.ravel().tolist() for k in range(domain.corner_count)), strict=True))
