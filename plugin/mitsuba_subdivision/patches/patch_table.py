"""The patch table: the elements of a cage, grouped by the signatures of their one-rings.

One-rings have integer codes, equal for elements of equal signatures, which are computed by whole-array operations: the
codes of an element's fans (`fan_codes`), in order, determine its one-ring. No `Signature` is made per element, as a
cage may have millions of elements, but has few classes.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property, partial

import numpy as np
from numpy.typing import NDArray

from ..evaluation.patch_tree import PatchTree, patch_trees
from ..mesh import ragged
from ..mesh.connectivity import IndexArray, IntArray, Topology
from ..mesh.one_ring import RingTable, one_rings
from ..mesh.shared import Content, forget, shared_by_key
from ..mesh.signature import Signature, fan_codes, row_codes, signatures_at
from ..schemes.domain import FloatArray
from ..schemes.scheme import Scheme, StencilTable

# A cage with more than MANY_CLASSES classes, and on average fewer than FEW_PATCHES patches in each, is refined once if
# that divides the number of classes by FEWER: a class costs milliseconds, refining a patch microseconds.
MANY_CLASSES = 100
FEW_PATCHES = 200
FEWER = 4


@dataclass(frozen=True, eq=False)
class PatchClass:
    """The patches whose one-rings have the same signature, and so the same stencils."""

    signature: Signature
    # (p,) int32: the corner of the element at which each patch begins, a half-edge of `PatchTable.elements`
    corners: IndexArray
    control_count: int  # K
    # Index in `PatchTable.controls` of the first control point; the others follow, column by column
    first_control: int


class PatchTable:
    """All patches of a cage: one for each element that fits the scheme's domain, one at every corner of any other."""

    def __init__(
        self,
        topology: Topology,  # The mesh: the cage, cut along its creases
        scheme: Scheme,
        is_hole: NDArray[np.bool_] | None = None,  # (n_f,) bool: faces that are no elements
        # (n_v,) int64: 0-based control point at each mesh vertex, and number of control points. By default mesh
        # vertices are control points.
        control_of_vertex: IntArray | None = None,
        control_count: int | None = None,
        *,
        # Whether a patch may begin at any corner of its element, so that elements whose one-rings are equal up to
        # rotation share a class. If not, a patch begins at its element's first corner.
        may_turn: bool = True,
    ) -> None:
        self.topology, self.scheme, self.is_hole, self.may_turn = topology, scheme, is_hole, may_turn
        count = topology.vertex_count
        self.control_of_vertex = np.arange(count) if control_of_vertex is None else control_of_vertex
        self.control_count = count if control_count is None else control_count
        # The mesh whose faces are the elements: the cage's mesh, or its dual, whose vertices are the cage's faces. A
        # face of the dual begins at the lowest half-edge of its vertex. Holes and border vertices, which are no
        # elements, become faces without corners.
        self.elements = topology
        # `half_edge_of_corner`; None if it is the identity, as for most cages
        self._half_edges: IndexArray | None = None
        t = topology
        if scheme.element == "vertex":
            offsets, half_edges = t.vertex_fans
            # A dual edge crosses the cage's edge that two successive faces about a vertex share.
            self.elements = Topology(t.face_count, np.diff(offsets), t.face[half_edges], t.edge[t.prev[half_edges]])
            self._half_edges = half_edges
        elif is_hole is not None and is_hole.any():
            self._half_edges = kept = t.half_edges_of(~is_hole).astype(np.int32)
            sizes = np.where(is_hole, 0, t.face_sizes)
            self.elements = Topology(t.vertex_count, sizes, t.face_vertices[kept], t.edge[kept])

    @cached_property
    def half_edge_of_corner(self) -> IndexArray:
        """``(n_h,)`` the half-edge of the mesh that corresponds to each half-edge of `elements`."""
        if self._half_edges is not None:
            return self._half_edges
        return np.arange(self.topology.half_edge_count, dtype=np.int32)

    @cached_property
    def is_whole(self) -> NDArray[np.bool_]:
        """``(n_e,)`` whether each element is a single patch: it has as many corners as the scheme's domain."""
        return self.elements.face_sizes == self.scheme.domain.corner_count

    @cached_property
    def classes(self) -> tuple[PatchClass, ...]:
        """The classes of all patches, in the order of their codes."""
        rings, corners = self.rings, ragged.rows(self._patch_codes[0][self._order[0]], self.patch_counts)
        columns = self._signatures, corners, rings.vertex_counts.tolist(), rings.offsets[:-1].tolist()
        return tuple(PatchClass(*row) for row in zip(*columns, strict=True))

    @property
    def controls(self) -> IndexArray:
        """`controls_of` of all classes, flat."""
        return self.rings.vertices

    def controls_of(self, patch_class: PatchClass, controls: IntArray | None = None) -> IntArray:
        """``(p, K)`` 0-based mesh vertices of each patch's one-ring; or those of others in the order of `controls`."""
        flat, first = self.controls if controls is None else controls, patch_class.first_control
        end = first + patch_class.control_count * len(patch_class.corners)
        return flat[first:end].reshape(patch_class.control_count, -1).T

    @cached_property
    def _signatures(self) -> list[Signature]:
        first = self._patch_codes[0][self._order[0][[0, *self._order[1]]]]
        half_edges = self.half_edge_of_corner[first]
        kind, is_local = self.scheme.element, self.scheme.has_local_borders
        return signatures_at(self.topology, half_edges, kind, self._patch_codes[2], near=is_local)

    @cached_property
    def rings(self) -> RingTable:
        """The one-rings of all patches, class by class."""
        half_edges = self.half_edge_of_corner[self._patch_codes[0][self._order[0]]]
        return RingTable(self.topology, one_rings(self._signatures), half_edges, self.patch_counts)

    def forget(self) -> None:
        """Drop data that are computed again on demand, for a mesh that only its kernels evaluate."""
        forget(self, self.topology, self.elements)

    @property
    def patch_count(self) -> int:
        return len(self._patch_codes[0])

    @property
    def class_count(self) -> int:
        return len(self._order[1]) + 1

    @property
    def patch_counts(self) -> IntArray:
        """``(c,)`` number of patches of each class."""
        return np.diff([0, *self._order[1], self.patch_count])

    @property
    def trees(self) -> list[PatchTree]:
        """The completely divided patch tree of each class. One call makes all, as they share most of their data."""
        return patch_trees(self.scheme, [patch_class.signature for patch_class in self.classes])

    @cached_property
    def _order(self) -> tuple[IntArray, IntArray]:
        """Patches sorted by their codes, and the indices at which all classes but the first begin."""
        codes = self._patch_codes[1]
        # Integers of few bits sort faster.
        codes = codes.astype(np.min_scalar_type(codes.max()), copy=False)
        order = np.argsort(codes, kind="stable")
        sorted_codes = codes[order]
        return order, np.flatnonzero(sorted_codes[1:] != sorted_codes[:-1]) + 1

    @cached_property
    def refined(self) -> tuple[PatchTable, StencilTable] | None:
        """Patches of the cage refined once, and the stencils of its vertices, if that leaves far fewer classes.

        As where polygons of many sizes meet vertices of many valences, and nearly every patch is a class: after a
        refinement, an old vertex has only new neighbours, which are of few kinds. All faces of the refined cage are
        elements, and whole. Normals in float32 are 2 to 5 times less exact, as its vertices are rounded.
        """
        if self.class_count <= max(MANY_CLASSES, self.patch_count // FEW_PATCHES):
            return None
        if self.elements is not self.topology or not self.scheme.splits_corners:
            return None
        refinement = self.scheme.refine(self.topology)
        table = PatchTable(refinement.topology, self.scheme, may_turn=False)
        if FEWER * table.class_count > self.class_count:
            return None
        return table, refinement.stencils

    @property
    def evaluated(self) -> PatchTable:
        """The table whose patches are evaluated: that of the cage refined once, or this one."""
        return self if self.refined is None else self.refined[0]

    def places(self, patch_class: PatchClass) -> IndexArray:
        """``(p,)`` the corner of the element that each patch of `evaluated` covers, a half-edge of `elements`."""
        # As the scheme `splits_corners`, face h of the refined cage lies at half-edge h of the cage, and begins there.
        return patch_class.corners if self.refined is None else self.evaluated.topology.face[patch_class.corners]

    def evaluated_at(self, corners: IntArray) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.int64]]:
        """`patch_at` in `evaluated`, for half-edges of this table's `elements` at which its patches begin."""
        table = self.evaluated
        return table.patch_at(corners if table is self else table.topology.face_offsets[corners])

    def evaluated_points(self, points: FloatArray) -> FloatArray:
        """``(n, k)`` values at the vertices of the mesh of `evaluated`, from those at this table's mesh vertices."""
        return points if self.refined is None else self.refined[1].matrix @ points

    def control_rows(
        self,
        # By default those of the table
        control_of_vertex: IntArray | None = None,
        control_count: int = 0,
    ) -> tuple[NDArray[np.uint32], StencilTable | None]:
        """`controls` as rows of control values; for refined patches, also stencils that refine the cage's values."""
        if control_of_vertex is None:
            control_of_vertex, control_count = self.control_of_vertex, self.control_count
        if self.refined is not None:
            key = _over_control_values, self, Content(control_of_vertex), control_count
            over_values = partial(_over_control_values, self.refined[1], control_of_vertex, control_count)
            return self.evaluated.controls.view(np.uint32), shared_by_key(key, over_values)
        controls = self.controls
        if not np.array_equal(control_of_vertex, np.arange(len(control_of_vertex))):
            controls = control_of_vertex.astype(np.int32)[controls]
        return controls.view(np.uint32), None

    def patch_at(self, corners: IntArray) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.int64]]:
        """Look up half-edges of `elements`. Returns the class, the patch in it, and the corner of the patch."""
        class_index, patch, patch_corner = (column[corners].astype(np.int64) for column in self._patch_of_corner)
        return class_index, patch, patch_corner

    @cached_property
    def _patch_of_corner(self) -> tuple[IntArray, IndexArray, NDArray[np.int8]]:
        """`patch_at` for all half-edges, in small integer types, as a cage may have millions of them."""
        t = self.elements
        dtypes = np.min_scalar_type(-self.class_count), np.int32, np.int8
        class_index, patch, patch_corner = (np.full(t.half_edge_count, -1, dtype=dtype) for dtype in dtypes)
        corners, counts = self._patch_codes[0][self._order[0]], self.patch_counts
        in_class, index = np.repeat(np.arange(len(counts)), counts), ragged.index_in_row(counts)
        class_index[corners], patch[corners], patch_corner[corners] = in_class, index, 0
        if self.is_whole.any():
            is_whole = self.is_whole[t.face[corners]]
            corners, in_class, index = corners[is_whole], in_class[is_whole], index[is_whole]
            for turn in range(1, self.scheme.domain.corner_count):
                corners = t.next[corners]
                class_index[corners], patch[corners], patch_corner[corners] = in_class, index, turn
        return class_index, patch, patch_corner

    @cached_property
    def _patch_codes(self) -> tuple[IndexArray, IntArray, IntArray]:
        """The corner at which each patch begins; its code, equal for equal signatures; and `fan_codes` of the mesh."""
        t, of_mesh = self.elements, fan_codes(self.topology, near=self.scheme.has_local_borders)
        fans = of_mesh if t is self.topology else of_mesh[self.half_edge_of_corner]
        begins, whole_codes = self._turned_to_least(fans, t.face_offsets[:-1][self.is_whole])
        corners: list[IntArray] = [begins]
        codes = [whole_codes]
        sizes = np.where(self.is_whole, 0, t.face_sizes)
        for size in (1 + np.flatnonzero(np.bincount(sizes)[1:])).tolist():
            corners.append(t.half_edges_of(sizes == size))
            # Codes of the fans at all corners, from the first one on, distinguish the signatures of patches.
            around = t.around_faces(corners[-1], 1 if self.scheme.element == "vertex" else size)
            first_unused = 1 + max(int(codes_of_size.max(initial=0)) for codes_of_size in codes)
            codes.append(first_unused + row_codes([fans[corner] for corner in around]).astype(np.uint32))
        return np.concatenate(corners, dtype=np.int32), np.concatenate(codes), of_mesh

    def _turned_to_least(
        self,
        fans: IntArray,  # (n_h,) int: codes of the fans at the corners
        corners: IndexArray,  # (n,) int32: first corners of the elements
    ) -> tuple[IndexArray, IntArray]:
        """Begin each whole element at the corner from which its code is least, so that rotated copies get equal codes.

        Returns these corners, the first ones if patches may not turn, and the codes.
        """
        count = self.scheme.domain.corner_count
        turn_count = count if self.may_turn else 1
        at_corners = fans[corners + np.arange(count)[:, None]]
        # Seen from another first corner, an element's columns are rotated.
        around = np.concatenate([at_corners, at_corners], axis=None)
        columns = range(1 if self.scheme.element == "vertex" else count)
        length = turn_count * len(corners)
        codes = row_codes([around[column * len(corners) :][:length] for column in columns])
        codes = codes.reshape(turn_count, len(corners))
        return corners + codes.argmin(axis=0).astype(np.int32), codes.min(axis=0)


def _over_control_values(stencils: StencilTable, control_of_vertex: IntArray, control_count: int) -> StencilTable:
    """Stencils over control values, sorted. Weights of vertices with the same value add up."""
    columns = control_of_vertex.astype(np.int32)[stencils.columns]
    order, begins = ragged.sorted_order(stencils.rows * np.int64(control_count) + columns)
    first, weights = order[begins], np.add.reduceat(stencils.weights[order], np.flatnonzero(begins))
    return StencilTable(stencils.row_count, control_count, stencils.rows[first], columns[first], weights)
