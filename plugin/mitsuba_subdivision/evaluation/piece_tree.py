"""All pieces of an element as a tree, with the polynomials of each piece: for kernels that evaluate it anywhere.

A kernel meets its samples when it runs. So the element is divided completely (`divided_element`), and each part is a
node: an inner one, divided into the four copies of its domain or turned only; a regular piece; or a tip, the part
around an extraordinary point.

A regular piece is a polynomial, whose coefficients are weights times the control points of the element's one-ring. So
is each of the three regular children of a tip's first levels. Whoever has the control points makes all these
coefficients once, and a sample needs nothing else. Nearly all samples lie there: three levels leave a 64th of a tip.

Deeper levels are equations (10) and (12) as a table. A *block* has a row for each control point of the one-ring, and a
column for each monomial of the scheme's `PolynomialBasis`. Sums of rows times control points, relative to the first of
these, are coefficients. The first eigenvector is left out of them, and all others are divided by the power of the
second eigenvalue, ``λ_2ⁿ``: the polynomial has to be multiplied by that, but for its constant, the point itself.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum
from functools import lru_cache

import numpy as np

from ..mesh.connectivity import IntArray
from ..mesh.one_ring import one_ring
from ..mesh.signature import Signature
from ..schemes.domain import FloatArray
from ..schemes.scheme import Scheme
from .divided_element import ElementTip, Part, divided_element
from .equations import times_powers
from .irregular_patch import IrregularPatch
from .polynomial_basis import polynomial_basis
from .tip_levels import distinct_levels

# Levels of a tip that are pieces like others, at most. Their normals need no frames: single precision has enough bits
# of the cross product of derivatives that become parallel, level by level.
PIECE_LEVELS = 3


class NodeKind(IntEnum):
    """What a node of a tree is."""

    DIVIDED = 0
    ONLY_CHILD = 1
    REGULAR = 2
    TIP = 3


class FrameKind(IntEnum):
    """Where the derivatives in a tip do not serve as a frame: nowhere, at the point, or at all deeper levels."""

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
        `Part.turn` of each.
    first : (n,) uint32
        Of an inner node the first child, after which the others follow. Of a leaf the number of its piece; those of a
        tip follow each other, level by level.
    pieces : (p, m, K) float64
        Coefficients of the pieces' polynomials over the one-ring's control points.
    frames : (n,) uint32
        `FrameKind` of a tip, else 0.
    levels : (n,) uint32
        At which level a tip ends, and the rest of it begins; else 0.
    first_block : (n,) uint32
        Of a tip: a block for each deeper level and each regular child there, then one for the rest, linear between the
        tangents along the edges, then one whose derivatives are the frame of (13). If the frame is uneven, there are as
        many blocks for levels once more, of the point without the second eigenvector, divided by the power of the third
        eigenvalue.
    blocks : (b, K, m) float64
        As the relative first control point is zero, no block needs the first row for weights. Its first entry is the
        power of the second eigenvalue, ``λ_2ⁿ``; the others are, in uneven tips, the polynomial of the second
        eigenvector, of which `uneven_frame` is made.
    """

    kinds: IntArray
    turns: IntArray
    first: IntArray
    pieces: FloatArray
    frames: IntArray
    levels: IntArray
    first_block: IntArray
    blocks: FloatArray


# A tree takes up to some megabytes, where valences are high.
@lru_cache(maxsize=128)
def piece_tree(scheme: Scheme, signature: Signature, piece_levels: int = PIECE_LEVELS) -> PieceTree:
    """Make the tree of an element of a signature.

    Parameters
    ----------
    scheme : Scheme
    signature : Signature
    piece_levels : int
        How many levels of a tip are pieces; the others are deeper ones.

    Raises
    ------
    SchemeError
        As `divided_element`.
    """
    builder = _Builder(scheme, one_ring(signature).vertex_count, piece_levels)
    return builder.tree(divided_element(scheme, signature))


# What `PieceTree` has of a node, but for its turn.
_Node = tuple[NodeKind, int, FrameKind, int, int]


