"""Error criteria of adaptive tessellations: distance of triangles from the surface, or length of their edges.

Cones of directions contain all tangents, or all normals, of parts of patches.
"""

from __future__ import annotations

import sys
from collections.abc import Callable
from dataclasses import dataclass
from math import sqrt
from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..mesh.connectivity import IntArray
from ..schemes.domain import FloatArray

# Distance of triangles in a parameter box from the surface, relative to its second differences along the box. Their
# circumcircle is that of the box, whose squared radius is a quarter of the squared diagonal [Waldron 1998].
SQUARE_ERROR = 1 / 8
# The same on triangular grids, relative to the sides of their triangles: half the largest squared radius of the
# smallest circle around a triangle of a strip between two rates, at a corner where both sides' segments are halved.
TRIANGLE_ERROR = 0.227
# Factor of the error for triangles that an outline's sensor cannot see edge-on. Their error is visible where surfaces
# intersect, and in shadows: at 6.4 pixels, a teapot's handle ended in a different place.
COARSE = 8.0
# Angle from perpendicular to the view, in radians, up to which a normal counts as beside a silhouette, beyond which
# coarse triangles might project.
BESIDE_OUTLINE = np.radians(4)

Measure = Literal["chord", "edge"]
HeightsAt = Callable[[IntArray, FloatArray], FloatArray]

# Least divisor. Not by NumPy's finfo, as NumPy before 2.3 warns where Dr.Jit computes without subnormals.
TINY = sys.float_info.min
# Excess over an integer that counts as rounding error and does not round a rate up.
RATE_ROUNDING = 1e-9
# Upper limit of rates, above any that is used.
MOST = 1 << 20
# Directions whose sine is below this are parallel.
PARALLEL = 1e-9


@dataclass(frozen=True, eq=False)
class Sensor:
    """Viewpoint and pixel size of a sensor."""

    eye: FloatArray  # (3,) float64: in the space of the control points
    # Least size of a pixel over the image, at a distance of one; for an orthographic sensor, at any distance
    pixel: float
    direction: FloatArray | None = None  # (3,) float64: view direction of an orthographic sensor, else None

    def pixel_size(self, lower: FloatArray, upper: FloatArray) -> FloatArray:
        """``(.., t)`` least size of a pixel anywhere in boxes ``(.., 3, t)``."""
        if self.direction is not None:
            return np.full(lower[..., 0, :].shape, self.pixel)
        eye = self.eye[:, None]
        return self.pixel * np.linalg.norm(np.maximum(0, np.maximum(lower - eye, eye - upper)), axis=-2)

    def may_see_outline(self, lower: FloatArray, upper: FloatArray, cone: Cone) -> NDArray[np.bool_]:
        """``(.., t)`` whether a normal in a cone may be nearly perpendicular to the view of a point in a box."""
        if self.direction is not None:
            view, spread = self.direction[:, None], np.zeros(lower[..., 0, :].shape)
        else:
            view = (lower + upper) / 2 - self.eye[:, None]
            distance, radius = np.linalg.norm(view, axis=-2), np.linalg.norm(upper - lower, axis=-2) / 2
            with np.errstate(divide="ignore", invalid="ignore"):
                view = view / distance[..., None, :]
                spread = np.where(radius < distance, np.arcsin(radius / distance), np.pi)
        tilt = np.arcsin(np.clip(np.abs(dot(cone.axis, view)), 0, 1))
        return ~(tilt > np.arcsin(np.clip(cone.sine, 0, 1)) + spread + BESIDE_OUTLINE) | (cone.sine >= 1)


