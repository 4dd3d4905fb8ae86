"""Divide an element into pieces, but only where there are samples.

Words, in this module and in `patch_pieces`:

- A *child* is what one refinement makes of an element: one of four copies of its domain, or the whole of it.
- A *part* is what several refinements make of an element: a child of a child, and so on.
- A *piece* is a part that needs no further division: a regular patch, or one with a single extraordinary point.

An element without semi-sharp features has few pieces, which are always the same. A crease of sharpness s has 2^s parts
along it, most of them without a sample, and parts in which no samples lie are not divided. Two things save more:

- Parts that have the same signature are divided as one. All parts after so many refinements are refined in one mesh.
- *Steady* refinements are made once. An element with creases of sharpness 4.7 and 6.2 is refined by the same rules as
  one with 2.7 and 4.2: all of them are sharp before and after, and how sharp makes no difference. Its children have 3.7
  and 5.2, those of the other have 1.7 and 3.2, and that is all that differs. So the signature is lowered by 2, the
  number of its `Signature.steady_refinements`, and refined; the children's sharpness is raised by 2 again. The children
  of 3.7 and 5.2 are lowered in turn, by 1, to 2.7 and 4.2: what is asked for then is known already.
"""

from __future__ import annotations

from collections.abc import Iterator
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from ..mesh import ragged
from ..mesh.connectivity import IntArray
from ..mesh.record import Record
from ..mesh.sharpness import INFINITE
from ..mesh.signature import Signature
from ..schemes.domain import AffineMap, FloatArray, ParameterDomain
from ..schemes.members import optional_member
from ..schemes.scheme import Scheme, SchemeError
from .patch_pieces import IrregularStructure, Piece, all_pieces
from .refined_element import RefinedElement

# After these nothing is semi-sharp: every refinement takes one from a sharpness, which is below `INFINITE`.
MOST_SEMI_SHARP_REFINEMENTS = int(INFINITE)


class OccupiedPieces(Record):
    """Pieces of the same structure, and the samples that lie in them.

    Attributes
    ----------
    pieces : tuple of Piece
        All regular, or all with the same `IrregularStructure`.
    samples : (m,) int64
        Numbers of the samples; at least one.
    piece : (m,) int64
        The piece that each lies in.
    local : (m, 2) float64
        Its parameters in that piece.
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
        If refinement does not separate the irregularities of the one-ring, or something stays semi-sharp for ever.
    """
    mesh = None
    # After a refinement there are two records at most: of parts that had one child, and of parts that had four.
    undivided = [_Parts.whole(scheme.domain, signature, uv, corner)] if len(uv) else []
    for _ in range(MOST_SEMI_SHARP_REFINEMENTS + 1):
        divided: list[_Parts] = []
        for parts in undivided:
            semi_sharp = []
            for number, found in enumerate(parts.signatures):
                if found.is_semi_sharp:
                    semi_sharp.append(number)
                else:
                    yield from parts.only([number]).in_pieces(scheme.domain, all_pieces(scheme, found))
            if not semi_sharp:
                continue
            from .ring_mesh import refined_together

            steady = [steady_refinements(scheme, parts.signatures[number]) for number in semi_sharp]
            lowered = [parts.signatures[n].sharpened(-by) for n, by in zip(semi_sharp, steady, strict=True)]
            elements, mesh = refined_together(scheme, lowered, mesh)
            for count in {len(element.domains) for element in elements}:
                alike = [k for k, element in enumerate(elements) if len(element.domains) == count]
                chosen = parts.only([semi_sharp[k] for k in alike])
                divided.append(chosen.divided(scheme.domain, [(elements[k], steady[k]) for k in alike]))
        undivided = divided
    if undivided:
        raise SchemeError(
            f"{scheme.name}: {MOST_SEMI_SHARP_REFINEMENTS + 1} refinements leave something of a {signature.kind} of "
            f"sharpness {signature.sharpness:g} semi-sharp; expected each to take one from the sharpness"
        )


def steady_refinements(scheme: Scheme, signature: Signature) -> int:
    """How far a signature is lowered; not at all where Chaikin's method mixes sharpness, as no two levels are alike."""
    if optional_member(scheme, "crease_method") == "chaikin" and not signature.has_equal_creases:
        return 0
    return signature.steady_refinements


