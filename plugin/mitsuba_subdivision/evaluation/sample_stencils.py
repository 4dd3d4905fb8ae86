"""Limit stencils of the same samples on elements of many signatures, in passes over all of these.

Samples descend to the pieces that they lie in, depth by depth. Parts of different elements with the same signature and
samples at the same parameters become one. At the pieces all samples of a kind are evaluated together. Then, from depth
to depth upwards, weights over the control points of a part become weights over those of its parent, by one
product for each child of a signature.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from ..mesh import ragged
from ..mesh.connectivity import IntArray
from ..mesh.signature import Signature
from ..schemes.domain import FloatArray
from ..schemes.scheme import Scheme
from .divided_element import MOST_DEPTH, DividedElement, PartKind, element_of, not_isolated, refine_elements
from .element import without_collapsed
from .irregular_patch import IrregularPatch
from .occupied_pieces import CANCELLED
from .patch_pieces import Piece
from .refined_rings import RingMesh

# Stencils of more weights than these are not kept. The others take 16 MB at most.
KEPT_WEIGHTS = 1 << 17
# Levels of tips of high valence that are refined: derivatives have enough digits there without frames.
REFINED_LEVELS = 3


def stencils_by_signature(scheme: Scheme, signatures: Sequence[Signature], uv: FloatArray) -> list[FloatArray]:
    """`element_stencils` of the same samples on elements of several signatures, seen from their first corners.

    Parameters
    ----------
    uv : (s, 2) float64

    Returns
    -------
    list of (3, s, K) float64, read-only

    Raises
    ------
    SchemeError
        If refinement does not separate the irregularities of a one-ring.
    """
    elements = [element_of(scheme, signature) for signature in signatures]
    if 3 * len(uv) * sum(each.control_count for each in elements) > KEPT_WEIGHTS:
        return _same_samples(scheme, elements, uv)
    # A copy of the list.
    return [*_kept_stencils(scheme, tuple(signatures), uv.tobytes())]


@lru_cache(maxsize=16)
def _kept_stencils(scheme: Scheme, signatures: tuple[Signature, ...], uv: bytes) -> list[FloatArray]:
    """Stencils that are kept, because many shapes have elements of the same signatures with the same samples.

    They are kept together: the last bits of a sum may depend on what is summed with it.
    """
    return _same_samples(scheme, [element_of(scheme, each) for each in signatures], np.frombuffer(uv).reshape(-1, 2))


def stencils_of_samples(
    scheme: Scheme, signatures: Sequence[Signature], counts: Sequence[int], uv: FloatArray
) -> list[FloatArray]:
    """As `stencils_by_signature`, of other samples on each element.

    Parameters
    ----------
    signatures : sequence of Signature
        All different.
    counts : sequence of int
        Number of samples of each element.
    uv : (s, 2) float64
        Samples of all elements, one element after the other.
    """
    elements = [element_of(scheme, signature) for signature in signatures]
    return _stencils(scheme, elements, np.repeat(np.arange(len(elements)), counts), uv)


def _same_samples(scheme: Scheme, elements: list[DividedElement], uv: FloatArray) -> list[FloatArray]:
    """`stencils_by_signature`; elements that occur several times are evaluated once."""
    different = list(dict.fromkeys(elements))
    element, local = np.repeat(np.arange(len(different)), len(uv)), np.tile(uv, (len(different), 1))
    found = dict(zip(different, _stencils(scheme, different, element, local), strict=True))
    return [found[element] for element in elements]


def _stencils(scheme: Scheme, elements: list[DividedElement], element: IntArray, uv: FloatArray) -> list[FloatArray]:
    """Stencils of samples on different elements, sorted by these."""
    depths = _depths(scheme, elements, element, uv)
    _evaluate_pieces(scheme, depths)
    for above, below in reversed(list(pairwise(depths))):
        _lift(above, below)
    for number, stencils in enumerate(depths[0].stencils):
        without_collapsed(stencils[1:], depths[0].frame_weights[:, depths[0].samples(number)])
        stencils.flags.writeable = False
    return depths[0].stencils


@dataclass(frozen=True, eq=False)
class _Depth:
    """Parts of elements after so many refinements, of different signatures, and the different samples in them.

    Attributes
    ----------
    elements : list of n DividedElement
    first : (n + 1,) int64
        The first sample of each, after which come its others; and the number of samples.
    uv : (s, 2) float64
        Parameters in the part.
    is_in_piece : (s,) bool
        Whether each is evaluated there, and not in a child.
    groups : list of (int, int, (m,) int64, int, (m,) int64)
        Samples that lie in the same child of an element: the element, the child's number, the samples; the child's
        index among the elements of the next depth, and the samples there. Together, all that do not lie in pieces.
    stencils : list of (3, s_element, K) float64
        For each element, weights over its control points: of the points, and of two tangents by its parameters.
    frame_weights : (2, s) float64
        As `PieceGroup.absolute_weights`, or more: absolute weights are added up at the pieces, where what cancels
        above is not yet known.
    """

    elements: list[DividedElement]
    first: IntArray
    uv: FloatArray
    is_in_piece: NDArray[np.bool_]
    groups: list[tuple[int, int, IntArray, int, IntArray]]
    stencils: list[FloatArray]
    frame_weights: FloatArray

    @classmethod
    def of(
        cls,
        elements: list[DividedElement],
        first: IntArray,
        uv: FloatArray,
        is_in_piece: NDArray[np.bool_],
        groups: list[tuple[int, int, IntArray, int, IntArray]],
    ) -> _Depth:
        """A depth without weights yet."""
        counts = np.diff(first).tolist()
        stencils = [np.empty((3, n, each.control_count)) for each, n in zip(elements, counts, strict=True)]
        return cls(elements, first, uv, is_in_piece, groups, stencils, np.empty((2, len(uv))))

    def samples(self, element: int) -> slice:
        return slice(int(self.first[element]), int(self.first[element + 1]))


def _depths(scheme: Scheme, elements: list[DividedElement], element: IntArray, uv: FloatArray) -> list[_Depth]:
    """Samples at every depth down to their pieces: first in the elements, then in the parts after each refinement."""
    mesh: RingMesh | None = None
    found: list[_Depth] = []
    for _ in range(MOST_DEPTH + 1):
        mesh = refine_elements(scheme, elements, mesh)
        first = ragged.offsets(np.bincount(element, minlength=len(elements)))
        kinds = np.array([each.kind for each in elements])
        is_inner = kinds[element] <= PartKind.ONLY_CHILD
        for each, samples in zip(elements, pairwise(first.tolist()), strict=True):
            is_inner[slice(*samples)] |= _is_beside_tip(scheme, each, uv[slice(*samples)])
        inner = np.flatnonzero(is_inner)
        if not len(inner):
            return [*found, _Depth.of(elements, first, uv, ~is_inner, [])]
        parent = element[inner]
        child, in_child = scheme.domain.first_child(uv[inner].T)
        is_only = kinds[parent] == PartKind.ONLY_CHILD
        child, in_child = np.where(is_only, 0, child), np.where(is_only, uv[inner].T, in_child).T
        pairs, pair = np.unique(4 * parent + child, return_inverse=True)
        numbers: dict[DividedElement, int] = {}
        below = [numbers.setdefault(elements[key // 4].child_element(key % 4), len(numbers)) for key in pairs.tolist()]
        element_below, uv_below, number = _distinct(np.array(below)[pair], in_child)
        in_pairs = np.split(np.argsort(pair, kind="stable"), np.cumsum(np.bincount(pair))[:-1])
        groups: list[tuple[int, int, IntArray, int, IntArray]] = [
            (key // 4, key % 4, inner[own], own_below, number[own])
            for key, own, own_below in zip(pairs.tolist(), in_pairs, below, strict=True)
        ]
        found.append(_Depth.of(elements, first, uv, ~is_inner, groups))
        elements, element, uv = list(numbers), element_below, uv_below
    raise not_isolated(scheme, elements[0].signature, MOST_DEPTH + 1)


def _distinct(element: IntArray, uv: FloatArray) -> tuple[IntArray, FloatArray, IntArray]:
    """Different samples, sorted by their elements, and which of these each is."""
    order = np.lexsort((*uv.T, element))
    element, uv = element[order], uv[order]
    is_new = np.ones(len(order), dtype=bool)
    is_new[1:] = (element[1:] != element[:-1]) | (uv[1:] != uv[:-1]).any(axis=1)
    number = np.empty_like(order)
    number[order] = np.cumsum(is_new) - 1
    return element[is_new], uv[is_new], number


def _evaluate_pieces(scheme: Scheme, depths: list[_Depth]) -> None:
    """Find the weights of all samples that lie in pieces, those of the same patch together."""
    alike: dict[IrregularPatch | None, list[tuple[_Depth, int, Piece, IntArray]]] = {}
    for depth in depths:
        for number, each in enumerate(depth.elements):
            if each.piece is not None:
                in_piece = np.flatnonzero(depth.is_in_piece[depth.samples(number)])
                alike.setdefault(each.piece.patch, []).append((depth, number, each.piece, in_piece))
    for patch, pieces in alike.items():
        uv = [piece.domain(depth.uv[depth.first[number] + own]) for depth, number, piece, own in pieces]
        together = np.concatenate(uv)
        at_point = patch is not None and not scheme.domain.extent(together).any()
        if patch is not None and at_point and (limit := patch.limit_in_ring) is not None:
            weights, magnitude = (np.repeat(each[:, None], len(together), axis=1) for each in limit)
        else:
            limit = None
            weights, magnitude = _rows(scheme, patch, together)
        begin = 0
        for (depth, number, piece, own), own_uv in zip(pieces, uv, strict=True):
            within = slice(begin, begin + len(own_uv))
            begin = within.stop
            to_controls = piece.over_controls if limit is None else piece.scattered
            found = to_controls(weights[:, within])
            depth.stencils[number][:, own] = _by_parent(found, piece.domain.matrix)
            by_piece = magnitude[:, within] @ piece.absolute_sums
            if patch is not None:
                by_piece = CANCELLED * by_piece + np.abs(found[1:]).sum(axis=2)
            depth.frame_weights[:, depth.first[number] + own] = np.abs(piece.domain.matrix).T @ by_piece


def _is_beside_tip(scheme: Scheme, element: DividedElement, uv: FloatArray) -> NDArray[np.bool_] | bool:
    """Whether samples of an element lie in the first levels of a tip of high valence.

    To refine its one-ring takes less time and memory than an eigenbasis, which in open fans each face has for itself.
    """
    piece = element.piece
    if piece is None or piece.patch is None or piece.patch.limit_in_ring is None:
        return False
    return scheme.domain.extent(piece.domain(uv)) >= 2.0**-REFINED_LEVELS


def _rows(scheme: Scheme, patch: IrregularPatch | None, uv: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Rows of samples in a piece, over its control points or eigen-coordinates.

    Returns
    -------
    rows : (3, s, K_piece)
        Of the point, and of two tangents.
    magnitude : (2, s, K_piece)
        Absolute weights of the control points in these.
    """
    if patch is None:
        rows = scheme.regular_basis(uv, 1)
        return rows, np.abs(rows[1:])
    found = patch.rows(uv, "stabilized", np.float64, 1)
    rows = found.rows if found.frame is None else np.concatenate([found.rows[:1], found.frame])
    return rows, np.abs(rows[1:]) @ np.abs(patch.basis.inverse)


def _lift(above: _Depth, below: _Depth) -> None:
    """Find the weights of samples above that lie in children, which are elements below."""
    for element, number, samples, child, samples_below in above.groups:
        matrix = above.elements[element].domains[number].matrix
        rows = _by_parent(below.stencils[child][:, samples_below - below.first[child]], matrix)
        found = above.elements[element].over_controls(rows, number)
        above.stencils[element][:, samples - above.first[element]] = found
        above.frame_weights[:, samples] = np.abs(matrix).T @ below.frame_weights[:, samples_below]


def _by_parent(rows: FloatArray, matrix: FloatArray) -> FloatArray:
    """Rows of points and tangents ``(3, s, K)``, with the tangents by other parameters, of which these are a map."""
    turned: FloatArray = np.eye(3)
    turned[1:, 1:] = matrix.T
    return (turned @ rows.reshape(3, -1)).reshape(rows.shape)
