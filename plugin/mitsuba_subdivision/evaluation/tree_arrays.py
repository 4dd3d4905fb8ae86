"""Patch trees as flat arrays with the polynomials of all pieces, for kernels that evaluate them at any parameters.

The samples of a kernel are unknown before it runs. So elements are divided completely (`patch_trees`). Each node is an
inner node, with four children or one; a regular piece; or a tip, the patch around an extraordinary point.

A regular piece is a polynomial, whose coefficients are weights times the control points of the element's one-ring. So
is each of the three regular children at the first levels of a tip. These coefficients are computed once for the control
points, and suffice for nearly all samples: after three levels a 64th of a tip's domain is left.

Deeper levels use equations (10) and (12) as a table. A *block* has a row for each control point of the one-ring, and a
column for each monomial of the scheme's `PolynomialBasis`. The sum of rows times control points, relative to the first
control point, gives coefficients. The first eigenvector, which is constant, contributes only to the point itself.
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
from .irregular_patch import IrregularPatch, float32_levels, level_polynomials
from .patch_tree import PartKind, PatchTree, patch_trees
from .polynomials import polynomial_basis

# Default number of levels of a tip that are stored as pieces. Their normals need no frames: derivatives become more
# parallel at each level, but at these single precision keeps enough bits of their cross product.
PIECE_LEVELS = 3
# Number of regular children of a tip at each level.
LEVEL_PIECES = 3
# Maximum number of pieces of a part whose coefficients are stored as a whole. Larger elements are split into parts:
# along semi-sharp creases there are thousands of parts of few kinds, which share coefficients.
SHARED_PIECES = 64


class FrameKind(IntEnum):
    """Where the normals of a tip need a frame in place of the derivatives."""

    DERIVATIVES = 0  # Nowhere
    AT_POINT = 1  # At the extraordinary point
    UNEVEN = 2  # At all deeper levels: `uneven_frame`


class PieceMap(NamedTuple):
    """Map from the control points of the element's one-ring to the coefficients of consecutive pieces."""

    first_piece: int
    # (K_part, K) float64: stencils of the control points of a part's one-ring, so that equal parts of many elements
    # share ``pieces``. None if ``pieces`` are over the element's one-ring.
    stencils: FloatArray | None
    pieces: FloatArray  # (p, m, K_part) float64: coefficients of the pieces' polynomials over control points


@dataclass(frozen=True, eq=False)
class TreeArrays:
    """Nodes, pieces and blocks of a patch tree."""

    kinds: IntArray  # (n,) uint32: `PartKind` of each node. The first node is the element.
    turns: IntArray  # (n,) uint32: `PatchTree.turn` of each node
    # (n,) uint32: for an inner node the first of its consecutive children. For a leaf the number of its first piece;
    # the pieces of a tip are consecutive, level by level.
    first: IntArray
    piece_count: int
    maps: tuple[PieceMap, ...]  # Maps to the coefficients of all pieces
    frames: IntArray  # (n,) uint32: `FrameKind` of a tip, else 0
    levels: IntArray  # (n,) uint32: number of levels of a tip, after which its rest begins; else 0
    # (n,) uint32: first block of a tip. Blocks of a tip: one for each regular child of each deeper level; one for the
    # rest, linear with the tangents along the edges; one whose derivatives are the frame of (13). If the frame is
    # uneven, another one for each regular child of each deeper level: the point without the second eigenvector, divided
    # by the power of the third eigenvalue.
    first_block: IntArray
    # (b, K, m) float64. Row 0 has no weights, as the first control point, relative to itself, is zero. In uneven tips
    # row 0 is the polynomial of the second eigenvector, for `uneven_frame`.
    blocks: FloatArray


