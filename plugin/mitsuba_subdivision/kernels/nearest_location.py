"""Finds the nearest point of a surface from a starting location, by Newton's method across elements."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import drjit as dr

from .array_types import ArrayTypes, Float, Index, Mask, Vector3
from .element_walk import ElementWalk, Location, distances
from .piece_kernel import PatchValues, Piece
from .vectors import LONGEST_STEP, STEP_TOLERANCE, STEP_TOLERANCE_DOUBLE, rounding

# Maximum number of steps; about five are usual.
STEPS = 40
# A step that increases the distance is shortened by this factor, and abandoned below these lengths.
SHORTER, GIVEN_UP_SINGLE, GIVEN_UP_DOUBLE = 0.25, 1e-6, 1e-12
# If the determinant of the second derivatives is below this fraction of that of the tangents, the distance is nearly a
# saddle, and a Gauss-Newton step uses the tangents alone; with a damping term if they are parallel.
CONVEX, PARALLEL = 1e-4, 1e-6
# Points nearer to a side of the domain than this are on it.
ON_SIDE = 1e-6
# Directions of the sides of a domain with so many corners, in the order of `distances`.
_SIDES = {3: ((1, 0), (1, -1), (0, 1)), 4: ((1, 0), (0, 1), (1, 0), (0, 1))}


@dataclass(frozen=True, eq=False)
class NearestPoints:
    """Given points, whose nearest surface points follow them when they or the control points change."""

    p: Vector3
    # The direction in which a surface point may move that lies on a border or a crease; zero at a corner
    along_u: Float
    along_v: Float
    is_free: Mask  # Surface points that may move in all directions

    def step(self, here: PatchValues) -> tuple[Float, Float]:
        """Newton's step at given values of the surface, with derivatives that follow the nearest point."""
        away = here.value - self.p
        by_u, by_v = dr.dot(away, here.du), dr.dot(away, here.dv)
        free_u, free_v = _newton(dr.detach(here), dr.detach(away), by_u, by_v)
        part = _along(dr.detach(here), dr.detach(away), by_u, by_v, self.along_u, self.along_v)
        along_u, along_v = part * self.along_u, part * self.along_v
        return dr.select(self.is_free, free_u, along_u), dr.select(self.is_free, free_v, along_v)


