"""Split an element into pieces where there are samples, by walking down its refinements."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from ..mesh import ragged
from ..mesh.connectivity import IntArray
from ..mesh.sharpness import INFINITE
from ..mesh.signature import Signature
from ..schemes.domain import AffineMap, FloatArray, ParameterDomain
from ..schemes.scheme import Scheme, SchemeError
from .patch_pieces import IrregularStructure, Piece, all_pieces
from .refined_element import RefinedElement, refined_together

# After which nothing is semi-sharp: every refinement takes one from a sharpness, which is below `INFINITE`.
MOST_SEMI_SHARP_REFINEMENTS = int(INFINITE)


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
        If refinement does not separate the irregularities of the one-ring, or leaves what is semi-sharp as it is.
    """
    levels = [_Level.whole(scheme.domain, signature, uv, corner)] if len(uv) else []
    mesh = None
    for _ in range(MOST_SEMI_SHARP_REFINEMENTS + 1):
        following: list[_Level] = []
        for level in levels:
            divided: list[tuple[int, Signature, int]] = []
            for number, sharp in enumerate(level.signatures):
                if not sharp.is_semi_sharp:
                    yield from level.parts(number).in_pieces(scheme.domain, all_pieces(scheme, sharp))
                    continue
                steady = sharp.steady_refinements
                divided.append((number, sharp.sharpened(-steady), steady))
            elements, mesh = refined_together(scheme, (base for _, base, _ in divided), mesh)
            by_count: dict[int, list[tuple[int, RefinedElement, int]]] = {}
            for (number, _, steady), element in zip(divided, elements, strict=True):
                by_count.setdefault(len(element.domains), []).append((number, element, steady))
            following += [level.divided(scheme.domain, alike) for alike in by_count.values()]
        levels = following
    if levels:
        raise SchemeError(
            f"{scheme.name}: {MOST_SEMI_SHARP_REFINEMENTS + 1} refinements leave something of a {signature.kind} of "
            f"sharpness {signature.sharpness:g} semi-sharp; expected each to take one from the sharpness"
        )


