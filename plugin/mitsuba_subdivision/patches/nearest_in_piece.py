"""The point of a polynomial piece that is nearest to a given point: Newton's method within the piece's domain.

Boxes that are turned to lie along the pieces tell which may have it, and whether the distance has one minimum there.
"""

from __future__ import annotations

import sys
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..evaluation.polynomials import BernsteinBasis, times
from ..mesh.connectivity import IntArray
from ..schemes.domain import FloatArray
from .polynomial_pieces import PartArrays, PolynomialPieces

# Most steps; five to seven are usual, more where a point is about as far away as the surface's centre of curvature.
STEPS = 60
# After a step this short, in parameters of a piece, the next would be lost in rounding.
STEP_TOLERANCE = 1e-11
# A step of Newton's this short is the last as well: the rest is about its square.
LAST_NEWTON_STEP = 1e-7
# No further from an edge of the domain than this is on the edge: rounding of a sum of parameters.
ON_EDGE = 4e-16
# Where the determinant of a Hessian is below this part of that of the tangents, the distance is nearly a saddle, and
# the tangents alone are used, as by Gauss and Newton.
CONVEX = 1e-6
# Regularization where tangents are parallel, relative to their squared lengths.
PARALLEL = 1e-12
# And where they vanish.
VANISHING = 1e-100
# A step that leads further away is shortened to this part.
SHORTER = 0.25
# Points are processed in runs of this many, whose arrays stay in a processor's cache.
CHUNK = 4096
# Rounding error of a distance, relative to the size of the coordinates: some units of double precision.
ROUNDED = 2.0**-50


