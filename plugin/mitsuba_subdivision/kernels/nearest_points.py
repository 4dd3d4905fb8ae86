"""Finds the nearest point of a surface from a starting location, by Newton's method across elements."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import drjit as dr

from .array_types import Float, Index, Mask, Vector3
from .line_intersection import LONGEST_STEP, STEP_TOLERANCE
from .locations import ElementWalk, Location
from .piece_kernel import PatchValues, Piece

# Maximum number of Newton steps; about five are usual.
STEPS = 40
# Tolerance of a step's length in double precision, as `STEP_TOLERANCE`: derivatives depend on it.
STEP_TOLERANCE_DOUBLE = 1e-7
# Factor of a step that has increased the distance; lengths, in parameters of a piece, below which the search stops.
SHORTER, GIVEN_UP_SINGLE, GIVEN_UP_DOUBLE = 0.25, 1e-6, 1e-12
# Least determinant of the second derivatives of half the squared distance, relative to the product of the squared
# lengths of the tangents. Below it, a Gauss-Newton step replaces Newton's; its damping, relative to these squared
# lengths, is for parallel tangents.
CONVEX, PARALLEL = 1e-4, 1e-6
# Largest distance of points on a side of the domain from it, in parameters of an element.
ON_SIDE = 1e-6
# Directions of the sides of a domain by its number of corners, in the order of `ParameterDomain.edge_distances`.
_SIDES = {3: ((1, 0), (1, -1), (0, 1)), 4: ((1, 0), (0, 1), (1, 0), (0, 1))}


@dataclass(frozen=True, eq=False)
class NearestPoints:
    """Points that constrain their nearest surface points when they or the control points change."""

    p: Vector3
    # Direction of the border or the crease that a surface point lies on, in parameters; zero at a corner
    along_u: Float
    along_v: Float
    is_free: Mask  # Lanes whose surface point may move in all directions

    @property
    def variables(self) -> tuple[Vector3, ...]:
        """Arrays that the surface points follow besides the control points."""
        return (self.p,)

    def step(self, here: PatchValues) -> tuple[Float, Float]:
        """Newton step from given values of the surface, whose derivatives follow the nearest point."""
        offset = here.value - self.p
        by_u, by_v = dr.dot(offset, here.du), dr.dot(offset, here.dv)
        free_u, free_v = _newton(dr.detach(here), dr.detach(offset), by_u, by_v)
        length = _along(dr.detach(here), dr.detach(offset), by_u, by_v, self.along_u, self.along_v)
        along_u, along_v = length * self.along_u, length * self.along_v
        return dr.select(self.is_free, free_u, along_u), dr.select(self.is_free, free_v, along_v)


# Not frozen: Dr.Jit assigns the fields of a loop's state.
@dataclass(eq=False)
class _Descent:
    """State of the descent of `nearest_locations`."""

    steps_left: Index
    location: Location  # The nearest one so far
    squared_distance: Float
    # The next step, and a factor that shortens it
    du: Float
    dv: Float
    factor: Float


def nearest_locations(
    walk: ElementWalk,  # Elements of the surface
    piece_at: Callable[..., Piece],  # Function of a half-edge, u and v, which returns the detached piece
    p: Vector3,  # Detached
    start: Location,
) -> tuple[Location, NearestPoints]:
    """Find the locations nearest to points, seen from the first corner in whole elements."""
    types = walk.types
    last_step = STEP_TOLERANCE_DOUBLE if types.is_double else STEP_TOLERANCE
    shortest_step = GIVEN_UP_DOUBLE if types.is_double else GIVEN_UP_SINGLE

    def step(last: _Descent) -> tuple[_Descent]:
        du, dv = last.factor * last.du, last.factor * last.dv
        location = walk.carried(Location(last.location.half_edge, last.location.u + du, last.location.v + dv))
        piece = piece_at(location.half_edge, location.u, location.v)
        values = piece.values(derivatives=2)
        offset = values.value - p
        squared = dr.squared_norm(offset)
        rounding = types.rounding * (dr.norm(p) + dr.norm(values.value))
        improves = squared <= last.squared_distance + rounding * (dr.sqrt(squared) + rounding)
        length = dr.maximum(dr.abs(du), dr.abs(dv)) * piece.magnification
        is_first = dr.isinf(last.squared_distance)
        new_du, new_dv, *_ = _step(walk, location, values, offset)
        is_done = (improves & ~is_first & (length < last_step)) | (~improves & (length < shortest_step))
        return (
            _Descent(
                dr.select(is_done, 0, last.steps_left - 1),
                last.location.chosen(improves, location),
                dr.select(improves, squared, last.squared_distance),
                dr.select(improves, new_du, last.du),
                dr.select(improves, new_dv, last.dv),
                dr.select(improves, 1, last.factor * SHORTER),
            ),
        )

    zero = types.float(0)
    begin = _Descent(types.index(STEPS), start, zero + dr.inf, zero, zero, zero + 1)
    (end,) = dr.while_loop(
        (begin,), lambda state: state.steps_left > 0, step, mode="symbolic", label="nearest_location"
    )
    # One more step, which is not taken, determines the directions in which the final location may move.
    location, _ = walk.from_first(end.location)
    values = piece_at(location.half_edge, location.u, location.v).values(derivatives=2)
    _, _, along_u, along_v, is_free = _step(walk, location, values, values.value - p)
    return location, NearestPoints(p, along_u, along_v, is_free)


def _step(
    walk: ElementWalk, location: Location, values: PatchValues, offset: Vector3
) -> tuple[Float, Float, Float, Float, Mask]:
    """Newton step, projected to a border that it would cross; direction of the border; whether there is none."""
    zero = walk.types.float(0)
    by_u, by_v = dr.dot(offset, values.du), dr.dot(offset, values.dv)
    du, dv = _limited(*_newton(values, offset, by_u, by_v))
    border_u, border_v, is_free = _border(walk, location, du, dv)
    length = _along(values, offset, by_u, by_v, border_u, border_v)
    along_u, along_v = _limited(length * border_u, length * border_v)
    # A step along a border stops at a corner.
    _, _, may_move = _border(walk, location, along_u, along_v)
    border_u, border_v, along_u, along_v = (
        dr.select(may_move, x, zero) for x in (border_u, border_v, along_u, along_v)
    )
    return dr.select(is_free, du, along_u), dr.select(is_free, dv, along_v), border_u, border_v, is_free


def _border(walk: ElementWalk, location: Location, du: Float, dv: Float) -> tuple[Float, Float, Mask]:
    """Direction of the border that a step would cross, and whether it crosses none."""
    types = walk.types
    inside = walk.domain.edge_distances(location.u, location.v)
    after = walk.domain.edge_distances(location.u + du, location.v + dv)
    side, least_distance = types.index(len(inside)), types.float(0)
    for k, (distance, distance_after) in enumerate(zip(inside, after, strict=True)):
        leaves = (distance <= ON_SIDE) & (distance_after < least_distance) & (distance_after < distance)
        side = dr.select(leaves, types.index(k), side)
        least_distance = dr.select(leaves, distance_after, least_distance)
    is_on_side = side < len(inside)
    # Test only the side that the step crosses furthest.
    is_free = ~(is_on_side & walk.is_border(location, side, is_on_side))
    u, v = types.float(0), types.float(0)
    for k, (along_u, along_v) in enumerate(_SIDES[walk.domain.corner_count]):
        u, v = dr.select(side == k, along_u, u), dr.select(side == k, along_v, v)
    return u, v, is_free


def _limited(du: Float, dv: Float) -> tuple[Float, Float]:
    longest: Float = dr.maximum(dr.maximum(dr.abs(du), dr.abs(dv)), LONGEST_STEP)
    factor = LONGEST_STEP / longest
    return du * factor, dv * factor


def _forms(values: PatchValues, offset: Vector3) -> tuple[tuple[Float, Float, Float], tuple[Float, Float, Float]]:
    """First fundamental form, and second derivatives of half the squared distance: uu, uv, vv of each."""
    du, dv = values.du, values.dv
    first_form = dr.squared_norm(du), dr.dot(du, dv), dr.squared_norm(dv)
    hessian = tuple(
        coefficient + dr.dot(offset, second) for coefficient, second in zip(first_form, values.second, strict=True)
    )
    return first_form, hessian  # type: ignore[return-value]


def _newton(values: PatchValues, offset: Vector3, by_u: Float, by_v: Float) -> tuple[Float, Float]:
    (a, b, c), (h, i, j) = _forms(values, offset)
    is_convex = (h > 0) & (h * j - i * i > CONVEX * a * c)
    damped = PARALLEL * (a + c)
    h, i, j = dr.select(is_convex, h, a + damped), dr.select(is_convex, i, b), dr.select(is_convex, j, c + damped)
    determinant = h * j - i * i
    exists = determinant > 0
    inverse = dr.select(exists, 1 / dr.select(exists, determinant, 1), 0)
    return (i * by_v - j * by_u) * inverse, (i * by_u - h * by_v) * inverse


def _along(values: PatchValues, offset: Vector3, by_u: Float, by_v: Float, along_u: Float, along_v: Float) -> Float:
    first_curvature, curvature = (
        form[0] * along_u * along_u + 2 * form[1] * along_u * along_v + form[2] * along_v * along_v
        for form in _forms(values, offset)
    )
    divisor = dr.select(curvature > CONVEX * first_curvature, curvature, first_curvature)
    exists = divisor > 0
    return dr.select(exists, -(by_u * along_u + by_v * along_v) / dr.select(exists, divisor, 1), 0)