@dataclass(frozen=True, eq=False)
class _Level:
    """Parts of an element after as many refinements, in order of signature, and the samples that lie in them.

    Attributes
    ----------
    uv, corner, samples, part, matrices, offsets
        As `_Parts` has them.
    signatures : list of Signature
        All different.
    first : (n + 1,) int64
        The first part of each signature, and the number of parts.
    stencils : list of (p, K_part, K) float64 or None
        Of the parts of each signature.
    """

    uv: FloatArray
    corner: NDArray[np.int64]
    samples: IntArray
    part: IntArray
    matrices: FloatArray
    offsets: FloatArray
    signatures: list[Signature]
    first: IntArray
    stencils: list[FloatArray | None]

    @classmethod
    def whole(cls, domain: ParameterDomain, signature: Signature, uv: FloatArray, corner: NDArray[np.int64]) -> _Level:
        """The element itself."""
        part = np.zeros(len(uv), dtype=np.int64)
        maps = _corner_maps(domain)
        return cls(uv, corner, np.arange(len(uv)), part, *maps, [signature], np.array([0, 1]), [None])

    def parts(self, number: int) -> _Parts:
        """Those of a signature."""
        begin, end = self.first[number : number + 2]
        own = np.flatnonzero((self.part >= begin) & (self.part < end))
        return _Parts(
            self.uv[own],
            self.corner[own],
            self.samples[own],
            self.part[own] - begin,
            self.matrices[begin:end],
            self.offsets[begin:end],
            self.stencils[number],
        )

    def divided(self, domain: ParameterDomain, elements: list[tuple[int, RefinedElement, int]]) -> _Level:
        """Parts in which samples lie after another refinement of the parts of some signatures.

        Parameters
        ----------
        elements : list of (number, element, steady)
            Of each of these signatures, and how much sharper it is than the element. All have as many parts.
        """
        numbers = np.array([number for number, _, _ in elements])
        counts = self.first[numbers + 1] - self.first[numbers]
        begins = ragged.starts(counts)
        # Which of the elements each part here is of, and its number before.
        of = np.repeat(np.arange(len(elements)), counts)
        before = np.arange(len(of)) + (self.first[numbers] - begins)[of]
        place = np.full(len(self.matrices), -1)
        place[before] = np.arange(len(of))
        own = np.flatnonzero(place[self.part] >= 0)
        uv, corner, part = self.uv[own], self.corner[own], place[self.part[own]]

        of_elements = np.array([element.matrices for _, element, _ in elements])[of].swapaxes(0, 1)[:, :, None]
        matrices = of_elements @ self.matrices[before]
        offsets = (of_elements @ self.offsets[before][..., None])[..., 0]
        offsets += np.array([element.offsets for _, element, _ in elements])[of].swapaxes(0, 1)[:, :, None]
        # On the border of several parts, the first.
        chosen = np.argmax(domain.inside(_applied(matrices, offsets, part, corner, uv)), axis=0)
        # Parts of the same element that have the same number follow each other.
        sequence = (
            (len(matrices) - 1) * begins[of] + counts[of] * np.arange(len(matrices))[:, None] + np.arange(len(of))
        )
        pairs = np.empty(sequence.size, dtype=np.int64)
        pairs[sequence] = np.arange(sequence.size).reshape(sequence.shape)
        found = pairs[np.flatnonzero(np.bincount(sequence[chosen, part]))]
        child, parent = np.divmod(found, len(of))
        element_of = of[parent]
        begins_run = np.flatnonzero((np.diff(child, prepend=-1) != 0) | (np.diff(element_of, prepend=-1) != 0)).tolist()

        runs: dict[Signature, list[tuple[slice, FloatArray]]] = {}
        for begin, end in zip(begins_run, [*begins_run[1:], len(found)], strict=True):
            number, element, steady = elements[element_of[begin]]
            signature, stencils = element.part(int(child[begin]))
            over = self.stencils[number]
            if over is not None and end - begin < len(over):
                over = over[before[parent[begin:end]] - self.first[number]]
            stencils = stencils[None] if over is None else stencils @ over
            runs.setdefault(signature.sharpened(steady), []).append((slice(begin, end), stencils))
        order = np.concatenate([np.arange(len(found))[run] for alike in runs.values() for run, _ in alike])
        child, parent = child[order], parent[order]
        part_of = np.empty(sequence.shape, dtype=np.int64)
        part_of[child, parent] = np.arange(len(order))
        stencils = [[own for _, own in alike] for alike in runs.values()]
        stencils = [alike[0] if len(alike) == 1 else np.concatenate(alike) for alike in stencils]
        return _Level(
            uv,
            corner,
            self.samples[own],
            part_of[chosen, part],
            matrices[child, parent],
            offsets[child, parent],
            list(runs),
            ragged.offsets([len(alike) for alike in stencils]),
            stencils,
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
            _applied(matrices, offsets, self.part, self.corner, self.uv),
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
        local = _applied(matrices, offsets, self.part, self.corner, self.uv)
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


def _applied(
    matrices: FloatArray, offsets: FloatArray, part: IntArray, corner: NDArray[np.int64], uv: FloatArray
) -> FloatArray:
    """Parameters ``(.., s, 2)`` by maps ``(.., p, corners, 2, 2)`` and ``(.., p, corners, 2)``."""
    matrix, offset = matrices[..., part, corner, :, :], offsets[..., part, corner, :]
    return matrix[..., 0] * uv[:, None, 0] + matrix[..., 1] * uv[:, None, 1] + offset


@lru_cache(maxsize=16)
def _corner_maps(domain: ParameterDomain) -> tuple[FloatArray, FloatArray]:
    """Maps from each corner's parameters to the domain's: ``(1, corners, 2, 2)`` and ``(1, corners, 2)``."""
    maps = [domain.rotation(corner) for corner in range(domain.corner_count)]
    return np.array([[m.matrix for m in maps]]), np.array([[m.offset for m in maps]])
