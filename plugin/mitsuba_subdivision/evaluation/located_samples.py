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
from .equations import Evaluator, SampleRows, locate, times_matrix
from .irregular_patch import LEVEL_PIECES, PIECE_LEVELS, IrregularPatch, level_polynomials
from .normals import TANGENT_ROUNDING
from .patch_tree import MOST_DEPTH, PartKind, PatchTree, Piece, divide, not_isolated
from .polynomials import polynomial_basis

# Share of the absolute terms that `frame_magnitude` counts as weight, as large terms of sums over eigen-coordinates may
# cancel and leave rounding errors. Times `TANGENT_ROUNDING`, this share is at least one rounding error.
CANCELLED = 1 / 16
FEW_SAMPLES = 4  # A piece with fewer samples than this is replaced by a plane for each sample
PLANE_POWERS = np.array([(0, 0), (1, 0), (0, 1)])  # Exponents of the monomials of a plane


# A node of the patch trees with samples: its tree; its number of samples, which are in increasing order at depth 0, and
# parent by parent below; and for each child that contains samples its number, its index among the nodes of the next
# depth, and the indices of its samples among those of this node.
Node = tuple[PatchTree, int, list[tuple[int, int, IntArray]]]


@dataclass(frozen=True, eq=False)
class Leaves:
    """Samples in all leaves with the same irregular patch, or in all regular leaves."""

    patch: IrregularPatch | None
    uv: FloatArray  # (n, 2) parameters in the leaf
    # For each leaf: its depth, its index among the nodes of this depth, its piece, and its slice of `uv`
    parts: list[tuple[int, int, Piece, slice]]


