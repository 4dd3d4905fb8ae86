"""Everything that evaluates a cage's patches anywhere, as flat arrays: what a kernel needs to look up."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from ..evaluation.piece_tree import NodeKind, PieceTree, piece_tree
from ..mesh import ragged
from ..mesh.connectivity import IntArray
from ..mesh.shared import Content, Shared
from ..progress import counted
from ..schemes.domain import FloatArray
from .patch_table import PatchTable

if TYPE_CHECKING:
    from scipy import sparse

# In place of a twin, where there is none.
NOTHING = 0xFFFFFFFF
# Columns of `PieceTable.half_edges`.
TWIN, FOLLOWING, PRECEDING, CLASS = range(4)
# What `PieceTable.patch_codes` are made of: the corner of the element, the corner of the patch in units of this,
# whether the element is whole, and the number of the patch.
CORNERS, PATCH_CORNER, WHOLE, PATCH = 3, 4, 16, 32


@dataclass(frozen=True, eq=False)
class PieceTable:
    """The pieces of all patches, and how to get from one element to the next.

    An element is named by one of its half-edges, and parameters are seen from there, as in `evaluate_patches`.

    Attributes
    ----------
    patches : PatchTable
    control_count : int
    half_edges : (n_h, 4) uint32
        Of each half-edge of the elements its twin, or `NOTHING`; the following and the preceding one in its element;
        the class of its patch.
    patch_codes : (n_h,) uint32
        Number of its patch in the class, times `PATCH`; plus `WHOLE` if its element is whole; plus `PATCH_CORNER` times
        the corner of the patch at which it begins; plus the corner of its element if that is whole, else 0.
    classes : (c, 4) uint32
        Index of a class's first control in ``controls``, its numbers of patches and of controls, its first node.
    nodes : (n, 4) uint32
        `PieceTree.kinds` plus 8 times the turn; first child or order or row of weights; `PieceTree.frames` plus 4 times
        the number of levels; row of ``slow``.
    shrinking : (n,) float64
        `PieceTree.shrinking`.
    weights : (w, m) float64
        Blocks of all classes, one row for each control point.
    slow : (c, m) float64
        `PieceTree.slow` of all classes.
    orders : (o, R) uint32
        `PieceTree.orders`.
    controls : (n,) uint32
        `PatchTable.controls`, as indices of control values; of refined ones if there is a ``refinement``.
    refinement : (n, control_count) sparse array or None
        Makes refined control values, where the patches are those of the cage refined once.
    """

    patches: PatchTable
    control_count: int
    half_edges: NDArray[np.uint32]
    patch_codes: NDArray[np.uint32]
    classes: NDArray[np.uint32]
    nodes: NDArray[np.uint32]
    shrinking: FloatArray
    weights: FloatArray
    slow: FloatArray
    orders: NDArray[np.uint32]
    controls: NDArray[np.uint32]
    refinement: sparse.csr_array | None

    @classmethod
    def build(cls, patches: PatchTable, row: IntArray, control_count: int) -> PieceTable:
        """Prepare the evaluation of some patches; the same object for equal arguments, while somebody holds it.

        Parameters
        ----------
        patches : PatchTable
        row : (n_v,) int64
            0-based control value at each mesh vertex.
        control_count : int

        Raises
        ------
        SchemeError
            As `piece_tree`.
        """
        key = patches, Content(row), control_count
        return _TABLES.get(key, lambda: cls._build(patches, row, control_count))

    @classmethod
    def _build(cls, patches: PatchTable, row: IntArray, control_count: int) -> PieceTable:
        refined = patches.refined
        table = patches if refined is None else refined.table
        trees = [piece_tree(table.scheme, each.signature) for each in counted(table.classes, "Pieces of patch classes")]
        controls, refinement = patches.control_rows(row, control_count)
        first_nodes = ragged.starts(np.array([len(tree.kinds) for tree in trees]))
        classes = [
            (each.first_control, len(each.corners), each.controls.shape[1], first)
            for each, first in zip(table.classes, first_nodes, strict=True)
        ]
        half_edges, patch_codes = _half_edges(patches)
        return cls(
            patches,
            control_count,
            half_edges,
            patch_codes,
            np.array(classes, dtype=np.uint32),
            _joined_nodes(trees),
            np.concatenate([tree.shrinking for tree in trees]),
            np.concatenate([tree.blocks.reshape(-1, tree.blocks.shape[2]) for tree in trees]),
            np.concatenate([tree.slow for tree in trees]),
            np.concatenate([tree.orders for tree in trees]),
            controls,
            refinement,
        )


_TABLES: Shared[PieceTable] = Shared()


def _half_edges(patches: PatchTable) -> tuple[NDArray[np.uint32], NDArray[np.uint32]]:
    """`PieceTable.half_edges` and `PieceTable.patch_codes`."""
    t, refined = patches.elements, patches.refined
    every = np.arange(t.half_edge_count, dtype=np.int32)
    # Face h of the cage refined once lies at half-edge h of the cage, and begins there.
    found = patches.patch_of_corner if refined is None else refined.table.patch_of_corner
    own = every if refined is None else refined.table.topology.face_offsets[:-1]
    class_index, patch, patch_corner = (values[own] for values in found)
    twin = np.where(t.twin < 0, NOTHING, t.twin.astype(np.int64))
    face = t.face_of(every)
    is_whole = patches.is_whole[face]
    corner = np.where(is_whole, every - t.face_offsets[face], 0)
    half_edges = np.stack(
        [twin, t.following(every), t.preceding(every), class_index], axis=1, dtype=np.uint32, casting="unsafe"
    )
    return half_edges, (PATCH * patch + WHOLE * is_whole + PATCH_CORNER * patch_corner + corner).astype(np.uint32)


def _joined_nodes(trees: list[PieceTree]) -> NDArray[np.uint32]:
    """`PieceTable.nodes`."""
    nodes, first_node, first_row, first_slow, first_order = [], 0, 0, 0, 0
    for tree in trees:
        blocks = np.isin(tree.kinds, (NodeKind.REGULAR, NodeKind.IRREGULAR))
        first = np.where(blocks, first_row + tree.first * tree.blocks.shape[1], tree.first + first_node)
        first = np.where(tree.kinds == NodeKind.OWN_POINTS, tree.first + first_order, first)
        frames = tree.frames + 4 * tree.levels
        nodes.append(np.stack([tree.kinds + 8 * tree.turns, first, frames, tree.slow_rows + first_slow], axis=1))
        first_node += len(tree.kinds)
        first_row += tree.blocks.shape[0] * tree.blocks.shape[1]
        first_slow += len(tree.slow)
        first_order += len(tree.orders)
    return np.concatenate(nodes).astype(np.uint32)
