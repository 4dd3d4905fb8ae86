"""The point of a polynomial piece that is nearest to a given point, by Newton's method within the piece's domain.

Oriented boxes around the pieces tell which pieces may hold it, and whether the distance has one minimum in a piece.
"""

from __future__ import annotations

import sys
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..evaluation.equations import times_matrix
from ..evaluation.polynomials import BernsteinBasis, times
from ..mesh.connectivity import IntArray
from ..schemes.domain import FloatArray, ParameterDomain
from .polynomial_pieces import PartArrays, PolynomialPieces

# Most steps. Five to seven are usual, more where a point is about as far away as the surface's centre of curvature.
STEPS = 60
# Length of a step, in parameters of a piece, after which the next would be lost in rounding.
STEP_TOLERANCE = 1e-11
# Length of a Newton step after which the remaining error, about its square, needs no further step.
LAST_NEWTON_STEP = 1e-7
# Distance from an edge of the domain, in parameters, up to which a point is on the edge: rounding of a sum.
ON_EDGE = 4e-16
# Least determinant of the Hessian, relative to that of the first fundamental form, for a Newton step. Below, the
# distance is nearly a saddle, and a Gauss-Newton step is taken.
CONVEX = 1e-6
# Regularization where tangents are parallel, relative to their squared lengths.
PARALLEL = 1e-12
# Regularization where tangents vanish, absolute.
VANISHING = 1e-100
# Factor by which a step that increases the distance is shortened.
SHORTER = 0.25
# Points, and boxes, per run, whose arrays stay in a processor's cache.
CHUNK, RUN = 4096, 1024
# Rounding error of a distance, relative to the size of the coordinates: some units of double precision.
ROUNDED = 2.0**-50
# Tolerance of the products of an orthonormal frame's vectors.
SQUARE = 1e-12
# Least length of a tangent, to which shorter ones are clamped so that divisions by its square do not overflow.
SHORTEST = 1e-100


