"""Split an element into pieces where there are samples, by walking down its refinements."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from ..cage.connectivity import IntArray
from ..cage.signature import Signature
from ..schemes.domain import AffineMap, FloatArray, ParameterDomain
from ..schemes.scheme import Scheme, SchemeError
from .patch_pieces import Piece, whole_piece
from .refined_element import RefinedElement, refined_together

# Refinements after which every element of a stationary scheme consists of regular and self-similar pieces, once nothing
# is semi-sharp any more; the schemes here need one or two. More means rules that keep making new irregularities.
MAX_REFINEMENTS = 6


@dataclass(frozen=True, eq=False)
class OccupiedPieces:
    """Pieces of a kind, and the samples that lie in them.

    Attributes
    ----------
    pieces : tuple of Piece
        All of one structure.
    samples : (m,) int64
        Which of the samples; at least one.
    piece : (m,) int64
        The piece that each lies in.
    local : (m, 2) float64
        Its parameters there.
    jacobian : (m, 2, 2) float64
        Derivative of these by the sample's own (u, v).
    """

    pieces: tuple[Piece, ...]
    samples: IntArray
    piece: IntArray
    local: FloatArray
    jacobian: FloatArray


def occupied_pieces(
    scheme: Scheme, signature: Signature, uv: FloatArray, corner: NDArray[np.int64]
) -> Iterator[OccupiedPieces]:
    """Pieces of an element in which samples lie, each sample in one; others are not made.

    All pieces together cover the element. There may be many: a crease of sharpness s has 2^s along it. But few parts
    that a refinement makes differ in their signatures, and those that do not are refined together.

    Parameters
    ----------
    signature : Signature
        Of the element's one-ring.
    uv : (s, 2) float64
        With (0, 0) at the sample's corner.
    corner : (s,) int64

    Raises
    ------
    SchemeError
        If refinement does not separate the irregularities of the one-ring.
    """
    parts = {signature: [_Parts.whole(scheme.domain, uv, corner)]} if len(uv) else {}
    mesh = None
    for _ in range(MAX_REFINEMENTS + math.ceil(signature.sharpness) + 1):
        divided: list[tuple[Signature, int, _Parts]] = []
        for sharp, found in parts.items():
            here = _Parts.joined(found)
            steady = sharp.steady_refinements
            base = sharp.sharpened(-steady)
            piece = whole_piece(scheme, base)
            if piece is not None:
                yield here.as_pieces(piece)
            else:
                divided.append((base, steady, here))
        parts: dict[Signature, list[_Parts]] = {}
        elements, mesh = refined_together(scheme, (base for base, _, _ in divided), mesh)
        for element, (_, steady, here) in zip(elements, divided, strict=True):
            for child, inside in here.divided(scheme.domain, element):
                parts.setdefault(child.sharpened(steady), []).append(inside)
    if parts:
        left = next(iter(parts))
        raise SchemeError(
            f"{scheme.name}: refinement leaves a {left.kind} with fans {left.fans} neither regular nor self-similar; "
            "expected a scheme that isolates extraordinary points"
        )


@dataclass(frozen=True, eq=False)
class _Parts:
    """Parts of an element that have the same signature, and the samples that lie in them.

    Attributes
    ----------
    uv : (s, 2) float64
        With (0, 0) at the sample's corner.
    corner, samples : (s,) int64
        Corner and number of each sample.
    part : (s,) int64
        The part that each lies in.
    matrices, offsets : (p, corners, 2, 2), (p, corners, 2) float64
        Maps from each corner's parameters to each part's. They are composed before they are applied, so a tiny (u, v)
        at any corner stays exact.
    stencils : (p, K_part, K) float64 or None
        Control points of each part over the element's one-ring; None for the element itself.
    """

    uv: FloatArray
    corner: NDArray[np.int64]
    samples: IntArray
    part: IntArray
    matrices: FloatArray
    offsets: FloatArray
    stencils: FloatArray | None

    @classmethod
    def whole(cls, domain: ParameterDomain, uv: FloatArray, corner: NDArray[np.int64]) -> _Parts:
        """The element itself."""
        part = np.zeros(len(uv), dtype=np.int64)
        return cls(uv, corner, np.arange(len(uv)), part, *_corner_maps(domain), None)

    @classmethod
    def joined(cls, several: list[_Parts]) -> _Parts:
        """Parts of several elements in one."""
        if len(several) == 1:
            return several[0]
        first = np.cumsum([0, *(len(parts.matrices) for parts in several)])
        names = ("uv", "corner", "samples", "matrices", "offsets", "stencils")
        fields = {name: np.concatenate([getattr(parts, name) for parts in several]) for name in names}
        return cls(part=np.concatenate([p.part + begin for p, begin in zip(several, first, strict=False)]), **fields)

    def divided(self, domain: ParameterDomain, element: RefinedElement) -> Iterator[tuple[Signature, _Parts]]:
        """Parts of these parts in which samples lie, those with the same number in ``element``; and their signature."""
        matrices = element.matrices[:, None, None] @ self.matrices
        offsets = (element.matrices[:, None, None] @ self.offsets[..., None])[..., 0] + element.offsets[:, None, None]
        # On the border of several parts, the first.
        chosen = np.argmax(domain.inside(self._applied(matrices, offsets)), axis=0)
        for number in np.flatnonzero(np.bincount(chosen)).tolist():
            own = np.flatnonzero(chosen == number)
            used, part = np.zeros(1, dtype=np.int64), self.part[own]
            if len(self.matrices) > 1:
                used, part = np.unique(part, return_inverse=True)
            child, stencils = element.part(number)
            yield (
                child,
                _Parts(
                    self.uv[own],
                    self.corner[own],
                    self.samples[own],
                    part,
                    matrices[number, used],
                    offsets[number, used],
                    stencils[None] if self.stencils is None else stencils @ self.stencils[used],
                ),
            )

    def as_pieces(self, piece: Piece) -> OccupiedPieces:
        """Pieces that the parts are, of the same structure as ``piece``."""
        matrices = piece.domain.matrix @ self.matrices
        offsets = self.offsets @ piece.domain.matrix.T + piece.domain.offset
        stencils = piece.stencils[None] if self.stencils is None else piece.stencils @ self.stencils
        rows = zip(matrices[:, 0], offsets[:, 0], stencils, strict=True)
        return OccupiedPieces(
            tuple(Piece(AffineMap(matrix, offset), own, piece.irregular) for matrix, offset, own in rows),
            self.samples,
            self.part,
            self._applied(matrices, offsets),
            matrices[self.part, self.corner],
        )

    def _applied(self, matrices: FloatArray, offsets: FloatArray) -> FloatArray:
        """Parameters ``(.., s, 2)`` by maps ``(.., p, corners, 2, 2)`` and ``(.., p, corners, 2)``."""
        matrix, offset = matrices[..., self.part, self.corner, :, :], offsets[..., self.part, self.corner, :]
        return matrix[..., 0] * self.uv[:, None, 0] + matrix[..., 1] * self.uv[:, None, 1] + offset


@lru_cache(maxsize=16)
def _corner_maps(domain: ParameterDomain) -> tuple[FloatArray, FloatArray]:
    """Maps from each corner's parameters to the domain's: ``(1, corners, 2, 2)`` and ``(1, corners, 2)``."""
    maps = [domain.rotation(corner) for corner in range(domain.corner_count)]
    return np.array([[m.matrix for m in maps]]), np.array([[m.offset for m in maps]])
