"""Limit stencils of the same samples on elements of many signatures, in passes over all of these.

Samples walk down to the pieces that they lie in, depth by depth. Where parts of different elements have the same
signature and samples at the same parameters, both go on as one. At the pieces all samples of a kind are evaluated
together. On the way back up, weights over the control points of a part become weights over those of its parent, by one
product for each child of a signature.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import TYPE_CHECKING

import numpy as np

from ..mesh import ragged
from ..mesh.connectivity import IntArray
from ..mesh.signature import Signature
from ..schemes.domain import IDENTITY, FloatArray
from ..schemes.scheme import Scheme
from .divided_element import MOST_DEPTH, DividedElement, divide_once, element_of
from .element import without_collapsed
from .irregular_patch import IrregularPatch
from .occupied_pieces import CANCELLED, not_isolated

if TYPE_CHECKING:
    from .ring_mesh import RingMesh

# Stencils of more weights than these are not kept. The others take 16 MB at most.
KEPT_WEIGHTS = 1 << 17


def stencils_together(scheme: Scheme, signatures: Sequence[Signature], uv: FloatArray) -> list[FloatArray]:
    """What `element_stencils` has of the same samples on elements of some signatures, seen from their first corners.

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
    """As `stencils_together`, of other samples on each element.

    Parameters
    ----------
    signatures : sequence of Signature
        All different.
    counts : sequence of int
        How many samples each element has.
    uv : (s, 2) float64
        Samples of all elements, one element after the other.
    """
    elements = [element_of(scheme, signature) for signature in signatures]
    return _stencils(scheme, elements, np.repeat(np.arange(len(elements)), counts), uv)


def _same_samples(scheme: Scheme, elements: list[DividedElement], uv: FloatArray) -> list[FloatArray]:
    """`stencils_together`; elements that are asked for more than once are evaluated once."""
    different = list(dict.fromkeys(elements))
    element, local = np.repeat(np.arange(len(different)), len(uv)), np.tile(uv, (len(different), 1))
    found = dict(zip(different, _stencils(scheme, different, element, local), strict=True))
    return [found[element] for element in elements]


def _stencils(scheme: Scheme, elements: list[DividedElement], element: IntArray, uv: FloatArray) -> list[FloatArray]:
    """Stencils of samples on different elements, sorted by these."""
    depths = _depths(scheme, elements, element, uv)
    weights = [_Weights.none(depth) for depth in depths]
    _evaluate_pieces(scheme, depths, weights)
    for number in range(len(depths) - 1, 0, -1):
        _lift(depths[number - 1], weights[number - 1], depths[number], weights[number])
    first = weights[0]
    for number, stencils in enumerate(first.stencils):
        without_collapsed(stencils[1:], first.frame_weights[:, depths[0].samples(number)])
        stencils.flags.writeable = False
    return first.stencils


@dataclass(frozen=True, eq=False)
class _Run:
    """Samples that lie in the same child of an element.

    Attributes
    ----------
    element, child : int
        Numbers of the element and of its child.
    samples : (m,) int64
    below : int
        Number of the child among the elements of the next depth.
    samples_below : (m,) int64
        Numbers of the samples there.
    """

    element: int
    child: int
    samples: IntArray
    below: int
    samples_below: IntArray


@dataclass(frozen=True, eq=False)
class _Depth:
    """Parts of elements after so many refinements, of different signatures, and the different samples in them.

    Attributes
    ----------
    elements : list of n DividedElement
    first : (n + 1,) int64
        The first sample of each, after which come its others; and the number of samples.
    local : (s, 2) float64
        Parameters in the part.
    runs : list of _Run
        All samples that do not lie in pieces.
    """

    elements: list[DividedElement]
    first: IntArray
    local: FloatArray
    runs: list[_Run]

    def samples(self, element: int) -> slice:
        return slice(int(self.first[element]), int(self.first[element + 1]))


