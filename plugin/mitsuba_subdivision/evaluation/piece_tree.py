"""All pieces of an element as a tree, with the polynomials of each piece: for kernels that evaluate it anywhere.

`occupied_pieces` divides an element where samples lie. A kernel cannot: it meets its samples when it runs. So here the
element is divided completely, and what the equations of `equations` need at any level is in a table. A node is

- an inner one, divided into the four copies of its domain, or turned only (`NodeKind`);
- a regular piece: one block of weights;
- an irregular piece: a block for each level and each regular child there.

A *block* has a row for each control point of the element's one-ring, and a column for each monomial of the scheme's
`PolynomialBasis`. The sum of the rows times the control points, relative to the first of these, are the coefficients of
the point as a polynomial of the piece's parameters.

The blocks of an irregular piece are (10) and (12): the first eigenvector is left out, and all others are divided by the
power of the second eigenvalue. So the polynomial has to be multiplied by ``λ_2ⁿ``, but for its constant, which is that
of the point itself.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from enum import IntEnum
from functools import lru_cache

import numpy as np

from ..mesh.connectivity import IntArray
from ..mesh.one_ring import one_ring
from ..mesh.signature import Signature
from ..schemes.domain import IDENTITY, AffineMap, FloatArray, ParameterDomain
from ..schemes.scheme import Scheme, SchemeError
from .equations import times_powers
from .irregular_patch import IrregularPatch, irregular_patch
from .occupied_pieces import MOST_SEMI_SHARP_REFINEMENTS
from .patch_pieces import MAX_REFINEMENTS, Piece, whole_piece
from .polynomial_basis import polynomial_basis
from .refined_element import refined_element

# Levels have blocks of their own until the extraordinary point is as near as this, in parameters and in sizes of the
# patch. Single precision tells nothing nearer apart from the point itself, and one block stands for all: that of (13).
NEAREST = 2.0**-24
# Most of a weight that is one: a regular piece whose control points are the one-ring's own.
OWN = 1e-13


class NodeKind(IntEnum):
    """What a node of a tree is."""

    DIVIDED = 0
    ONLY_CHILD = 1
    OWN_POINTS = 2
    REGULAR = 3
    IRREGULAR = 4


class FrameKind(IntEnum):
    """Where the derivatives of an irregular piece do not serve as a frame: nowhere, at the point, or at all levels."""

    DERIVATIVES = 0
    AT_POINT = 1
    UNEVEN = 2


@dataclass(frozen=True, eq=False)
class PieceTree:
    """Pieces of an element.

    Attributes
    ----------
    kinds : (n,) uint32
        `NodeKind` of each node. The first node is the element.
    turns : (n,) uint32
        How a node's parameters follow from those of the copy of its parent's domain that it covers:
        `ParameterDomain.rotation` of this.
    first : (n,) uint32
        Of an inner node the first child, after which the others follow; of ``OWN_POINTS`` a row of ``orders``; of a
        piece the first block.
    frames : (n,) uint32
        `FrameKind` of an irregular piece, else 0. It has blocks for its levels, to each as many as there are regular
        children. After these comes one for the rest, linear between the tangents along the edges; and one whose
        derivatives are the frame of (13). If the frame is uneven, there are as many blocks for levels once more, of the
        point without the second eigenvector, divided by the power of the third eigenvalue.
    levels : (n,) uint32
        Of an irregular piece, how many levels have blocks; else 0.
    slow_rows : (n,) uint32
        Of an uneven piece, the first row of ``slow``; there is one for each regular child.
    shrinking : (n,) float64
        Of an irregular piece the second eigenvalue, else one.
    blocks : (b, K, m) float64
    slow : (c, m) float64
        Polynomials of the second eigenvector over regular children, of which `uneven_frame` is made.
    orders : (o, R) uint32
        Control points of the one-ring in the order of the scheme's lattice.
    irregular : dict of int to (IrregularPatch, (K_piece, K) float64)
        By the number of an irregular piece's node: what its blocks are made of, and its control points over the
        one-ring.
    """

    kinds: IntArray
    turns: IntArray
    first: IntArray
    frames: IntArray
    levels: IntArray
    slow_rows: IntArray
    shrinking: FloatArray
    blocks: FloatArray
    slow: FloatArray
    orders: IntArray
    irregular: Mapping[int, tuple[IrregularPatch, FloatArray]]


# A tree takes up to some megabytes, where valences are high.
@lru_cache(maxsize=128)
def piece_tree(scheme: Scheme, signature: Signature) -> PieceTree:
    """Divide an element of a signature completely.

    Raises
    ------
    SchemeError
        If refinement does not separate the irregularities of the one-ring, or the scheme divides domains in a way of
        its own.
    """
    return _Builder(scheme, signature).tree()


@dataclass(frozen=True, eq=False)
class _Part:
    """A part of the element that becomes a node.

    Attributes
    ----------
    signature : Signature
    stencils : (K_part, K) float64
        Its control points over those of the element.
    turn : int
    depth : int
    """

    signature: Signature
    stencils: FloatArray
    turn: int
    depth: int


# What `PieceTree` has of a node.
_Node = tuple[NodeKind, int, int, FrameKind | int, int, int, float]


class _Builder:
    """Makes the arrays of a tree, parent by parent."""

    def __init__(self, scheme: Scheme, signature: Signature) -> None:
        self._scheme, self._basis = scheme, polynomial_basis(scheme)
        self._parts = [_Part(signature, np.eye(one_ring(signature).vertex_count), 0, 0)]
        self._nodes: list[_Node] = []
        self._blocks: list[FloatArray] = []
        self._slow: list[FloatArray] = []
        self._orders: list[IntArray] = []
        self._irregular: dict[int, tuple[IrregularPatch, FloatArray]] = {}
        self._block_count = 0

    def tree(self) -> PieceTree:
        # Parts are appended while the loop runs.
        for part in self._parts:
            self._nodes.append(self._node(part))
        kinds, turns, first, frames, levels, slow_rows, shrinking = (
            np.array(column) for column in zip(*self._nodes, strict=True)
        )
        slow = np.concatenate([np.empty((0, len(self._basis.powers))), *self._slow])
        control_count = self._parts[0].stencils.shape[1]
        none: FloatArray = np.empty((0, len(self._basis.powers), control_count))
        blocks: FloatArray = np.concatenate([none, *self._blocks])
        orders = np.array(self._orders, dtype=np.uint32).reshape(-1, self._basis.matrix.shape[1])
        return PieceTree(
            kinds,
            turns,
            first,
            frames,
            levels,
            slow_rows,
            shrinking,
            blocks.swapaxes(1, 2),
            slow,
            orders,
            self._irregular,
        )

    def _node(self, part: _Part) -> _Node:
        piece = whole_piece(self._scheme, part.signature)
        if piece is None:
            return self._inner_node(part)
        stencils = piece.stencils @ part.stencils
        if piece.irregular is None:
            return self._regular_node(part.turn, stencils)
        turn = part.turn + _turn_of(self._scheme.domain, piece)
        return self._irregular_node(turn, irregular_patch(self._scheme, piece.irregular), stencils)

    def _inner_node(self, part: _Part) -> _Node:
        element = refined_element(self._scheme, part.signature)
        if part.depth > MOST_SEMI_SHARP_REFINEMENTS + MAX_REFINEMENTS:
            raise SchemeError(
                f"{self._scheme.name}: refinement leaves a {part.signature.kind} with fans {part.signature.fans} "
                "neither regular nor self-similar; expected a scheme that isolates extraordinary points"
            )
        domain, first = self._scheme.domain, len(self._parts)
        copies = (IDENTITY,) if len(element.domains) == 1 else domain.children
        found: dict[int, _Part] = {}
        for number, inner in enumerate(element.domains):
            copy, turn = _copy_of(self._scheme, copies, inner)
            child, stencils = element.child(number)
            found[copy] = _Part(child, stencils @ part.stencils, turn, part.depth + 1)
        self._parts += [found[copy] for copy in range(len(copies))]
        kind = NodeKind.ONLY_CHILD if len(copies) == 1 else NodeKind.DIVIDED
        return kind, part.turn, first, 0, 0, 0, 1.0

    def _regular_node(self, turn: int, stencils: FloatArray) -> _Node:
        order = np.argmax(stencils, axis=1)
        if np.abs(stencils - np.eye(stencils.shape[1])[order]).max() < OWN:
            self._orders.append(order)
            return NodeKind.OWN_POINTS, turn, len(self._orders) - 1, 0, 0, 0, 1.0
        return NodeKind.REGULAR, turn, self._added((self._basis.matrix @ stencils)[None]), 0, 0, 0, 1.0

    def _irregular_node(self, turn: int, patch: IrregularPatch, stencils: FloatArray) -> _Node:
        basis, count = patch.basis, len(self._basis.powers)
        coordinates = basis.inverse @ stencils
        # The regular children's polynomials over the eigen-coordinates.
        rows: FloatArray = self._basis.matrix @ patch.eigen_children
        level_count = int(np.ceil(np.log(NEAREST) / np.log(max(0.5, basis.subdominant))))
        by_level = self._by_level(rows, patch, basis.subdominant, level_count)
        by_level[:, 0] *= basis.subdominant ** np.repeat(np.arange(level_count), len(rows))[:, None]
        by_level[:, 0, 0] = 1
        rest: FloatArray = np.zeros((2, count, len(coordinates)))
        u, v = (int(np.flatnonzero((self._basis.powers == power).all(axis=1))[0]) for power in ((1, 0), (0, 1)))
        rest[0, [u, v]], rest[1, [u, v]] = patch.edge_tangents, patch.limit_frame
        # Polynomials are about the middle of the domain, and the point itself is at its corner.
        rest[0, 0] = basis.subdominant**level_count * self._basis.centre @ patch.edge_tangents
        rest[0, 0, 0] = 1
        blocks, slow_row, frames = [by_level, rest], 0, FrameKind.AT_POINT
        if patch.contracts_unevenly:
            blocks.append(self._by_level(rows, patch, float(basis.moduli[2]), level_count))
            slow_row, frames = sum(map(len, self._slow)), FrameKind.UNEVEN
            self._slow.append(rows[:, :, 1])
        elif not patch.has_own_frame:
            frames = FrameKind.DERIVATIVES
        first = self._added(np.concatenate(blocks) @ coordinates)
        # Nodes are appended in order: this one comes next.
        self._irregular[len(self._nodes)] = patch, stencils
        turn %= self._scheme.domain.corner_count
        return NodeKind.IRREGULAR, turn, first, frames, level_count, slow_row, basis.subdominant

    def _by_level(self, rows: FloatArray, patch: IrregularPatch, base: float, level_count: int) -> FloatArray:
        """Rows ``(c, m, K)`` of regular children times powers of the eigenvalues over a base: ``(levels c, m, K)``."""
        level = np.arange(level_count)
        repeated = np.repeat(rows.reshape(-1, 1, rows.shape[2]), level_count, axis=1)
        found = times_powers(repeated, level, patch.basis, base).reshape(*rows.shape[:2], level_count, -1)
        return np.moveaxis(found, 2, 0).reshape(-1, *rows.shape[1:])

    def _added(self, blocks: FloatArray) -> int:
        """Number of the first of some blocks ``(b, m, K)``, which are added."""
        self._blocks.append(blocks)
        self._block_count += len(blocks)
        return self._block_count - len(blocks)


def _turn_of(domain: ParameterDomain, piece: Piece) -> int:
    """The turn that leads to a whole piece's own parameters."""
    return next(turn for turn in range(domain.corner_count) if domain.rotation(turn).is_same(piece.domain))


def _copy_of(scheme: Scheme, copies: tuple[AffineMap, ...], inner: AffineMap) -> tuple[int, int]:
    """In which copy of the domain a child lies, and how it is turned there."""
    for turn in range(scheme.domain.corner_count):
        rotation = scheme.domain.rotation(turn)
        for number, copy in enumerate(copies):
            if (rotation @ copy).is_same(inner):
                return number, turn
    raise SchemeError(f"{scheme.name}: a child's domain is none of {len(copies)} copies; expected one, maybe turned")