class LocatedSamples:
    """Samples, and the leaves of patch trees that contain them. Raises SchemeError as `patch_trees` does."""

    def __init__(
        self,
        scheme: Scheme,
        elements: Sequence[PatchTree],  # All different
        element: IntArray,  # (s,) int64: index of each sample's element, in increasing order
        uv: FloatArray,  # (s, 2) float64: parameters with (0, 0) at the sample's corner, so that they are exact near it
        corner: IntArray,  # (s,) int64: corner of the element at which (u, v) is (0, 0)
    ) -> None:
        self.scheme, self._given = scheme, (elements, element, uv, corner)
        # Numbers of the children that contain each sample, as digits in base four below a leading one; the least
        # significant digit is the child of the element. Samples of an element with the same path lie in the same leaf.
        self.path = np.zeros(len(uv), dtype=np.int64)
        self.leaf_sample = np.zeros(len(uv), dtype=np.int64)  # Number of each sample, counted through all `leaves`
        self._depths: list[list[Node]] = []
        domain, uv, speed, leaf_turn = scheme.domain, uv.copy(), np.ones(len(uv)), corner.copy()
        in_leaves: dict[IrregularPatch | None, list[tuple[int, int, Piece, IntArray]]] = {}
        trees, samples = list(elements), list[IntArray]([np.empty(0, dtype=np.int64)] * len(elements))
        for number, in_element in _grouped(element):
            samples[number] = in_element
        for depth in range(MOST_DEPTH + 1):
            divide(trees)
            nodes: list[Node] = [(tree, len(in_tree), []) for tree, in_tree in zip(trees, samples, strict=True)]
            self._depths.append(nodes)
            inner = []
            for number, (tree, in_tree) in enumerate(zip(trees, samples, strict=True)):
                if tree.piece is None:
                    inner.append(number)
                elif len(in_tree):
                    in_leaves.setdefault(tree.piece.patch, []).append((depth, number, tree.piece, in_tree))
                    leaf_turn[in_tree] = (corner[in_tree] + tree.turn) % domain.corner_count
                    self.path[in_tree] += 1 << 2 * depth
            counts = [len(samples[number]) for number in inner]
            if not sum(counts):
                break
            in_inner, begins = np.concatenate([samples[number] for number in inner]), np.cumsum(counts) - counts
            child, *child_uv, faster = domain.child_at(*uv[in_inner].T)
            is_only = np.repeat([trees[number].kind == PartKind.ONLY_CHILD for number in inner], counts)
            # Children at corners are numbered from the element's first corner; the middle of a triangle comes last.
            corners = domain.corner_count
            child = np.where(child < corners, (child + corner[in_inner]) % corners, child)
            child, uv[in_inner] = np.where(is_only, 0, child), np.where(is_only, uv[in_inner].T, child_uv).T
            self.path[in_inner] += child << 2 * depth
            speed[in_inner] *= np.where(is_only, 1, faster)
            in_children: dict[PatchTree, tuple[int, list[IntArray]]] = {}
            for key, at in _grouped(4 * np.repeat(np.arange(len(inner)), counts) + child):
                (parent, _, children), number, in_child = nodes[inner[key // 4]], key % 4, in_inner[at]
                tree, _ = parent.children[number]
                index, in_parents = in_children.setdefault(tree, (len(in_children), []))
                in_parents.append(in_child)
                children.append((number, index, at - begins[key // 4]))
            trees, samples = [*in_children], [np.concatenate(in_parents) for _, in_parents in in_children.values()]
        else:
            raise not_isolated(scheme, trees[0].signature)
        # To the parameters of the leaves.
        matrices, offsets = zip(*(domain.rotation(turn) for turn in range(domain.corner_count)), strict=True)
        rotation: FloatArray = np.stack(matrices, axis=-1).take(leaf_turn, axis=-1)
        uv = (rotation[:, 0] * uv[:, 0] + rotation[:, 1] * uv[:, 1] + np.stack(offsets, -1).take(leaf_turn, -1)).T
        # (2, 2, s) float64: derivatives of the leaf's parameters by the sample's (u, v)
        self.jacobian = rotation * speed
        self.leaves, begin = list[Leaves](), 0
        for patch, rows in in_leaves.items():
            in_patch = np.concatenate([in_tree for *_, in_tree in rows])
            self.leaf_sample[in_patch] = np.arange(begin, begin + len(in_patch))
            ends = np.cumsum([len(in_tree) for *_, in_tree in rows]).tolist()
            parts = [(*row[:3], slice(end - len(row[3]), end)) for row, end in zip(rows, ends, strict=True)]
            self.leaves.append(Leaves(patch, uv[in_patch], parts))
            begin += len(in_patch)

    def chosen(self, which: IntArray) -> LocatedSamples:
        """Return a subset of the samples; ``which`` is in increasing order."""
        elements, element, uv, corner = self._given
        return LocatedSamples(self.scheme, elements, element[which], uv[which], corner[which])

    def rows(self, evaluator: Evaluator, dtype: DTypeLike, derivatives: int) -> list[SampleRows]:
        """Return rows of each of the `leaves`, over eigen-coordinates; regular ones and "power" over control points."""
        of_leaves = []
        for leaves in self.leaves:
            if leaves.patch is not None:
                of_leaves.append(leaves.patch.rows(leaves.uv, evaluator, dtype, derivatives))
                continue
            rows, count = self.scheme.regular_basis(leaves.uv.astype(dtype, copy=False), derivatives), len(leaves.uv)
            ones, level = np.ones((2, count), dtype=dtype), np.zeros(count, dtype=np.int64)
            of_leaves.append(SampleRows(rows, ones, level, rows[1:3]))
        return of_leaves

    def weights(
        self,
        # (d, n, K_leaf) for each of the `leaves`: rows over eigen-coordinates, or control points of regular patches
        of_leaves: Sequence[FloatArray],
        *,
        power: bool = False,  # Whether rows of irregular patches are over control points, too
    ) -> list[FloatArray]:
        """Transform rows of leaves into weights over the one-rings: (s_element, d, K) float64 for each element."""
        size = len(of_leaves[0]) if of_leaves else 0
        in_leaf: list[dict[int, FloatArray]] = [{} for _ in self._depths]
        for leaves, leaf_rows in zip(self.leaves, of_leaves, strict=True):
            rows = leaf_rows.astype(np.float64, copy=False)
            for depth, number, piece, uv_slice in leaves.parts:
                matrix = piece.stencils if power or piece.patch is None else piece.coordinates
                weights = np.empty((uv_slice.stop - uv_slice.start, size, matrix.shape[1]))
                in_leaf[depth][number] = weights
                times_matrix(rows[:, uv_slice], matrix, weights.swapaxes(0, 1))
        below: list[FloatArray] = []
        for depth in range(len(self._depths) - 1, -1, -1):
            current, begins = [], [0] * len(below)
            for number, (tree, count, children) in enumerate(self._depths[depth]):
                if number in in_leaf[depth]:
                    current.append(in_leaf[depth][number])
                    continue
                node_weights: FloatArray = np.empty((count, size, tree.control_count))
                for child_number, child, at in children:
                    begins[child] += len(at)
                    child_rows = below[child][begins[child] - len(at) : begins[child]]
                    product = times_matrix(
                        child_rows.reshape(1, -1, child_rows.shape[2]), tree.children[child_number][1]
                    )
                    node_weights[at] = product.reshape(len(at), size, -1)
                current.append(node_weights)
            below = current
        return below

    def per_sample(self, of_leaves: Sequence[NDArray[Any]]) -> NDArray[Any]:
        """Reorder values ``(.., n)`` of the samples of each of the `leaves` to ``(.., s)``, the order of samples."""
        return np.concatenate(of_leaves, axis=-1)[..., self.leaf_sample]

    def slices(self) -> Iterator[slice]:
        """Return the samples of each element."""
        ends = np.cumsum([count for _, count, _ in self._depths[0]]).tolist()
        return (slice(begin, end) for begin, end in pairwise([0, *ends]))


def _grouped(keys: IntArray) -> Iterator[tuple[int, IntArray]]:
    """Return the distinct keys in increasing order, each with the indices at which it stands."""
    counts = np.bincount(keys)
    occurring, order = np.flatnonzero(counts), np.argsort(keys.astype(np.min_scalar_type(len(counts))), kind="stable")
    return zip(occurring.tolist(), ragged.rows(order, counts[occurring]), strict=True)


def frame_magnitude(leaves: Leaves, sample_rows: SampleRows) -> FloatArray:
    """Return ``(2, n)`` sums of the absolute weights of control points in the tangents of leaves, see `CANCELLED`."""
    tangents, share = sample_rows.tangents, 1 if leaves.patch is None else CANCELLED
    magnitude = np.empty(tangents.shape[:2], tangents.dtype)
    for _, _, piece, uv_slice in leaves.parts:
        rows = tangents[:, uv_slice]
        magnitude[:, uv_slice] = np.abs(rows) @ (share * piece.absolute_sums).astype(rows.dtype)
        if leaves.patch is not None:
            weights = np.abs(times_matrix(rows, piece.coordinates))
            magnitude[:, uv_slice] += weights @ np.ones(weights.shape[2])
    return magnitude


def by_uv(tangents: FloatArray, jacobian: FloatArray) -> FloatArray:
    """Transform derivatives ``(2, .., s)`` by the leaf's parameters to derivatives by the sample's (u, v)."""
    (a, b), (c, d) = jacobian
    u, v = tangents
    return np.stack([a * u + c * v, b * u + d * v])


def limit_stencils(located: LocatedSamples) -> list[FloatArray]:
    """Compute limit stencils of samples over the one-rings of their elements: (s_element, 3, K) float64 for each.

    These are weights of the point, and of two tangents whose cross product is along the normal. Away from extraordinary
    points, borders and sharp features, these are the derivatives times a positive factor, which may differ between
    samples. They are zero where the surface is folded for all control points.
    """
    rows = located.rows("stabilized", np.float64, 1)
    stencils = located.weights([np.concatenate([leaf_rows.rows[:1], leaf_rows.tangents]) for leaf_rows in rows])
    if rows:
        magnitude = located.per_sample([frame_magnitude(*pair) for pair in zip(located.leaves, rows, strict=True)])
        rounded = TANGENT_ROUNDING[64] * by_uv(magnitude, np.abs(located.jacobian))
        for weights, samples in zip(stencils, located.slices(), strict=True):
            tangents = by_uv(weights[:, 1:].transpose(1, 2, 0), located.jacobian[..., samples])
            # Weights cancel, as on the fold between faces back to back.
            tangents.swapaxes(1, 2)[np.abs(tangents).sum(axis=1) <= rounded[:, samples]] = 0
            weights[:, 1:] = tangents.transpose(2, 0, 1)
    return stencils


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
    """Return planes, and polynomials of the scheme's `PolynomialBasis`, that evaluate samples, each by one of the two.

    Normals are along the cross product of the derivatives. The derivatives of planes are tangents of any length. Raises
    SchemeError as `patch_trees` does.
    """
    element = np.repeat(np.arange(len(elements)), [len(element_uv) for element_uv in uv])
    located = LocatedSamples(scheme, elements, element, np.concatenate(uv), 0 * element)
    numbers, parameters = zip(*(_in_pieces(scheme, leaves) for leaves in located.leaves), strict=True)
    number, st = located.per_sample(numbers), located.per_sample(parameters).T
    order = np.lexsort((number, located.path, element))  # Sorted so that the samples of a piece are consecutive
    keys = np.stack([element, located.path, number])[:, order]
    begins = np.flatnonzero((np.diff(keys, axis=1, prepend=-2) != 0).any(axis=0))
    counts = np.diff(begins, append=len(order))
    has_plane = (number[order[begins]] < 0) | (counts < FEW_SAMPLES)
    in_planes = np.sort(order[np.repeat(has_plane, counts)])
    # The first sample of each piece stands for it. The sort is stable, so these are in the order of elements.
    in_pieces, first = order[~np.repeat(has_plane, counts)], order[begins[~has_plane]]
    plane, piece = np.full((2, len(element)), -1)
    plane[in_planes] = np.arange(len(in_planes))
    piece[in_pieces] = np.repeat(np.arange(len(first)), counts[~has_plane])
    return (
        Polynomials(limit_stencils(located.chosen(in_planes)), plane, 0 * st),
        Polynomials(_pieces(located.chosen(first)), piece, st),
    )


def _in_pieces(scheme: Scheme, leaves: Leaves) -> tuple[IntArray, FloatArray]:
    """Return the piece of each sample, -1 if it needs a plane, and ``(2, n)`` parameters from the piece's middle."""
    local, number = leaves.uv, np.zeros(len(leaves.uv), dtype=np.int64)
    if leaves.patch is not None:
        level, child, local = locate(scheme.domain, leaves.uv)
        has_piece = (level < PIECE_LEVELS) & (scheme.domain.extent(leaves.uv) > 0)
        number = np.where(has_piece, LEVEL_PIECES * level + child, -1)
    return number, (local - scheme.domain.centre).T


def _pieces(samples: LocatedSamples) -> list[FloatArray]:
    """Return ``(p, m, K)`` coefficients of the piece that contains each sample, for each element."""
    scheme, rows = samples.scheme, []
    matrix = polynomial_basis(scheme).matrix
    for leaves in samples.leaves:
        if leaves.patch is None:
            rows.append(np.broadcast_to(matrix[:, None], (len(matrix), len(leaves.uv), matrix.shape[1])))
        else:
            polynomials = level_polynomials(leaves.patch, matrix, np.arange(PIECE_LEVELS))
            pieces = polynomials.reshape(-1, len(matrix), polynomials.shape[3])
            rows.append(pieces[_in_pieces(scheme, leaves)[0]].swapaxes(0, 1))
    return samples.weights(rows)
