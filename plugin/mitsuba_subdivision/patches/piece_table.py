"""The pieces of all patches as flat arrays for kernels: lookup tables, and weights that give their coefficients."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import DTypeLike, NDArray

from ..evaluation.patch_tree import PartKind, patch_trees
from ..evaluation.polynomials import polynomial_basis
from ..evaluation.tree_arrays import LEVEL_PIECES, PIECE_LEVELS, TreeArrays, tree_arrays
from ..mesh import ragged
from ..mesh.connectivity import IntArray
from ..mesh.shared import Content, Shared
from ..messages import counted
from ..schemes.domain import FloatArray
from .patch_table import PatchTable

if TYPE_CHECKING:
    from scipy import sparse

# Floats that a kernel reads at once.
PACKET = 4
# Twin of a half-edge on the border.
NOTHING = 0xFFFFFFFF
# Columns of `PieceTable.half_edges`.
TWIN, FOLLOWING, PRECEDING, CODE = range(4)
# Bit fields of a half-edge's code: mask of the corner of the element; units of the corner of the patch, of the flag of
# a whole element, and of the index of the patch.
CORNERS, PATCH_CORNER, WHOLE, PATCH = 3, 4, 16, 32
# Bit fields of the first column of `PieceTable.nodes`: mask of the kind, unit of the turn. Of the last column: mask of
# the frame, unit and mask of the number of levels, unit of the number of controls.
KINDS, TURN = 3, 4
FRAMES, LEVEL, LEVELS, CONTROL = 3, 4, 1023, 4096
# Most bytes of coefficients, in single precision, of the levels of tips that are stored as pieces.
COEFFICIENT_BYTES = 1 << 26


@dataclass(frozen=True, eq=False)
class PieceTable:
    """The pieces of all patches, and the neighbours of elements.

    An element is identified by one of its half-edges, at which parameters start, as in `PatchSampler.evaluate`.

    *Coefficients* depend on the control points. They are the polynomials of the pieces of all patches, three numbers
    for each monomial, padded to whole packets; then, for each patch with tips, the control points of its one-ring, each
    padded to a packet, all but the first one relative to the first one. The whole is padded to whole pieces.
    """

    patches: PatchTable
    control_count: int
    piece_levels: int  # Number of levels of tips that are stored as pieces
    packets_of_piece: int  # Packets of the coefficients of a piece
    packet_count: int  # Packets of all coefficients
    patch_starts: NDArray[np.uint32]  # (p, 2) uint32: first piece and first node of each patch
    # (p,) uint32: first packet of the control points of each patch; any number for patches without tips
    rings: NDArray[np.uint32]
    # (n, 4) uint32: `TreeArrays.kinds` plus `TURN` times the turn; index of the first child, or of the piece, counted
    # from the patch's first piece; row of `weights` at which a tip's blocks begin; `TreeArrays.frames` plus `LEVEL`
    # times the levels plus `CONTROL` times the number of control points in the one-ring
    nodes: NDArray[np.uint32]
    trees: tuple[TreeArrays, ...]  # Of each class
    # (c, 7) uint32, for each class: index of its first entry in `controls`; number of patches, and of controls per
    # patch; first piece; number of pieces per patch; first packet of control points; number of these per patch
    classes: NDArray[np.uint32]
    # (n,) uint32: `PatchTable.controls` as indices of control values, or of refined ones if there is a `refinement`
    controls: NDArray[np.uint32]
    # (n, control_count) matrix from control values to refined ones, if patches are those of the cage refined once
    refinement: sparse.csr_array | None

    @classmethod
    def build(
        cls,
        patches: PatchTable,
        control_of_vertex: IntArray,  # (n_v,) int64: 0-based control value at each mesh vertex
        control_count: int,
        # Number of levels of tips that are stored as pieces; fewer where these exceed COEFFICIENT_BYTES
        piece_levels: int = PIECE_LEVELS,
    ) -> PieceTable:
        """Prepare the evaluation of patches. Calls with equal arguments share the object while it is referenced."""
        key = patches, Content(control_of_vertex), control_count, piece_levels
        return _TABLES.get(key, lambda: cls._build(patches, control_of_vertex, control_count, piece_levels))

    @classmethod
    def _build(
        cls, patches: PatchTable, control_of_vertex: IntArray, control_count: int, piece_levels: int
    ) -> PieceTable:
        refined = patches.refined
        table = patches if refined is None else refined.table
        counts, control_counts = np.array([len(kind.corners) for kind in table.classes]), table.control_counts
        # Building all trees in one call shares most of their data.
        elements = patch_trees(table.scheme, [kind.signature for kind in table.classes])
        packets_of_piece = piece_packets(len(polynomial_basis(table.scheme).powers))
        tip_count = int(np.array([element.tip_count for element in elements]) @ counts)
        bytes_of_level = 4 * PACKET * packets_of_piece * LEVEL_PIECES * tip_count
        if bytes_of_level:
            piece_levels = min(piece_levels, COEFFICIENT_BYTES // bytes_of_level)
        signatures = counted([kind.signature for kind in table.classes], "Pieces of patch classes")
        trees = tuple(tree_arrays(table.scheme, signature, piece_levels) for signature in signatures)
        sizes = np.array([tree.piece_count for tree in trees])
        rings = np.where([len(tree.blocks) > 0 for tree in trees], control_counts, 0)
        first_pieces, piece_count = ragged.starts(sizes * counts), int(sizes @ counts)
        first_rings = packets_of_piece * piece_count + ragged.starts(rings * counts)
        packet_count = packets_of_piece * piece_count + int(rings @ counts)
        first_controls = [kind.first_control for kind in table.classes]
        columns = first_controls, counts, control_counts, first_pieces, sizes, first_rings, rings
        first_nodes = ragged.starts(np.array([len(tree.kinds) for tree in trees]))
        in_class = ragged.index_in_row(counts)
        starts = np.repeat(first_pieces, counts) + np.repeat(sizes, counts) * in_class, np.repeat(first_nodes, counts)
        return cls(
            patches,
            control_count,
            piece_levels,
            packets_of_piece,
            packet_count + -packet_count % packets_of_piece,
            np.stack(starts, axis=1).astype(np.uint32),
            (np.repeat(first_rings, counts) + np.repeat(rings, counts) * in_class).astype(np.uint32),
            _joined_nodes(trees, control_counts.tolist()),
            trees,
            np.stack(columns, axis=1).astype(np.uint32),
            *patches.control_rows(control_of_vertex, control_count),
        )

    def weights(self, size: int, dtype: DTypeLike = np.float64) -> FloatArray:
        """``(w, size)`` blocks of all classes, one row for each control point, padded with zeros.

        Computed at each call, as kernels keep the result.
        """
        rows = np.concatenate([tree.blocks.reshape(-1, tree.blocks.shape[2]) for tree in self.trees], dtype=dtype)
        return np.pad(rows, ((0, 0), (0, size - rows.shape[1])))

    @property
    def half_edges(self) -> NDArray[np.uint32]:
        """``(n_h, 4)`` uint32, neighbours and codes of half-edges; computed at each call, as kernels keep the result.

        The columns are the twin, or `NOTHING`; the following and the preceding half-edge in the element; and a code:
        `PATCH` times the index of the patch, plus `WHOLE` if the element is whole, plus `PATCH_CORNER` times the corner
        of the patch at which the half-edge begins, plus the corner of the element if that is whole, else 0.
        """
        patches = self.patches
        t, refined = patches.elements, patches.refined
        half_edge = np.arange(t.half_edge_count, dtype=np.int32)
        # Face h of the cage refined once lies at half-edge h of the cage, and begins there.
        table = patches if refined is None else refined.table
        patch_half_edge = half_edge if refined is None else table.topology.face_offsets[:-1]
        class_index, patch, patch_corner = table.patch_at(patch_half_edge)
        first_patch = ragged.starts(np.array([len(patch_class.corners) for patch_class in table.classes]))
        face = t.face[half_edge]
        is_whole = patches.is_whole[face]
        columns = np.empty((len(half_edge), 4), dtype=np.uint32)
        columns[:, TWIN] = np.where(t.twin < 0, NOTHING, t.twin.astype(np.int64))
        columns[:, FOLLOWING], columns[:, PRECEDING] = t.next[half_edge], t.prev[half_edge]
        corner = np.where(is_whole, half_edge - t.face_offsets[face], 0)
        patch = first_patch[class_index] + patch
        columns[:, CODE] = PATCH * patch + WHOLE * is_whole + PATCH_CORNER * patch_corner + corner
        return columns


_TABLES: Shared[PieceTable] = Shared()


def piece_packets(monomial_count: int) -> int:
    """Packets of the coefficients of a piece, three numbers for each monomial."""
    return -(-3 * monomial_count // PACKET)


def _joined_nodes(trees: tuple[TreeArrays, ...], control_counts: list[int]) -> NDArray[np.uint32]:
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
