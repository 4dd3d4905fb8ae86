"""Samples in the leaves of patch trees: weights over the one-rings of their elements, and polynomials through them.

All evaluation at a face and (u, v) goes this way. A sample descends from its element, refinement by refinement, to the
leaf that contains it: a regular patch, or the patch around an extraordinary point. There its rows are those of the
scheme's regular basis, or of equations (10), (12) and (13). On the way back, rows over the one-ring of a child become
rows over the one-ring of its parent, by one matrix product for each child of a signature, shared by all elements.

Vertices of a tessellation are evaluated as polynomials (`sampled_polynomials`). In a regular piece, or in one of the
regular pieces around an extraordinary point, this is the polynomial of the piece. Where few samples lie in a piece,
each sample has its own tangent plane instead, which has fewer coefficients. Samples at extraordinary points, and near
them beyond the levels that are pieces, also have planes.
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

# Share of the absolute terms that `frame_magnitude` counts as weight. Weights of control points are sums over
# eigen-coordinates, whose large terms may cancel and leave rounding errors. Times `TANGENT_ROUNDING`, this share is at
# least one rounding error.
CANCELLED = 1 / 16
# A piece with fewer samples than this is replaced by a plane for each sample.
FEW_SAMPLES = 4
# Exponents of the monomials of a plane.
PLANE_POWERS = np.array([(0, 0), (1, 0), (0, 1)])


@dataclass(frozen=True, eq=False)
class _Depth:
    """Distinct elements at one depth of the patch trees, and their samples, sorted by element."""

    elements: list[PatchTree]
    first: IntArray  # (n + 1,) the first sample of each element; then the number of samples
    # One group for each child that contains samples: index of the element, number of the child, the samples; index of
    # the child among the elements of the next depth, and the same samples as numbered there.
    groups: list[tuple[int, int, IntArray, int, IntArray]]

    def samples(self, element: int) -> slice:
        return slice(int(self.first[element]), int(self.first[element + 1]))


@dataclass(frozen=True, eq=False)
class Leaves:
    """Samples in all leaves with the same irregular patch, or in all regular leaves."""

    patch: IrregularPatch | None
    uv: FloatArray  # (n, 2) parameters in the leaf
    # For each leaf: its depth, its index among the elements of this depth, its piece, its samples as numbered at this
    # depth, and their slice of `uv`.
    parts: list[tuple[int, int, Piece, IntArray, slice]]
    begin: int  # Number of the first sample, counted over all `Leaves`

    def rows(self, scheme: Scheme, evaluator: Evaluator, dtype: DTypeLike, derivatives: int) -> SampleRows:
        """Return rows over the eigen-coordinates; for regular patches and "power", over the control points."""
        if self.patch is not None:
            return self.patch.rows(self.uv, evaluator, dtype, derivatives)
        rows = scheme.regular_basis(self.uv.astype(dtype, copy=False), derivatives)
        count = len(self.uv)
        return SampleRows(rows, np.ones((2, count), dtype=dtype), np.zeros(count, dtype=np.int64))


class LocatedSamples:
    """Samples, and the leaves of patch trees that contain them.

    Raises SchemeError if refinement does not separate the irregularities of a one-ring, or a feature always stays
    semi-sharp.

    Attributes
    ----------
    leaf_sample : (s,) int64
        Number of each sample, counted through all `leaves`.
    path : (s,) int64
        Numbers of the children that contain each sample, as digits in base four below a leading one; the least
        significant digit is the child of the element. Two samples of an element lie in the same leaf if their paths are
        equal.
    jacobian : (2, 2, s) float64
        Derivatives of the leaf's parameters by the sample's (u, v).
    """

    def __init__(
        self,
        scheme: Scheme,
        elements: Sequence[PatchTree],  # All different
        element: IntArray,  # (s,) int64: index of each sample's element, in increasing order
        # (s, 2) float64: parameters with (0, 0) at the sample's corner, so that they are exact near it
        uv: FloatArray,
        corner: IntArray,  # (s,) int64: corner of the element at which (u, v) is (0, 0)
    ) -> None:
        self.scheme, self._given = scheme, (elements, element, uv, corner)
        self.leaves: list[Leaves] = []
        self._depths: list[_Depth] = []
        parts = self._descend(list(elements), element, uv, corner)
        self.leaf_sample, self.path, self.jacobian = self._ascend(parts, len(uv))

    def _descend(
        self, elements: list[PatchTree], element: IntArray, uv: FloatArray, turn: IntArray
    ) -> list[tuple[int, IntArray, IntArray]]:
        """Fill `_depths` and `leaves`; return depth, samples and turns of all `Leaves.parts`, in order."""
        scheme, domain = self.scheme, self.scheme.domain
        in_leaves: dict[IrregularPatch | None, list[tuple[int, int, Piece, IntArray, FloatArray, IntArray]]] = {}
        for depth in range(MOST_DEPTH + 1):
            first = ragged.offsets(np.bincount(element, minlength=len(elements)))
            kinds = np.array([tree.kind for tree in elements])
            leaf_turn = (turn + np.array([tree.turn for tree in elements])[element]) % domain.corner_count
            leaf_uv = _turned(scheme, uv, leaf_turn)
            for number, (tree, sample_range) in enumerate(zip(elements, pairwise(first.tolist()), strict=True)):
                if tree.piece is not None and sample_range[0] < sample_range[1]:
                    samples = slice(*sample_range)
                    row = depth, number, tree.piece, np.arange(*sample_range), leaf_uv[samples], leaf_turn[samples]
                    in_leaves.setdefault(tree.piece.patch, []).append(row)
            inner = np.flatnonzero(kinds[element] <= PartKind.ONLY_CHILD)
            if not len(inner):
                self._depths.append(_Depth(elements, first, []))
                break
            child, child_uv = domain.first_child(uv[inner].T)
            is_only = kinds[element[inner]] == PartKind.ONLY_CHILD
            # Children at corners are numbered from the element's first corner; the middle of a triangle comes last.
            corners = domain.corner_count
            child = np.where(child < corners, (child + turn[inner]) % corners, child)
            child, child_uv = np.where(is_only, 0, child), np.where(is_only, uv[inner].T, child_uv).T
            # Pairs of an element and the number of one of its children, as `4 * element + child`.
            pairs, pair = np.unique(4 * element[inner] + child, return_inverse=True)
            child_index: dict[PatchTree, int] = {}
            children = [
                child_index.setdefault(elements[key // 4].child_element(key % 4), len(child_index))
                for key in pairs.tolist()
            ]
            next_element, next_turn, next_uv, next_sample = _sorted(np.array(children)[pair], turn[inner], child_uv)
            pair_samples = np.split(np.argsort(pair, kind="stable"), np.cumsum(np.bincount(pair))[:-1])
            groups: list[tuple[int, int, IntArray, int, IntArray]] = [
                (key // 4, key % 4, inner[samples], index, next_sample[samples])
                for key, samples, index in zip(pairs.tolist(), pair_samples, children, strict=True)
            ]
            self._depths.append(_Depth(elements, first, groups))
            elements, element, uv, turn = list(child_index), next_element, next_uv, next_turn
        else:
            raise not_isolated(scheme, elements[0].signature, MOST_DEPTH + 1)
        return self._gather_leaves(in_leaves)

    def _gather_leaves(self, in_leaves: dict) -> list[tuple[int, IntArray, IntArray]]:
        all_parts, begin = [], 0
        for patch, rows in in_leaves.items():
            parts, end = [], 0
            for depth, number, piece, samples, _, turn in rows:
                parts.append((depth, number, piece, samples, slice(end, end + len(samples))))
                all_parts.append((depth, samples, turn))
                end += len(samples)
            self.leaves.append(Leaves(patch, np.concatenate([row[4] for row in rows]), parts, begin))
            begin += end
        return all_parts

    def _ascend(self, parts: list[tuple[int, IntArray, IntArray]], count: int) -> tuple[IntArray, IntArray, FloatArray]:
        """Return ``leaf_sample``, ``path`` and ``jacobian``; ``parts`` are the result of `_descend`."""
        domain = self.scheme.domain
        numbers = [np.empty(int(depth.first[-1]), dtype=np.int64) for depth in self._depths]
        paths = [np.ones(len(depth_numbers), dtype=np.int64) for depth_numbers in numbers]
        speeds = [np.ones(len(depth_numbers)) for depth_numbers in numbers]
        begin = 0
        for depth, samples, _ in parts:
            numbers[depth][samples] = np.arange(begin, begin + len(samples))
            begin += len(samples)
        for depth in range(len(self._depths) - 2, -1, -1):
            for element, number, samples, _, child_samples in self._depths[depth].groups:
                speed = self._depths[depth].elements[element].domains[number].matrix[0, 0]
                numbers[depth][samples] = numbers[depth + 1][child_samples]
                paths[depth][samples] = 4 * paths[depth + 1][child_samples] + number
                speeds[depth][samples] = speed * speeds[depth + 1][child_samples]
        turns = np.concatenate([turn for *_, turn in parts]) if parts else np.empty(0, dtype=np.int64)
        matrices = np.stack([domain.rotation(turn).matrix for turn in range(domain.corner_count)])
        rotations = matrices[turns[numbers[0]]] if count else np.empty((0, 2, 2))
        return numbers[0], paths[0], np.moveaxis(rotations * speeds[0][:, None, None], 0, -1)

    def chosen(self, which: IntArray) -> LocatedSamples:
        """Return a subset of the samples; ``which`` is in increasing order."""
        elements, element, uv, corner = self._given
        return LocatedSamples(self.scheme, elements, element[which], uv[which], corner[which])

    def rows(self, evaluator: Evaluator, dtype: DTypeLike, derivatives: int) -> list[SampleRows]:
        """Return `Leaves.rows` of all `leaves`."""
        return [leaves.rows(self.scheme, evaluator, dtype, derivatives) for leaves in self.leaves]

    def weights(self, of_leaves: Sequence[FloatArray], *, power: bool = False) -> list[FloatArray]:
        """Transform rows of leaves into weights over the one-rings of the elements.

        Returns list of (s_element, d, K) float64: one array for each element.

        Parameters
        ----------
        of_leaves : sequence of (d, n, K_leaf)
            Rows of the samples of each of the `leaves`, over eigen-coordinates, or control points of regular patches.
        power : bool
            Whether rows of irregular patches are over control points, too.
        """
        by_depth: list[list[FloatArray | None]] = [[None] * len(depth.elements) for depth in self._depths]

        def element_weights(depth: int, number: int, size: int) -> FloatArray:
            weights = by_depth[depth][number]
            if weights is None:
                current = self._depths[depth]
                count = int(current.first[number + 1] - current.first[number])
                weights = by_depth[depth][number] = np.empty((count, size, current.elements[number].control_count))
            return weights

        size = 0
        for leaves, leaf_rows in zip(self.leaves, of_leaves, strict=True):
            rows, size = leaf_rows.astype(np.float64, copy=False), len(leaf_rows)
            for depth, number, piece, _, uv_slice in leaves.parts:
                matrix = piece.stencils if power or piece.patch is None else piece.coordinates
                # An element that is a leaf has no samples in children, so this fills its array.
                times(rows[:, uv_slice], matrix, element_weights(depth, number, size).swapaxes(0, 1))
        for depth in range(len(self._depths) - 2, -1, -1):
            current, child_first = self._depths[depth], self._depths[depth + 1].first
            for element, number, samples, child, child_samples in current.groups:
                child_rows = element_weights(depth + 1, child, size).take(child_samples - child_first[child], axis=0)
                flat = child_rows.reshape(1, -1, child_rows.shape[2])
                parent_rows = times(flat, current.elements[element].child(number)[1]).reshape(*child_rows.shape[:2], -1)
                element_weights(depth, element, size)[samples - current.first[element]] = parent_rows
            by_depth[depth + 1] = []
        return [element_weights(0, number, size) for number in range(len(self._depths[0].elements))]

    def per_sample(self, of_leaves: Sequence[NDArray[Any]]) -> NDArray[Any]:
        """Reorder values ``(.., n)`` of the samples of each of the `leaves` to ``(.., s)``, the order of samples."""
        return np.concatenate(of_leaves, axis=-1)[..., self.leaf_sample]

    def is_in(self, leaves: Leaves) -> NDArray[np.bool_]:
        """Return ``(s,)``: whether samples lie in these leaves."""
        return (self.leaf_sample >= leaves.begin) & (self.leaf_sample < leaves.begin + len(leaves.uv))

    @property
    def leaf_uv(self) -> FloatArray:
        """``(s, 2)`` parameters in the leaves."""
        return np.concatenate([leaves.uv for leaves in self.leaves])[self.leaf_sample]

    def slices(self) -> Iterator[slice]:
        """Return the samples of each element."""
        return (self._depths[0].samples(number) for number in range(len(self._depths[0].elements)))


def frame_magnitude(leaves: Leaves, sample_rows: SampleRows) -> FloatArray:
    """Return ``(2, n)`` sums of the absolute weights of control points in the tangents of leaves, see `CANCELLED`."""
    tangents = sample_rows.tangents
    rows = np.abs(tangents)
    if leaves.patch is not None:
        rows = CANCELLED * times(rows, np.abs(leaves.patch.basis.inverse).astype(rows.dtype))
    magnitude = np.empty(rows.shape[:2], rows.dtype)
    for _, _, piece, _, uv_slice in leaves.parts:
        magnitude[:, uv_slice] = rows[:, uv_slice] @ piece.absolute_sums.astype(rows.dtype)
        if leaves.patch is not None:
            magnitude[:, uv_slice] += np.abs(times(tangents[:, uv_slice], piece.coordinates)).sum(axis=2)
    return magnitude


def without_collapsed(tangents: FloatArray, magnitude: FloatArray) -> None:
    """Set weights ``(2, s, K)`` of tangents to zero where they cancel, as on the fold between faces back to back."""
    tangents[np.abs(tangents).sum(axis=2) <= TANGENT_ROUNDING[64] * magnitude] = 0


def _turned(scheme: Scheme, uv: FloatArray, turn: IntArray) -> FloatArray:
    """Return parameters with (0, 0) at the first corner, from ``uv`` with (0, 0) at the corner ``turn``."""
    turned = uv.copy()
    for corner in np.flatnonzero(np.bincount(turn)[1:]) + 1:
        is_turned = turn == corner
        turned[is_turned] = scheme.domain.rotation(int(corner))(uv[is_turned])
    return turned


def _sorted(element: IntArray, turn: IntArray, uv: FloatArray) -> tuple[IntArray, IntArray, FloatArray, IntArray]:
    """Return samples sorted by element, and the new index of each sample."""
    order = np.argsort(element.astype(np.min_scalar_type(element.max(initial=0))), kind="stable")
    number = np.empty_like(order)
    number[order] = np.arange(len(order))
    return element[order], turn[order], uv[order], number


class Polynomials(NamedTuple):
    """Polynomials in the same monomials, and the samples that they evaluate."""

    # list of (p, m, K) float64, for each element: map control points to the coefficients of its p polynomials
    rows: list[FloatArray]
    # (s,) int64: polynomial of each sample, counted through all elements; -1 for a sample without one
    polynomial: IntArray
    st: FloatArray  # (s, 2) float64: parameters of each sample in its polynomial, relative to the domain's middle


def sampled_polynomials(
    scheme: Scheme,
    elements: Sequence[PatchTree],  # All different
    uv: Sequence[FloatArray],  # (s_element, 2) float64: samples of each element
) -> tuple[Polynomials, Polynomials]:
    """Return planes, and polynomials of the scheme's `PolynomialBasis`, that evaluate samples.

    Each sample has one of the two. Normals are along the cross product of the derivatives. The derivatives of planes
    are tangents of any length.

    Raises SchemeError if refinement does not separate the irregularities of a one-ring, or a feature always stays
    semi-sharp.
    """
    element = np.repeat(np.arange(len(elements)), [len(element_uv) for element_uv in uv])
    located = LocatedSamples(scheme, elements, element, np.concatenate(uv), 0 * element)
    numbers, parameters = zip(*(_in_pieces(scheme, leaves) for leaves in located.leaves), strict=True)
    number, st = located.per_sample(numbers), located.per_sample(parameters).T
    # Sorted so that the samples of a piece are consecutive.
    order = np.lexsort((number, located.path, element))
    keys = np.stack([element, located.path, number])[:, order]
    begins = np.flatnonzero((np.diff(keys, axis=1, prepend=-2) != 0).any(axis=0))
    counts = np.diff(begins, append=len(order))
    has_plane = (number[order[begins]] < 0) | (counts < FEW_SAMPLES)
    in_planes = np.sort(order[np.repeat(has_plane, counts)])
    # The first sample of each piece stands for it. The sort is stable, so that first samples are in the order of
    # elements.
    in_pieces, first = order[~np.repeat(has_plane, counts)], order[begins[~has_plane]]
    plane, piece = np.full((2, len(element)), -1)
    plane[in_planes] = np.arange(len(in_planes))
    piece[in_pieces] = np.repeat(np.arange(len(first)), counts[~has_plane])
    return (
        Polynomials(_planes(located.chosen(in_planes)), plane, 0 * st),
        Polynomials(_pieces(located.chosen(first)), piece, st),
    )


def _in_pieces(scheme: Scheme, leaves: Leaves) -> tuple[IntArray, FloatArray]:
    """Return the piece of each sample, -1 for samples that need a plane, and ``(2, n)`` parameters in the piece.

    Parameters are relative to the middle of the domain.
    """
    local, number = leaves.uv, np.zeros(len(leaves.uv), dtype=np.int64)
    if leaves.patch is not None:
        level, child, local = locate(scheme.domain, leaves.uv)
        has_piece = (level < PIECE_LEVELS) & (scheme.domain.extent(leaves.uv) > 0)
        number = np.where(has_piece, LEVEL_PIECES * level + child, -1)
    return number, (local - scheme.domain.centre).T


def _planes(samples: LocatedSamples) -> list[FloatArray]:
    """Return ``(p, 3, K)`` coefficients of a plane through each sample, for each element."""
    rows = samples.rows("stabilized", np.float64, 1)
    planes = samples.weights([np.concatenate([leaf_rows.rows[:1], leaf_rows.tangents]) for leaf_rows in rows])
    if rows:
        magnitude = samples.per_sample([frame_magnitude(*pair) for pair in zip(samples.leaves, rows, strict=True)])
        for element_planes, element_samples in zip(planes, samples.slices(), strict=True):
            without_collapsed(element_planes[:, 1:].swapaxes(0, 1), magnitude[:, element_samples])
    return planes


def _pieces(samples: LocatedSamples) -> list[FloatArray]:
    """Return ``(p, m, K)`` coefficients of the piece that contains each sample, for each element."""
    scheme, rows = samples.scheme, []
    for leaves in samples.leaves:
        if leaves.patch is None:
            matrix = polynomial_basis(scheme).matrix[:, None]
            rows.append(np.broadcast_to(matrix, (len(matrix), len(leaves.uv), matrix.shape[2])))
        else:
            polynomials = level_polynomials(scheme, leaves.patch, PIECE_LEVELS)
            rows.append(polynomials[_in_pieces(scheme, leaves)[0]].swapaxes(0, 1))
    return samples.weights(rows)
