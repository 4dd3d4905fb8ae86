"""Intersects lines with the surface by Newton's method from a nearby location."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import drjit as dr

from .array_types import ArrayTypes, Float, Index, Mask, Vector3
from .locations import ElementWalk, Location
from .piece_kernel import PatchValues
from .vectors import LONGEST_STEP, STEP_TOLERANCE, dot, over, rounding, step_along

if TYPE_CHECKING:
    from .displacement import DisplacedPiece
    from .piece_kernel import Piece

    AnyPiece = Piece | DisplacedPiece

# Maximum number of rounds for each aim of `LineIntersection`, and number of Newton steps in a round. Each round starts
# in the piece that the last one has reached.
ROUNDS = 12
STEPS_IN_ROUND = 3
# Largest overshoot of a border by rounding, in parameters of a piece. A larger one means that the border stops the
# search.
BEYOND_BORDER = 1e-6
# Successive aims of the search, see `LineIntersection`; the `kind` of a hit is the aim that succeeded.
ON_LINE, ON_NORMAL, MISSED = range(3)
# Added to an aim when the search has ended.
_ENDED = 4


@dataclass(frozen=True, eq=False)
class LineHits:
    """Hits of lines on a surface."""

    location: Location  # Seen from the first corner in whole elements
    kind: Index  # `ON_LINE`; `ON_NORMAL`, also for a point on a border or a crease beside the line; or `MISSED`
    values: PatchValues  # The surface at the location, detached and without second derivatives


@dataclass(frozen=True, eq=False)
class Lines:
    """Lines that constrain surface points when control points or the lines change."""

    # Origins, in the space of the control points, and directions
    o: Vector3
    d: Vector3
    hold: Mask  # Lanes whose point lies on its line; other points keep their location on the surface

    def step(self, here: PatchValues) -> tuple[Float, Float]:
        """Newton step from given values of the surface, whose derivatives follow the line."""
        du, dv = step_along(self.o - here.value, self.d, dr.detach(here.du), dr.detach(here.dv))
        return dr.select(self.hold, du, 0), dr.select(self.hold, dv, 0)


@dataclass(frozen=True, eq=False)
class _Round:
    """Result of Newton steps within a piece."""

    d: Vector3  # Direction of the line; the normal for the aim `ON_NORMAL`
    # Sum of the steps
    u: Float
    v: Float
    length: Float  # Length of the last step
    is_along_surface: Mask  # Lanes whose last step was along the surface, towards another hit of the line
    values: PatchValues  # The surface before the last step


class LineIntersection:
    """Newton's method for intersections of lines with a surface.

    The search has three aims, each with at most `ROUNDS` rounds. A round takes some steps within a piece of the
    surface, and moves to the piece that they reach. A search that does not converge restarts with the next aim:

    - `ON_LINE`: the line. Where the hit faces the wrong way, a step along the surface leads towards the other side of
      the solid that the line enters or leaves.
    - `ON_NORMAL`: the line through the given point along the surface's normal at the start of the search.
    - `MISSED`: none; evaluates the surface at the start of the search.

    Where steps lead beyond a border or a crease, the result is the nearest point on it.
    """

    def __init__(
        self,
        types: ArrayTypes,
        walk: ElementWalk,  # Elements of the surface
        # Function of a half-edge, u, v, a mask and the row of the half-edge, which returns the piece of the surface
        piece: Callable[..., AnyPiece],
    ) -> None:
        self._types, self._walk, self._piece = types, walk, piece
        self._rounding = rounding(types)

    def hits(
        self, p: Vector3, d: Vector3, location: Location, active: Mask, max_distance: Float, facing: Float
    ) -> LineHits:
        """Intersect lines with the surface; parameters as for `SurfaceKernel.line_hits`."""
        types = self._types

        def continues(aim: Index, *_: Any) -> Mask:
            return active & (aim < _ENDED)

        def search(
            aim: Index,
            round_count: Index,
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
            turns = (aim == ON_NORMAL) & (round_count == 0)
            steps = self._steps(piece, p, d, is_held | (aim == MISSED), turns, side, facing)
            surface = steps.values
            offset = p - surface.value
            unclamped = Location(half_edge, u + steps.u, v + steps.v)
            is_finite = dr.isfinite(steps.u) & dr.isfinite(steps.v)
            target = self._walk.carried(unclamped, active & is_finite, row)

            # Tolerance of the step's length, in parameters of a piece: rounding errors exceed `STEP_TOLERANCE` next to
            # extraordinary points.
            coordinate_size = dr.sqrt(dot(p, p)) + dr.sqrt(dot(surface.value, surface.value))
            longest_derivative = dr.sqrt(dr.maximum(dot(surface.du, surface.du), dot(surface.dv, surface.dv)))
            last_step = dr.clip(
                over(self._rounding * coordinate_size * piece.magnification, longest_derivative), STEP_TOLERANCE, 1
            )
            parameter_change = dr.maximum(dr.abs(target.u - u), dr.abs(target.v - v))
            has_settled = is_finite & (dr.minimum(steps.length, parameter_change) * piece.magnification < last_step)
            # This is also true if the other side is unreachable, beyond a crease.
            is_wrong_side = has_settled & (aim == ON_LINE) & (dot(surface.normal, steps.d) * facing < 0)
            converges = has_settled & ~is_wrong_side & ~steps.is_along_surface
            converges &= (target.half_edge == half_edge) & piece.is_inside(target.u - u, target.v - v, last_step)
            converges &= dr.sqrt(dot(offset, offset)) <= max_distance
            # At a border, successive steps overshoot by nearly the same amount.
            overshoot = dr.maximum(dr.abs(target.u - unclamped.u), dr.abs(target.v - unclamped.v)) * piece.magnification
            holds = converges & (overshoot > BEYOND_BORDER)

            ends = is_held | (aim == MISSED) | (converges & ~holds)
            fails = (round_count + 1 >= ROUNDS) & ~(ends | holds)
            new_side = dr.select(dot(offset, steps.d) < 0, types.float(-1), types.float(1))
            side = dr.select(steps.is_along_surface, side, dr.select(is_wrong_side, new_side, 0))
            side = dr.select(fails, 0, side)
            # A point on the border that stops the search is not on its line.
            reached_aim = dr.select(is_held & (aim == ON_LINE), types.index(ON_NORMAL), aim)
            aim = dr.select(ends, reached_aim + _ENDED, dr.select(fails, aim + 1, aim))
            target = Location(half_edge, u, v).chosen(is_finite, target).chosen(fails, location)
            round_count = dr.select(fails, 0, round_count + 1)
            return (
                aim,
                round_count,
                side,
                holds,
                steps.d,
                target.half_edge,
                target.u,
                target.v,
                surface.value,
                surface.du,
                surface.dv,
                surface.normal,
            )

        zero = types.float(0)
        start = (types.index(ON_LINE), types.index(0), zero, zero > 1, d, location.half_edge, location.u, location.v)
        state = (*start, *(d * 0 for _ in range(4)))
        aim, _, _, _, _, half_edge, u, v, *values = dr.while_loop(
            state, continues, search, mode="symbolic", label="line_intersection"
        )
        location_from_first, corner = self._walk.from_first(Location(half_edge, u, v), active)
        return LineHits(
            location_from_first, aim & (_ENDED - 1), PatchValues(*values).seen_from_first(self._walk, corner)
        )

    def _steps(
        self,
        piece: AnyPiece,
        p: Vector3,
        d: Vector3,
        is_still: Mask,  # Lanes that take no step
        turns: Mask,  # Lanes that replace the direction of the line by the normal
        # Non-zero if the last hit was on the wrong side. From a point that faces the wrong way, a step then leads along
        # the surface, in the direction of the line if positive, or against it.
        side: Float,
        facing: Float,
    ) -> _Round:
        """Take Newton steps within a piece."""
        types = self._types

        def continues(steps_left: Index, *_: Any) -> Mask:
            return steps_left > 0

        def step(
            steps_left: Index, d: Vector3, u: Float, v: Float, length: Float, is_along_surface: Mask, *_: Any
        ) -> tuple:
            surface = piece.values(u, v)
            is_first = steps_left > STEPS_IN_ROUND
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
            return steps_left, d, u, v, length, is_along_surface, surface.value, surface.du, surface.dv, surface.normal

        zero = types.float(0)
        start = (types.index(STEPS_IN_ROUND + 1), type(d)(d), zero, zero, zero, zero > 1)
        state = (*start, *(d * 0 for _ in range(4)))
        _, d, u, v, length, is_along_surface, *values = dr.while_loop(
            state, continues, step, mode="symbolic", label="newton"
        )
        return _Round(d, u, v, length, is_along_surface, PatchValues(*values))
