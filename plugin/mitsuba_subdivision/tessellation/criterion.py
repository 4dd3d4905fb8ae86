"""Error criteria of adaptive tessellations: distance of triangles from the surface, or length of their edges.

Cones of directions contain all tangents, or all normals, of parts of patches.
"""

from __future__ import annotations

import sys
from collections.abc import Callable
from dataclasses import dataclass
from enum import Enum, auto
from math import sqrt

import numpy as np
from numpy.typing import NDArray

from ..mesh.connectivity import IntArray
from ..schemes.domain import FloatArray

# Within boxes of parameters, triangles are no further from a surface than an eighth of its second differences along the
# box: they lie in the circle around the box, whose squared radius is a quarter of that of its diagonal [Waldron 1998].
SQUARE_ERROR = 1 / 8
# The same on triangular grids, in sides of their triangles: half the squared radius of the smallest circle around any
# triangle of a strip between two rates. The largest is at a corner where segments of both sides are half as long.
TRIANGLE_ERROR = 0.227
# Factor of the error of triangles that an outline's sensor cannot see edge-on. It shows where surfaces intersect, and
# in shadows: at 64 tenths of a pixel, a teapot's handle ended elsewhere.
COARSE = 8.0
# Normals this nearly perpendicular to the view are beside a silhouette: coarse triangles there might stick out beyond
# it.
BESIDE_OUTLINE = np.radians(4)

# In place of zero, where it would divide. Not NumPy's finfo: where Dr.Jit computes without subnormals, NumPy before 2.3
# warns of it.
TINY = sys.float_info.min
# Excess over an integer that counts as rounding error and does not round a rate up.
RATE_ROUNDING = 1e-9
# Offsets of the integers to try from the one below the best real number.
TRIED = (-1, 0, 1)
# Above any number of segments.
MOST = 1 << 20


class Measure(Enum):
    """The limited quantity: the distance between triangles and surface, or the length of edges."""

    CHORD = auto()
    EDGE = auto()


@dataclass(frozen=True, eq=False)
class Sensor:
    """Viewpoint and pixel size of a sensor."""

    eye: FloatArray  # (3,) float64: in the space of the control points
    # Size of a pixel at a distance of one, the least over the picture; or everywhere, if the sensor is orthographic
    pixel: float
    direction: FloatArray | None = None  # (3,) float64 or None: of view, if the sensor is orthographic

    def pixel_size(self, lower: FloatArray, upper: FloatArray) -> FloatArray:
        """``(.., t)`` least size of a pixel anywhere in boxes ``(.., 3, t)``."""
        if self.direction is not None:
            return np.full(lower[..., 0, :].shape, self.pixel)
        eye = self.eye[:, None]
        return self.pixel * np.linalg.norm(np.maximum(0, np.maximum(lower - eye, eye - upper)), axis=-2)

    def may_see_outline(self, lower: FloatArray, upper: FloatArray, cone: NormalCone) -> NDArray[np.bool_]:
        """``(.., t)`` whether a normal in a cone may be nearly perpendicular to the view of a point in a box."""
        if self.direction is not None:
            view, spread = self.direction[:, None], np.zeros(lower[..., 0, :].shape)
        else:
            view = (lower + upper) / 2 - self.eye[:, None]
            distance, radius = np.linalg.norm(view, axis=-2), np.linalg.norm(upper - lower, axis=-2) / 2
            with np.errstate(divide="ignore", invalid="ignore"):
                view, spread = (
                    view / distance[..., None, :],
                    np.where(radius < distance, np.arcsin(radius / distance), np.pi),
                )
        tilt = np.arcsin(np.clip(np.abs(dot(cone.axis, view)), 0, 1))
        return ~(tilt > np.arcsin(np.clip(cone.sine, 0, 1)) + spread + BESIDE_OUTLINE) | (cone.sine >= 1)


@dataclass(frozen=True, eq=False)
class DisplacementBound:
    """Heights of a displacement, and their bound."""

    # Finds heights ``(s,)`` of samples, given as for `PatchSampler.evaluate`
    heights: Callable[[IntArray, FloatArray], FloatArray]
    extent: float  # Largest distance that any point moves; of a texture that is no bitmap, that any sample does


