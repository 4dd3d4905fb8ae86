"""Where lines meet the surface, by Newton's method from a place nearby."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import drjit as dr

from .array_types import ArrayTypes
from .element_walk import ElementWalk, Location

if TYPE_CHECKING:
    from .displacement import DisplacedPiece
    from .piece_polynomial import PiecePolynomial

    AnyPiece = PiecePolynomial | DisplacedPiece

# Rounds of Newton's steps along the ray, and then as many along the normal where they do not converge. The next round
# begins in the piece to which the last one has led.
ROUNDS = 12
STEPS_IN_ROUND = 3
# Longest step, in parameters of an element: polynomials may be far off outside theirs.
LONGEST_STEP = 0.5
# A step shorter than this, in parameters of a piece, is the last: the next would be about as short as its square.
LAST_STEP = 3e-4
# What rounding leaves of a step in space, in sizes of the points that it leads from and to: some units of either.
ROUNDED_SINGLE, ROUNDED_DOUBLE = 2.0**-21, 2.0**-50
# Ways that lines have met the surface, see `LineMeeting`.
ON_LINE, ON_NORMAL, NOWHERE = range(3)
_HAS_MET = 4


@dataclass(frozen=True, eq=False)
class Meeting:
    """Where lines have met a surface.

    Attributes
    ----------
    location : Location
        In whole elements seen from the first corner.
    way : index array
        `ON_LINE`, `ON_NORMAL` or `NOWHERE`.
    piece : PiecePolynomial or DisplacedPiece
        The surface there, without derivatives by control points.
    """

    location: Location
    way: Any
    piece: AnyPiece


@dataclass(frozen=True, eq=False)
class Lines:
    """Lines that surface points stay on when control points or the lines themselves change.

    Attributes
    ----------
    o, d : 3-vectors
        A point of each, in the space of the control points, and the direction.
    hold : mask
        Which of them do: where a point is not on its line, it stays where it is on the surface.
    """

    o: Any
    d: Any
    hold: Any = True


class LineMeeting:
    """Newton's method along lines, over a surface.

    Where it does not converge, along the surface's normal at the place where it began; and where that does not either,
    it stays there. On borders and creases it takes the nearest point there.

    Parameters
    ----------
    types : ArrayTypes
    walk : ElementWalk
        Over the surface's elements.
    piece : callable
        The piece of the surface in which parameters lie, from a half-edge, u, v and a mask.
    none : PiecePolynomial or DisplacedPiece
        A piece that is nothing, of the kind that this gives.
    """

    def __init__(self, types: ArrayTypes, walk: ElementWalk, piece: Callable[..., AnyPiece], none: AnyPiece) -> None:
        self._types, self._walk, self._piece, self._none = types, walk, piece, none

    def found(self, p: Any, d: Any, location: Location, active: Any, reach: Any, facing: Any) -> Meeting:
        """Where lines meet the surface; parameters as those of `SurfaceKernel.meet`."""
        types = self._types

        def goes_on(way: Any, *_: Any) -> Any:
            return active & (way <= NOWHERE)

        def go(way: Any, count: Any, seeks: Any, d: Any, half_edge: Any, u: Any, v: Any, *_: Any) -> tuple:
            piece = self._piece(half_edge, u, v, active)
            found = piece.values()
            normal = dr.cross(found.tangent_u, found.tangent_v)
            d = dr.select((way == ON_NORMAL) & (count == 0), normal, d)
            # Where the line was met on the wrong side, along the surface until it faces the other way.
            goes_round = (seeks != 0) & (dr.dot(normal, d) * facing < 0)
            round_u, round_v = along_tangents(seeks * d, normal, found.du, found.dv)
            factor = over(LONGEST_STEP, dr.maximum(dr.abs(round_u), dr.abs(round_v)))
            round_u, round_v = round_u * factor, round_v * factor
            stays = way == NOWHERE
            of_u, of_v, length = types.float(0), types.float(0), types.float(0)
            for step in range(STEPS_IN_ROUND):
                found = piece.values() if step else found
                du, dv = along_tangents(p - found.value, d, found.du, found.dv)
                length = dr.maximum(dr.abs(du), dr.abs(dv))
                factor = LONGEST_STEP / dr.maximum(length, LONGEST_STEP)
                du, dv = dr.select(stays, 0, du * factor), dr.select(stays, 0, dv * factor)
                of_u, of_v, piece = of_u + du, of_v + dv, piece.moved(du, dv)
            of_u, of_v = dr.select(goes_round, round_u, of_u), dr.select(goes_round, round_v, of_v)
            is_finite = dr.isfinite(of_u) & dr.isfinite(of_v)
            aim = Location(half_edge, u + of_u, v + of_v)
            here = self._walk.carried(aim, active & is_finite)
            # On a border, the last steps have led beyond it to nearly the same point again and again.
            piece = piece.moved(here.u - aim.u, here.v - aim.v)
            length = dr.minimum(length, dr.maximum(dr.abs(here.u - u), dr.abs(here.v - v)))
            # Next to extraordinary points, what rounding leaves is longer than the last step in parameters of a piece.
            rounded = (ROUNDED_DOUBLE if types.is_double else ROUNDED_SINGLE) * (dr.norm(p) + dr.norm(found.value))
            rounded = over(rounded * piece.magnification, dr.maximum(dr.norm(found.du), dr.norm(found.dv)))
            last_step = dr.clip(rounded, LAST_STEP, 1)
            arrives = is_finite & (length * piece.magnification < last_step)
            # Also where the other side is out of reach, beyond a crease.
            faces = dr.dot(dr.cross(found.tangent_u, found.tangent_v), d) * facing
            is_wrong_side = arrives & (way == ON_LINE) & (faces < 0)
            towards = dr.select(dr.dot(p - found.value, d) < 0, types.float(-1), types.float(1))
            seeks = dr.select(goes_round, seeks, dr.select(is_wrong_side, towards, 0))
            arrives &= (here.half_edge == half_edge) & piece.is_inside(last_step) & (dr.norm(p - found.value) <= reach)
            arrives &= (goes_round | is_wrong_side) == False  # noqa: E712 - an array
            arrives |= stays
            fails = (count + 1 >= ROUNDS) & (arrives == False)  # noqa: E712
            seeks = dr.select(fails, 0, seeks)
            here = Location(half_edge, u, v).chosen(is_finite, here).chosen(fails, location)
            way = dr.select(arrives, way + _HAS_MET, dr.select(fails, way + 1, way))
            return way, dr.select(fails, 0, count + 1), seeks, d, here.half_edge, here.u, here.v, *piece.arrays()

        start = (location.half_edge, location.u, location.v)
        state = (types.index(0), types.index(0), types.float(0), d, *start, *self._none.arrays())
        found = dr.while_loop(state, goes_on, go, mode=types.loops, label="meet_surface")
        way, _, _, _, half_edge, u, v, *arrays = found
        piece = self._none.with_arrays(arrays).seen_from_first(self._walk.corner(half_edge, active))
        return Meeting(self._walk.from_first(Location(half_edge, u, v), active), way & (_HAS_MET - 1), piece)


def along_tangents(r: Any, d: Any, du: Any, dv: Any) -> tuple[Any, Any]:
    """How far along two tangents a way ``r`` leads, but for what of it is along ``d``: Newton's step."""
    inverse = over(1, dr.dot(dr.cross(du, dv), d))
    return dr.dot(d, dr.cross(r, dv)) * inverse, dr.dot(d, dr.cross(du, r)) * inverse


def over(value: Any, divisor: Any) -> Any:
    """A quotient; infinite where the divisor is zero, also in scalar variants, where that would be an error."""
    exists = divisor != 0
    return dr.select(exists, value / dr.select(exists, divisor, 1), dr.inf)
