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

import drjit as dr

from .algebra import LONGEST_STEP, STEP_TOLERANCE, dot, over, step_along
from .array_types import ArrayTypes, Float, Index, Mask, Vector3
from .locations import ElementWalk, Location
from .piece_kernel import PatchValues, Piece

# Maximum number of rounds for each aim, and number of Newton steps in a round.
ROUNDS = 12
STEPS_IN_ROUND = 3
# Largest overshoot of a border by rounding, in parameters of a piece. A larger one means that the border stops the
# search.
BEYOND_BORDER = 1e-6
# Successive aims of the search; the `kind` of a hit is the aim that succeeded.
ON_LINE, ON_NORMAL, MISSED = range(3)
# Added to an aim when the search has ended.
_ENDED = 4


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
    facing: Float = 0,
) -> tuple[Location, Index, PatchValues]:
    """Intersect lines with a surface near given locations. Arguments must be detached.

    Returns locations, seen from the first corner in whole elements; the kinds of hits: `ON_LINE`, `ON_NORMAL`, also for
    a point on a border or a crease beside the line, or `MISSED`; and the surface there, without second derivatives.
    """
    types = walk.types

    def search(aim, round_count, side, is_held, d, half_edge, u, v, *_):
        row = walk.row(half_edge, active)
        piece = piece_at(half_edge, u, v, active, row)
        turns = (aim == ON_NORMAL) & (round_count == 0)
        d, (du, dv), length, is_along_surface, surface = piece_hits(
            types, piece, p, d, is_still=is_held | (aim == MISSED), turns=turns, side=side, facing=facing
        )
        offset = p - surface.value
        unclamped = Location(half_edge, u + du, v + dv)
        is_finite = dr.isfinite(du) & dr.isfinite(dv)
        target = walk.carried(unclamped, active & is_finite, row)

        # Tolerance of the step's length, in parameters of a piece: rounding errors exceed `STEP_TOLERANCE` next to
        # extraordinary points.
        coordinate_size = dr.sqrt(dot(p, p)) + dr.sqrt(dot(surface.value, surface.value))
        longest_derivative = dr.sqrt(dr.maximum(dot(surface.du, surface.du), dot(surface.dv, surface.dv)))
        last_step = dr.clip(
            over(types.rounding * coordinate_size * piece.magnification, longest_derivative), STEP_TOLERANCE, 1
        )
        parameter_change = dr.maximum(dr.abs(target.u - u), dr.abs(target.v - v))
        has_settled = is_finite & (dr.minimum(length, parameter_change) * piece.magnification < last_step)
        # This is also true if the other side is unreachable, beyond a crease.
        is_wrong_side = has_settled & (aim == ON_LINE) & (dot(surface.normal, d) * facing < 0)
        converges = has_settled & ~is_wrong_side & ~is_along_surface
        converges &= (target.half_edge == half_edge) & piece.is_inside(target.u - u, target.v - v, last_step)
        converges &= dr.sqrt(dot(offset, offset)) <= max_distance
        # At a border, successive steps overshoot by nearly the same amount.
        overshoot = dr.maximum(dr.abs(target.u - unclamped.u), dr.abs(target.v - unclamped.v)) * piece.magnification
        holds = converges & (overshoot > BEYOND_BORDER)

        ends = is_held | (aim == MISSED) | (converges & ~holds)
        fails = (round_count + 1 >= ROUNDS) & ~(ends | holds)
        new_side = dr.select(dot(offset, d) < 0, types.float(-1), types.float(1))
        side = dr.select(is_along_surface, side, dr.select(is_wrong_side, new_side, 0))
        side = dr.select(fails, 0, side)
        # A point on the border that stops the search is not on its line.
        reached_aim = dr.select(is_held & (aim == ON_LINE), types.index(ON_NORMAL), aim)
        aim = dr.select(ends, reached_aim + _ENDED, dr.select(fails, aim + 1, aim))
        target = Location(half_edge, u, v).chosen(is_finite, target).chosen(fails, location)
        round_count = dr.select(fails, 0, round_count + 1)
        return aim, round_count, side, holds, d, target.half_edge, target.u, target.v, *surface.first_order

    zero = types.float(0)
    start = (types.index(ON_LINE), types.index(0), zero, zero > 1, d, location.half_edge, location.u, location.v)
    aim, _, _, _, _, half_edge, u, v, *values = dr.while_loop(
        (*start, *(d * 0 for _ in range(4))),
        lambda aim, *_: active & (aim < _ENDED),
        search,
        mode="symbolic",
        label="line_intersection",
    )
    from_first, corner = walk.from_first(Location(half_edge, u, v), active)
    return from_first, aim & (_ENDED - 1), PatchValues(*values).seen_from_first(walk, corner)


def piece_hits(
    types: ArrayTypes,
    piece: Piece,
    p: Vector3,  # A point of each line
    d: Vector3,  # Direction of each line
    *,
    is_still: Mask = False,  # Lanes that take no step
    turns: Mask = False,  # Lanes that replace the direction of the line by the normal
    # Non-zero if the last hit was on the wrong side. From a point that faces the wrong way, a step then leads along the
    # surface, in the direction of the line if positive, or against it.
    side: Float = 0,
    facing: Float = 0,  # As for `line_hits`
    steps: int = STEPS_IN_ROUND,
) -> tuple[Vector3, tuple[Float, Float], Float, Mask, PatchValues]:
    """Intersect lines with the polynomial of a piece, continued beyond it, by some Newton steps from its parameters.

    Returns the directions of the lines; the sum of the steps by u and v; the length of the last step; lanes whose last
    step was along the surface, towards another hit of the line; and the surface before the last step.
    """

    def step(steps_left, d, u, v, length, is_along_surface, *_):
        surface = piece.values(u, v)
        is_first = steps_left > steps
        d = dr.select(is_first & turns, surface.normal, d)
        is_along_surface |= is_first & (side != 0) & (dot(surface.normal, d) * facing < 0)
        is_last = (steps_left == 1) | is_still
        du, dv = step_along(
            dr.select(is_along_surface, side * d, p - surface.value),
            dr.select(is_along_surface, surface.normal, d),
            surface.du,
            surface.dv,
        )
        size = dr.maximum(dr.abs(du), dr.abs(dv))
        factor = LONGEST_STEP / dr.select(is_along_surface, size, dr.maximum(size, LONGEST_STEP))
        factor = dr.select(is_last, 0, factor)
        length = dr.select(is_last, length, size)
        u, v = dr.fma(du, factor, u), dr.fma(dv, factor, v)
        # After a short step, only evaluate the surface there.
        is_short = (size * piece.magnification < STEP_TOLERANCE) & (steps_left > 1)
        steps_left = dr.select(is_last | is_along_surface, 0, dr.select(is_short, 1, steps_left - 1))
        return steps_left, d, u, v, length, is_along_surface, *surface.first_order

    zero = types.float(0)
    start = (types.index(steps + 1), type(d)(d), zero, zero, zero, zero > 1)
    _, d, u, v, length, is_along_surface, *values = dr.while_loop(
        (*start, *(d * 0 for _ in range(4))),
        lambda steps_left, *_: steps_left > 0,
        step,
        mode="symbolic",
        label="newton",
    )
    return d, (u, v), length, is_along_surface, PatchValues(*values)
