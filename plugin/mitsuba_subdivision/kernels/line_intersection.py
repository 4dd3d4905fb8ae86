"""Intersects lines with the surface by Newton's method from a nearby location."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import drjit as dr

from .array_types import ArrayTypes, Float, Index, Mask, Vector3
from .element_walk import ElementWalk, Location, turned
from .piece_kernel import PatchValues
from .vectors import LONGEST_STEP, STEP_TOLERANCE, dot, over, rounding, step_along

if TYPE_CHECKING:
    from .displacement import DisplacedPiece
    from .piece_kernel import Piece

    AnyPiece = Piece | DisplacedPiece

# Rounds of Newton's steps along the line, and then as many along the normal if they do not converge. Each round begins
# in the piece that the last one has reached.
ROUNDS = 12
STEPS_IN_ROUND = 3
# Largest overshoot of a border by rounding, in parameters of a piece.
BEYOND_BORDER = 1e-6
# Successive aims of the search, see `LineIntersection`; the `kind` of a hit is the aim that succeeded.
ON_LINE, ON_NORMAL, MISSED = range(3)
# Added to these when the search has ended.
_ENDED = 4


@dataclass(frozen=True, eq=False)
class LineHits:
    """Hits of lines on a surface."""

    location: Location  # In whole elements seen from the first corner
    kind: Index  # `ON_LINE`; `ON_NORMAL`, also where a border or a crease is nearest; or `MISSED`
    values: PatchValues  # The surface there, without derivatives by control points and without second ones


@dataclass(frozen=True, eq=False)
class Lines:
    """Lines that surface points stay on when control points or the lines themselves change."""

    # A point of each, in the space of the control points, and the direction
    o: Vector3
    d: Vector3
    hold: Mask  # Which lines hold their points: a point that is not on its line keeps its location on the surface

    def step(self, here: PatchValues) -> tuple[Float, Float]:
        """Newton's step at given values of the surface, with derivatives that follow the line."""
        du, dv = step_along(self.o - here.value, self.d, dr.detach(here.du), dr.detach(here.dv))
        return dr.select(self.hold, du, 0), dr.select(self.hold, dv, 0)


@dataclass(frozen=True, eq=False)
class _Round:
    """Newton's steps within a piece."""

    d: Vector3  # The direction of the line, which may be turned to the normal
    # Sum of the steps
    u: Float
    v: Float
    length: Float  # Of the last one
    is_along_surface: Mask  # Where it was a step along the surface, to the other intersection of the line
    values: PatchValues  # The surface before the last step