class _Parts(Record):
    """Parts of an element after so many refinements, and the samples that lie in them.

    Parts of the same signature follow each other.

    Attributes
    ----------
    uv : (s, 2) float64
        With (0, 0) at the sample's corner.
    corner, samples : (s,) int64
        Corner and number of each sample.
    part : (s,) int64
        The part that each sample lies in.
    matrices, offsets : (p, corners, 2, 2), (p, corners, 2) float64
        Maps to each part's parameters from the element's, as counted from each of its corners. Maps are composed before
        they are applied, so a tiny (u, v) at any corner stays exact.
    signatures : list of n Signature
        All different.
    first : (n + 1,) int64
        The first part of each signature, and the number of parts.
    stencils : list of n (p_signature, K_part, K) float64, or None
        For each signature, the control points of its parts over the element's one-ring; None for the element itself.
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
    def whole(cls, domain: ParameterDomain, signature: Signature, uv: FloatArray, corner: NDArray[np.int64]) -> _Parts:
        """The element itself, as its only part."""
        part = np.zeros(len(uv), dtype=np.int64)
        maps = _corner_maps(domain)
        return cls(uv, corner, np.arange(len(uv)), part, *maps, [signature], np.array([0, 1]), [None])

    def only(self, numbers: list[int]) -> _Parts:
        """The parts of some of the signatures, in that order."""
        if numbers == list(range(len(self.signatures))):
            return self
        counts = np.diff(self.first)[numbers]
        kept = ragged.ranges(self.first[numbers], counts)
        renumbered = np.full(len(self.matrices), -1)
        renumbered[kept] = np.arange(len(kept))
        part = renumbered[self.part]
        own = np.flatnonzero(part >= 0)
        return _Parts(
            self.uv[own],
            self.corner[own],
            self.samples[own],
            part[own],
            self.matrices[kept],
            self.offsets[kept],
            [self.signatures[number] for number in numbers],
            ragged.offsets(counts),
            [self.stencils[number] for number in numbers],
        )

    def divided(self, domain: ParameterDomain, elements: list[tuple[RefinedElement, int]]) -> _Parts:
        """Children of the parts in which samples lie.

        Parameters
        ----------
        elements : list of (element, steady)
            For each signature, an element of a signature lowered by ``steady``. All have the same number of children.
        """
        signature_of = np.repeat(np.arange(len(elements)), np.diff(self.first))
        part_count, child_count = len(signature_of), len(elements[0][0].domains)
        matrices, offsets = self._composed(
            np.array([element.matrices for element, _ in elements])[signature_of].swapaxes(0, 1),
            np.array([element.offsets for element, _ in elements])[signature_of].swapaxes(0, 1),
        )
        child_of_sample, _ = self._first_inside(domain, matrices, offsets)
        occupied, number_of_sample = _occupied(child_of_sample * part_count + self.part, child_count * part_count)
        child, parent = np.divmod(occupied, part_count)
        # The same child of all parts of a signature is one run: it has one signature, and one product gives the
        # stencils of the whole run.
        run = signature_of[parent] * child_count + child
        in_runs = np.argsort(run, kind="stable")
        by_signature: dict[Signature, list[tuple[IntArray, FloatArray]]] = {}
        for own in np.split(in_runs, np.flatnonzero(np.diff(run[in_runs])) + 1):
            number = int(signature_of[parent[own[0]]])
            element, steady = elements[number]
            signature, stencils = element.child(int(child[own[0]]))
            before = self.stencils[number]
            if before is None:
                found = stencils[None]
            elif len(own) == len(before):
                found = stencils @ before
            else:
                found = stencils @ before[parent[own] - self.first[number]]
            by_signature.setdefault(signature.sharpened(steady), []).append((own, found))
        # Runs of the same signature follow each other.
        order = np.concatenate([own for runs in by_signature.values() for own, _ in runs])
        renumbered = np.empty(len(order), dtype=np.int64)
        renumbered[order] = np.arange(len(order))
        stencils_of = [_joined([found for _, found in runs]) for runs in by_signature.values()]
        return _Parts(
            self.uv,
            self.corner,
            self.samples,
            renumbered[number_of_sample],
            matrices[child[order], parent[order]],
            offsets[child[order], parent[order]],
            list(by_signature),
            ragged.offsets([len(stencils) for stencils in stencils_of]),
            list(stencils_of),
        )

    def in_pieces(self, domain: ParameterDomain, pieces: tuple[Piece, ...]) -> Iterator[OccupiedPieces]:
        """Pieces in which samples lie. All parts have the same signature, and consist of ``pieces``."""
        (over,) = self.stencils
        matrices, offsets = self._composed(
            np.array([piece.domain.matrix for piece in pieces])[:, None],
            np.array([piece.domain.offset for piece in pieces])[:, None],
        )
        piece_of_sample, local = self._first_inside(domain, matrices, offsets)
        if len(pieces) == 1:
            # Every part is one piece: most elements are, and this takes less time than the general case.
            controls = pieces[0].stencils[None] if over is None else pieces[0].stencils @ over
            found = _made_pieces(matrices[0, :, 0], offsets[0, :, 0], controls, pieces[0].irregular)
            yield OccupiedPieces(found, self.samples, self.part, local, matrices[0, self.part, self.corner])
            return
        part_count = len(self.matrices)
        occupied, number_of_sample = _occupied(piece_of_sample * part_count + self.part, len(pieces) * part_count)
        piece, part = np.divmod(occupied, part_count)
        by_structure: dict[IrregularStructure | None, list[int]] = {}
        for number, own_piece in enumerate(piece.tolist()):
            by_structure.setdefault(pieces[own_piece].irregular, []).append(number)
        for structure, numbers in by_structure.items():
            renumbered = np.full(len(occupied), -1)
            renumbered[numbers] = np.arange(len(numbers))
            # Views of all samples take less time than copies, and often there is one structure only.
            own = slice(None) if len(by_structure) == 1 else np.flatnonzero(renumbered[number_of_sample] >= 0)
            stencils = np.stack([pieces[own_piece].stencils for own_piece in piece[numbers].tolist()])
            if over is not None:
                stencils = stencils @ over[part[numbers]]
            # A piece's own map is from the element's parameters as counted from its first corner.
            first_corner = piece[numbers], part[numbers], 0
            yield OccupiedPieces(
                _made_pieces(matrices[first_corner], offsets[first_corner], stencils, structure),
                self.samples[own],
                renumbered[number_of_sample[own]],
                local[own],
                matrices[piece_of_sample[own], self.part[own], self.corner[own]],
            )

    def _composed(self, matrices: FloatArray, offsets: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Maps to c children of each part: ``(c, p, corners, 2, 2)`` and ``(c, p, corners, 2)``.

        Parameters
        ----------
        matrices, offsets : (c, p, 2, 2), (c, p, 2), or (c, 1, 2, 2), (c, 1, 2)
            From a part's parameters to those of its children.
        """
        matrices, offsets = matrices[:, :, None], offsets[:, :, None]
        return matrices @ self.matrices, (matrices @ self.offsets[..., None])[..., 0] + offsets

    def _first_inside(
        self, domain: ParameterDomain, matrices: FloatArray, offsets: FloatArray
    ) -> tuple[IntArray, FloatArray]:
        """The first child that each sample lies in, as it may lie on the border of several, and its parameters there.

        Parameters
        ----------
        matrices, offsets : (c, p, corners, 2, 2), (c, p, corners, 2)

        Returns
        -------
        child : (s,) int64
        local : (s, 2) float64
        """
        matrix, offset = matrices[:, self.part, self.corner], offsets[:, self.part, self.corner]
        local = matrix[..., 0] * self.uv[:, None, 0] + matrix[..., 1] * self.uv[:, None, 1] + offset
        if len(local) == 1:
            return np.zeros(len(self.uv), dtype=np.int64), local[0]
        child = np.argmax(domain.inside(local), axis=0)
        return child, local[child, np.arange(len(child))]


