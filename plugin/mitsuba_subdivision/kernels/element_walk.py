"""From element to element: parameters that have left one are carried to its neighbour."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import drjit as dr

from ..patches.piece_table import CORNERS, FOLLOWING, NOTHING, PRECEDING, TWIN, WHOLE
from .array_types import ArrayTypes
from .domain_map import MappedParameters, clamped, distances

if TYPE_CHECKING:
    from ..patches import PieceTable
    from ..schemes.domain import ParameterDomain


@dataclass(frozen=True, eq=False)
class Location:
    """Where samples lie: parameters, seen from a half-edge of their element.

    Attributes
    ----------
    half_edge : index array
    u, v : float arrays
    """

    half_edge: Any
    u: Any
    v: Any

    def chosen(self, condition: Any, other: Location) -> Location:
        """Another location where a condition holds."""
        select = dr.select
        return Location(
            select(condition, other.half_edge, self.half_edge),
            select(condition, other.u, self.u),
            select(condition, other.v, self.v),
        )


class ElementWalk:
    """The elements of a piece table on the device, and what lies next to what.

    Parameters
    ----------
    table : PieceTable
    types : ArrayTypes

    Attributes
    ----------
    domain : ParameterDomain
        Of the elements.
    """

    def __init__(self, table: PieceTable, types: ArrayTypes) -> None:
        self._types = types
        self.domain: ParameterDomain = table.patches.scheme.domain
        self._half_edges, self._patch_codes = types.indices(table.half_edges), types.indices(table.patch_codes)
        self._first = types.indices(table.patches.elements.face_offsets)
        self._all_whole = bool(table.patches.is_whole.all())

    def at(self, element: Any, u: Any, v: Any, corner: Any = 0, active: Any = True) -> Location:
        """The location in an element with parameters seen from one of its corners."""
        return Location(self._types.fetch(self._types.index, self._first, element, active) + corner, u, v)

    def patch_code(self, half_edge: Any, active: Any = True) -> Any:
        """`PieceTable.patch_codes` of half-edges."""
        return self._types.fetch(self._types.index, self._patch_codes, half_edge, active)

    def corner(self, half_edge: Any, active: Any = True) -> Any:
        """At which corner of whole elements half-edges begin; 0 in others."""
        return self.patch_code(half_edge, active) & CORNERS

    def from_first(self, location: Location, active: Any = True) -> Location:
        """The same locations, in whole elements seen from the first corner."""
        corner = self.corner(location.half_edge, active)
        turned = MappedParameters.of(location.u, location.v, self._types.float).turned(self.domain, corner)
        return Location(location.half_edge - corner, turned.u, turned.v)

    def neighbour(self, half_edge: Any, column: int, active: Any = True) -> Any:
        """A column of `PieceTable.half_edges`: the twin, the half-edge after or before in the element, the class."""
        return self._types.fetch(self._types.index4, self._half_edges, half_edge, active)[column]

    def is_whole(self, half_edge: Any, active: Any = True) -> Any:
        """Whether elements fit the domain."""
        return (self.patch_code(half_edge, active) & WHOLE) != 0

    def carried(self, location: Location, active: Any = True) -> Location:
        """Locations whose parameters have left their element, in the neighbour that they have come to.

        Its parameters go on as if both elements lay in a plane. Where there is no neighbour, on a border or a crease,
        and where they have left the neighbour as well, the nearest ones on its sides are taken.
        """
        inside = distances(self.domain, location.u, location.v)
        least, side = inside[0], self._types.index(0)
        for k, distance in enumerate(inside[1:], start=1):
            side = dr.select(distance < least, self._types.index(k), side)
            least = dr.minimum(least, distance)
        has_left = active & (least < 0)
        edge, t, depth = self._beside_edge(location, side, has_left)
        found = location
        if not self._all_whole:
            is_whole = self.is_whole(location.half_edge, has_left)
            edge_of_corner, t_of_corner, depth_of_corner = self._beside_edge_of_corner(location, side, has_left)
            edge = dr.select(is_whole, edge, edge_of_corner)
            t, depth = dr.select(is_whole, t, t_of_corner), dr.select(is_whole, depth, depth_of_corner)
            crosses_spoke = has_left & (is_whole == False) & ((side == 1) | (side == 2))  # noqa: E712 - an array
            found = found.chosen(crosses_spoke, self._across_spoke(location, side, has_left))
            has_left = has_left & (crosses_spoke == False)  # noqa: E712
        twin = self.neighbour(edge, TWIN, has_left)
        has_left = has_left & (twin != NOTHING)
        found = found.chosen(has_left, self._entered(twin, 1 - t, -depth, has_left))
        u, v = clamped(self.domain, found.u, found.v)
        return Location(found.half_edge, u, v)

    def is_border(self, location: Location, side: Any, active: Any = True) -> Any:
        """Whether a side of elements, in the order of `distances`, has no neighbour: on borders and creases."""
        edge, _, _ = self._beside_edge(location, side, active)
        if not self._all_whole:
            is_whole = self.is_whole(location.half_edge, active)
            of_corner, _, _ = self._beside_edge_of_corner(location, side, active)
            # Inside an element are its other corners.
            is_spoke = (is_whole == False) & ((side == 1) | (side == 2))  # noqa: E712 - an array
            edge, active = dr.select(is_whole, edge, of_corner), active & (is_spoke == False)  # noqa: E712
        return active & (self.neighbour(edge, TWIN, active) == NOTHING)

    def _beside_edge(self, location: Location, side: Any, active: Any) -> tuple[Any, Any, Any]:
        """Of whole elements the half-edge on a side, and parameters seen from there."""
        following, preceding = (self.neighbour(location.half_edge, column, active) for column in (FOLLOWING, PRECEDING))
        edge = dr.select(side == 0, location.half_edge, following)
        if self.domain.corner_count == 4:
            edge = dr.select(side == 2, self.neighbour(following, FOLLOWING, active), edge)
        count = self.domain.corner_count
        edge = dr.select(side == count - 1, preceding, edge)
        back = dr.select(side == 0, self._types.index(0), count - side)
        seen = MappedParameters.of(location.u, location.v, self._types.float).turned(self.domain, back)
        return edge, seen.u, seen.v

    def _beside_edge_of_corner(self, location: Location, side: Any, active: Any) -> tuple[Any, Any, Any]:
        """Of corners of other elements the half-edge at the first or the last side, and parameters along all of it."""
        is_first = side == 0
        edge = dr.select(is_first, location.half_edge, self.neighbour(location.half_edge, PRECEDING, active))
        return (
            edge,
            dr.select(is_first, location.u, 2 - location.v) / 2,
            dr.select(is_first, location.v, location.u) / 2,
        )

    def _across_spoke(self, location: Location, side: Any, active: Any) -> Location:
        """Locations in the next or the previous corner of the same element."""
        is_next = side == 1
        following, preceding = (self.neighbour(location.half_edge, column, active) for column in (FOLLOWING, PRECEDING))
        return Location(
            dr.select(is_next, following, preceding),
            dr.select(is_next, location.v, 2 - location.v),
            dr.select(is_next, 2 - location.u, location.u),
        )

    def _entered(self, edge: Any, t: Any, depth: Any, active: Any) -> Location:
        """Locations in an element at a distance along one of its half-edges and away from it."""
        whole = Location(edge, t, depth)
        if self._all_whole:
            return whole
        is_near = t <= 0.5
        following = self.neighbour(edge, FOLLOWING, active)
        corner = Location(
            dr.select(is_near, edge, following),
            2 * dr.select(is_near, t, depth),
            2 * dr.select(is_near, depth, 1 - t),
        )
        return corner.chosen(self.is_whole(edge, active), whole)
