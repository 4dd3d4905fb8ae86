"""A patch tree as flat arrays, with the polynomials of each piece: for kernels that evaluate it anywhere.

The samples of a kernel are unknown before it runs. So the element is divided completely (`patch_trees`), and each
part is a node: an inner one, divided into the four copies of its domain or turned only; a regular piece; or a tip, the
part around an extraordinary point.

A regular piece is a polynomial, whose coefficients are weights times the control points of the element's one-ring. So
is each of the three regular children of a tip's first levels. All these coefficients are computed once for the control
points, and a sample needs nothing else. Nearly all samples lie there: three levels leave a 64th of a tip.

Deeper levels are equations (10) and (12) as a table. A *block* has a row for each control point of the one-ring, and a
column for each monomial of the scheme's `PolynomialBasis`. Sums of rows times control points, relative to the first of
these, are coefficients. The first eigenvector, which is constant, is left out but for the point itself.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum
from functools import lru_cache
from typing import NamedTuple

import numpy as np

from ..mesh.connectivity import IntArray
from ..mesh.signature import Signature
from ..schemes.domain import FloatArray
from ..schemes.scheme import Scheme
from .equations import times_powers
from .irregular_patch import IrregularPatch, float32_levels
from .patch_tree import PartKind, PatchTree, patch_trees
from .polynomials import polynomial_basis

# Levels of a tip that are pieces like others, at most. Their normals need no frames: single precision has enough bits
# of the cross product of derivatives that become parallel, level by level.
PIECE_LEVELS = 3
# Regular children of a tip at each level.
LEVEL_PIECES = 3
# Elements of more pieces are taken apart: along semi-sharp creases, there are thousands of parts of few kinds.
SHARED_PIECES = 64


class FrameKind(IntEnum):
    """Where a tip needs a frame in place of the derivatives: nowhere, at the point, or at all deeper levels."""

    DERIVATIVES = 0
    AT_POINT = 1
    UNEVEN = 2


class PieceMap(NamedTuple):
    """Makes the coefficients of consecutive pieces from the control points of the element's one-ring."""

    first_piece: int
    # (K_part, K) float64, or None: makes the control points of a part's one-ring, where parts of many elements are
    # divided alike: then they share ``pieces``. None if these are over the element's own one-ring.
    stencils: FloatArray | None
    pieces: FloatArray  # (p, m, K_part) float64: coefficients of the pieces' polynomials over control points


@dataclass(frozen=True, eq=False)
class TreeArrays:
    """Pieces of an element."""

    kinds: IntArray  # (n,) uint32: `PartKind` of each node. The first node is the element.
    turns: IntArray  # (n,) uint32: `PatchTree.turn` of each
    # (n,) uint32: of an inner node the first child, after which the others follow. Of a leaf the number of its piece;
    # those of a tip follow each other, level by level.
    first: IntArray
    piece_count: int
    maps: tuple[PieceMap, ...]  # Make the coefficients of all pieces
    frames: IntArray  # (n,) uint32: `FrameKind` of a tip, else 0
    levels: IntArray  # (n,) uint32: the level at which a tip ends and its rest begins; else 0
    # (n,) uint32: of a tip: a block for each deeper level and each regular child there, then one for the rest, linear
    # between the tangents along the edges, then one whose derivatives are the frame of (13). If the frame is uneven,
    # there are as many blocks for levels once more, of the point without the second eigenvector, divided by the power
    # of the third eigenvalue.
    first_block: IntArray
    # (b, K, m) float64: as the relative first control point is zero, no block needs the first row for weights. In
    # uneven tips it is the polynomial of the second eigenvector, of which `uneven_frame` is made.
    blocks: FloatArray


# A tree takes up to some megabytes, where valences are high.
@lru_cache(maxsize=128)
def tree_arrays(
    scheme: Scheme,
    signature: Signature,
    piece_levels: int = PIECE_LEVELS,  # Number of levels of a tip that are pieces; the others are deeper ones
) -> TreeArrays:
    """Make the tree of an element of a signature."""
    (element,) = patch_trees(scheme, [signature])
    kinds, turns, first = element.nodes.T.copy()
    # Regular pieces come first, in their order, then those of tips.
    maps, piece_count = [], 0
    for part, stencils in _shared_parts(element):
        pieces = _regular_pieces(scheme, part)
        maps.append(PieceMap(piece_count, stencils, pieces))
        piece_count += len(pieces)
    frames, levels, first_block = np.zeros((3, len(first)), dtype=np.int64)
    blocks: list[FloatArray] = [np.empty((0, element.control_count, len(polynomial_basis(scheme).powers)))]
    block_count = 0
    # Nodes come in another order than tips.
    is_tip = np.flatnonzero(kinds == PartKind.TIP)
    for node, piece in zip(is_tip[np.argsort(first[is_tip])].tolist(), element.tips, strict=True):
        tip = _tip(scheme, piece.irregular_patch, piece_levels)
        frames[node], levels[node] = tip.frame, tip.level_count
        first[node], first_block[node] = piece_count, block_count
        maps.append(PieceMap(piece_count, None, tip.pieces @ piece.coordinates))
        own = (tip.blocks @ piece.coordinates).swapaxes(1, 2).copy()
        own[: len(tip.second_eigenvector), 0] = tip.second_eigenvector
        blocks.append(own)
        piece_count, block_count = piece_count + len(tip.pieces), block_count + len(own)
    return TreeArrays(
        kinds,
        turns,
        first,
        piece_count,
        tuple(each for each in maps if len(each.pieces)),
        frames,
        levels,
        first_block,
        np.concatenate(blocks),
    )