class _Builder:
    """Makes the arrays of a tree, part by part."""

    def __init__(self, scheme: Scheme, control_count: int, piece_levels: int) -> None:
        self._basis, self._piece_levels = polynomial_basis(scheme), piece_levels
        self._shape = (len(self._basis.powers), control_count)
        self._pieces: list[FloatArray] = [np.empty((0, *self._shape))]
        self._blocks: list[FloatArray] = [np.empty((0, *self._shape))]
        self._piece_count = self._block_count = 0

    def tree(self, parts: tuple[Part, ...]) -> PieceTree:
        nodes = [self._node(part) for part in parts]
        kinds, first, frames, levels, first_block = (np.array(each) for each in zip(*nodes, strict=True))
        turns = np.array([part.turn for part in parts])
        blocks = np.concatenate(self._blocks).swapaxes(1, 2)
        return PieceTree(kinds, turns, first, np.concatenate(self._pieces), frames, levels, first_block, blocks)

    def _node(self, part: Part) -> _Node:
        if part.controls is not None:
            return NodeKind.REGULAR, self._added_pieces((self._basis.matrix @ part.controls)[None]), 0, 0, 0  # type: ignore[return-value]
        if part.tip is not None:
            return self._tip_node(part.tip)
        kind = NodeKind.ONLY_CHILD if len(part.children) == 1 else NodeKind.DIVIDED
        return kind, part.children.start, 0, 0, 0  # type: ignore[return-value]

    def _tip_node(self, tip: ElementTip) -> _Node:
        patch, coordinates = tip.patch, tip.coordinates
        basis, count = patch.basis, len(self._basis.powers)
        # The regular children's polynomials over the eigen-coordinates.
        rows: FloatArray = self._basis.matrix @ patch.eigen_children
        level_count, piece_levels = distinct_levels(patch), self._piece_levels
        by_level = self._by_level(rows, patch, basis.subdominant, np.arange(level_count))
        power = basis.subdominant ** np.repeat(np.arange(level_count), len(rows))
        by_level[:, 0] *= power[:, None]
        by_level[:, 0, 0] = 1
        piece_count = piece_levels * len(rows)
        pieces = by_level[:piece_count].copy()
        pieces[:, 1:] *= power[:piece_count, None, None]
        rest: FloatArray = np.zeros((2, count, len(coordinates)))
        u, v = (int(np.flatnonzero((self._basis.powers == power).all(axis=1))[0]) for power in ((1, 0), (0, 1)))
        rest[0, [u, v]], rest[1, [u, v]] = patch.edge_tangents, patch.limit_frame
        # Polynomials are about the middle of the domain, and the point itself is at its corner.
        rest[0, 0] = basis.subdominant**level_count * self._basis.centre @ patch.edge_tangents
        rest[0, 0, 0] = 1
        levels = np.arange(piece_levels, level_count)
        blocks, slow = [by_level[piece_count:], rest], np.zeros((len(rows), count))
        frames = FrameKind.AT_POINT if patch.has_own_frame else FrameKind.DERIVATIVES
        if patch.contracts_unevenly:
            blocks.append(self._by_level(rows, patch, float(basis.moduli[2]), levels))
            frames, slow = FrameKind.UNEVEN, rows[:, :, 1]
        found: FloatArray = np.concatenate(blocks) @ coordinates
        level_blocks = found[: len(levels) * len(rows)]
        level_blocks[:, :, 0] = np.tile(slow, (len(levels), 1))
        level_blocks[:, 0, 0] = power[piece_count:]
        found[len(level_blocks), 0, 0] = basis.subdominant**level_count
        first = self._added_pieces(pieces @ coordinates)
        self._blocks.append(found)
        self._block_count += len(found)
        return NodeKind.TIP, first, frames, level_count, self._block_count - len(found)

    def _by_level(self, rows: FloatArray, patch: IrregularPatch, base: float, levels: IntArray) -> FloatArray:
        """Rows ``(c, m, K)`` of regular children times powers of the eigenvalues over a base: ``(levels c, m, K)``."""
        repeated = np.repeat(rows.reshape(-1, 1, rows.shape[2]), len(levels), axis=1)
        found = times_powers(repeated, levels, patch.basis, base).reshape(*rows.shape[:2], len(levels), -1)
        return np.moveaxis(found, 2, 0).reshape(-1, *rows.shape[1:])

    def _added_pieces(self, pieces: FloatArray) -> int:
        """Number of the first of some pieces ``(p, m, K)``, which are added."""
        self._pieces.append(pieces)
        self._piece_count += len(pieces)
        return self._piece_count - len(pieces)