@dataclass(frozen=True, eq=False)
class Criterion:
    """An error limit for all triangles of a tessellation. Raises ValueError if the error is negative or no number.

    Attributes
    ----------
    error : float
        The limit; in pixels, if there is a ``sensor``.
    sensor : Sensor or None
        Whose pixels the error is counted in.
    outline : Sensor or None
        Triangles that this sensor cannot see edge-on, and so cannot be at a silhouette, may be coarse.
    displacement : DisplacementBound or None
        Displacement of the surface. The limit is checked at samples of it.
    """

    measure: Measure
    error: float
    sensor: Sensor | None = None
    outline: Sensor | None = None
    displacement: DisplacementBound | None = None

    def __post_init__(self) -> None:
        if not self.error >= 0:
            raise ValueError(f"an error of {self.error}; expected a number from 0 on")

    def limit(self, lower: FloatArray, upper: FloatArray, cone: NormalCone) -> FloatArray:
        """``(.., t)`` the limit in parts of the surface in boxes ``(.., 3, t)``, with normals in cones."""
        found = np.full(cone.sine.shape, float(self.error))
        if self.sensor is not None:
            extent = 0.0 if self.displacement is None else self.displacement.extent
            found *= self.sensor.pixel_size(lower - extent, upper + extent)
        if self.outline is not None:
            found[~self.outline.may_see_outline(lower, upper, cone)] *= COARSE
        return found

    def form(
        self,
        derivatives: list[FloatArray],
        tangents: tuple[TangentCone, TangentCone],
        cone: NormalCone,
        corner_count: int,
    ) -> FloatArray:
        """The limited quantity as a function of the segments along u and v.

        Parameters
        ----------
        derivatives : five (b, .., 3, t) float
            Bernstein coefficients of the derivatives by u, v, uu, uv and vv; of some parts of patches.
        tangents : two TangentCone
            Along u and v.
        corner_count : int
            Of the domain.

        Returns
        -------
        (3, .., t) float
            A, B and C: over squares, ``A / n_u^2 + 2 B / (n_u n_v) + C / n_v^2`` is to be no more than the limit or, if
            edges are measured, its square. Over triangles the rate is one, ``A / n^2``, and the others are zero.
        """
        du, dv, uu, uv, vv = derivatives
        if self.measure is Measure.EDGE:
            if corner_count == 3:
                # Those of strips lead across two triangles of the lattice at most.
                return _isotropic(4 * np.max([dot(d, d).max(axis=0) for d in (du, dv, du - dv)], axis=0))
            a, c = (np.sqrt(dot(d, d).max(axis=0)) for d in (du, dv))
            return np.stack([a**2, np.minimum(a * c, _most_dot(du, dv)), c**2])
        second = [uu, uv, vv]
        if corner_count == 3:
            # Along an angle: the mean, plus a cosine and a sine of twice the angle.
            mean = (uu - uv + vv) * (2 / 3)
            second = [mean, uu - mean, (uv - uu / 2) * (2 / sqrt(3))]
        # Distance from the surface: along its normals, and a little more where the difference has a tangential part, as
        # the surface has curved away there; at most the whole difference.
        longest = [dot(d, d).max(axis=0) for d in second]
        # Where the surface degenerates to a curve, neither the normal part nor the tangential excess is known; rounding
        # may leave a tangent that nearly vanishes, and an excess beyond single precision.
        with np.errstate(divide="ignore", over="ignore", invalid="ignore"):
            slip = 1 + _slip(tangents, np.max(longest, axis=0))
            sizes = [
                np.fmin(slip * cone.along(d, most), np.sqrt(most)) for d, most in zip(second, longest, strict=True)
            ]
        if corner_count == 3:
            return _isotropic(TRIANGLE_ERROR * (sizes[0] + np.hypot(sizes[1], sizes[2])))
        return SQUARE_ERROR * np.stack(sizes)

    def bound(self, limit: FloatArray) -> FloatArray:
        """Upper limit of `form`."""
        return limit**2 if self.measure is Measure.EDGE else limit

    def form_of_displacement(self, heights: FloatArray) -> FloatArray:
        """``(3, t)`` contribution of a displacement to `form`, from its heights ``(n, n, t)`` over tiles, by v and u.

        On triangles, samples above the diagonal count as well, because the displacement continues there.
        """
        if self.measure is Measure.EDGE:
            along_u, along_v = (
                (len(heights) - 1) * np.diff(heights, axis=1),
                (len(heights) - 1) * np.diff(heights, axis=0),
            )
            a, c = (np.square(along).max(axis=(0, 1)) for along in (along_u, along_v))
            return np.stack([a, np.sqrt(a * c), c])
        second = [np.diff(heights, 2, axis=1), np.diff(np.diff(heights, axis=0), axis=1), np.diff(heights, 2, axis=0)]
        return SQUARE_ERROR * (len(heights) - 1) ** 2 * np.stack([np.abs(each).max(axis=(0, 1)) for each in second])

    def segments(self, second: FloatArray, limit: FloatArray) -> IntArray:
        """``(t,)`` segments that keep curves to a limit, by their second derivatives ``(b, 3, t)``."""
        furthest = SQUARE_ERROR * np.sqrt(dot(second, second).max(axis=0))
        return rounded_up(np.sqrt(furthest / np.maximum(limit, TINY)))