# A tree takes up to some megabytes at high valences.
@lru_cache(maxsize=128)
def tree_arrays(
    scheme: Scheme,
    signature: Signature,
    piece_levels: int = PIECE_LEVELS,  # Number of levels of a tip that are pieces; the others are blocks
) -> TreeArrays:
    """Return the arrays of the patch tree of a signature."""
    (element,) = patch_trees(scheme, [signature])
    kinds, turns, first = element.nodes.T.copy()
    # Regular pieces come before those of tips.
    maps, piece_count = [], 0
    for part, stencils in _shared_parts(element):
        pieces = _regular_pieces(scheme, part)
        maps.append(PieceMap(piece_count, stencils, pieces))
        piece_count += len(pieces)
    frames, levels, first_block = np.zeros((3, len(first)), dtype=np.int64)
    blocks: list[FloatArray] = [np.empty((0, element.control_count, len(polynomial_basis(scheme).powers)))]
    block_count = 0
    # In nodes of tips, `first` is the index in `PatchTree.tips`.
    tip_nodes = np.flatnonzero(kinds == PartKind.TIP)
    for node, piece in zip(tip_nodes[np.argsort(first[tip_nodes])].tolist(), element.tips, strict=True):
        tip_pieces, tip_rows, first_rows, frames[node], levels[node] = _tip(scheme, piece.irregular_patch, piece_levels)
        first[node], first_block[node] = piece_count, block_count
        maps.append(PieceMap(piece_count, None, tip_pieces @ piece.coordinates))
        tip_blocks = (tip_rows @ piece.coordinates).swapaxes(1, 2).copy()
        tip_blocks[: len(first_rows), 0] = first_rows
        blocks.append(tip_blocks)
        piece_count, block_count = piece_count + len(tip_pieces), block_count + len(tip_blocks)
    return TreeArrays(
        kinds,
        turns,
        first,
        piece_count,
        tuple(piece_map for piece_map in maps if len(piece_map.pieces)),
        frames,
        levels,
        first_block,
        np.concatenate(blocks),
    )


# A tip takes some megabytes at high valences.
@lru_cache(maxsize=16)
def _tip(
    scheme: Scheme, patch: IrregularPatch, piece_levels: int
) -> tuple[FloatArray, FloatArray, FloatArray, FrameKind, int]:
    """Return polynomials of a tip over the eigen-coordinates.

    Returns those of the pieces ``(n, m, K)``; the blocks ``(b, m, K)``; row 0 of the first l blocks ``(l, m)``, see
    `TreeArrays.blocks`; the kind of frame; and the number of levels, as in `TreeArrays.levels`.
    """
    basis, polynomials, level_count = patch.basis, polynomial_basis(scheme), float32_levels(patch)
    by_level = level_polynomials(patch, polynomials.matrix, np.arange(level_count))
    shape = -1, *by_level.shape[2:]
    deeper = by_level[piece_levels:]
    rest: FloatArray = np.zeros((2, *shape[1:]))
    u, v = (int(np.flatnonzero((polynomials.powers == power).all(axis=1))[0]) for power in ((1, 0), (0, 1)))
    rest[0, [u, v]], rest[1, [u, v]] = basis.subdominant**level_count * patch.edge_tangents, patch.limit_frame
    # Polynomials are about the middle of the domain, and the extraordinary point is at its corner.
    rest[0, 0] = polynomials.centre @ rest[0, [u, v]]
    rest[0, 0, 0] = 1
    blocks, second_eigenvector = [deeper.reshape(shape), rest], 0 * by_level[0, :, :, 0]
    frame = FrameKind.AT_POINT if patch.has_own_frame else FrameKind.DERIVATIVES
    if patch.contracts_unevenly:
        across = deeper / basis.moduli[2] ** np.arange(piece_levels, level_count)[:, None, None, None]
        across[..., :2] = 0
        blocks.append(across.reshape(shape))
        frame, second_eigenvector = FrameKind.UNEVEN, by_level[0, :, :, 1]
    second_eigenvector = np.tile(second_eigenvector, (len(deeper), 1))
    return by_level[:piece_levels].reshape(shape), np.concatenate(blocks), second_eigenvector, frame, level_count


def _shared_parts(element: PatchTree) -> list[tuple[PatchTree, FloatArray | None]]:
    """Return the largest parts with at most `SHARED_PIECES` pieces, and their stencils; None for the whole element."""
    if element.piece is not None or element.regular_count <= SHARED_PIECES:
        return [(element, None)]
    return [
        (part, child_stencils if stencils is None else stencils @ child_stencils)
        for child, child_stencils in element.children
        for part, stencils in _shared_parts(child)
    ]


@lru_cache(maxsize=1024)
def _regular_pieces(scheme: Scheme, element: PatchTree) -> FloatArray:
    """Return ``(p, m, K)`` coefficients of an element's regular pieces."""
    return element.coefficients(polynomial_basis(scheme).matrix)
