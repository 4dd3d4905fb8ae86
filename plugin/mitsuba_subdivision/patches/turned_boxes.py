"""Boxes that are turned to lie along polynomial pieces, and whether the distance has one minimum in a piece."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..evaluation.bernstein import BernsteinBasis
from ..mesh.connectivity import IntArray
from ..schemes.domain import FloatArray
from .polynomial_pieces import PolynomialPieces

# How far rounding may leave a frame from one of unit vectors at right angles.
SQUARE = 1e-12
# Shorter tangents count as of this length. Its square can still be divided by.
SHORTEST = 1e-100


@dataclass(frozen=True, eq=False)
class TurnedBoxes:
    """Boxes around pieces, turned to lie along them.

    Attributes
    ----------
    basis : BernsteinBasis
        Of the pieces.
    frames : (n, 3, 3) float64
        Unit vectors along the sides, the last one across the piece.
    middles, halves : (n, 3) float64
        Of the boxes, along these; distances of their sides from the middle.
    points : (n, 3) float64
        Of the pieces, at the middle of their domains.
    back : (n, 2, 3) float64
        Makes parameters of a way along the tangents there.
    bends : (n, 3) float64
        Norms of the second derivatives along each side, at most; across the piece, of what they differ from those in
        the middle. By parameters by which the tangents in the middle are unit vectors at right angles, as all that
        follows.
    curvatures : (n, 2) float64
        The least and the largest eigenvalue of the second derivatives across the piece in the middle.
    stretch : (n,) float64
        The least squared length of unit ways anywhere in the piece, at least.
    """

    basis: BernsteinBasis
    frames: FloatArray
    middles: FloatArray
    halves: FloatArray
    points: FloatArray
    back: FloatArray
    bends: FloatArray
    curvatures: FloatArray
    stretch: FloatArray

    @property
    def _arrays(self) -> tuple[FloatArray, ...]:
        return self.frames, self.middles, self.halves, self.points, self.back, self.bends, self.curvatures, self.stretch

    @classmethod
    def around(cls, pieces: PolynomialPieces) -> TurnedBoxes:
        """Boxes around pieces."""
        # Where tangents vanish, bends are infinite, and nothing is known to be convex.
        with np.errstate(over="ignore", invalid="ignore"):
            return cls._around(pieces)

    @classmethod
    def _around(cls, pieces: PolynomialPieces) -> TurnedBoxes:
        basis, coefficients = pieces.basis, pieces.coefficients
        middle = basis.values(basis.domain.corners.mean(axis=0)[None])
        by_u, by_v = basis.derivatives
        points, du, dv = (np.concatenate([middle, middle @ by_u, middle @ by_v]) @ coefficients).swapaxes(0, 1)
        frames = _frames(du, dv)
        along = coefficients @ frames.swapaxes(1, 2)
        low, high = along.min(axis=1), along.max(axis=1)
        middles = (low + high) / 2 + (frames @ pieces.origins[:, :, None])[:, :, 0]
        # The least squares of a way along the tangents.
        a, b, c = (np.einsum("nx,nx->n", *pair) for pair in ((du, du), (du, dv), (dv, dv)))
        determinant = np.maximum(a * c - b * b, SHORTEST)[:, None]
        back = np.stack([(c[:, None] * du - b[:, None] * dv), (a[:, None] * dv - b[:, None] * du)], axis=1)
        back /= determinant[:, None]
        # Parameters by which the tangents in the middle are unit vectors at right angles: derivatives by them.
        first = 1 / np.maximum(np.sqrt(a), SHORTEST)
        second = 1 / np.maximum(np.sqrt(determinant[:, 0]) * first, SHORTEST)
        shear = -b * first**2
        first, second, shear = first[:, None, None], second[:, None, None], shear[:, None, None]
        by_first, by_second = first * (by_u @ along), second * (shear * (by_u @ along) + by_v @ along)
        of_first = first * (by_u @ by_first), second * (shear * (by_u @ by_first) + by_v @ by_first)
        bends = (*of_first, second * (shear * (by_u @ by_second) + by_v @ by_second))
        across = [(middle @ each)[:, 0, 2] for each in bends]
        mean, radius = (across[0] + across[2]) / 2, np.hypot((across[0] - across[2]) / 2, across[1])
        curvatures = np.stack([mean - radius, mean + radius], axis=1)
        square = np.zeros_like(low)
        for weight, each, own in zip((1, 2, 1), bends, across, strict=True):
            each[:, :, 2] -= own[:, None]
            square += weight * np.abs(each).max(axis=1) ** 2
        # What the tangents change at most.
        change = sum(
            np.einsum("nbx,nbx->nb", each, each).max(axis=1)
            for each in (own - middle @ own for own in (by_first, by_second))
        )
        stretch = np.maximum(1 - np.sqrt(change), 0) ** 2
        return cls(
            basis,
            frames,
            middles,
            (high - low) / 2,
            points + pieces.origins,
            back,
            np.sqrt(square),
            curvatures,
            stretch,
        )

    def chosen(self, which: NDArray) -> TurnedBoxes:
        """Some of the boxes, by their numbers or a mask."""
        return TurnedBoxes(self.basis, *(each[which] for each in self._arrays))

    @classmethod
    def joined(cls, parts: list[TurnedBoxes]) -> TurnedBoxes:
        """Boxes one after the other; at least one part."""
        columns = zip(*(part._arrays for part in parts), strict=True)
        return cls(parts[0].basis, *(np.concatenate(column) for column in columns))

    def gaps(self, points: FloatArray, which: IntArray) -> tuple[FloatArray, NDArray[np.bool_]]:
        """How far points are from boxes, and whether the squared distance has one minimum in each piece.

        It has where it is a convex function of the piece's parameters: half its second derivatives are those of the
        surface times the difference, plus products of tangents.

        Returns
        -------
        squared_distance : (s,) float64
            To the box.
        is_convex : (s,) bool
        """
        away = self.middles[which] - (self.frames[which] @ points[:, :, None])[:, :, 0]
        halves, size = self.halves[which], np.abs(away)
        gap = np.maximum(size - halves, 0)
        across, half = away[:, 2:], halves[:, 2:]
        curvatures = self.curvatures[which]
        # Infinite where tangents vanish.
        with np.errstate(invalid="ignore"):
            least = np.minimum((across - half) * curvatures, (across + half) * curvatures).min(axis=1)
            others = np.einsum("sx,sx->s", size + halves, self.bends[which])
            is_convex = others - least < self.stretch[which]
        return np.einsum("sx,sx->s", gap, gap), is_convex

    def starts(self, points: FloatArray, which: IntArray) -> FloatArray:
        """``(s, 2)`` parameters of pieces near given points, as if the pieces were flat; in the domain."""
        domain = self.basis.domain
        uv = domain.corners.mean(axis=0) + (self.back[which] @ (points - self.points[which])[:, :, None])[:, :, 0]
        uv = np.clip(uv, 0, 1)
        if domain.corner_count == 3:
            uv = np.clip(uv - np.maximum(uv.sum(axis=1) - 1, 0)[:, None] / 2, 0, 1)
        return uv


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
