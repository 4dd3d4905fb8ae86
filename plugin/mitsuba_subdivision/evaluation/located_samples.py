"""Samples in the leaves of patch trees: weights over the one-rings of their elements, and polynomials that hold them.

This is the one way from a face and (u, v) to the surface. A sample descends from its element, refinement by refinement,
to the leaf that it lies in: a regular patch, or the patch around an extraordinary point. There its rows are those of
the scheme's regular basis, or of equations (10), (12) and (13). On the way back, rows over the one-ring of a child
become rows over that of its parent, by one product for each child of a signature, whatever elements it belongs to.

Vertices of a tessellation need polynomials that hold them (`sampled_polynomials`). In a regular piece, or one of the
regular pieces around an extraordinary point, these are the piece's own. Where few samples lie in a piece, each has a
polynomial of its own instead, the plane through its point along its two tangents, which has fewer coefficients. So have
samples at extraordinary points, and near them beyond the levels that are pieces.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import DTypeLike, NDArray

from ..mesh import ragged
from ..mesh.connectivity import IntArray
from ..schemes.domain import FloatArray
from ..schemes.scheme import Scheme
from .equations import Evaluator, SampleRows, locate, times
from .irregular_patch import IrregularPatch
from .normals import TANGENT_ROUNDING
from .patch_tree import MOST_DEPTH, PartKind, PatchTree, Piece, not_isolated
from .polynomials import polynomial_basis
from .tree_arrays import LEVEL_PIECES, PIECE_LEVELS, level_polynomials

# Weights of control points are sums over eigen-coordinates, in which large terms may cancel. Cancelled terms leave
# rounding errors. So this part of them counts as weight: times `TANGENT_ROUNDING` that is one rounding error, or more.
CANCELLED = 1 / 16


@dataclass(frozen=True, eq=False)
class _Depth:
    """Elements after so many refinements, all different, and the samples in them, sorted by these."""

    elements: list[PatchTree]
    first: IntArray  # (n + 1,) the first sample of each element; then the number of samples
    # Samples in the same child of an element, for all but those in leaves: the element, the child's number, the
    # samples; the child's index among the elements of the next depth, and the samples there.
    groups: list[tuple[int, int, IntArray, int, IntArray]]

    def samples(self, element: int) -> slice:
        return slice(int(self.first[element]), int(self.first[element + 1]))


@dataclass(frozen=True, eq=False)
class Leaves:
    """Samples in leaves of the same patch, or in regular ones."""

    patch: IrregularPatch | None
    uv: FloatArray  # (n, 2) parameters in the leaf
    # The depth, the element there, its piece, its samples there, and where these are among those of the leaves.
    parts: list[tuple[int, int, Piece, IntArray, slice]]
    begin: int  # Number of the first sample, over the leaves of all patches.

    def rows(self, scheme: Scheme, evaluator: Evaluator, dtype: DTypeLike, derivatives: int) -> SampleRows:
        """Rows over the eigen-coordinates, or the control points of regular patches and for "power"."""
        if self.patch is not None:
            return self.patch.rows(self.uv, evaluator, dtype, derivatives)
        rows = scheme.regular_basis(self.uv.astype(dtype, copy=False), derivatives)
        count = len(self.uv)
        return SampleRows(rows, np.ones((2, count), dtype=dtype), np.zeros(count, dtype=np.int64))


class LocatedSamples:
    """The leaves in which samples lie.

    Raises SchemeError if refinement does not separate the irregularities of a one-ring, or something always stays
    semi-sharp.

    Attributes
    ----------
    leaf_sample : (s,) int64
        Number of each sample among those of all leaves.
    path : (s,) int64
        Of each sample the numbers of the children that it lies in: the digits of base four after a one, the last of
        them first. Two samples of an element lie in the same leaf if they have the same path.
    jacobian : (2, 2, s) float64
        Derivatives of the parameters in the leaf by the sample's own.
    """

    def __init__(
        self,
        scheme: Scheme,
        elements: Sequence[PatchTree],  # All different
        element: IntArray,  # (s,) int64: index of each sample's element, in increasing order
        uv: FloatArray,  # (s, 2) float64: parameters, with (0, 0) at the sample's corner. They stay exact near it.
        corner: IntArray,  # (s,) int64
    ) -> None:
        self.scheme, self._given = scheme, (elements, element, uv, corner)
        self.leaves: list[Leaves] = []
        self._depths: list[_Depth] = []
        found = self._descend(list(elements), element, uv, corner)
        self.leaf_sample, self.path, self.jacobian = self._ascend(found, len(uv))

    def _descend(
        self, elements: list[PatchTree], element: IntArray, uv: FloatArray, turn: IntArray
    ) -> list[tuple[int, IntArray, IntArray]]:
        """Fill the depths and the leaves; the depth, the samples and the turns of each part of the leaves, in order."""
        scheme, domain = self.scheme, self.scheme.domain
        in_leaves: dict[IrregularPatch | None, list[tuple[int, int, Piece, IntArray, FloatArray, IntArray]]] = {}
        for depth in range(MOST_DEPTH + 1):
            first = ragged.offsets(np.bincount(element, minlength=len(elements)))
            kinds = np.array([each.kind for each in elements])
            total = (turn + np.array([each.turn for each in elements])[element]) % domain.corner_count
            turned = _turned(scheme, uv, total)
            for number, (each, own) in enumerate(zip(elements, pairwise(first.tolist()), strict=True)):
                if each.piece is not None and own[0] < own[1]:
                    at = slice(*own)
                    row = depth, number, each.piece, np.arange(*own), turned[at], total[at]
                    in_leaves.setdefault(each.piece.patch, []).append(row)
            inner = np.flatnonzero(kinds[element] <= PartKind.ONLY_CHILD)
            if not len(inner):
                self._depths.append(_Depth(elements, first, []))
                break
            child, in_child = domain.first_child(uv[inner].T)
            is_only = kinds[element[inner]] == PartKind.ONLY_CHILD
            # Copies at corners are counted from the first one; that in the middle of a triangle comes after them.
            corners = domain.corner_count
            child = np.where(child < corners, (child + turn[inner]) % corners, child)
            child, in_child = np.where(is_only, 0, child), np.where(is_only, uv[inner].T, in_child).T
            pairs, pair = np.unique(4 * element[inner] + child, return_inverse=True)
            numbers: dict[PatchTree, int] = {}
            below = [
                numbers.setdefault(elements[key // 4].child_element(key % 4), len(numbers)) for key in pairs.tolist()
            ]
            element_below, turn_below, uv_below, at_below = _sorted(np.array(below)[pair], turn[inner], in_child)
            in_pairs = np.split(np.argsort(pair, kind="stable"), np.cumsum(np.bincount(pair))[:-1])
            groups: list[tuple[int, int, IntArray, int, IntArray]] = [
                (number // 4, number % 4, inner[own], own_below, at_below[own])
                for number, own, own_below in zip(pairs.tolist(), in_pairs, below, strict=True)
            ]
            self._depths.append(_Depth(elements, first, groups))
            elements, element, uv, turn = list(numbers), element_below, uv_below, turn_below
        else:
            raise not_isolated(scheme, elements[0].signature, MOST_DEPTH + 1)
        return self._gather_leaves(in_leaves)

    def _gather_leaves(self, in_leaves: dict) -> list[tuple[int, IntArray, IntArray]]:
        found, begin = [], 0
        for patch, rows in in_leaves.items():
            parts, end = [], 0
            for depth, number, piece, samples, _, turn in rows:
                parts.append((depth, number, piece, samples, slice(end, end + len(samples))))
                found.append((depth, samples, turn))
                end += len(samples)
            self.leaves.append(Leaves(patch, np.concatenate([row[4] for row in rows]), parts, begin))
            begin += end
        return found

    def _ascend(self, found: list[tuple[int, IntArray, IntArray]], count: int) -> tuple[IntArray, IntArray, FloatArray]:
        """``leaf_sample``, ``path`` and ``jacobian``."""
        domain = self.scheme.domain
        numbers = [np.empty(int(depth.first[-1]), dtype=np.int64) for depth in self._depths]
        paths = [np.ones(len(each), dtype=np.int64) for each in numbers]
        speeds = [np.ones(len(each)) for each in numbers]
        begin = 0
        for depth, samples, _ in found:
            numbers[depth][samples] = np.arange(begin, begin + len(samples))
            begin += len(samples)
        for depth in range(len(self._depths) - 2, -1, -1):
            for element, number, samples, _, below in self._depths[depth].groups:
                speed = self._depths[depth].elements[element].domains[number].matrix[0, 0]
                numbers[depth][samples] = numbers[depth + 1][below]
                paths[depth][samples] = 4 * paths[depth + 1][below] + number
                speeds[depth][samples] = speed * speeds[depth + 1][below]
        turns = np.concatenate([turn for *_, turn in found]) if found else np.empty(0, dtype=np.int64)
        matrices = np.stack([domain.rotation(turn).matrix for turn in range(domain.corner_count)])
        rotations = matrices[turns[numbers[0]]] if count else np.empty((0, 2, 2))
        return numbers[0], paths[0], np.moveaxis(rotations * speeds[0][:, None, None], 0, -1)

    def chosen(self, which: IntArray) -> LocatedSamples:
        """Some of the samples, in increasing order."""
        elements, element, uv, corner = self._given
        return LocatedSamples(self.scheme, elements, element[which], uv[which], corner[which])

    def rows(self, evaluator: Evaluator, dtype: DTypeLike, derivatives: int) -> list[SampleRows]:
        """`Leaves.rows` of all leaves."""
        return [leaves.rows(self.scheme, evaluator, dtype, derivatives) for leaves in self.leaves]

    def weights(self, of_leaves: Sequence[FloatArray], *, power: bool = False) -> list[FloatArray]:
        """Rows of leaves as weights over the one-rings of the elements.

        Returns list of (s_element, d, K) float64: for each element.

        Parameters
        ----------
        of_leaves : sequence of (d, n, K_leaf)
            For each of the `leaves` the rows of its samples, over eigen-coordinates or regular control points.
        power : bool
            Whether rows are over the control points of irregular patches, too.
        """
        by_depth: list[list[FloatArray | None]] = [[None] * len(depth.elements) for depth in self._depths]

        def over(depth: int, number: int, size: int) -> FloatArray:
            found = by_depth[depth][number]
            if found is None:
                at = self._depths[depth]
                count = int(at.first[number + 1] - at.first[number])
                found = by_depth[depth][number] = np.empty((count, size, at.elements[number].control_count))
            return found

        size = 0
        for leaves, own in zip(self.leaves, of_leaves, strict=True):
            rows, size = own.astype(np.float64, copy=False), len(own)
            for depth, number, piece, _, at in leaves.parts:
                matrix = piece.stencils if power or piece.patch is None else piece.coordinates
                # All samples of an element lie in it, if it is a leaf.
                times(rows[:, at], matrix, over(depth, number, size).swapaxes(0, 1))
        for depth in range(len(self._depths) - 2, -1, -1):
            above = self._depths[depth]
            for element, number, samples, child, below in above.groups:
                rows_below = over(depth + 1, child, size).take(below - self._depths[depth + 1].first[child], axis=0)
                flat = rows_below.reshape(1, -1, rows_below.shape[2])
                found = times(flat, above.elements[element].child(number)[1]).reshape(*rows_below.shape[:2], -1)
                over(depth, element, size)[samples - above.first[element]] = found
            by_depth[depth + 1] = []
        return [over(0, number, size) for number in range(len(self._depths[0].elements))]

    def per_sample(self, of_leaves: Sequence[NDArray[Any]]) -> NDArray[Any]:
        """Numbers ``(.., n)`` of the samples of all leaves, for the samples ``(.., s)``."""
        return np.concatenate(of_leaves, axis=-1)[..., self.leaf_sample]

    def is_in(self, leaves: Leaves) -> NDArray[np.bool_]:
        """``(s,)`` whether samples lie in some leaves."""
        return (self.leaf_sample >= leaves.begin) & (self.leaf_sample < leaves.begin + len(leaves.uv))

    @property
    def leaf_uv(self) -> FloatArray:
        """``(s, 2)`` parameters in the leaves."""
        return np.concatenate([leaves.uv for leaves in self.leaves])[self.leaf_sample]

    def slices(self) -> Iterator[slice]:
        """Samples of each element."""
        return (self._depths[0].samples(number) for number in range(len(self._depths[0].elements)))


def frame_magnitude(leaves: Leaves, sample_rows: SampleRows) -> FloatArray:
    """Sums ``(2, n)`` of the absolute weights of control points in the tangents of leaves, see `CANCELLED`."""
    tangents = sample_rows.tangents
    rows = np.abs(tangents)
    if leaves.patch is not None:
        rows = CANCELLED * times(rows, np.abs(leaves.patch.basis.inverse).astype(rows.dtype))
    found = np.empty(rows.shape[:2], rows.dtype)
    for _, _, piece, _, at in leaves.parts:
        found[:, at] = rows[:, at] @ piece.absolute_sums.astype(rows.dtype)
        if leaves.patch is not None:
            found[:, at] += np.abs(times(tangents[:, at], piece.coordinates)).sum(axis=2)
    return found


def without_collapsed(tangents: FloatArray, magnitude: FloatArray) -> None:
    """Set weights ``(2, s, K)`` of tangents to zero where they cancel, as on the fold between faces back to back."""
    tangents[np.abs(tangents).sum(axis=2) <= TANGENT_ROUNDING[64] * magnitude] = 0


def _turned(scheme: Scheme, uv: FloatArray, turn: IntArray) -> FloatArray:
    """Parameters seen from the first corner, from those seen from later ones."""
    found = uv.copy()
    for corner in np.flatnonzero(np.bincount(turn)[1:]) + 1:
        at = turn == corner
        found[at] = scheme.domain.rotation(int(corner))(uv[at])
    return found


def _sorted(element: IntArray, turn: IntArray, uv: FloatArray) -> tuple[IntArray, IntArray, FloatArray, IntArray]:
    """Samples sorted by their elements, and where each of those given comes."""
    order = np.argsort(element.astype(np.min_scalar_type(element.max(initial=0))), kind="stable")
    number = np.empty_like(order)
    number[order] = np.arange(len(order))
    return element[order], turn[order], uv[order], number


# Fewer samples of a piece have planes.
FEW_SAMPLES = 4
# Exponents of the monomials of a plane.
PLANE_POWERS = np.array([(0, 0), (1, 0), (0, 1)])


class Polynomials(NamedTuple):
    """Polynomials of the same monomials, and the samples that they hold."""

    # list of (p, m, K) float64, for each element: times control points, the coefficients of each of its polynomials
    rows: list[FloatArray]
    # (s,) int64: which of them holds each sample, counted through all elements; -1 where none does
    polynomial: IntArray
    st: FloatArray  # (s, 2) float64: parameters of each sample there, from the middle of the domain


def sampled_polynomials(
    scheme: Scheme,
    elements: Sequence[PatchTree],  # All different
    uv: Sequence[FloatArray],  # (s, 2) float64: samples of each
) -> tuple[Polynomials, Polynomials]:
    """Planes, and polynomials of the scheme's `PolynomialBasis`, that hold samples.

    Normals are along the cross product of the derivatives. Those of planes are tangents of any length.

    Raises SchemeError if refinement does not separate the irregularities of a one-ring, or something always stays
    semi-sharp.
    """
    element = np.repeat(np.arange(len(elements)), [len(own) for own in uv])
    located = LocatedSamples(scheme, elements, element, np.concatenate(uv), 0 * element)
    numbers, parameters = zip(*(_in_pieces(scheme, leaves) for leaves in located.leaves), strict=True)
    number, st = located.per_sample(numbers), located.per_sample(parameters).T
    # Samples of an element that lie in the same piece follow each other.
    order = np.lexsort((number, located.path, element))
    keys = np.stack([element, located.path, number])[:, order]
    begins = np.flatnonzero((np.diff(keys, axis=1, prepend=-2) != 0).any(axis=0))
    counts = np.diff(begins, append=len(order))
    has_plane = (number[order[begins]] < 0) | (counts < FEW_SAMPLES)
    in_planes = np.sort(order[np.repeat(has_plane, counts)])
    # A piece is found at the first of its samples. The sort is stable, so that these come in the order of elements.
    in_pieces, first = order[~np.repeat(has_plane, counts)], order[begins[~has_plane]]
    plane, piece = np.full((2, len(element)), -1)
    plane[in_planes] = np.arange(len(in_planes))
    piece[in_pieces] = np.repeat(np.arange(len(first)), counts[~has_plane])
    return (
        Polynomials(_planes(located.chosen(in_planes)), plane, 0 * st),
        Polynomials(_pieces(located.chosen(first)), piece, st),
    )


def _in_pieces(scheme: Scheme, leaves: Leaves) -> tuple[IntArray, FloatArray]:
    """Of the samples in some leaves, numbers of their pieces, -1 where they have planes; ``(2, n)`` parameters there.

    Parameters are from the middle of the domain.
    """
    local, number = leaves.uv, np.zeros(len(leaves.uv), dtype=np.int64)
    if leaves.patch is not None:
        level, child, local = locate(scheme.domain, leaves.uv)
        has_piece = (level < PIECE_LEVELS) & (scheme.domain.extent(leaves.uv) > 0)
        number = np.where(has_piece, LEVEL_PIECES * level + child, -1)
    return number, (local - scheme.domain.centre).T


def _planes(samples: LocatedSamples) -> list[FloatArray]:
    """Coefficients ``(p, 3, K)`` of a plane through each sample, for each element."""
    rows = samples.rows("stabilized", np.float64, 1)
    found = samples.weights([np.concatenate([each.rows[:1], each.tangents]) for each in rows])
    if rows:
        magnitude = samples.per_sample([frame_magnitude(*each) for each in zip(samples.leaves, rows, strict=True)])
        for own, at in zip(found, samples.slices(), strict=True):
            without_collapsed(own[:, 1:].swapaxes(0, 1), magnitude[:, at])
    return found


def _pieces(samples: LocatedSamples) -> list[FloatArray]:
    """Coefficients ``(p, m, K)`` of the piece that each sample lies in, for each element."""
    scheme, rows = samples.scheme, []
    for leaves in samples.leaves:
        if leaves.patch is None:
            matrix = polynomial_basis(scheme).matrix[:, None]
            rows.append(np.broadcast_to(matrix, (len(matrix), len(leaves.uv), matrix.shape[2])))
        else:
            polynomials = level_polynomials(scheme, leaves.patch, PIECE_LEVELS)
            rows.append(polynomials[_in_pieces(scheme, leaves)[0]].swapaxes(0, 1))
    return samples.weights(rows)