class NearestLocation:
    """Finds nearest points near given locations."""

    def __init__(self, types: ArrayTypes, walk: ElementWalk, piece: Callable[..., Piece]) -> None:
        # The piece is that at a half-edge, parameters and a mask, without derivatives.
        self._types, self._walk, self._piece = types, walk, piece
        self._domain = walk.domain

    def found(
        self,
        p: Vector3,  # Without derivatives
        start: Location,  # Where to begin
        active: Mask = True,
    ) -> tuple[Location, NearestPoints]:
        """Locations where the distance to points is least, at least among those nearby, and where they may move.

        In whole elements, locations are seen from the first corner.
        """
        types = self._types
        last_step = STEP_TOLERANCE_DOUBLE if types.is_double else STEP_TOLERANCE
        given_up = GIVEN_UP_DOUBLE if types.is_double else GIVEN_UP_SINGLE
        rounded = rounding(types)

        def continues(left: Index, *_: Any) -> Mask:
            return active & (left > 0)

        def step(
            left: Index,
            half_edge: Index,
            u: Float,
            v: Float,
            squared: Float,
            du: Float,
            dv: Float,
            part: Float,
            *_: Any,
        ) -> tuple:
            aim = Location(half_edge, u + part * du, v + part * dv)
            here = self._walk.carried(aim, active)
            piece = self._piece(here.half_edge, here.u, here.v, active)
            values = piece.values(derivatives=2)
            away = values.value - p
            now = dr.squared_norm(away)
            size = dr.norm(p) + dr.norm(values.value)
            improves = now <= squared + rounded * size * (dr.sqrt(now) + rounded * size)
            length = dr.maximum(dr.abs(part * du), dr.abs(part * dv)) * piece.magnification
            is_first = dr.isinf(squared)
            new_u, new_v, along_u, along_v, is_free = self._step(here, values, away)
            ends = (improves & (is_first == False) & (length < last_step)) | (  # noqa: E712 - an array
                (improves == False) & (length < given_up)  # noqa: E712
            )
            best = Location(half_edge, u, v).chosen(improves, here)
            return (
                dr.select(ends, 0, left - 1),
                best.half_edge,
                best.u,
                best.v,
                dr.select(improves, now, squared),
                dr.select(improves, new_u, du),
                dr.select(improves, new_v, dv),
                dr.select(improves, 1, part * SHORTER),
                along_u,
                along_v,
                is_free,
            )

        zero = types.float(0)
        begin = (types.index(STEPS), start.half_edge, start.u, start.v, zero + dr.inf, zero, zero, zero + 1)
        state = (*begin, zero, zero, zero > 1)
        _, half_edge, u, v, *_ = dr.while_loop(state, continues, step, mode="symbolic", label="nearest_location")
        # A last step at the final location, seen from the first corner, for the direction in which it may move.
        location = self._walk.from_first(Location(half_edge, u, v), active)
        values = self._piece(location.half_edge, location.u, location.v, active).values(derivatives=2)
        _, _, along_u, along_v, is_free = self._step(location, values, values.value - p)
        return location, NearestPoints(p, along_u, along_v, is_free)

    def _step(self, here: Location, values: PatchValues, away: Vector3) -> tuple[Float, Float, Float, Float, Mask]:
        """Newton's step, projected to a border that it would cross; the border's direction; and whether it is free."""
        types = self._types
        by_u, by_v = dr.dot(away, values.du), dr.dot(away, values.dv)
        du, dv = _newton(values, away, by_u, by_v)
        du, dv = _limited(du, dv)
        first_u, first_v, is_free = self._direction(here, du, dv)
        part = _along(values, away, by_u, by_v, first_u, first_v)
        along_u, along_v = _limited(part * first_u, part * first_v)
        # Along a border it may reach a corner, and stop there.
        _, _, may_move = self._direction(here, along_u, along_v)
        first_u, first_v = dr.select(may_move, first_u, types.float(0)), dr.select(may_move, first_v, types.float(0))
        along_u, along_v = dr.select(may_move, along_u, types.float(0)), dr.select(may_move, along_v, types.float(0))
        return dr.select(is_free, du, along_u), dr.select(is_free, dv, along_v), first_u, first_v, is_free

    def _direction(self, here: Location, du: Float, dv: Float) -> tuple[Float, Float, Mask]:
        """Direction of the border that a step would cross, and whether the step is free, as it crosses none."""
        types = self._types
        inside = distances(self._domain, here.u, here.v)
        after = distances(self._domain, here.u + du, here.v + dv)
        leaving, least = types.index(len(inside)), types.float(0)
        for k, (now, then) in enumerate(zip(inside, after, strict=True)):
            leaves = (now <= ON_SIDE) & (then < least) & (then < now)
            leaving, least = dr.select(leaves, types.index(k), leaving), dr.select(leaves, then, least)
        is_on_side = leaving < len(inside)
        # Test whether this side alone is a border.
        is_free = (is_on_side & self._walk.is_border(here, leaving, is_on_side)) == False  # noqa: E712 - an array
        u, v = types.float(0), types.float(0)
        for k, (along_u, along_v) in enumerate(_SIDES[self._domain.corner_count]):
            u, v = dr.select(leaving == k, along_u, u), dr.select(leaving == k, along_v, v)
        return u, v, is_free


def _limited(du: Float, dv: Float) -> tuple[Float, Float]:
    factor = LONGEST_STEP / dr.maximum(dr.maximum(dr.abs(du), dr.abs(dv)), LONGEST_STEP)
    return du * factor, dv * factor


def _forms(values: PatchValues, away: Vector3) -> tuple[tuple[Float, Float, Float], tuple[Float, Float, Float]]:
    """First fundamental form, and the same plus the difference's components along second derivatives."""
    du, dv = values.du, values.dv
    flat = dr.squared_norm(du), dr.dot(du, dv), dr.squared_norm(dv)
    bent = tuple(each + dr.dot(away, second) for each, second in zip(flat, values.second, strict=True))
    return flat, bent  # type: ignore[return-value]


def _newton(values: PatchValues, away: Vector3, by_u: Float, by_v: Float) -> tuple[Float, Float]:
    """The step that zeroes the gradient of half the squared distance."""
    (a, b, c), (h, i, j) = _forms(values, away)
    is_convex = (h > 0) & (h * j - i * i > CONVEX * a * c)
    damped = PARALLEL * (a + c)
    h, i, j = dr.select(is_convex, h, a + damped), dr.select(is_convex, i, b), dr.select(is_convex, j, c + damped)
    determinant = h * j - i * i
    exists = determinant > 0
    inverse = dr.select(exists, 1 / dr.select(exists, determinant, 1), 0)
    return (i * by_v - j * by_u) * inverse, (i * by_u - h * by_v) * inverse


def _along(values: PatchValues, away: Vector3, by_u: Float, by_v: Float, along_u: Float, along_v: Float) -> Float:
    """Length of the step in a direction; zero if the direction is zero."""
    flat, bent = (
        each[0] * along_u * along_u + 2 * each[1] * along_u * along_v + each[2] * along_v * along_v
        for each in _forms(values, away)
    )
    bend = dr.select(bent > CONVEX * flat, bent, flat)
    exists = bend > 0
    return dr.select(exists, -(by_u * along_u + by_v * along_v) / dr.select(exists, bend, 1), 0)