def _depths(scheme: Scheme, elements: list[DividedElement], element: IntArray, local: FloatArray) -> list[_Depth]:
    """Samples on the way to their pieces: first the elements, then what each refinement makes of them."""
    mesh: RingMesh | None = None
    found: list[_Depth] = []
    for _ in range(MOST_DEPTH + 1):
        mesh = divide_once(scheme, elements, mesh)
        first = ragged.offsets(np.bincount(element, minlength=len(elements)))
        inner = np.flatnonzero(np.array([each.piece is None for each in elements])[element])
        if not len(inner):
            return [*found, _Depth(elements, first, local, [])]
        child, in_child = _first_inside(scheme, elements, element[inner], local[inner])
        pairs, pair = np.unique(4 * element[inner] + child, return_inverse=True)
        numbers: dict[DividedElement, int] = {}
        below = [numbers.setdefault(elements[key // 4].child(key % 4).element, len(numbers)) for key in pairs.tolist()]
        element_below, local_below, number = _distinct(np.array(below)[pair], in_child)
        in_pairs = np.split(np.argsort(pair, kind="stable"), np.cumsum(np.bincount(pair))[:-1])
        runs = [
            _Run(key // 4, key % 4, inner[own], own_below, number[own])
            for key, own, own_below in zip(pairs.tolist(), in_pairs, below, strict=True)
        ]
        found.append(_Depth(elements, first, local, runs))
        elements, element, local = list(numbers), element_below, local_below
    raise not_isolated(scheme, elements[0].signature, MOST_DEPTH + 1)


def _first_inside(
    scheme: Scheme, elements: list[DividedElement], element: IntArray, local: FloatArray
) -> tuple[IntArray, FloatArray]:
    """The first child of its element that each sample lies in, and its parameters there."""
    # An only child stands for all four, and pieces are not asked for.
    maps = [([copy.into for copy in each.copies] or [IDENTITY]) * 4 for each in elements]
    matrices = np.array([[into.matrix for into in each[:4]] for each in maps])[element]
    offsets = np.array([[into.offset for into in each[:4]] for each in maps])[element]
    found = matrices[..., 0] * local[:, None, None, 0] + matrices[..., 1] * local[:, None, None, 1] + offsets
    child = np.argmax(scheme.domain.inside(found), axis=1)
    return child, found[np.arange(len(child)), child]


def _distinct(element: IntArray, local: FloatArray) -> tuple[IntArray, FloatArray, IntArray]:
    """Different samples, sorted by their elements, and which of these each is."""
    order = np.lexsort((*local.T, element))
    element, local = element[order], local[order]
    is_new = np.ones(len(order), dtype=bool)
    is_new[1:] = (element[1:] != element[:-1]) | (local[1:] != local[:-1]).any(axis=1)
    number = np.empty_like(order)
    number[order] = np.cumsum(is_new) - 1
    return element[is_new], local[is_new], number


@dataclass(frozen=True, eq=False)
class _Weights:
    """Weights of samples over the control points of their parts.

    Attributes
    ----------
    stencils : list of (3, s_element, K) float64
        Of the points, and of two tangents by the part's parameters, for each element.
    frame_weights : (2, s) float64
        As `PieceGroup.absolute_weights`, or more: absolute weights are added up at the pieces, where what cancels
        above is not yet known.
    """

    stencils: list[FloatArray]
    frame_weights: FloatArray

    @classmethod
    def none(cls, depth: _Depth) -> _Weights:
        """Weights that are not yet known."""
        counts = np.diff(depth.first).tolist()
        pairs = zip(depth.elements, counts, strict=True)
        return cls([np.empty((3, n, each.control_count)) for each, n in pairs], np.empty((2, len(depth.local))))


def _evaluate_pieces(scheme: Scheme, depths: list[_Depth], weights: list[_Weights]) -> None:
    """Find the weights of all samples in elements that are pieces."""
    places: dict[IrregularPatch | None, list[tuple[int, int]]] = {}
    for depth, of_depth in enumerate(depths):
        for number, each in enumerate(of_depth.elements):
            if each.piece is not None:
                places.setdefault(each.tips[0].patch if each.tips else None, []).append((depth, number))
    for patch, own in places.items():
        at = [(depths[depth], weights[depth], number) for depth, number in own]
        local = [of.elements[number].own_piece.domain(of.local[of.samples(number)]) for of, _, number in at]
        rows, magnitude = _rows(scheme, patch, np.concatenate(local))
        begin = 0
        for (of, found, number), uv in zip(at, local, strict=True):
            run = slice(begin, begin + len(uv))
            begin = run.stop
            piece, element = of.elements[number].own_piece, of.elements[number]
            sums = np.abs(piece.stencils).sum(axis=1)
            seen = _by_parent(rows[:, run], piece.domain.matrix)
            found.stencils[number][:] = seen @ (piece.stencils if patch is None else element.tips[0].coordinates)
            by_piece = magnitude[:, run] @ sums
            if patch is not None:
                by_piece = CANCELLED * by_piece + np.abs(rows[1:, run] @ element.tips[0].coordinates).sum(axis=2)
            found.frame_weights[:, of.samples(number)] = np.abs(piece.domain.matrix).T @ by_piece


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


def _lift(above: _Depth, found: _Weights, below: _Depth, known: _Weights) -> None:
    """Find the weights of samples above that lie in children, which are elements below."""
    for run in above.runs:
        element = above.elements[run.element]
        child, matrix = element.child(run.child), element.copies[run.child].into.matrix
        rows = known.stencils[run.below][:, run.samples_below - below.first[run.below]]
        rows = _by_parent(rows, matrix) @ child.stencils
        found.stencils[run.element][:, run.samples - above.first[run.element]] = rows
        found.frame_weights[:, run.samples] = np.abs(matrix).T @ known.frame_weights[:, run.samples_below]


def _by_parent(rows: FloatArray, matrix: FloatArray) -> FloatArray:
    """Rows of points and tangents ``(3, s, K)``, with the tangents by other parameters, of which these are a map."""
    turned: FloatArray = np.eye(3)
    turned[1:, 1:] = matrix.T
    return (turned @ rows.reshape(3, -1)).reshape(rows.shape)