@dataclass(frozen=True, eq=False)
class Criterion:
    """An error limit for all triangles of a tessellation. Raises ValueError if it is negative or not a number."""

    measure: Measure  # The limited quantity: the distance between triangles and surface, or the length of edges
    error: float  # The limit, in pixels of the ``sensor`` if there is one
    sensor: Sensor | None = None
    # Triangles that this sensor cannot see edge-on, and that are hence at no silhouette, may be coarse.
    outline: Sensor | None = None
    # Maps samples, given as for `PatchSampler.evaluate`, to heights ``(s,)`` of a displacement, at which the limit is
    # checked; and the largest distance that any point is displaced, or any of many samples of a texture
    heights: HeightsAt | None = None
    highest: float = 0.0

    def __post_init__(self) -> None:
        if not self.error >= 0:
            raise ValueError(f"an error of {self.error}; expected a number from 0 on")

    def limit(self, lower: FloatArray, upper: FloatArray, normals: Cone | None = None) -> FloatArray:
        """``(.., t)`` the limit for parts of the surface in boxes ``(.., 3, t)``, by default with any normals."""
        limit = np.full(lower[..., 0, :].shape, float(self.error))
        if self.sensor is not None:
            limit *= self.sensor.pixel_size(lower - self.highest, upper + self.highest)
        if self.outline is not None and normals is not None:
            limit[~self.outline.may_see_outline(lower, upper, normals)] *= COARSE
        return limit

    def form(self, points: FloatArray, derivatives: list[FloatArray], corner_count: int) -> FloatArray:
        """Bound the limited quantity, relative to its limit, by a function of the numbers of segments along u and v.

        ``points`` are Bernstein coefficients ``(b, .., 3, t)`` of parts of patches, and ``derivatives`` those by u, v,
        uu, uv and vv. Returns A, B and C, ``(3, .., t)``. Over squares, ``A / n_u^2 + 2 B / (n_u n_v) + C / n_v^2``
        must not exceed 1. Over triangles with n segments per side, ``A / n^2`` must not, and B and C are zero.
        """
        (u, shortest_u), (v, shortest_v) = map(tangent_cone, derivatives[:2])
        normals = normal_cone(u, v)
        if self.measure == "edge":
            form = _edge_form(derivatives[0], derivatives[1], corner_count)
        else:
            form = _chord_form(derivatives[2:], np.minimum(shortest_u, shortest_v), normals, corner_count)
        return self._relative(form, self.limit(points.min(axis=0), points.max(axis=0), normals))

    def form_of_displacement(self, points: FloatArray, heights: FloatArray, corner_count: int) -> FloatArray:
        """``(3, t)`` contribution to `form` of heights ``(n, n, t)`` over tiles, by v and u; NaN beyond a triangle."""
        steps, is_triangle = len(heights) - 1, corner_count == 3
        u, v = (steps * np.diff(heights, axis=axis) for axis in (1, 0))
        if self.measure == "edge" and is_triangle:
            u, v = u[:-1], v[:, :-1]
            form = _isotropic(4 * np.nanmax(np.square([u, v, u - v]), axis=(0, 1, 2)))
        elif self.measure == "edge":
            a, c = (np.abs(d).max(axis=(0, 1)) for d in (u, v))
            form = np.stack([a**2, a * c, c**2])
        else:
            uu, uv, vv = (steps * np.diff(first, axis=axis) for first, axis in ((u, 1), (u, 0), (v, 0)))
            if is_triangle:
                mean, cosine, sine = _by_angle(uu[:-2], uv[:-1, :-1], vv[:, :-2])
                form = _isotropic(TRIANGLE_ERROR * np.nanmax(np.abs(mean) + np.hypot(cosine, sine), axis=(0, 1)))
            else:
                form = SQUARE_ERROR * np.stack([np.abs(d).max(axis=(0, 1)) for d in (uu, uv, vv)])
        return self._relative(form, self.limit(points.min(axis=0), points.max(axis=0)))

    def _relative(self, form: FloatArray, limit: FloatArray) -> FloatArray:
        with np.errstate(over="ignore"):
            return form / np.maximum(limit**2 if self.measure == "edge" else limit, TINY)

    def segments(self, second: FloatArray, points: FloatArray) -> IntArray:
        """``(t,)`` segments that keep curves on surfaces ``(b, 3, t)`` within the limit, from second derivatives."""
        furthest = SQUARE_ERROR * np.sqrt(dot(second, second).max(axis=0))
        limit = self.limit(points.min(axis=0), points.max(axis=0))
        return rounded_up(np.sqrt(furthest / np.maximum(limit, TINY)))


def _edge_form(du: FloatArray, dv: FloatArray, corner_count: int) -> FloatArray:
    if corner_count == 3:
        # Edges of strips cross at most two triangles of the grid.
        return _isotropic(4 * np.max([dot(d, d).max(axis=0) for d in (du, dv, du - dv)], axis=0))
    a, c = (np.sqrt(dot(d, d).max(axis=0)) for d in (du, dv))
    most_dot = np.abs(dot(du[:, None], dv[None])).max(axis=(0, 1))
    return np.stack([a**2, np.minimum(a * c, most_dot), c**2])


def _chord_form(second: list[FloatArray], shortest: FloatArray, normals: Cone, corner_count: int) -> FloatArray:
    """`Criterion.form` of the distance of triangles, from the least length of both tangents."""
    if corner_count == 3:
        second = _by_angle(*second)
    # The distance from the surface is the normal component of the difference, plus an excess due to its tangential
    # component, over which the surface curves; at most the length of the difference.
    longest = [dot(d, d).max(axis=0) for d in second]
    # Where the surface degenerates to a curve, neither the normal component nor the excess is known. Rounding may leave
    # a tangent that nearly vanishes, and an excess beyond single precision.
    with np.errstate(divide="ignore", over="ignore", invalid="ignore"):
        slip = 1 + np.where(shortest > 0, np.max(longest, axis=0) / shortest**2 / 8, np.inf)
        # Largest extent along any of the normals.
        lengths = [np.sqrt(most) for most in longest]
        extents = [
            np.abs(dot(d, normals.axis)).max(axis=0) + normals.sine * a for d, a in zip(second, lengths, strict=True)
        ]
        sizes = [np.fmin(slip * extent, length) for extent, length in zip(extents, lengths, strict=True)]
    if corner_count == 3:
        return _isotropic(TRIANGLE_ERROR * (sizes[0] + np.hypot(sizes[1], sizes[2])))
    return SQUARE_ERROR * np.stack(sizes)