def nearest_in_pieces(
    pieces: PolynomialPieces,
    which: IntArray,  # (s,) int64: index of the piece for each point
    points: FloatArray,  # (s, 3) float64
    uv: FloatArray,  # (s, 2) float64: initial parameters, in the domain of the piece
    size: float,  # Largest absolute coordinate, for the rounding error
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Find a local minimum of the distance from each point to its piece.

    Returns ``(s, 2)`` parameters, squared distances, and `slopes`, not zero where a minimum lies on a piece's edge.
    """
    runs = np.split(np.arange(len(points)), range(CHUNK, len(points), CHUNK))
    minima = [_nearest(pieces, which[run], points[run], uv[run], size) for run in runs]
    uv, squared_distance, slope = map(np.concatenate, zip(*minima, strict=True))
    return uv, squared_distance, slope


def _nearest(
    pieces: PolynomialPieces, which: IntArray, points: FloatArray, uv: FloatArray, size: float
) -> tuple[FloatArray, FloatArray, FloatArray]:
    uv, jet, rounded = uv.copy(), _jet(pieces, which, points, uv), ROUNDED * size
    # Fraction of the next step that is taken; and points that have not converged.
    part, left = np.ones(len(uv)), np.arange(len(uv))
    for _ in range(STEPS):
        step, is_newton = _step(pieces.basis.domain, uv[left], jet[left])
        step *= part[left, None]
        new_uv = uv[left] + step
        new_jet = _jet(pieces, which[left], points[left], new_uv)
        before, after = (np.einsum("sx,sx->s", away, away) for away in (jet[left, 0], new_jet[:, 0]))
        # Where a step would increase the distance, the next one is shortened instead.
        improves = after <= before + rounded * (np.sqrt(before) + rounded)
        uv[left[improves]], jet[left[improves]] = new_uv[improves], new_jet[improves]
        part[left] = np.where(improves, 1, part[left] * SHORTER)
        length = np.abs(step).max(axis=1, initial=0)
        left = left[~((length < STEP_TOLERANCE) | (is_newton & improves & (length < LAST_NEWTON_STEP)))]
        if not len(left):
            break
    return uv, np.einsum("sx,sx->s", jet[:, 0], jet[:, 0]), slopes(jet[:, 1:3], jet[:, 0])


def _step(domain: ParameterDomain, at: FloatArray, jet: FloatArray) -> tuple[FloatArray, NDArray[np.bool_]]:
    """Newton's step ``(s, 2)``, along an edge if it would leave the domain, cut at the next; and whether it is full."""
    normals, difference, tangents = domain.edge_normals, jet[:, 0], jet[:, 1:3]
    gradient = np.einsum("sdx,sx->sd", tangents, difference)
    metric = tangents @ tangents.swapaxes(1, 2)
    a, b, c = metric[:, 0, 0], metric[:, 0, 1], metric[:, 1, 1]
    uu, uv, vv = np.einsum("sdx,sx->ds", jet[:, 3:], difference)
    hessian = np.stack([a + uu, b + uv, c + vv], axis=1)
    is_newton = (hessian[:, 0] > 0) & (hessian[:, 0] * hessian[:, 2] - hessian[:, 1] ** 2 > CONVEX * a * c)
    damped = PARALLEL * (a + c) + VANISHING
    matrix = np.where(is_newton[:, None], hessian, np.stack([a + damped, b, c + damped], axis=1))
    h, i, j = matrix.T
    step = np.stack([i * gradient[:, 1] - j * gradient[:, 0], i * gradient[:, 0] - h * gradient[:, 1]], axis=1)
    step /= (h * j - i * i)[:, None]

    inside = np.stack(domain.edge_distances(*at.T), axis=1)
    on_edge = inside <= ON_EDGE
    held = on_edge & (gradient @ normals.T > 0)
    count = held.sum(axis=1)
    # A step may leave the domain although the distance falls inwards.
    leaves = on_edge & (step @ normals.T < 0)
    slides = np.flatnonzero((count == 1) | ((count == 0) & leaves.any(axis=1)))
    if len(slides):
        edge = np.argmax(np.where(count[slides, None] == 1, held[slides], leaves[slides]), axis=1)
        along = normals[edge] @ np.array([[0.0, 1.0], [-1.0, 0.0]])
        square, product = along**2, along[:, 0] * along[:, 1]
        # Hessian and first fundamental form along the edge.
        bend, flat = (
            square[:, 0] * form[0] + 2 * product * form[1] + square[:, 1] * form[2]
            for form in (hessian[slides].T, (a[slides], b[slides], c[slides]))
        )
        is_newton[slides] = bend > CONVEX * flat
        bend = np.where(is_newton[slides], bend, flat + damped[slides])
        step[slides] = along * (-np.einsum("sd,sd->s", along, gradient[slides]) / bend)[:, None]
    step[count > 1] = 0
    out = -(step @ normals.T)
    with np.errstate(divide="ignore", invalid="ignore"):
        part = np.where(out > 0, np.maximum(inside, 0) / out, np.inf).min(axis=1)
    return step * np.minimum(part, 1)[:, None], is_newton & (part >= 1)


def _jet(pieces: PolynomialPieces, piece: IntArray, points: FloatArray, uv: FloatArray) -> FloatArray:
    """``(s, 6, 3)`` differences from points to the surface, and derivatives of the surface by u, v, uu, uv and vv."""
    rows = times_matrix(pieces.basis.values(uv)[None], pieces.basis.jets)
    jet: FloatArray = rows.reshape(len(uv), 6, -1) @ pieces.coefficients[piece]
    jet[:, 0] += pieces.origins[piece] - points
    return jet


def slopes(tangents: FloatArray, difference: FloatArray) -> FloatArray:
    """``(s,)`` larger components of differences ``(s, 3)`` along unit tangents: how fast the distance falls there.

    ``tangents`` are ``(s, 2, 3)``. Zero, up to rounding, if the difference is along the normal.
    """
    along = np.abs(np.einsum("sdx,sx->sd", tangents, difference))
    lengths = np.sqrt(np.einsum("sdx,sdx->sd", tangents, tangents))
    return (along / np.maximum(lengths, sys.float_info.min)).max(axis=1)


@dataclass(frozen=True, eq=False)
class TurnedBoxes(PartArrays):
    """Oriented boxes around pieces, with bounds by parameters whose tangents at the middle are orthonormal."""

    basis: BernsteinBasis  # Of the pieces
    frames: FloatArray  # (n, 3, 3) float64: unit vectors along the sides, the last one along the piece's normal
    middles: FloatArray  # (n, 3) float64: centres of the boxes in the coordinates of `frames`
    halves: FloatArray  # (n, 3) float64: half the lengths of the sides
    points: FloatArray  # (n, 3) float64: points of the pieces at the middle of their domains
    back: FloatArray  # (n, 2, 3) float64: maps a displacement along the tangents at `points` to parameters
    # (n, 3) float64: upper bounds of the norms of the second derivatives along each side; along the normal, of their
    # difference from those at the middle
    bends: FloatArray
    # (n, 2) float64: least and largest eigenvalue of the second derivatives along the normal at the middle
    curvatures: FloatArray
    stretch: FloatArray  # (n,) float64: lower bound of the squared length of a unit displacement, over the whole piece

    @classmethod
    def around(cls, pieces: PolynomialPieces) -> TurnedBoxes:
        # Where tangents vanish, bends are infinite, and no piece passes as convex.
        with np.errstate(over="ignore", invalid="ignore"):
            return cls.joined(
                [cls._around(pieces.basis, columns, pieces.origins[run]) for run, columns in pieces.runs(RUN)]
            )

    @classmethod
    def _around(cls, basis: BernsteinBasis, coefficients: FloatArray, origins: FloatArray) -> TurnedBoxes:
        """Compute boxes around a run of pieces. Intermediate arrays have the pieces along their last axis."""
        of_u, of_v = basis.derivatives
        middle = basis.values(basis.domain.centre[None])[0]
        points, du, dv = times(np.stack([middle, middle @ of_u, middle @ of_v]), coefficients)
        frames = _frames(du.T, dv.T)
        axes = np.ascontiguousarray(frames.transpose(1, 2, 0))
        along = axes[:, 0] * coefficients[:, None, 0]
        for x in (1, 2):
            along += axes[:, x] * coefficients[:, None, x]
        low, high = along.min(axis=0), along.max(axis=0)
        # `back` is the pseudo-inverse of the tangents.
        a, b, c = (np.einsum("xn,xn->n", *pair) for pair in ((du, du), (du, dv), (dv, dv)))
        determinant = np.maximum(a * c - b * b, SHORTEST)
        back = np.stack([c * du - b * dv, a * dv - b * du]) / determinant
        # Derivatives by parameters in which the tangents at the middle are orthonormal, as by Gram and Schmidt.
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
        across = [middle @ bend[:, 2] for bend in bends]
        mean, radius = (across[0] + across[2]) / 2, np.hypot((across[0] - across[2]) / 2, across[1])
        square = np.zeros_like(low)
        for weight, bend, across_at_middle in zip((1, 2, 1), bends, across, strict=True):
            bend[:, 2] -= across_at_middle
            square += weight * np.abs(bend).max(axis=0) ** 2
        # Bound of the squared change of the tangents over the piece.
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
        which: IntArray,  # (s,) int64: index of each point's box
        squared_reach: FloatArray,  # (s,) float64: largest squared distance of each point from its box
    ) -> tuple[IntArray, FloatArray, FloatArray]:
        """Find the points within reach of their boxes: indices ``(n,)``, and their squared distances from the boxes.

        And the vectors ``(n, 3)`` from them to the centres of the boxes in the coordinates of `frames`.
        """
        near_of_runs = [(np.empty(0, dtype=np.int64), np.empty(0), np.empty((0, 3)))]
        for begin in range(0, len(which), RUN):
            run = slice(begin, begin + RUN)
            box = which[run]
            away = (self.frames.take(box, axis=0) @ points[run, :, None])[:, :, 0]
            np.subtract(self.middles.take(box, axis=0), away, out=away)
            gap = np.maximum(np.abs(away) - self.halves.take(box, axis=0), 0)
            squared_distance = np.einsum("sx,sx->s", gap, gap)
            near = np.flatnonzero(squared_distance <= squared_reach[run])
            near_of_runs.append((near + begin, squared_distance[near], away[near]))
        near, squared_distance, away = map(np.concatenate, zip(*near_of_runs, strict=True))
        return near, squared_distance, away

    def are_convex(
        self,
        away: FloatArray,  # (n, 3) float64: as returned by `near`
        which: IntArray,  # (n,) int64: index of each point's box
    ) -> NDArray[np.bool_]:
        """``(n,)`` whether a bound shows that the squared distance is a convex function of the piece's parameters.

        Half its Hessian is the first fundamental form plus the products of the difference with second derivatives.
        """
        halves = self.halves[which]
        across, half, curvatures = away[:, 2:], halves[:, 2:], self.curvatures[which]
        # Infinite where tangents vanish.
        with np.errstate(invalid="ignore"):
            least = np.minimum((across - half) * curvatures, (across + half) * curvatures).min(axis=1)
            change = np.einsum("sx,sx->s", np.abs(away) + halves, self.bends[which])
            return change - least < self.stretch[which]

    def starts(self, points: FloatArray, which: IntArray) -> FloatArray:
        """``(s, 2)`` parameters near points, from the tangent plane of each piece, clamped to the domain."""
        away = (self.back[which] @ (points - self.points[which])[:, :, None])[:, :, 0]
        return self.basis.domain.clamped(self.basis.domain.centre + away)


def _frames(du: FloatArray, dv: FloatArray) -> FloatArray:
    """Orthonormal frames ``(n, 3, 3)``: along ``du``, in the tangent plane, normal. Axes if tangents are parallel."""
    with np.errstate(divide="ignore", invalid="ignore"):
        normal = np.cross(du, dv)
        normal /= np.linalg.norm(normal, axis=1, keepdims=True)
        first = du / np.linalg.norm(du, axis=1, keepdims=True)
        frames = np.stack([first, np.cross(normal, first), normal], axis=1)
        error = np.abs(frames @ frames.swapaxes(1, 2) - np.eye(3)).max(axis=(1, 2))
    # This form also replaces values that are not a number.
    frames[~(error < SQUARE)] = np.eye(3)
    return frames
