"""Intersections of lines with a surface, by Newton's method from a nearby location.

The search has three aims, each with at most `ROUNDS` rounds. A round takes some steps within a piece of the surface,
and moves to the piece that they reach. A search that does not converge restarts with the next aim:

- `ON_LINE`: the line. Where the hit faces the wrong way, a step along the surface leads towards the other side of the
  solid that the line enters or leaves.
- `ON_NORMAL`: the line through the given point along the surface's normal at the start of the search.
- `MISSED`: none; evaluates the surface at the start of the search.

Where steps lead beyond a border or a crease, the result is the nearest point on it.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple

import drjit as dr

from .algebra import dot, over, step_along
from .array_types import ArrayTypes, Float, Index, Mask, Vector3
from .locations import ElementWalk, Location
from .piece_kernel import PatchValues, Piece

# Maximum number of rounds for each aim, and number of Newton steps in a round.
ROUNDS = 12
STEPS_IN_ROUND = 3
# Longest Newton step, in parameters of an element: outside of its element, a polynomial may be far from the surface.
LONGEST_STEP = 0.5
# Tolerance of a Newton step's length, in parameters of a piece: a next step would be about as long as its square.
STEP_TOLERANCE = 3e-4
# Largest overshoot of a border by rounding, in parameters of a piece. At a larger one the border stops the search.
BEYOND_BORDER = 1e-6
# Successive aims of the search; the `kind` of a hit is the aim that succeeded.
ON_LINE, ON_NORMAL, MISSED = range(3)


@dataclass(frozen=True, eq=False)
class Lines:
    """Lines that constrain surface points when control points or the lines change."""

    # Origins, in the space of the control points, and directions
    o: Vector3
    d: Vector3
    hold: Mask  # Lanes whose point lies on its line; other points keep their location on the surface

    @property
    def variables(self) -> tuple[Vector3, ...]:
        """Arrays that the points follow besides the control points."""
        return self.o, self.d

    def step(self, here: PatchValues) -> tuple[Float, Float]:
        """Newton step from given values of the surface, whose derivatives follow the line."""
        du, dv = step_along(self.o - here.value, self.d, dr.detach(here.du), dr.detach(here.dv))
        return dr.select(self.hold, du, 0), dr.select(self.hold, dv, 0)


class _Search(NamedTuple):
    """State of the search for the hits of `line_hits`."""

    aim: Index
    is_done: Mask
    rounds: Index  # Number of rounds with this aim
    # Non-zero after a hit on the wrong side: the next step is along the surface, with the line if positive, or against
    side: Float
    is_held: Mask  # Lanes that a border has stopped in the last round
    # Location
    half_edge: Index
    u: Float
    v: Float
    d: Vector3  # Direction of the line, or of the normal
    surface: tuple[Vector3, ...]  # `PatchValues.first_order`


class _Newton(NamedTuple):
    """State of the Newton steps of `piece_hits`."""

    steps_left: Index
    # Sum of the steps
    u: Float
    v: Float
    length: Float  # Length of the last step
    is_along_surface: Mask  # Lanes whose last step was along the surface, towards another hit of the line
    d: Vector3  # Direction of the line, or of the normal
    surface: tuple[Vector3, ...]  # `PatchValues.first_order` before the last step


def line_hits(
    walk: ElementWalk,  # Elements of the surface
    # Function of a half-edge, u, v, a mask and the row of the half-edge, which returns the piece of the surface
    piece_at: Callable[..., Piece],
    p: Vector3,  # A point of each line, near the surface
    d: Vector3,  # Direction of each line
    location: Location,  # Starting point of the search
    active: Mask = True,
    *,
    max_distance: Float = dr.inf,  # Maximum distance of the hit from ``p``
    # Wanted sign of the dot product of the normal and ``d``; 0 for either. A line that enters a ball also leaves it,
    # and Newton's method may converge to either hit.
    wanted_sign: Float = 0,
) -> tuple[Location, Index, PatchValues]:
    """Intersect lines with a surface near given locations. Arguments must be detached.

    Returns locations, seen from the first corner in whole elements; the kinds of hits: `ON_LINE`, `ON_NORMAL`, also for
    a point on a border or a crease beside the line, or `MISSED`; and the surface there, without second derivatives.
    """
    types = walk.types

    def next_round(last: _Search) -> _Search:
        here, aim = Location(last.half_edge, last.u, last.v), last.aim
        row = walk.row(here.half_edge, active)
        piece = piece_at(here.half_edge, here.u, here.v, active, row)
        is_still, turns = last.is_held | (aim == MISSED), (aim == ON_NORMAL) & (last.rounds == 0)
        newton = piece_hits(
            types, piece, p, last.d, is_still=is_still, turns=turns, side=last.side, wanted_sign=wanted_sign
        )
        surface, d = PatchValues(*newton.surface), newton.d
        offset = p - surface.value
        unclamped = Location(here.half_edge, here.u + newton.u, here.v + newton.v)
        is_finite = dr.isfinite(newton.u) & dr.isfinite(newton.v)
        target = walk.carried(unclamped, active & is_finite, row)
        du, dv = target.u - here.u, target.v - here.v

        # Tolerance of the step's length, in a piece's parameters: errors near extraordinary points are larger.
        coordinate_size = dr.sqrt(dot(p, p)) + dr.sqrt(dot(surface.value, surface.value))
        longest_derivative = dr.sqrt(dr.maximum(dot(surface.du, surface.du), dot(surface.dv, surface.dv)))
        last_step = dr.clip(
            over(types.rounding * coordinate_size * piece.magnification, longest_derivative), STEP_TOLERANCE, 1
        )
        change = dr.maximum(dr.abs(du), dr.abs(dv))
        has_settled = is_finite & (dr.minimum(newton.length, change) * piece.magnification < last_step)
        # This is also true if the other side is unreachable, beyond a crease.
        is_wrong_side = has_settled & (aim == ON_LINE) & (dot(surface.normal, d) * wanted_sign < 0)
        converges = has_settled & ~is_wrong_side & ~newton.is_along_surface
        converges &= (target.half_edge == here.half_edge) & piece.is_inside(du, dv, last_step)
        converges &= dr.sqrt(dot(offset, offset)) <= max_distance
        # At a border, successive steps overshoot by nearly the same amount.
        overshoot = dr.maximum(dr.abs(target.u - unclamped.u), dr.abs(target.v - unclamped.v)) * piece.magnification
        is_held = converges & (overshoot > BEYOND_BORDER)

        is_done = is_still | (converges & ~is_held)
        fails = (last.rounds + 1 >= ROUNDS) & ~(is_done | is_held)
        new_side = dr.select(dot(offset, d) < 0, types.float(-1), types.float(1))
        side = dr.select(newton.is_along_surface, last.side, dr.select(is_wrong_side, new_side, 0))
        # A point on the border that stops the search is not on its line.
        aim = dr.select(last.is_held & (aim == ON_LINE), types.index(ON_NORMAL), dr.select(fails, aim + 1, aim))
        reached = here.chosen(is_finite, target).chosen(fails, location)
        rounds, side = (dr.select(fails, 0, value) for value in (last.rounds + 1, side))
        return _Search(aim, is_done, rounds, side, is_held, reached.half_edge, reached.u, reached.v, d, newton.surface)

    no, zero = types.float(0) > 1, types.float(0)
    given = location.half_edge, location.u, location.v
    start = _Search(types.index(ON_LINE), no, types.index(0), zero, no, *given, d, (d * 0,) * 4)
    end = _repeated(next_round, start, lambda _aim, is_done, *_: active & ~is_done, "line_intersection")
    from_first, corner = walk.from_first(Location(end.half_edge, end.u, end.v), active)
    return from_first, end.aim, PatchValues(*end.surface).seen_from_first(walk, corner)


def piece_hits(
    types: ArrayTypes,
    piece: Piece,
    p: Vector3,  # A point of each line
    d: Vector3,  # Direction of each line
    *,
    is_still: Mask = False,  # Lanes that take no step
    turns: Mask = False,  # Lanes that replace the direction of the line by the normal
    side: Float = 0,  # As in `_Search`
    wanted_sign: Float = 0,  # As for `line_hits`
    steps: int = STEPS_IN_ROUND,
) -> _Newton:
    """Intersect lines with the polynomial of a piece, continued beyond it, by Newton steps from its parameters."""

    def next_step(last: _Newton) -> _Newton:
        surface = piece.values(last.u, last.v)
        is_first = last.steps_left > steps
        d = dr.select(is_first & turns, surface.normal, last.d)
        is_along_surface = last.is_along_surface | (is_first & (side != 0) & (dot(surface.normal, d) * wanted_sign < 0))
        is_last = (last.steps_left == 1) | is_still
        du, dv = step_along(
            dr.select(is_along_surface, side * d, p - surface.value),
            dr.select(is_along_surface, surface.normal, d),
            surface.du,
            surface.dv,
        )
        size = dr.maximum(dr.abs(du), dr.abs(dv))
        longest: Float = dr.select(is_along_surface, size, dr.maximum(size, LONGEST_STEP))
        factor = dr.select(is_last, 0, LONGEST_STEP / longest)
        length = dr.select(is_last, last.length, size)
        u, v = dr.fma(du, factor, last.u), dr.fma(dv, factor, last.v)
        # After a short step, only evaluate the surface there.
        is_short = (size * piece.magnification < STEP_TOLERANCE) & (last.steps_left > 1)
        left = dr.select(is_last | is_along_surface, 0, dr.select(is_short, 1, last.steps_left - 1))
        return _Newton(left, u, v, length, is_along_surface, d, surface.first_order)

    zero = types.float(0)
    start = _Newton(types.index(steps + 1), zero, zero, zero, zero > 1, d, (d * 0,) * 4)
    return _repeated(next_step, start, lambda steps_left, *_: steps_left > 0, "newton")


def _repeated(step: Callable[[Any], Any], start: Any, is_active: Callable[..., Mask], label: str) -> Any:
    """Repeat a step from a state while a condition of its numbers holds: a loop over the numbers in the state.

    Dr.Jit takes longer to find them in objects. The state ends with a vector, and a tuple of vectors.
    """
    make, vector, count = type(start), type(start.d), len(start) - 2

    def numbers(state: Any) -> tuple:
        return *state[:count], *state.d, *(number for each in state.surface for number in each)

    def state(numbers: tuple) -> Any:
        d, *surface = (vector(*numbers[i : i + 3]) for i in range(count, len(numbers), 3))
        return make(*numbers[:count], d, surface)

    def next_numbers(*values: Any) -> tuple:
        return numbers(step(state(values)))

    return state(dr.while_loop(numbers(start), is_active, next_numbers, mode="symbolic", label=label))
