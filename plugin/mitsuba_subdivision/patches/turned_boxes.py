"""Boxes that are turned to lie along polynomial pieces, and whether the distance has one minimum in a piece."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..evaluation.bernstein import BernsteinBasis, times
from ..mesh.connectivity import IntArray
from ..schemes.domain import FloatArray
from .polynomial_pieces import PartArrays, PolynomialPieces

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