def _made_pieces(
    matrices: FloatArray, offsets: FloatArray, stencils: FloatArray, structure: IrregularStructure | None
) -> tuple[Piece, ...]:
    """Pieces of a structure: ``(n, 2, 2)`` and ``(n, 2)`` maps from the element's parameters, ``(n, K_piece, K)``."""
    rows = zip(matrices, offsets, stencils, strict=True)
    return tuple(Piece(AffineMap(matrix, offset), controls, structure) for matrix, offset, controls in rows)


def _occupied(places: IntArray, place_count: int) -> tuple[IntArray, IntArray]:
    """Places that occur among those of the samples, in increasing order, and which of these each sample has."""
    occurring = np.flatnonzero(np.bincount(places, minlength=place_count))
    renumbered = np.empty(place_count, dtype=np.int64)
    renumbered[occurring] = np.arange(len(occurring))
    return occurring, renumbered[places]


def _joined(stencils: list[FloatArray]) -> FloatArray:
    return stencils[0] if len(stencils) == 1 else np.concatenate(stencils)


@lru_cache(maxsize=16)
def _corner_maps(domain: ParameterDomain) -> tuple[FloatArray, FloatArray]:
    """Maps from each corner's parameters to the domain's: ``(1, corners, 2, 2)`` and ``(1, corners, 2)``."""
    maps = [domain.rotation(corner) for corner in range(domain.corner_count)]
    return np.array([[m.matrix for m in maps]]), np.array([[m.offset for m in maps]])