def _isotropic(values: FloatArray) -> FloatArray:
    return np.stack([values, np.zeros_like(values), np.zeros_like(values)])


def _most_dot(du: FloatArray, dv: FloatArray) -> FloatArray:
    """``(.., t)`` largest dot product of a vector of one hull and one of another."""
    return np.abs(dot(du[:, None], dv[None])).max(axis=(0, 1))


def _slip(
    tangents: tuple[TangentCone, TangentCone],
    longest: FloatArray,  # (.., t) float: largest squared second derivative
) -> FloatArray:
    """``(.., t)`` relative excess of the distance over its part along the normal, at one segment."""
    shortest = np.minimum(tangents[0].shortest, tangents[1].shortest)
    return np.where(shortest > 0, longest / shortest**2 / 8, np.inf)


def least_product(
    # (f, 3, t) float64: A, B and C, not negative; `f` of them, each of which is to be no more than one
    forms: FloatArray,
) -> IntArray:
    """Integers whose product is least, of those with ``A / n_u^2 + 2 B / (n_u n_v) + C / n_v^2`` no more than one.

    Returns (t, 2) int64.
    """
    forms = np.minimum(forms, MOST)
    a, b, c = np.maximum(forms.max(axis=0), TINY)
    # Of real numbers those with the least product have A / n_u^2 = C / n_v^2.
    rate = np.sqrt(2 + 2 * b / (np.sqrt(a) * np.sqrt(c)))
    tried = []
    for away in TRIED:
        tried.append(_with_other(forms, np.floor(rate * np.sqrt(a)) + away))
        tried.append(_with_other(forms[:, ::-1], np.floor(rate * np.sqrt(c)) + away)[:, ::-1])
    found = np.stack(tried)
    best = np.argmin(found.prod(axis=2) + 1e-3 * found.sum(axis=2), axis=0)
    return found[best, np.arange(len(best))].astype(np.int64)


def _with_other(forms: FloatArray, first: FloatArray) -> FloatArray:
    """``(t, 2)`` the given first rates, raised where infeasible, and the least second rates for them."""
    a, b, c = forms[:, 0], forms[:, 1], forms[:, 2]
    first = np.clip(np.maximum(first, np.floor(np.sqrt(a.max(axis=0))) + 1), 1, MOST)
    left, linear = 1 - a / first**2, b / first
    # Of c y^2 + 2 linear y = left, for y = 1 / second.
    second = ((linear + np.sqrt(linear**2 + c * left)) / left).max(axis=0)
    return np.stack([first, rounded_up(second)], axis=1)


def rounded_up(values: FloatArray) -> IntArray:
    """Round up to integers of at least 1, ignoring rounding errors above an integer."""
    return np.clip(np.ceil(values - RATE_ROUNDING), 1, MOST).astype(np.int64)


