"""Where lines meet the surface, by Newton's method from a place nearby."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import drjit as dr

from .array_types import ArrayTypes
from .domain_map import turned
from .element_walk import ElementWalk, Location
from .piece_kernel import PatchValues
from .vectors import cross

if TYPE_CHECKING:
    from .displacement import DisplacedPiece
    from .piece_kernel import Piece

    AnyPiece = Piece | DisplacedPiece

# Rounds of Newton's steps along the ray, and then as many along the normal where they do not converge. The next round
# begins in the piece to which the last one has led.
ROUNDS = 12
STEPS_IN_ROUND = 3
# Longest step, in parameters of an element: polynomials may be far off outside theirs.
LONGEST_STEP = 0.5
# A step shorter than this, in parameters of a piece, is the last: the next would be about as short as its square.
LAST_STEP = 3e-4
# So far beyond a border, in parameters of a piece, rounding may lead.
BEYOND = 1e-6
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
        `ON_LINE`; `ON_NORMAL`, also where a border or a crease is nearest; or `NOWHERE`.
    values : PatchValues
        The surface there, without derivatives by control points and without second ones.
    """

    location: Location
    way: Any
    values: PatchValues


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

    def step(self, here: PatchValues) -> tuple[Any, Any]:
        """Newton's step at given values of the surface, with derivatives that follow the line."""
        du, dv = along_tangents(self.o - here.value, self.d, dr.detach(here.du), dr.detach(here.dv))
        return dr.select(self.hold, du, 0), dr.select(self.hold, dv, 0)


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
        The piece of the surface in which parameters lie, from a half-edge, u, v, a mask and the half-edge's row.
    """

    def __init__(self, types: ArrayTypes, walk: ElementWalk, piece: Callable[..., AnyPiece]) -> None:
        self._types, self._walk, self._piece = types, walk, piece
        self._rounding = ROUNDED_DOUBLE if types.is_double else ROUNDED_SINGLE

    def found(self, p: Any, d: Any, location: Location, active: Any, reach: Any, facing: Any) -> Meeting:
        """Where lines meet the surface; parameters as those of `SurfaceKernel.meet`."""
        types = self._types

        def goes_on(way: Any, *_: Any) -> Any:
            return active & (way <= NOWHERE)

        def go(way: Any, count: Any, seeks: Any, stays: Any, d: Any, half_edge: Any, u: Any, v: Any, *_: Any) -> tuple:
            row = self._walk.row(half_edge, active)
            piece = self._piece(half_edge, u, v, active, row)
            was_held, is_still = stays, stays | (way == NOWHERE)
            turns = (way == ON_NORMAL) & (count == 0)
            d, of_u, of_v, length, goes_round, *here = self._steps(piece, p, d, is_still, turns, seeks, facing)
            value, du, dv, normal = here
            is_finite = dr.isfinite(of_u) & dr.isfinite(of_v)
            aim = Location(half_edge, u + of_u, v + of_v)
            to = self._walk.carried(aim, active & is_finite, row)
            # Next to extraordinary points, what rounding leaves is longer than the last step in parameters of a piece.
            rounded = self._rounding * (dr.norm(p) + dr.norm(value))
            rounded = over(rounded * piece.magnification, dr.maximum(dr.norm(du), dr.norm(dv)))
            last_step = dr.clip(rounded, LAST_STEP, 1)
            # On a border, steps lead beyond it to nearly the same point again and again: there it is to stay.
            is_beyond = dr.maximum(dr.abs(to.u - aim.u), dr.abs(to.v - aim.v)) * piece.magnification > BEYOND
            length = dr.minimum(length, dr.maximum(dr.abs(to.u - u), dr.abs(to.v - v)))
            ends = is_finite & (length * piece.magnification < last_step)
            # Also where the other side is out of reach, beyond a crease.
            is_wrong_side = ends & (way == ON_LINE) & (dr.dot(normal, d) * facing < 0)
            towards = dr.select(dr.dot(p - value, d) < 0, types.float(-1), types.float(1))
            seeks = dr.select(goes_round, seeks, dr.select(is_wrong_side, towards, 0))
            ends &= (to.half_edge == half_edge) & piece.is_inside(to.u - u, to.v - v, last_step)
            ends &= (dr.norm(p - value) <= reach) & ((goes_round | is_wrong_side) == False)  # noqa: E712 - an array
            arrives = is_still | (ends & (is_beyond == False))  # noqa: E712
            stays = ends & is_beyond
            fails = (count + 1 >= ROUNDS) & ((arrives | stays) == False)  # noqa: E712
            seeks = dr.select(fails, 0, seeks)
            to = Location(half_edge, u, v).chosen(is_finite, to).chosen(fails, location)
            # What is held on a border is not on its line.
            met = dr.select(was_held & (way == ON_LINE), types.index(ON_NORMAL), way)
            way = dr.select(arrives, met + _HAS_MET, dr.select(fails, way + 1, way))
            count = dr.select(fails, 0, count + 1)
            return way, count, seeks, stays, d, to.half_edge, to.u, to.v, value, du, dv, normal

        nothing = d * 0
        begin = (types.index(0), types.index(0), types.float(0), types.float(0) > 1, d)
        state = (*begin, location.half_edge, location.u, location.v, *(type(d)(nothing) for _ in range(4)))
        found = dr.while_loop(state, goes_on, go, mode=types.loops, label="meet_surface")
        way, half_edge, u, v, *here = found[0], *found[5:]
        corner = self._walk.corner(half_edge, active)
        first = Location(half_edge - corner, *turned(self._walk.domain, u, v, corner))
        return Meeting(first, way & (_HAS_MET - 1), PatchValues(*here).seen_from_first(self._walk, corner))

    def _steps(
        self, piece: AnyPiece, p: Any, d: Any, is_still: Any, turns: Any, seeks: Any, facing: Any
    ) -> tuple[Any, ...]:
        """Newton's steps within a piece.

        Parameters
        ----------
        is_still : mask
            Where none are taken.
        turns : mask
            Where the line is to be along the normal.
        seeks : float array
            Unless zero, the line was met on the wrong side. From a place that faces the wrong way, a step leads along
            the surface: in the direction of the line, or against it.

        Returns
        -------
        d : 3-vector
        of_u, of_v : float arrays
            How far the steps have led.
        length : float array
            Of the last one.
        goes_round : mask
            Where it was one along the surface.
        value, du, dv, normal : 3-vectors
            Of the piece there.
        """
        types = self._types

        def goes_on(left: Any, *_: Any) -> Any:
            return left > 0

        def step(left: Any, d: Any, of_u: Any, of_v: Any, length: Any, goes_round: Any, *_: Any) -> tuple:
            here = piece.values(of_u, of_v)
            is_first = left > STEPS_IN_ROUND
            d = dr.select(is_first & turns, here.normal, d)
            goes_round |= is_first & (seeks != 0) & (dr.dot(here.normal, d) * facing < 0)
            is_last = (left == 1) | is_still
            # Along the surface, or along the line.
            along = dr.select(goes_round, here.normal, d)
            way = dr.select(goes_round, seeks * d, p - here.value)
            du, dv = along_tangents(way, along, here.du, here.dv)
            size = dr.maximum(dr.abs(du), dr.abs(dv))
            factor = LONGEST_STEP / dr.select(goes_round, size, dr.maximum(size, LONGEST_STEP))
            factor = dr.select(is_last, 0, factor)
            length = dr.select(is_last, length, size)
            of_u, of_v = dr.fma(du, factor, of_u), dr.fma(dv, factor, of_v)
            # After a short step, once more for the values there.
            is_short = (size * piece.magnification < LAST_STEP) & (left > 1)
            left = dr.select(is_last | goes_round, 0, dr.select(is_short, 1, left - 1))
            return left, d, of_u, of_v, length, goes_round, here.value, here.du, here.dv, here.normal

        zero, nothing = types.float(0), d * 0
        begin = (types.index(STEPS_IN_ROUND + 1), type(d)(d), zero, zero, zero, zero > 1)
        state = (*begin, *(type(d)(nothing) for _ in range(4)))
        return dr.while_loop(state, goes_on, step, mode=types.loops, label="newton")[1:]


def along_tangents(r: Any, d: Any, du: Any, dv: Any) -> tuple[Any, Any]:
    """How far along two tangents a way ``r`` leads, but for what of it is along ``d``: Newton's step."""
    across_v, across_u = cross(dv, d), cross(d, du)
    inverse = over(1, dr.dot(du, across_v))
    return dr.dot(r, across_v) * inverse, dr.dot(r, across_u) * inverse


def over(value: Any, divisor: Any) -> Any:
    """A quotient; infinite where the divisor is zero, also in scalar variants, where that would be an error."""
    exists = divisor != 0
    return dr.select(exists, value / dr.select(exists, divisor, 1), dr.inf)
