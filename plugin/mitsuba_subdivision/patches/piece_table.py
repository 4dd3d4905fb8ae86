"""The pieces of all patches as flat arrays for kernels: lookup tables, and weights that give their coefficients.

The samples of a kernel are unknown before it runs. So elements are divided completely (`patch_trees`). Each node is an
inner node, with four children or one; a regular piece; or a tip, the patch around an extraordinary point.

Regular pieces, and the three regular children at the first levels of a tip, are polynomials, whose coefficients are
computed once for the control points, and suffice for nearly all samples. Deeper levels are sums by equations (10) and
(12): section 7 of plugin/MATHEMATICS.md. The first eigenvector, which is constant, contributes only to the point.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..evaluation.equations import times_matrix
from ..evaluation.irregular_patch import LEVEL_PIECES, PIECE_LEVELS, IrregularPatch, float32_levels, level_polynomials
from ..evaluation.patch_tree import PartKind, PatchTree
from ..evaluation.polynomials import polynomial_basis
from ..mesh import ragged
from ..mesh.connectivity import IntArray
from ..mesh.shared import Content, shared
from ..messages import counted
from ..schemes.domain import FloatArray
from .patch_table import PatchTable

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
# the frame, unit and mask of the number of levels, unit of the number of terms.
KINDS, TURN = 3, 4
FRAMES, LEVEL, LEVELS, TERM = 3, 4, 1023, 4096
# Where the normals of a tip need a frame in place of the derivatives: nowhere, at the extraordinary point, or at all
# deeper levels (`uneven_frame`).
NO_FRAME, AT_POINT, UNEVEN = range(3)
# Blocks of `Tip.rows` after those of the regular children of a level: the rest, the frame at the point, the factors.
REST, FRAME, FACTORS = LEVEL_PIECES, LEVEL_PIECES + 1, LEVEL_PIECES + 2
# Most bytes of coefficients, in single precision, of the levels of tips that are stored as pieces.
COEFFICIENT_BYTES = 1 << 26
# Maximum number of pieces of a part whose coefficients are stored as a whole. Larger elements are split into parts:
# along semi-sharp creases there are thousands of parts of few kinds, which share coefficients.
SHARED_PIECES = 128
# Rows of `PieceTable.classes`: index of the first entry in `controls`; numbers of patches and of controls per patch;
# first piece, and number of pieces per patch.
CLASS = np.dtype([(name, np.int64) for name in ("first_control", "patches", "controls", "first_piece", "pieces")])


@dataclass(frozen=True, eq=False)
class Tip:
    """Levels of tips of one kind that have no pieces, as sums of terms: polynomials times factors times coordinates."""

    # (r, n) float64: a row for each term, with a coefficient for each monomial, padded to whole packets, in blocks: one
    # for each regular child of level 0; one for the rest, linear with the tangents along the edges; one whose
    # derivatives are the frame of (13). Then, one after another, the factors of all terms for each level, and ones for
    # the rest. If the frame is uneven, the same factors without the second eigenvector, divided by the power of the
    # third eigenvalue, follow.
    rows: FloatArray
    coordinates: FloatArray  # (t, K) float64: coordinates of the terms over the eigen-coordinates
    frame: int  # `NO_FRAME`, `AT_POINT` or `UNEVEN`
    level_count: int


class TreeArrays(NamedTuple):
    """Nodes, pieces and tips of a patch tree, with indices that begin at 0."""

    # (n, 4) int64; the first node is the element. `PartKind` plus `TURN` times `PatchTree.turn`; index of the first of
    # consecutive children, or for a leaf of its first piece; index of a tip in `tips`; `Tip.frame` plus
    # `LEVEL` times the number of its levels, after which its rest begins, plus `TERM` times the number of its terms.
    # Pieces of a tip are consecutive, level by level; the coordinates of its terms are stored after them as pieces,
    # each of which begins with the first coordinate, the extraordinary point.
    nodes: IntArray
    piece_count: int
    # Maps to the coefficients of consecutive pieces: the first piece; (K_part, K) stencils of the control points of a
    # part's one-ring, so that equal parts of many elements share the map, or None for the element's own; and
    # (p, m, K_part) coefficients of the pieces' polynomials over these control points
    maps: tuple[tuple[int, FloatArray | None, FloatArray], ...]
    tips: tuple[Tip, ...]


@dataclass(frozen=True, eq=False)
class PieceTable:
    """The pieces of all patches, and the neighbours of elements, which are identified by one of their half-edges.

    *Coefficients* depend on the control points. They are the polynomials of the pieces of all patches, a number of each
    component for each monomial, padded to whole packets.
    """

    patches: PatchTable
    control_count: int
    piece_levels: int  # Number of levels of tips that are stored as pieces
    piece_count: int
    patch_starts: NDArray[np.uint32]  # (p, 2) uint32: first piece and first node of each patch
    # (n, 4) uint32: `TreeArrays.nodes` of all classes, counted through all of them; for tips the first row of `weights`
    nodes: NDArray[np.uint32]
    elements: tuple[PatchTree, ...]  # Of each class
    tips: tuple[Tip, ...]  # Different ones of all classes
    classes: NDArray[np.void]  # (c,) of type `CLASS`
    control_of_vertex: IntArray  # (n_v,) int64: 0-based control value at each mesh vertex

    @classmethod
    def build(
        cls,
        patches: PatchTable,
        # As for `PatchTable`, by default its own
        control_of_vertex: IntArray | None = None,
        control_count: int = 0,
        # Number of levels of tips that are stored as pieces; fewer where these exceed COEFFICIENT_BYTES
        piece_levels: int = PIECE_LEVELS,
    ) -> PieceTable:
        """Prepare the evaluation of patches. Calls with equal arguments share the object while it is referenced."""
        if control_of_vertex is None:
            control_of_vertex, control_count = patches.control_of_vertex, patches.control_count
        return shared(cls._build, patches, Content(control_of_vertex), control_count, piece_levels)

    @classmethod
    def _build(
        cls, patches: PatchTable, control_of_vertex: Content, control_count: int, piece_levels: int
    ) -> PieceTable:
        table = patches.evaluated
        counts, elements = table.patch_counts, table.trees
        tip_count = int(np.array([len(element.tips) for element in elements]) @ counts)
        packet_count = piece_packets(len(polynomial_basis(table.scheme).powers)) * LEVEL_PIECES * tip_count
        bytes_of_level = 4 * PACKET * packet_count
        if bytes_of_level:
            piece_levels = min(piece_levels, COEFFICIENT_BYTES // bytes_of_level)
        trees = [tree_arrays(element, piece_levels) for element in counted(elements, "Pieces of patch classes")]
        sizes = np.array([tree.piece_count for tree in trees])
        first_pieces, piece_count = ragged.starts(sizes * counts), int(sizes @ counts)
        columns = table.rings.offsets[:-1], counts, table.rings.vertex_counts, first_pieces, sizes
        node_counts = np.array([len(tree.nodes) for tree in trees])
        first_nodes, nodes = ragged.starts(node_counts), np.concatenate([tree.nodes for tree in trees])
        every_tip = [tip for tree in trees for tip in tree.tips]
        tips = tuple(dict.fromkeys(every_tip))
        first_row = dict(zip(tips, ragged.starts(np.array([len(tip.rows) for tip in tips])).tolist(), strict=True))
        nodes[:, 2] += np.repeat(ragged.starts(np.array([len(tree.tips) for tree in trees])), node_counts)
        is_tip = nodes[:, 0] & KINDS == PartKind.TIP
        nodes[is_tip, 2] = np.array([first_row[tip] for tip in every_tip], dtype=np.int64)[nodes[is_tip, 2]]
        is_inner = nodes[:, 0] & KINDS <= PartKind.ONLY_CHILD
        nodes[:, 1] += is_inner * np.repeat(first_nodes, node_counts)
        in_class = ragged.index_in_row(counts)
        starts = np.repeat(first_pieces, counts) + np.repeat(sizes, counts) * in_class, np.repeat(first_nodes, counts)
        return cls(
            patches,
            control_count,
            piece_levels,
            piece_count,
            np.stack(starts, axis=1).astype(np.uint32),
            nodes.astype(np.uint32),
            tuple(elements),
            tips,
            np.array([*zip(*columns, strict=True)], dtype=CLASS),
            control_of_vertex.array,
        )

    @property
    def half_edges(self) -> NDArray[np.uint32]:
        """``(n_h, 4)`` uint32, neighbours and codes of half-edges; computed at each call, as kernels keep the result.

        The columns are the twin, or `NOTHING`; the following and the preceding half-edge in the element; and a code:
        `PATCH` times the index of the patch, plus `WHOLE` if the element is whole, plus `PATCH_CORNER` times the corner
        of the patch at which the half-edge begins, plus the corner of the element if that is whole, else 0.
        """
        patches, t = self.patches, self.patches.elements
        half_edge = np.arange(t.half_edge_count, dtype=np.int32)
        class_index, patch, patch_corner = patches.evaluated_at(half_edge)
        first_patch, face = ragged.starts(patches.evaluated.patch_counts), t.face
        is_whole = patches.is_whole[face]
        columns = np.empty((len(half_edge), 4), dtype=np.uint32)
        columns[:, TWIN] = np.where(t.twin < 0, NOTHING, t.twin.astype(np.int64))
        columns[:, FOLLOWING], columns[:, PRECEDING] = t.next[half_edge], t.prev[half_edge]
        corner = np.where(is_whole, half_edge - t.face_offsets[face], 0)
        patch = first_patch[class_index] + patch
        columns[:, CODE] = PATCH * patch + WHOLE * is_whole + PATCH_CORNER * patch_corner + corner
        return columns


def piece_packets(monomial_count: int, size: int = 3) -> int:
    """Packets of the coefficients of a piece, ``size`` numbers for each monomial."""
    return -(-size * monomial_count // PACKET)


# Tables read each of their hundreds of trees twice, to count and to upload. A tree of a high valence takes megabytes.
@lru_cache(maxsize=512)
def tree_arrays(
    element: PatchTree,
    piece_levels: int = PIECE_LEVELS,  # Number of levels of a tip that are pieces; the others are summed
) -> TreeArrays:
    """Return the arrays of a patch tree."""
    kinds, turns, first = element.nodes.T.copy()
    index, last = np.zeros((2, len(first)), dtype=np.int64)
    # Regular pieces come before those of tips.
    maps, piece_count = [], 0
    parts, rows = _shared_parts(element)
    all_stencils = [None] if rows is None else ragged.rows(rows, [part.control_count for part in parts])
    for part, stencils in zip(parts, all_stencils, strict=True):
        pieces = _regular_pieces(part)
        maps.append((piece_count, stencils, pieces))
        piece_count += len(pieces)
    # In nodes of tips, `first` is the index in `PatchTree.tips`.
    tip_nodes, tips = np.flatnonzero(kinds == PartKind.TIP), list[Tip]()
    for node, piece in zip(tip_nodes[np.argsort(first[tip_nodes])].tolist(), element.tips, strict=True):
        tip, of_levels = _tip(piece.irregular_patch, piece_levels)
        first[node], index[node] = piece_count, len(tips)
        last[node] = tip.frame + LEVEL * tip.level_count + TERM * len(tip.coordinates)
        coordinates = tip.coordinates[1:] @ piece.coordinates
        # Each piece begins with the first coordinate, as the weights of a piece's constant sum to one.
        width = of_levels.shape[1] - 1
        padding = np.zeros((-len(coordinates) % width, coordinates.shape[1]))
        stored = np.concatenate([coordinates, padding]).reshape(-1, width, coordinates.shape[1])
        points = np.broadcast_to(piece.coordinates[0], (len(stored), 1, coordinates.shape[1]))
        pieces = np.concatenate([of_levels @ piece.coordinates, np.concatenate([points, stored], axis=1)])
        maps.append((piece_count, None, pieces))
        tips.append(tip)
        piece_count += len(pieces)
    nodes = np.stack([kinds + TURN * turns, first, index, last], axis=1)
    return TreeArrays(nodes, piece_count, tuple(part for part in maps if len(part[2])), tuple(tips))


@lru_cache(maxsize=1024)
def _tip(patch: IrregularPatch, piece_levels: int) -> tuple[Tip, FloatArray]:
    """Return the terms of a tip, and polynomials ``(n, m, K)`` of its first levels over the eigen-coordinates."""
    basis, polynomials, level_count = patch.basis, polynomial_basis(patch.scheme), float32_levels(patch)
    left, coordinates, factors = basis.power_terms(level_count)
    term_count = len(coordinates)
    blocks: FloatArray = np.zeros((FACTORS, term_count, len(polynomials.powers)))
    blocks[:REST] = (polynomials.matrix @ patch.eigen_children @ left).swapaxes(1, 2)
    u, v = (int(np.flatnonzero((polynomials.powers == power).all(axis=1))[0]) for power in ((1, 0), (0, 1)))
    # The first terms are those of the eigen-coordinates.
    rest, frame = blocks[REST:, : len(basis.eigenvalues)]
    rest[:, [u, v]] = basis.subdominant**level_count * patch.edge_tangents.T
    frame[:, [u, v]] = patch.limit_frame.T
    # Polynomials are about the middle of the domain, and the extraordinary point is at its corner.
    rest[:, 0] = rest[:, [u, v]] @ patch.scheme.domain.centre
    rest_factors, tables = np.ones((1, term_count)), [factors]
    if patch.contracts_unevenly:
        across = factors / basis.moduli[2] ** np.arange(level_count)[:, None]
        across[:, :2] = 0
        tables.append(across)
    values = np.concatenate([part.ravel() for table in tables for part in (table, rest_factors)])
    size = -(-len(polynomials.powers) // PACKET) * PACKET
    rows = np.pad(blocks.reshape(-1, blocks.shape[2]), ((0, 0), (0, size - blocks.shape[2])))
    rows = np.concatenate([rows, np.pad(values, (0, -len(values) % size)).reshape(-1, size)])
    frame_kind = UNEVEN if patch.contracts_unevenly else AT_POINT if patch.has_own_frame else NO_FRAME
    pieces = level_polynomials(patch, polynomials.matrix, np.arange(piece_levels))
    tip = Tip(rows, coordinates, frame_kind, level_count)
    return tip, pieces.reshape(LEVEL_PIECES * piece_levels, *pieces.shape[2:])


@lru_cache(maxsize=1024)
def _shared_parts(element: PatchTree) -> tuple[list[PatchTree], FloatArray | None]:
    """Return the largest parts of at most `SHARED_PIECES` pieces, and all their stencils; None for a whole element."""
    if element.piece is not None or element.regular_count <= SHARED_PIECES:
        return [element], None
    parts, rows = list[PatchTree](), []
    for child, stencils in element.children:
        of_child, of_parts = _shared_parts(child)
        parts += of_child
        rows.append(stencils if of_parts is None else times_matrix(of_parts[None], stencils)[0])
    return parts, np.concatenate(rows)


@lru_cache(maxsize=1024)
def _regular_pieces(element: PatchTree) -> FloatArray:
    """Return ``(p, m, K)`` coefficients of an element's regular pieces."""
    return element.coefficients(polynomial_basis(element.scheme).matrix)