# Directions whose sine is below this are parallel.
PARALLEL = 1e-9


def dot(a: FloatArray, b: FloatArray) -> FloatArray:
    """``(.., t)`` products of vectors ``(.., 3, t)``."""
    found: FloatArray = a[..., 0, :] * b[..., 0, :]
    found += a[..., 1, :] * b[..., 1, :]
    found += a[..., 2, :] * b[..., 2, :]
    return found


def cross(a: FloatArray, b: FloatArray) -> FloatArray:
    """``(.., 3, t)`` cross products of vectors ``(.., 3, t)``."""
    found = np.empty(np.broadcast_shapes(a.shape, b.shape), dtype=np.result_type(a, b))
    for axis in range(3):
        i, j = (axis + 1) % 3, (axis + 2) % 3
        np.subtract(a[..., i, :] * b[..., j, :], a[..., j, :] * b[..., i, :], out=found[..., axis, :])
    return found


@dataclass(frozen=True, eq=False)
class TangentCone:
    """Directions that contain all derivatives by a parameter of some patches, or of each part of these."""

    axis: FloatArray  # (.., 3, t) float: unit vectors; zero where there is none
    sine: FloatArray  # (.., t) float: of half the angle of the cone; one where derivatives may have any direction
    shortest: FloatArray  # (.., t) float: least extent of a derivative along the axis

    @classmethod
    def of(cls, derivative: FloatArray) -> TangentCone:
        """Cones of Bernstein coefficients ``(b, .., 3, t)``."""
        total = derivative.sum(axis=0)
        length = np.sqrt(dot(total, total))
        axis = total / np.where(length > 0, length, 1)[..., None, :]
        along, squared = dot(derivative, axis), dot(derivative, derivative)
        cosine = (along / np.sqrt(np.where(squared > 0, squared, 1))).min(axis=0)
        sine = np.where(cosine > 0, np.sqrt(np.maximum(0, 1 - cosine**2)), 1)
        return cls(axis, sine, along.min(axis=0))


@dataclass(frozen=True, eq=False)
class NormalCone:
    """Directions that contain all normals of some patches, or of each part of these."""

    axis: FloatArray  # (.., 3, t) float: unit vectors; zero where there is none
    sine: FloatArray  # (.., t) float: of half the angle of the cone; one where normals may have any direction

    @classmethod
    def of(cls, u: TangentCone, v: TangentCone) -> NormalCone:
        """Cones of the normals to tangents along u and v [Sederberg and Meyers 1988]."""
        normal = cross(u.axis, v.axis)
        sine, cosine = np.sqrt(dot(normal, normal)), np.abs(dot(u.axis, v.axis))
        safe = np.maximum(sine, PARALLEL)
        of_both = np.sqrt(u.sine**2 + 2 * u.sine * v.sine * cosine + v.sine**2) / safe
        exists = (sine > PARALLEL) & (u.sine < 1) & (v.sine < 1) & (of_both < 1)
        return cls(np.where(sine > PARALLEL, 1 / safe, 0)[..., None, :] * normal, np.where(exists, of_both, 1))

    @classmethod
    def of_any(cls, count: int) -> NormalCone:
        """Cones of ``count`` patches with unknown normals."""
        return cls(np.zeros((3, count)), np.ones(count))

    def around(self, axis: FloatArray) -> NormalCone:
        """Cones about other axes ``(3, t)`` that contain these."""
        angle = np.arccos(np.clip(dot(self.axis, axis), -1, 1)) + np.arcsin(np.clip(self.sine, 0, 1))
        return NormalCone(axis, np.where((self.sine < 1) & (angle < np.pi / 2), np.sin(angle), 1))

    def along(self, vectors: FloatArray, longest: FloatArray) -> FloatArray:
        """``(.., t)`` largest extent of vectors ``(b, .., 3, t)`` along a normal, with their largest squared length."""
        return np.abs(dot(vectors, self.axis)).max(axis=0) + self.sine * np.sqrt(longest)