def nearest_in_pieces(
    pieces: PolynomialPieces,
    which: IntArray,  # (s,) int64: the piece for each point
    points: FloatArray,  # (s, 3) float64
    uv: FloatArray,  # (s, 2) float64: parameters to begin with, in the domain of the piece
    size: float,  # Of the coordinates, for the rounding error
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Find a local minimum of the distance to a point in each piece.

    Returns parameters in the piece, (s, 2) float64; the squared distances; and how fast the distance still falls along
    the tangents, beyond the piece's edges too; see `slopes`.
    """
    runs = np.split(np.arange(len(points)), range(CHUNK, len(points), CHUNK))
    parts = [_nearest(_Descent.begun(pieces, which[at], points[at], uv[at], size)) for at in runs]
    uv, squared_distance, slope = map(np.concatenate, zip(*parts, strict=True))
    return uv, squared_distance, slope


def _nearest(found: _Descent) -> tuple[FloatArray, FloatArray, FloatArray]:
    """`nearest_in_pieces` of some points."""
    descent, left = found, np.arange(len(found.uv))
    for _ in range(STEPS):
        ends = descent.step()
        if ends.any():
            found.put(left[ends], descent.chosen(ends))
            descent, left = descent.chosen(~ends), left[~ends]
        if not len(left):
            break
    else:
        found.put(left, descent)
    return found.uv, found.squared_distance, slopes(found.tangents, found.difference)


@dataclass(eq=False)
class _Descent:
    """The descent of some points to the least distance."""

    pieces: PolynomialPieces
    which: IntArray  # (s,) int64
    points: FloatArray  # (s, 3) float64
    uv: FloatArray  # (s, 2) float64
    part: FloatArray  # (s,) float64: of Newton's step that is taken
    difference: FloatArray  # (s, 3) float64: from the point to the surface
    tangents: FloatArray  # (s, 2, 3) float64
    second: FloatArray  # (s, 3) float64: the difference's parts along the second derivatives by uu, uv and vv
    size: float

    @classmethod
    def begun(
        cls, pieces: PolynomialPieces, which: IntArray, points: FloatArray, uv: FloatArray, size: float
    ) -> _Descent:
        values = _values(pieces, which, points, uv)
        return cls(pieces, which.copy(), points.copy(), uv.copy(), np.ones(len(points)), *values, size)

    @property
    def _arrays(self) -> tuple[NDArray, ...]:
        return self.which, self.points, self.uv, self.part, self.difference, self.tangents, self.second

    def chosen(self, mask: NDArray[np.bool_]) -> _Descent:
        which, points, uv, part, difference, tangents, second = (each[mask] for each in self._arrays)
        return _Descent(self.pieces, which, points, uv, part, difference, tangents, second, self.size)

    def put(self, at: NDArray, other: _Descent) -> None:
        """Copy another's state for some of the points."""
        for own, new in zip(self._arrays, other._arrays, strict=True):
            own[at] = new

    @property
    def squared_distance(self) -> FloatArray:
        return np.einsum("sx,sx->s", self.difference, self.difference)

    def step(self) -> NDArray[np.bool_]:
        """Take a step, or a shorter one the next time; return which have converged."""
        step, is_newton = self._direction()
        step *= self.part[:, None]
        uv = self.uv + step
        difference, tangents, second = _values(self.pieces, self.which, self.points, uv)
        before, after = self.squared_distance, np.einsum("sx,sx->s", difference, difference)
        rounded = ROUNDED * self.size
        improves = after <= before + rounded * (np.sqrt(before) + rounded)
        if improves.all():
            self.uv, self.difference, self.tangents, self.second = uv, difference, tangents, second
            self.part[:] = 1
        else:
            for own, new in zip(
                (self.uv, self.difference, self.tangents, self.second), (uv, difference, tangents, second), strict=True
            ):
                own[improves] = new[improves]
            self.part = np.where(improves, 1, self.part * SHORTER)
        length = np.abs(step).max(axis=1, initial=0)
        return (length < STEP_TOLERANCE) | (is_newton & improves & (length < LAST_NEWTON_STEP))

    def _direction(self) -> tuple[FloatArray, NDArray[np.bool_]]:
        """Newton's step, along the edges of the domain where it would leave it, and no further than to the next.

        Returns the step, (s, 2) float64, and whether it is the full step of Newton's method.
        """
        domain = self.pieces.basis.domain
        normals = domain.edge_normals
        gradient = np.einsum("sdx,sx->sd", self.tangents, self.difference)
        metric = self.tangents @ self.tangents.swapaxes(1, 2)
        a, b, c = metric[:, 0, 0], metric[:, 0, 1], metric[:, 1, 1]
        uu, uv, vv = self.second.T
        hessian = np.stack([a + uu, b + uv, c + vv], axis=1)
        is_newton = (hessian[:, 0] > 0) & (hessian[:, 0] * hessian[:, 2] - hessian[:, 1] ** 2 > CONVEX * a * c)
        damped = PARALLEL * (a + c) + VANISHING
        matrix = np.where(is_newton[:, None], hessian, np.stack([a + damped, b, c + damped], axis=1))
        h, i, j = matrix.T
        step = np.stack([i * gradient[:, 1] - j * gradient[:, 0], i * gradient[:, 0] - h * gradient[:, 1]], axis=1)
        step /= (h * j - i * i)[:, None]

        inside = np.stack(domain.edge_distances(*self.uv.T), axis=1)
        on_edge = inside <= ON_EDGE
        held = on_edge & (gradient @ normals.T > 0)
        count = held.sum(axis=1)
        # Also where the step leads out although the distance falls inwards.
        leaves = on_edge & (step @ normals.T < 0)
        slides = np.flatnonzero((count == 1) | ((count == 0) & leaves.any(axis=1)))
        if len(slides):
            edge = np.argmax(np.where(count[slides, None] == 1, held[slides], leaves[slides]), axis=1)
            along = normals[edge] @ np.array([[0.0, 1.0], [-1.0, 0.0]])
            square, product = along**2, along[:, 0] * along[:, 1]
            bend, flat = (
                square[:, 0] * each[0] + 2 * product * each[1] + square[:, 1] * each[2]
                for each in (hessian[slides].T, (a[slides], b[slides], c[slides]))
            )
            is_newton[slides] = bend > CONVEX * flat
            bend = np.where(is_newton[slides], bend, flat + damped[slides])
            step[slides] = along * (-np.einsum("sd,sd->s", along, gradient[slides]) / bend)[:, None]
        step[count > 1] = 0
        out = -(step @ normals.T)
        with np.errstate(divide="ignore", invalid="ignore"):
            part = np.where(out > 0, np.maximum(inside, 0) / out, np.inf).min(axis=1)
        return step * np.minimum(part, 1)[:, None], is_newton & (part >= 1)


def _values(
    pieces: PolynomialPieces, which: IntArray, points: FloatArray, uv: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Differences, tangents, and the differences' parts along second derivatives; see `_Descent`."""
    powers, degree = pieces.basis.indices, pieces.basis.degree
    # Powers of both parameters, and their derivatives.
    value = np.ones((2, len(uv), degree + 1))
    for k in range(1, degree + 1):
        np.multiply(value[:, :, k - 1], uv.T, out=value[:, :, k])
    factor = np.arange(degree + 1, dtype=np.float64)
    first, second = np.zeros_like(value), np.zeros_like(value)
    np.multiply(value[:, :, :-1], factor[1:], out=first[:, :, 1:])
    np.multiply(value[:, :, :-2], (factor * (factor - 1))[2:], out=second[:, :, 2:])
    (u, v), (du, dv), (duu, dvv) = (
        (each[0][:, powers[:, 0]], each[1][:, powers[:, 1]]) for each in (value, first, second)
    )
    rows = np.empty((len(uv), 6, len(powers)))
    for number, (along_u, along_v) in enumerate(((u, v), (du, v), (u, dv), (duu, v), (du, dv), (u, dvv))):
        np.multiply(along_u, along_v, out=rows[:, number])
    found = rows @ pieces.monomials[which]
    difference = found[:, 0] + (pieces.origins[which] - points)
    return difference, found[:, 1:3], np.einsum("sdx,sx->sd", found[:, 3:], difference)


def slopes(tangents: FloatArray, difference: FloatArray) -> FloatArray:
    """How fast the distance falls along a surface, of tangents ``(s, 2, 3)`` and differences from points ``(s, 3)``.

    The larger of the difference's parts along the two tangents: zero but for rounding where it is along the normal.
    """
    along = np.abs(np.einsum("sdx,sx->sd", tangents, difference))
    lengths = np.sqrt(np.einsum("sdx,sdx->sd", tangents, tangents))
    return (along / np.maximum(lengths, sys.float_info.min)).max(axis=1)


# Rounding error of a frame of unit vectors at right angles.
SQUARE = 1e-12
# Boxes are made, and points are tested, in runs of this many, whose arrays stay in a processor's cache.
RUN = 1024
# Shorter tangents count as of this length. Its square can still be divided by.
SHORTEST = 1e-100


@dataclass(frozen=True, eq=False)
class TurnedBoxes(PartArrays):
    """Boxes around pieces, turned to lie along them."""

    basis: BernsteinBasis  # Of the pieces
    frames: FloatArray  # (n, 3, 3) float64: unit vectors along the sides, the last one across the piece
    # (n, 3) float64: of the boxes, along these; distances of their sides from the middle
    middles: FloatArray
    halves: FloatArray
    points: FloatArray  # (n, 3) float64: of the pieces, at the middle of their domains
    back: FloatArray  # (n, 2, 3) float64: makes parameters of a displacement along the tangents there
    # (n, 3) float64: norms of the second derivatives along each side, at most; across the piece, of what they differ
    # from those in the middle. By parameters by which the tangents in the middle are unit vectors at right angles, as
    # all that follows.
    bends: FloatArray
    # (n, 2) float64: the least and the largest eigenvalue of the second derivatives across the piece in the middle
    curvatures: FloatArray
    stretch: FloatArray  # (n,) float64: A lower bound of the squared length of unit displacements anywhere in the piece

    @classmethod
    def around(cls, pieces: PolynomialPieces) -> TurnedBoxes:
        """Boxes around pieces."""
        # Where tangents vanish, bends are infinite, and nothing is known to be convex.
        with np.errstate(over="ignore", invalid="ignore"):
            return cls.joined(
                [cls._around(pieces.basis, columns, pieces.origins[at]) for at, columns in pieces.runs(RUN)]
            )

    @classmethod
    def _around(cls, basis: BernsteinBasis, coefficients: FloatArray, origins: FloatArray) -> TurnedBoxes:
        """Boxes around a run of pieces, which arrays have along their last axis until the end."""
        of_u, of_v = basis.derivatives
        middle = basis.values(basis.domain.centre[None])[0]
        points, du, dv = times(np.stack([middle, middle @ of_u, middle @ of_v]), coefficients)
        frames = _frames(du.T, dv.T)
        axes = np.ascontiguousarray(frames.transpose(1, 2, 0))
        along = axes[:, 0] * coefficients[:, None, 0]
        for x in (1, 2):
            along += axes[:, x] * coefficients[:, None, x]
        low, high = along.min(axis=0), along.max(axis=0)
        # The least squares of a displacement along the tangents.
        a, b, c = (np.einsum("xn,xn->n", *pair) for pair in ((du, du), (du, dv), (dv, dv)))
        determinant = np.maximum(a * c - b * b, SHORTEST)
        back = np.stack([c * du - b * dv, a * dv - b * du]) / determinant
        # Parameters by which the tangents in the middle are unit vectors at right angles: derivatives by them.
        first = 1 / np.maximum(np.sqrt(a), SHORTEST)
        second = 1 / np.maximum(np.sqrt(determinant) * first, SHORTEST)
        shear = -b * first**2
        u, v, uu, uv, vv = times(np.concatenate(basis.two_derivatives), along).reshape(5, *along.shape)
        tangents = first * u, second * (shear * u + v)
        sheared = shear * uu + uv
        bends = (
            first * (first * uu),
            second * (first * sheared),
            second * (second * (shear * sheared + shear * uv + vv)),
        )
        across = [middle @ each[:, 2] for each in bends]
        mean, radius = (across[0] + across[2]) / 2, np.hypot((across[0] - across[2]) / 2, across[1])
        square = np.zeros_like(low)
        for weight, each, own in zip((1, 2, 1), bends, across, strict=True):
            each[:, 2] -= own
            square += weight * np.abs(each).max(axis=0) ** 2
        # Bound of the change of the tangents.
        change = np.zeros_like(mean)
        for tangent in tangents:
            off = tangent - times(middle[None], tangent)
            change += np.einsum("bxn,bxn->bn", off, off).max(axis=0)
        return cls(
            basis,
            frames,
            ((low + high) / 2).T + (frames @ origins[:, :, None])[:, :, 0],
            (high - low).T / 2,
            points.T + origins,
            back.transpose(2, 0, 1),
            np.sqrt(square).T,
            np.stack([mean - radius, mean + radius], axis=1),
            np.maximum(1 - np.sqrt(change), 0) ** 2,
        )

    def near(
        self,
        points: FloatArray,  # (s, 3) float64
        which: IntArray,  # (s,) int64: the box for each
        squared_reach: FloatArray,  # (s,) float64
    ) -> tuple[IntArray, FloatArray, FloatArray]:
        """Which points are no further from their box than a distance of their own.

        Returns numbers of these points, (n,) int64; their squared distances; and the way from them to the middles of
        their boxes, along the sides of these, (n, 3) float64.
        """
        found = [(np.empty(0, dtype=np.int64), np.empty(0), np.empty((0, 3)))]
        for begin in range(0, len(which), RUN):
            at = slice(begin, begin + RUN)
            own = which[at]
            away = (self.frames.take(own, axis=0) @ points[at, :, None])[:, :, 0]
            np.subtract(self.middles.take(own, axis=0), away, out=away)
            gap = np.maximum(np.abs(away) - self.halves.take(own, axis=0), 0)
            squared_distance = np.einsum("sx,sx->s", gap, gap)
            near = np.flatnonzero(squared_distance <= squared_reach[at])
            found.append((near + begin, squared_distance[near], away[near]))
        near, squared_distance, away = map(np.concatenate, zip(*found, strict=True))
        return near, squared_distance, away

    def are_convex(
        self,
        away: FloatArray,  # (n, 3) float64: as `near` gives it
        which: IntArray,  # (n,) int64
    ) -> NDArray[np.bool_]:
        """``(n,)`` whether squared distances from points have one minimum in each piece.

        They have where they are convex functions of the piece's parameters: half the second derivatives are those of
        the surface times the difference, plus products of tangents.
        """
        halves = self.halves[which]
        across, half, curvatures = away[:, 2:], halves[:, 2:], self.curvatures[which]
        # Infinite where tangents vanish.
        with np.errstate(invalid="ignore"):
            least = np.minimum((across - half) * curvatures, (across + half) * curvatures).min(axis=1)
            others = np.einsum("sx,sx->s", np.abs(away) + halves, self.bends[which])
            return others - least < self.stretch[which]

    def starts(self, points: FloatArray, which: IntArray) -> FloatArray:
        """``(s, 2)`` parameters of pieces near given points, as if the pieces were flat; in the domain."""
        away = (self.back[which] @ (points - self.points[which])[:, :, None])[:, :, 0]
        return self.basis.domain.clamped(self.basis.domain.centre + away)


def _frames(du: FloatArray, dv: FloatArray) -> FloatArray:
    """Unit vectors ``(n, 3, 3)`` along and across tangents; along the axes where these are parallel."""
    with np.errstate(divide="ignore", invalid="ignore"):
        normal = np.cross(du, dv)
        normal /= np.linalg.norm(normal, axis=1, keepdims=True)
        first = du / np.linalg.norm(du, axis=1, keepdims=True)
        frames = np.stack([first, np.cross(normal, first), normal], axis=1)
        error = np.abs(frames @ frames.swapaxes(1, 2) - np.eye(3)).max(axis=(1, 2))
    # Written so that what is not a number is replaced, too.
    frames[~(error < SQUARE)] = np.eye(3)
    return frames