class LineIntersection:
    """Newton's method along lines, over a surface.

    The search has three aims, each of `ROUNDS` rounds at most. A round takes some steps within a piece of the surface,
    and moves to the piece that they reach. A search that does not converge restarts with the next aim:

    - `ON_LINE`: the line. Where the surface there faces the wrong way, a step leads along the surface, to the other
      side of what the line enters or leaves.
    - `ON_NORMAL`: the point of the line that was given, along the surface's normal where the search began.
    - `MISSED`: only the surface's values where the search began.

    On borders and creases, where steps lead beyond, it holds the nearest point there.
    """

    def __init__(
        self,
        types: ArrayTypes,
        walk: ElementWalk,  # Over the surface's elements
        # The piece of the surface in which parameters lie, from a half-edge, u, v, a mask and the half-edge's row
        piece: Callable[..., AnyPiece],
    ) -> None:
        self._types, self._walk, self._piece = types, walk, piece
        self._rounding = rounding(types)

    def hits(
        self, p: Vector3, d: Vector3, location: Location, active: Mask, max_distance: Float, facing: Float
    ) -> LineHits:
        """Intersect lines with the surface; parameters as those of `SurfaceKernel.line_hits`."""
        types = self._types

        def continues(aim: Index, *_: Any) -> Mask:
            return active & (aim < _ENDED)

        def search(
            aim: Index,
            count: Index,
            side: Float,
            is_held: Mask,
            d: Vector3,
            half_edge: Index,
            u: Float,
            v: Float,
            *_: Any,
        ):
            row = self._walk.row(half_edge, active)
            piece = self._piece(half_edge, u, v, active, row)
            turns = (aim == ON_NORMAL) & (count == 0)
            taken = self._steps(piece, p, d, is_held | (aim == MISSED), turns, side, facing)
            here = taken.values
            away = p - here.value
            goal = Location(half_edge, u + taken.u, v + taken.v)
            is_finite = dr.isfinite(taken.u) & dr.isfinite(taken.v)
            to = self._walk.carried(goal, active & is_finite, row)

            # A step shorter than this, in parameters of a piece, is the last. Next to extraordinary points, rounding
            # errors exceed `STEP_TOLERANCE`.
            size = dr.sqrt(dot(p, p)) + dr.sqrt(dot(here.value, here.value))
            longest = dr.sqrt(dr.maximum(dot(here.du, here.du), dot(here.dv, here.dv)))
            last_step = dr.clip(over(self._rounding * size * piece.magnification, longest), STEP_TOLERANCE, 1)
            moved = dr.maximum(dr.abs(to.u - u), dr.abs(to.v - v))
            has_settled = is_finite & (dr.minimum(taken.length, moved) * piece.magnification < last_step)
            # Also if the other side is unreachable, beyond a crease.
            is_wrong_side = has_settled & (aim == ON_LINE) & (dot(here.normal, taken.d) * facing < 0)
            converges = has_settled & (is_wrong_side == False) & (taken.is_along_surface == False)  # noqa: E712 - arrays
            converges &= (to.half_edge == half_edge) & piece.is_inside(to.u - u, to.v - v, last_step)
            converges &= dr.sqrt(dot(away, away)) <= max_distance
            # At a border, successive steps overshoot to nearly the same point.
            beyond = dr.maximum(dr.abs(to.u - goal.u), dr.abs(to.v - goal.v)) * piece.magnification
            holds = converges & (beyond > BEYOND_BORDER)

            # The next state.
            ends = is_held | (aim == MISSED) | (converges & (holds == False))  # noqa: E712 - an array
            fails = (count + 1 >= ROUNDS) & ((ends | holds) == False)  # noqa: E712 - an array
            towards = dr.select(dot(away, taken.d) < 0, types.float(-1), types.float(1))
            side = dr.select(taken.is_along_surface, side, dr.select(is_wrong_side, towards, 0))
            side = dr.select(fails, 0, side)
            # A point held on a border is not on its line.
            found = dr.select(is_held & (aim == ON_LINE), types.index(ON_NORMAL), aim)
            aim = dr.select(ends, found + _ENDED, dr.select(fails, aim + 1, aim))
            to = Location(half_edge, u, v).chosen(is_finite, to).chosen(fails, location)
            count = dr.select(fails, 0, count + 1)
            return aim, count, side, holds, taken.d, to.half_edge, to.u, to.v, here.value, here.du, here.dv, here.normal

        zero = types.float(0)
        begin = (types.index(ON_LINE), types.index(0), zero, zero > 1, d, location.half_edge, location.u, location.v)
        state = (*begin, *(d * 0 for _ in range(4)))
        aim, _, _, _, _, half_edge, u, v, *values = dr.while_loop(
            state, continues, search, mode="symbolic", label="line_intersection"
        )
        corner = self._walk.corner(half_edge, active)
        first = Location(half_edge - corner, *turned(self._walk.domain, u, v, corner))
        return LineHits(first, aim & (_ENDED - 1), PatchValues(*values).seen_from_first(self._walk, corner))

    def _steps(
        self,
        piece: AnyPiece,
        p: Vector3,
        d: Vector3,
        is_still: Mask,  # Where none are taken
        turns: Mask,  # Where the line is to be along the normal
        # Unless zero, the line has intersected the surface on the wrong side. From a point that faces the
        # wrong way, a step leads along the surface: in the direction of the line, or against it.
        side: Float,
        facing: Float,
    ) -> _Round:
        """Newton's steps within a piece."""
        types = self._types

        def continues(left: Index, *_: Any) -> Mask:
            return left > 0

        def step(left: Index, d: Vector3, u: Float, v: Float, length: Float, is_along_surface: Mask, *_: Any) -> tuple:
            here = piece.values(u, v)
            is_first = left > STEPS_IN_ROUND
            d = dr.select(is_first & turns, here.normal, d)
            is_along_surface |= is_first & (side != 0) & (dot(here.normal, d) * facing < 0)
            is_last = (left == 1) | is_still
            du, dv = step_along(
                dr.select(is_along_surface, side * d, p - here.value),
                dr.select(is_along_surface, here.normal, d),
                here.du,
                here.dv,
            )
            size = dr.maximum(dr.abs(du), dr.abs(dv))
            factor = LONGEST_STEP / dr.select(is_along_surface, size, dr.maximum(size, LONGEST_STEP))
            factor = dr.select(is_last, 0, factor)
            length = dr.select(is_last, length, size)
            u, v = dr.fma(du, factor, u), dr.fma(dv, factor, v)
            # After a short step, once more for the values there.
            is_short = (size * piece.magnification < STEP_TOLERANCE) & (left > 1)
            left = dr.select(is_last | is_along_surface, 0, dr.select(is_short, 1, left - 1))
            return left, d, u, v, length, is_along_surface, here.value, here.du, here.dv, here.normal

        zero = types.float(0)
        begin = (types.index(STEPS_IN_ROUND + 1), type(d)(d), zero, zero, zero, zero > 1)
        state = (*begin, *(d * 0 for _ in range(4)))
        _, d, u, v, length, is_along_surface, *values = dr.while_loop(
            state, continues, step, mode="symbolic", label="newton"
        )
        return _Round(d, u, v, length, is_along_surface, PatchValues(*values))
