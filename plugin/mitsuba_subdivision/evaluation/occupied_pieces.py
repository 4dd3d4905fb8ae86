"""Split an element into pieces where there are samples, by walking down its refinements."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from ..cage.connectivity import IntArray
from ..cage.signature import Signature
from ..schemes.domain import AffineMap, FloatArray, ParameterDomain
from ..schemes.scheme import Scheme
from .patch_pieces import IrregularStructure, Piece, all_pieces, whole_piece
from .refined_element import RefinedElement, refined_together


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
    """Pieces of an element in which samples lie, each sample in one.

    All pieces together cover the element. There may be many: a crease of sharpness s has 2^s along it. So semi-sharp
    parts in which no samples lie are not refined. Those that have the same signature are refined as one, and those of a
    level in one mesh.

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
    while parts:
        divided: list[tuple[Signature, int, _Parts]] = []
        for sharp, found in parts.items():
            here = _Parts.joined(found)
            if not sharp.is_semi_sharp:
                yield from here.in_pieces(scheme.domain, all_pieces(scheme, sharp))
                continue
            steady = sharp.steady_refinements
            base = sharp.sharpened(-steady)
            piece = whole_piece(scheme, base)
            if piece is not None:
                yield here.as_pieces(piece)
            else:
                divided.append((base, steady, here))
        parts = {}
        elements, mesh = refined_together(scheme, (base for base, _, _ in divided), mesh)
        for element, (_, steady, here) in zip(elements, divided, strict=True):
            for child, inside in here.divided(scheme.domain, element):
                parts.setdefault(child.sharpened(steady), []).append(inside)


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

    def in_pieces(self, domain: ParameterDomain, pieces: tuple[Piece, ...]) -> Iterator[OccupiedPieces]:
        """Pieces of the parts in which samples lie; each part consists of ``pieces``."""
        if len(pieces) == 1:
            yield self.as_pieces(pieces[0])
            return
        count = len(self.matrices)
        of_pieces = np.array([piece.domain.matrix for piece in pieces])[:, None, None]
        matrices = of_pieces @ self.matrices
        offsets = (of_pieces @ self.offsets[..., None])[..., 0]
        offsets += np.array([piece.domain.offset for piece in pieces])[:, None, None]
        local = self._applied(matrices, offsets)
        # On the border of several pieces, the first.
        chosen = np.argmax(domain.inside(local), axis=0)
        # Pieces of parts in which samples lie, by structure.
        pairs: dict[IrregularStructure | None, list[int]] = {}
        found = chosen * count + self.part
        for pair in np.flatnonzero(np.bincount(found)).tolist():
            pairs.setdefault(pieces[pair // count].irregular, []).append(pair)
        place = np.full(len(pieces) * count, -1)
        for structure, alike in pairs.items():
            place[:] = -1
            place[alike] = np.arange(len(alike))
            own = np.flatnonzero(place[found] >= 0)
            number, part = np.divmod(alike, count)
            stencils = [pieces[k].stencils for k in number.tolist()]
            if self.stencils is not None:
                stencils = np.stack(stencils) @ self.stencils[part]
            rows = zip(matrices[number, part, 0], offsets[number, part, 0], stencils, strict=True)
            yield OccupiedPieces(
                tuple(Piece(AffineMap(matrix, offset), controls, structure) for matrix, offset, controls in rows),
                self.samples[own],
                place[found[own]],
                local[chosen[own], own],
                matrices[chosen[own], self.part[own], self.corner[own]],
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
