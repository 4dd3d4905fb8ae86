"""The pieces of all patches as flat arrays, for kernels: matrices that make their coefficients, and their lookup."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import DTypeLike, NDArray

from ..evaluation.patch_tree import PartKind, patch_trees
from ..evaluation.polynomials import polynomial_basis
from ..evaluation.tree_arrays import LEVEL_PIECES, PIECE_LEVELS, PieceMap, TreeArrays, tree_arrays
from ..mesh import ragged
from ..mesh.connectivity import IntArray
from ..mesh.shared import Content, Shared
from ..progress import counted
from ..schemes.domain import FloatArray
from .patch_table import PatchTable

if TYPE_CHECKING:
    from scipy import sparse

# Numbers are read in packets of this many.
PACKET = 4
# In place of a twin, where there is none.
NOTHING = 0xFFFFFFFF
# Columns of `PieceTable.half_edges`.
TWIN, FOLLOWING, PRECEDING, CODE = range(4)
# Fields of a half-edge's code: the corner of the element, the corner of the patch in units of this, whether the element
# is whole, and the number of the patch.
CORNERS, PATCH_CORNER, WHOLE, PATCH = 3, 4, 16, 32
# Of the first column of `PieceTable.nodes`: the kind, and the turn in units of this. Of the last: the frame, the number
# of levels, and the number of controls.
KINDS, TURN = 3, 4
FRAMES, LEVEL, LEVELS, CONTROL = 3, 4, 1023, 4096
# Levels of tips are left to the deeper ones if their coefficients would take more than this, in single precision.
COEFFICIENT_BYTES = 1 << 26


@dataclass(frozen=True, eq=False)
class PieceTable:
    """The pieces of all patches, and the neighbours of elements.

    An element is named by one of its half-edges, and parameters are seen from there, as in `PatchSampler.evaluate`.

    *Coefficients* depend on the control points: the polynomials of the pieces of all patches, three numbers for each
    monomial, padded to whole packets of four; then for each patch with tips the control points of its one-ring, each
    padded to a packet and all but the first relative to that; padded to whole pieces.
    """

    patches: PatchTable
    control_count: int
    piece_levels: int  # Number of levels of tips that are pieces
    patch_starts: NDArray[np.uint32]  # (p, 2) uint32: of each patch its first piece and its first node
    # (p,) uint32: first packet of the control points of each patch; any number for patches without tips
    rings: NDArray[np.uint32]
    # (n, 4) uint32: `TreeArrays.kinds` plus `TURN` times the turn; first child, or the piece, counted from the patch's
    # first; first row of ``weights`` of a tip's blocks; `TreeArrays.frames` plus `LEVEL` times the levels plus
    # `CONTROL` times the number of control points in the one-ring
    nodes: NDArray[np.uint32]
    trees: tuple[TreeArrays, ...]  # Of each class
    # (c, 7) uint32: of each class the index of its first control in ``controls``, its numbers of patches and of
    # controls, its first piece, how many pieces each patch has, its first packet of control points, and how many of
    # these each patch has
    classes: NDArray[np.uint32]
    # (n,) uint32: `PatchTable.controls`, as indices of control values; of refined ones if there is a ``refinement``
    controls: NDArray[np.uint32]
    # (n, control_count) sparse array or None: makes refined control values, where the patches are those of the cage
    # refined once
    refinement: sparse.csr_array | None

    @classmethod
    def build(
        cls,
        patches: PatchTable,
        control_of_vertex: IntArray,  # (n_v,) int64: 0-based control value at each mesh vertex
        control_count: int,
        # Number of levels of tips that are pieces, if these do not take too much memory
        piece_levels: int = PIECE_LEVELS,
    ) -> PieceTable:
        """Prepare the evaluation of some patches; equal arguments share the object while it is referenced."""
        key = patches, Content(control_of_vertex), control_count, piece_levels
        return _TABLES.get(key, lambda: cls._build(patches, control_of_vertex, control_count, piece_levels))

    @classmethod
    def _build(
        cls, patches: PatchTable, control_of_vertex: IntArray, control_count: int, piece_levels: int
    ) -> PieceTable:
        refined = patches.refined
        table = patches if refined is None else refined.table
        counts = np.array([len(each.corners) for each in table.classes])
        # All at once, as they share most of their data.
        elements = patch_trees(table.scheme, [each.signature for each in table.classes])
        packets_of_piece = piece_packets(len(polynomial_basis(table.scheme).powers))
        tip_counts = np.array([element.tip_count for element in elements])
        bytes_of_level = 4 * PACKET * packets_of_piece * LEVEL_PIECES * int((tip_counts * counts).sum())
        if bytes_of_level:
            piece_levels = min(piece_levels, COEFFICIENT_BYTES // bytes_of_level)
        signatures = counted([each.signature for each in table.classes], "Pieces of patch classes")
        trees = [tree_arrays(table.scheme, signature, piece_levels) for signature in signatures]
        has_ring = np.array([len(tree.blocks) > 0 for tree in trees])
        rings = has_ring * np.array([each.controls.shape[1] for each in table.classes])
        sizes = np.array([tree.piece_count for tree in trees])
        controls, refinement = patches.control_rows(control_of_vertex, control_count)
        first_pieces = ragged.starts(sizes * counts)
        first_nodes = ragged.starts(np.array([len(tree.kinds) for tree in trees]))
        first_rings = packets_of_piece * int((sizes * counts).sum()) + ragged.starts(rings * counts)
        classes = [
            (each.first_control, *each.controls.shape, *columns)
            for each, *columns in zip(table.classes, first_pieces, sizes, first_rings, rings, strict=True)
        ]
        starts = [
            np.stack([piece + size * np.arange(count), np.full(count, node)], axis=1)
            for piece, size, count, node in zip(first_pieces, sizes, counts, first_nodes, strict=True)
        ]
        rings_of_patches = [
            first + ring * np.arange(count) for first, ring, count in zip(first_rings, rings, counts, strict=True)
        ]
        return cls(
            patches,
            control_count,
            piece_levels,
            np.concatenate(starts).astype(np.uint32),
            np.concatenate(rings_of_patches).astype(np.uint32),
            _joined_nodes(trees, [each.controls.shape[1] for each in table.classes]),
            tuple(trees),
            np.array(classes, dtype=np.uint32),
            controls,
            refinement,
        )

    @property
    def maps(self) -> list[tuple[PieceMap, ...]]:
        """`TreeArrays.maps` of each class."""
        return [tree.maps for tree in self.trees]

    def weights(self, size: int, dtype: DTypeLike = np.float64) -> FloatArray:
        """``(w, size)`` blocks of all classes, one row for each control point, padded with zeros.

        Made at each call, as kernels keep them.
        """
        found = np.zeros((sum(tree.blocks.shape[0] * tree.blocks.shape[1] for tree in self.trees), size), dtype)
        end = 0
        for rows in (tree.blocks.reshape(-1, tree.blocks.shape[2]) for tree in self.trees):
            begin, end = end, end + len(rows)
            found[begin:end, : rows.shape[1]] = rows
        return found

    @property
    def half_edges(self) -> NDArray[np.uint32]:
        """``(n_h, 4)`` uint32, neighbours and codes of half-edges; computed at each call, as kernels keep it.

        Of each half-edge of the elements its twin, or `NOTHING`; the following and the preceding one in its element;
        and its code: the number of its patch times `PATCH`; plus `WHOLE` if its element is whole; plus `PATCH_CORNER`
        times the corner of the patch at which it begins; plus the corner of its element if that is whole, else 0.
        """
        patches = self.patches
        t, refined = patches.elements, patches.refined
        every = np.arange(t.half_edge_count, dtype=np.int32)
        # Face h of the cage refined once lies at half-edge h of the cage, and begins there.
        table = patches if refined is None else refined.table
        own = every if refined is None else table.topology.face_offsets[:-1]
        class_index, patch, patch_corner = table.patch_at(own)
        first_patch = ragged.starts(np.array([len(each.corners) for each in table.classes]))
        face = t.face[every]
        is_whole = patches.is_whole[face]
        found = np.empty((len(every), 4), dtype=np.uint32)
        found[:, TWIN] = np.where(t.twin < 0, NOTHING, t.twin.astype(np.int64))
        found[:, FOLLOWING], found[:, PRECEDING] = t.next[every], t.prev[every]
        corner = np.where(is_whole, every - t.face_offsets[face], 0)
        patch = first_patch[class_index] + patch
        found[:, CODE] = PATCH * patch + WHOLE * is_whole + PATCH_CORNER * patch_corner + corner
        return found

    @property
    def packets_of_piece(self) -> int:
        """Packets of a piece's coefficients."""
        return piece_packets(len(polynomial_basis(self.patches.scheme).powers))

    @property
    def packet_count(self) -> int:
        """Number of packets of all coefficients."""
        _, patches, _, _, pieces, _, rings = self.classes.astype(np.int64).T
        of_piece = self.packets_of_piece
        count = int((patches * (of_piece * pieces + rings)).sum())
        return count + -count % of_piece


_TABLES: Shared[PieceTable] = Shared()


def piece_packets(monomial_count: int) -> int:
    """Packets of a piece's coefficients, three numbers for each monomial."""
    return -(-3 * monomial_count // PACKET)


def _joined_nodes(trees: list[TreeArrays], control_counts: list[int]) -> NDArray[np.uint32]:
    """`PieceTable.nodes`."""
    nodes, first_node, first_row = [], 0, 0
    for tree, control_count in zip(trees, control_counts, strict=True):
        first = np.where(tree.kinds >= PartKind.REGULAR, tree.first, tree.first + first_node)
        ends = tree.frames + LEVEL * tree.levels + CONTROL * control_count
        rows = first_row + tree.first_block * control_count
        nodes.append(np.stack([tree.kinds + TURN * tree.turns, first, rows, ends], axis=1))
        first_node += len(tree.kinds)
        first_row += len(tree.blocks) * control_count
    return np.concatenate(nodes).astype(np.uint32)