def _by_angle(uu: FloatArray, uv: FloatArray, vv: FloatArray) -> list[FloatArray]:
    """Second derivatives by angle in an equilateral triangle: mean, factors of cosine and sine of twice the angle."""
    mean = (uu - uv + vv) * (2 / 3)
    return [mean, uu - mean, (uv - uu / 2) * (2 / sqrt(3))]


def _isotropic(values: FloatArray) -> FloatArray:
    return np.stack([values, np.zeros_like(values), np.zeros_like(values)])


def least_product(forms: FloatArray) -> IntArray:
    """``(t, 2)`` rates of least product with ``A / n_u^2 + 2 B / (n_u n_v) + C / n_v^2 <= 1``.

    For all non-negative ``forms`` A, B and C, ``(f, 3, t)``.
    """
    forms = np.minimum(forms, MOST)
    # Where A and C vanish, the quotient below must not overflow.
    a, b, c = np.maximum(forms.max(axis=0), 1e-100)
    # The real rates of least product satisfy A / n_u^2 = C / n_v^2. Integers beside these are tried.
    rate = np.sqrt(2 + 2 * b / (np.sqrt(a) * np.sqrt(c)))
    tried = []
    for offset in (-1, 0, 1):
        tried.append(_with_other(forms, np.floor(rate * np.sqrt(a)) + offset))
        tried.append(_with_other(forms[:, ::-1], np.floor(rate * np.sqrt(c)) + offset)[:, ::-1])
    candidates = np.stack(tried)
    best = np.argmin(candidates.prod(axis=2) + 1e-3 * candidates.sum(axis=2), axis=0)
    return candidates[best, np.arange(len(best))].astype(np.int64)


def _with_other(forms: FloatArray, first: FloatArray) -> FloatArray:
    """``(t, 2)`` first rates, raised where infeasible, and the least second rates for them."""
    a, b, c = forms[:, 0], forms[:, 1], forms[:, 2]
    first = np.clip(np.maximum(first, np.floor(np.sqrt(a.max(axis=0))) + 1), 1, MOST)
    left, linear = 1 - a / first**2, b / first
    # Solves c y^2 + 2 linear y = left for y = 1 / second.
    second = ((linear + np.sqrt(linear**2 + c * left)) / left).max(axis=0)
    return np.stack([first, rounded_up(second)], axis=1)


def rounded_up(values: FloatArray) -> IntArray:
    """Round up to integers of at least 1, ignoring rounding errors above an integer."""
    return np.clip(np.ceil(values - RATE_ROUNDING), 1, MOST).astype(np.int64)


def dot(a: FloatArray, b: FloatArray) -> FloatArray:
    """``(.., t)`` dot products of vectors ``(.., 3, t)``."""
    products: FloatArray = a[..., 0, :] * b[..., 0, :]
    products += a[..., 1, :] * b[..., 1, :]
    products += a[..., 2, :] * b[..., 2, :]
    return products


def unit(vectors: FloatArray) -> FloatArray:
    """``(.., 3, t)`` vectors divided by their lengths; zero vectors stay zero."""
    length = np.sqrt(dot(vectors, vectors))
    return vectors / np.where(length > 0, length, 1)[..., None, :]


class Cone(NamedTuple):
    """Cones of directions that contain all derivatives by one parameter, or all normals, of parts of patches."""

    axis: FloatArray  # (.., 3, t) float: unit vectors; zero where undefined
    sine: FloatArray  # (.., t) float: sine of the cone's half angle; 1 where there may be any direction


def tangent_cone(derivative: FloatArray) -> tuple[Cone, FloatArray]:
    """Cones of derivatives with Bernstein coefficients ``(b, .., 3, t)``, and the least components along their axes."""
    axis = unit(derivative.sum(axis=0))
    along, squared = dot(derivative, axis), dot(derivative, derivative)
    cosine = (along / np.sqrt(np.where(squared > 0, squared, 1))).min(axis=0)
    return Cone(axis, np.where(cosine > 0, np.sqrt(np.maximum(0, 1 - cosine**2)), 1)), along.min(axis=0)


def normal_cone(u: Cone, v: Cone) -> Cone:
    """Cones of normals from cones of tangents along u and v [Sederberg and Meyers 1988]."""
    normal = np.cross(u.axis, v.axis, axis=-2)
    sine, cosine = np.sqrt(dot(normal, normal)), np.abs(dot(u.axis, v.axis))
    safe = np.maximum(sine, PARALLEL)
    normal_sine = np.sqrt(u.sine**2 + 2 * u.sine * v.sine * cosine + v.sine**2) / safe
    exists = (sine > PARALLEL) & (u.sine < 1) & (v.sine < 1) & (normal_sine < 1)
    return Cone(np.where(sine > PARALLEL, 1 / safe, 0)[..., None, :] * normal, np.where(exists, normal_sine, 1))


def cone_around(cone: Cone, axis: FloatArray) -> Cone:
    """Cones about other axes ``(3, t)`` that contain cones."""
    angle = np.arccos(np.clip(dot(cone.axis, axis), -1, 1)) + np.arcsin(np.clip(cone.sine, 0, 1))
    return Cone(axis, np.where((cone.sine < 1) & (angle < np.pi / 2), np.sin(angle), 1))
