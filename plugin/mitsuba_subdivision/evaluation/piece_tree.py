"""All pieces of an element as a tree, with the polynomials of each piece: for kernels that evaluate it anywhere.

A kernel meets its samples when it runs. So the element is divided completely (`divided_elements`), and what the
equations of `equations` need at any level is in a table. Each part is a node:

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

from dataclasses import dataclass
from enum import IntEnum
from functools import lru_cache

import numpy as np

from ..mesh.connectivity import IntArray
from ..mesh.signature import Signature
from ..schemes.domain import FloatArray
from ..schemes.scheme import Scheme
from .divided_element import DividedElement, ElementTip, PartKind, divided_elements
from .equations import times_powers
from .irregular_patch import IrregularPatch
from .polynomial_basis import polynomial_basis
from .tip_levels import distinct_levels

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
        `DividedElement.turns` of each.
    first : (n,) uint32
        Of an inner node the first child, after which the others follow; of ``OWN_POINTS`` a row of ``orders``; of a
        piece the first block.
    frames : (n,) uint32
        `FrameKind` of an irregular piece, else 0. It has blocks for its `distinct_levels`, to each as many as there are
        regular children. After these comes one for the rest, linear between the tangents along the edges; and one whose
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


# A tree takes up to some megabytes, where valences are high.
@lru_cache(maxsize=128)
def piece_tree(scheme: Scheme, signature: Signature) -> PieceTree:
    """Make the tree of an element of a signature.

    Raises
    ------
    SchemeError
        As `divided_elements`.
    """
    (element,) = divided_elements(scheme, [signature])
    return _Builder(scheme, element).tree()


# What `PieceTree` has of each part that is no tip.
_KINDS = {
    PartKind.DIVIDED: NodeKind.DIVIDED,
    PartKind.ONLY_CHILD: NodeKind.ONLY_CHILD,
    PartKind.REGULAR: NodeKind.REGULAR,
    PartKind.TIP: NodeKind.IRREGULAR,
}


class _Builder:
    """Makes the arrays of a tree of a divided element."""

    def __init__(self, scheme: Scheme, element: DividedElement) -> None:
        self._basis, self._element = polynomial_basis(scheme), element
        self._blocks: list[FloatArray] = []
        self._slow: list[FloatArray] = []
        self._block_count = 0

    def tree(self) -> PieceTree:
        element, size = self._element, len(self._basis.powers)
        kinds = np.array([_KINDS[kind] for kind in PartKind])[element.kinds]
        # Pieces' own blocks come first, in their order, then those of tips.
        first = np.where(element.kinds == PartKind.REGULAR, element.leaf, element.children)
        frames, levels, slow_rows = np.zeros((3, len(kinds)), dtype=np.int64)
        shrinking = np.ones(len(kinds))
        orders: IntArray = np.empty((0, self._basis.matrix.shape[1]), dtype=np.uint32)
        if (own := _own_points(element)) is not None:
            kinds[0], orders = NodeKind.OWN_POINTS, own[None]
        else:
            self._added(element.coefficients(self._basis.matrix))
        for part in np.flatnonzero(kinds == NodeKind.IRREGULAR):
            found = self._irregular_node(element.tips[element.leaf[part]])
            first[part], frames[part], levels[part], slow_rows[part], shrinking[part] = found
        slow = np.concatenate([np.empty((0, size)), *self._slow])
        none: FloatArray = np.empty((0, size, element.control_count))
        blocks: FloatArray = np.concatenate([none, *self._blocks]).swapaxes(1, 2)
        return PieceTree(kinds, element.turns, first, frames, levels, slow_rows, shrinking, blocks, slow, orders)

    def _irregular_node(self, tip: ElementTip) -> tuple[int, FrameKind, int, int, float]:
        """What `PieceTree` has of a tip: ``first``, ``frames``, ``levels``, ``slow_rows`` and ``shrinking``."""
        patch, coordinates = tip.patch, tip.coordinates
        basis, count = patch.basis, len(self._basis.powers)
        # The regular children's polynomials over the eigen-coordinates.
        rows: FloatArray = self._basis.matrix @ patch.eigen_children
        level_count = distinct_levels(patch)
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
        return first, frames, level_count, slow_row, basis.subdominant

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


def _own_points(element: DividedElement) -> IntArray | None:
    """Control points of a regular piece in the order of the lattice, if they are the one-ring's own; else None.

    Those of an element that has been refined never are.
    """
    if element.piece is None or element.piece.irregular is not None:
        return None
    controls = element.piece.stencils
    order: IntArray = np.argmax(controls, axis=1).astype(np.uint32)
    return order if np.abs(controls - np.eye(controls.shape[1])[order]).max() < OWN else None