class _Tip(NamedTuple):
    """The polynomials of a tip over the eigen-coordinates."""

    pieces: FloatArray  # (n, m, K) float64
    blocks: FloatArray  # (b, m, K) float64
    # (l, m) float64: what stands in the first blocks in place of weights of the first control point
    second_eigenvector: FloatArray
    frame: FrameKind
    level_count: int  # At which level it ends


# Around vertices of high valence, tips take some megabytes.
@lru_cache(maxsize=16)
def _tip(scheme: Scheme, patch: IrregularPatch, piece_levels: int) -> _Tip:
    basis, polynomials = patch.basis, polynomial_basis(scheme)
    # The regular children's polynomials over the eigen-coordinates.
    rows: FloatArray = polynomials.matrix @ patch.eigen_children
    level_count = float32_levels(patch)
    by_level = level_polynomials(scheme, patch, level_count)
    piece_count = piece_levels * len(rows)
    rest: FloatArray = np.zeros((2, len(polynomials.powers), len(basis.eigenvalues)))
    u, v = (int(np.flatnonzero((polynomials.powers == each).all(axis=1))[0]) for each in ((1, 0), (0, 1)))
    rest[0, [u, v]], rest[1, [u, v]] = basis.subdominant**level_count * patch.edge_tangents, patch.limit_frame
    # Polynomials are about the middle of the domain, and the point itself is at its corner.
    rest[0, 0] = polynomials.centre @ rest[0, [u, v]]
    rest[0, 0, 0] = 1
    levels = np.arange(piece_levels, level_count)
    blocks, second_eigenvector = [by_level[piece_count:], rest], 0 * rows[:, :, 0]
    frame = FrameKind.AT_POINT if patch.has_own_frame else FrameKind.DERIVATIVES
    if patch.contracts_unevenly:
        blocks.append(_by_level(rows, patch, float(basis.moduli[2]), levels))
        frame, second_eigenvector = FrameKind.UNEVEN, rows[:, :, 1]
    second_eigenvector = np.tile(second_eigenvector, (len(levels), 1))
    return _Tip(by_level[:piece_count], np.concatenate(blocks), second_eigenvector, frame, level_count)


def level_polynomials(scheme: Scheme, patch: IrregularPatch, level_count: int) -> FloatArray:
    """Polynomials ``(c, m, K)`` of the regular children at the first levels, over the eigen-coordinates.

    `LEVEL_PIECES` of each level follow each other.
    """
    rows: FloatArray = polynomial_basis(scheme).matrix @ patch.eigen_children
    base = patch.basis.subdominant
    found = _by_level(rows, patch, base, np.arange(level_count))
    found *= base ** np.repeat(np.arange(level_count), len(rows))[:, None, None]
    # The first eigenvector is constant.
    found[:, 0, 0] = 1
    return found


def _by_level(rows: FloatArray, patch: IrregularPatch, base: float, levels: IntArray) -> FloatArray:
    """Rows ``(c, m, K)`` of regular children times powers of the eigenvalues over a base: ``(levels c, m, K)``."""
    repeated = np.repeat(rows.reshape(-1, 1, rows.shape[2]), len(levels), axis=1)
    found = times_powers(repeated, levels.astype(np.int64), patch.basis, base).reshape(*rows.shape[:2], len(levels), -1)
    return np.moveaxis(found, 2, 0).reshape(-1, *rows.shape[1:])


def _shared_parts(element: PatchTree) -> list[tuple[PatchTree, FloatArray | None]]:
    """The largest parts of few enough pieces, and their control points over those of the element, if it is not one."""
    if element.piece is not None or element.regular_count <= SHARED_PIECES:
        return [(element, None)]
    return [
        (part, of_child if stencils is None else stencils @ of_child)
        for child, of_child in element.children
        for part, stencils in _shared_parts(child)
    ]


@lru_cache(maxsize=1024)
def _regular_pieces(scheme: Scheme, element: PatchTree) -> FloatArray:
    """``(p, m, K)`` coefficients of an element's regular pieces."""
    return element.coefficients(polynomial_basis(scheme).matrix)
