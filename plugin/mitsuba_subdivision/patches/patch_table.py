"""The patch table: the elements of a cage, grouped by the signatures of their one-rings.

One-rings have integer codes, equal for elements of equal signatures, which are computed by whole-array operations. A
one-ring consists of the fans of faces around the vertices of an element. Each fan first gets a code for all that a
`Signature` records of it: the number of faces, their sizes, and the positions of borders and sharp edges, all as seen
from one of the faces. The codes of an element's fans, in order, determine its one-ring. No `Signature` is made per
element, as a cage may have millions of elements, but has few classes.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from ..mesh import ragged
from ..mesh.connectivity import IndexArray, IntArray, Topology, VertexRule
from ..mesh.one_ring import one_ring
from ..mesh.shared import Content, Shared
from ..mesh.signature import NEAR_FACES, Signature, near_behind, signature_at
from ..messages import counted
from ..schemes.domain import FloatArray
from ..schemes.scheme import Scheme

if TYPE_CHECKING:
    from scipy import sparse

# A cage with more than MANY_CLASSES classes, and on average fewer than FEW_PATCHES patches in each, is refined once if
# that divides the number of classes by FEWER: a class costs milliseconds, refining a patch microseconds.
MANY_CLASSES = 100
FEW_PATCHES = 200
FEWER = 4
# Range of codes up to which they are not renumbered: they fit into two bytes, which sort fast.
FEW_CODES = 1 << 16

# Refinement matrices, shared by tessellations and exact shading.
_REFINEMENTS: Shared[sparse.csr_array] = Shared()


@dataclass(frozen=True, eq=False)
class PatchClass:
    """The patches whose one-rings have the same signature, and so the same stencils."""

    signature: Signature
    # (p,) int32: the corner of the element at which each patch begins, a half-edge of `PatchTable.elements`
    corners: IndexArray
    controls: IndexArray  # (p, K) int32: 0-based mesh vertices of each patch's one-ring
    # Index of the first entry of `controls` in `PatchTable.controls`, where the rest follows, column by column
    first_control: int


class PatchTable:
    """All patches of a cage: one for each element that fits the scheme's domain, one at every corner of any other."""

    def __init__(
        self,
        topology: Topology,  # The mesh: the cage, cut along its creases
        scheme: Scheme,
        is_hole: NDArray[np.bool_] | None = None,  # (n_f,) bool: faces that are no elements
        *,
        # Whether a patch may begin at any corner of its element, so that elements whose one-rings are equal up to
        # rotation share a class. If not, a patch begins at its element's first corner.
        may_turn: bool = True,
    ) -> None:
        self.topology, self.scheme, self.is_hole, self.may_turn = topology, scheme, is_hole, may_turn

    @property
    def elements(self) -> Topology:
        """The mesh whose faces are the elements: the cage's mesh, or its dual, whose vertices are the cage's faces.

        A face of the dual begins at the lowest half-edge of its vertex. Holes and border vertices, which are no
        elements, become faces without corners.
        """
        return self._elements[0]

    @property
    def half_edge_of_corner(self) -> IndexArray:
        """``(n_h,)`` the half-edge of the mesh that corresponds to each half-edge of `elements`."""
        return self._elements[1]

    @cached_property
    def _elements(self) -> tuple[Topology, IndexArray]:
        t = self.topology
        if self.scheme.element == "vertex":
            offsets, half_edges = t.vertex_fans
            # A dual edge crosses the cage's edge that two successive faces about a vertex share.
            return Topology(t.face_count, np.diff(offsets), t.face[half_edges], t.edge[t.prev[half_edges]]), half_edges
        if self.is_hole is None or not self.is_hole.any():
            return t, np.arange(t.half_edge_count, dtype=np.int32)
        kept = t.half_edges_of(~self.is_hole).astype(np.int32)
        sizes = np.where(self.is_hole, 0, t.face_sizes)
        return Topology(t.vertex_count, sizes, t.face_vertices[kept], t.edge[kept]), kept

    @cached_property
    def is_whole(self) -> NDArray[np.bool_]:
        """``(n_e,)`` whether each element is a single patch: it has as many corners as the scheme's domain."""
        return self.elements.face_sizes == self.scheme.domain.corner_count

    @property
    def classes(self) -> tuple[PatchClass, ...]:
        """The classes of all patches, in the order of their codes."""
        return self._classes[0]

    @property
    def controls(self) -> IndexArray:
        """`PatchClass.controls` of all classes, flat."""
        return self._classes[1]

    @cached_property
    def control_counts(self) -> IntArray:
        """``(c,)`` K, the number of control points of a patch, of each class."""
        return np.array([patch_class.controls.shape[1] for patch_class in self.classes], dtype=np.int64)

    @cached_property
    def _classes(self) -> tuple[tuple[PatchClass, ...], IndexArray]:
        order, bounds = self._order
        corners_of_class = np.split(self._patch_codes[0][order], bounds)
        signatures = [
            signature_at(self.topology, int(self.half_edge_of_corner[corners[0]]), self.scheme.element)
            for corners in counted(corners_of_class, "Classes of patches")
        ]
        if self.scheme.has_local_borders:
            signatures = [signature.near() for signature in signatures]
        rings = [one_ring(signature) for signature in signatures]
        counts = [ring.vertex_count for ring in rings]
        entry_counts = [count * len(corners) for count, corners in zip(counts, corners_of_class, strict=True)]
        begins = ragged.offsets(entry_counts).tolist()
        controls = np.empty(begins[-1], dtype=np.int32)
        classes = []
        for signature, ring, corners, begin in zip(signatures, rings, corners_of_class, begins[:-1], strict=True):
            columns = controls[begin : begin + ring.vertex_count * len(corners)].reshape(ring.vertex_count, -1)
            class_controls = ring.gather(self.topology, self.half_edge_of_corner[corners], columns)
            classes.append(PatchClass(signature, corners, class_controls, begin))
        return tuple(classes), controls

    @property
    def patch_count(self) -> int:
        return len(self._patch_codes[0])

    @property
    def class_count(self) -> int:
        return len(self._order[1]) + 1

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
    def refined(self) -> RefinedPatches | None:
        """Patches of the cage refined once, if that leaves far fewer classes, see `RefinedPatches`; else None."""
        if self.class_count <= max(MANY_CLASSES, self.patch_count // FEW_PATCHES):
            return None
        if self.elements is not self.topology or not self.scheme.splits_corners:
            return None
        refinement = self.scheme.refine(self.topology)
        table = PatchTable(refinement.topology, self.scheme, may_turn=False)
        if FEWER * table.class_count > self.class_count:
            return None
        return RefinedPatches(table, refinement.stencils.matrix)

    def control_rows(
        self,
        control_of_vertex: IntArray,  # (n_v,) int64: 0-based control value at each mesh vertex
        control_count: int,
    ) -> tuple[NDArray[np.uint32], sparse.csr_array | None]:
        """`controls` as rows of control values; for refined patches, also the matrix that refines the cage's values."""
        refined = self.refined
        if refined is not None:
            from scipy import sparse

            def make() -> sparse.csr_array:
                # Mesh vertices with the same control point share a column, where their weights add up, in place.
                weights, shape = refined.matrix, (refined.matrix.shape[0], control_count)
                columns = control_of_vertex.astype(weights.indices.dtype)[weights.indices]
                matrix = sparse.csr_array((weights.data, columns, weights.indptr), shape=shape, copy=True)
                matrix.sum_duplicates()
                return matrix

            key = refined, Content(control_of_vertex), control_count
            return refined.table.controls.view(np.uint32), _REFINEMENTS.get(key, make)
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
        for index, patch_class in enumerate(self.classes):
            corners = patch_class.corners
            is_whole = self.is_whole[t.face[corners[0]]]
            for turn in range(self.scheme.domain.corner_count if is_whole else 1):
                class_index[corners], patch[corners], patch_corner[corners] = index, np.arange(len(corners)), turn
                corners = t.next[corners]
        return class_index, patch, patch_corner

    @cached_property
    def _patch_codes(self) -> tuple[IndexArray, IntArray]:
        """The corner at which each patch begins, and the patch's code, which is equal for equal signatures."""
        t, fans = self.elements, fan_codes(self.topology, near=self.scheme.has_local_borders)
        if t is not self.topology:
            fans = fans[self.half_edge_of_corner]
        whole = t.face_offsets[:-1][self.is_whole]
        if self.may_turn:
            begins, whole_codes = self._turned_to_least(fans, whole)
        else:
            begins, whole_codes = whole, row_codes(self._keys(fans, whole, self.scheme.domain.corner_count))
        if self.is_whole.all():
            return begins, whole_codes
        corners: list[IntArray] = [begins]
        codes = [whole_codes]
        partial = t.half_edges_of(~self.is_whole)
        sizes = t.face_sizes[t.face[partial]]
        for size in np.flatnonzero(np.bincount(sizes)).tolist():
            corners.append(partial[sizes == size])
            first_unused = 1 + max(int(codes_of_size.max(initial=0)) for codes_of_size in codes)
            codes.append(row_codes(self._keys(fans, corners[-1], size)).astype(np.int64) + first_unused)
        return np.concatenate(corners, dtype=np.int32), np.concatenate(codes)

    def _keys(self, fans: IntArray, corners: IntArray, corner_count: int) -> list[IntArray]:
        """Columns that distinguish the signatures of patches: codes of the fans at all corners, from `corners` on."""
        if self.scheme.element == "vertex":
            return [fans[corners]]
        columns = []
        for _ in range(corner_count):
            columns.append(fans[corners])
            corners = self.elements.next[corners]
        return columns

    def _turned_to_least(
        self,
        fans: IntArray,  # (n_h,) int: codes of the fans at the corners
        corners: IndexArray,  # (n,) int32: first corners of the elements
    ) -> tuple[IndexArray, IntArray]:
        """Begin each whole element at the corner from which its code is least, so that rotated copies get equal codes.

        Returns these corners and the codes.
        """
        count = self.scheme.domain.corner_count
        at_corners = fans[corners + np.arange(count)[:, None]]
        if self.scheme.element == "vertex":
            codes = row_codes([at_corners.ravel()])
        else:
            # Seen from another first corner, an element's columns are rotated.
            around = np.concatenate([at_corners, at_corners], axis=None)
            codes = row_codes([around[corner * len(corners) :][: at_corners.size] for corner in range(count)])
        codes = codes.reshape(at_corners.shape)
        least, turns = codes[0].copy(), np.zeros(len(corners), dtype=np.int32)
        for turn in range(1, count):
            is_less = codes[turn] < least
            turns[is_less] = turn
            np.minimum(least, codes[turn], out=least)
        return corners + turns, least


@dataclass(frozen=True, eq=False)
class RefinedPatches:
    """Patches of a cage refined once, under a scheme that makes a quadrilateral of every face corner.

    They serve cages of many classes: where polygons of many sizes meet vertices of many valences, nearly every patch
    may be the only one of its class, and the stencils of a class take milliseconds. In the refined cage, an old vertex
    has only new neighbours, which are of few kinds, so that few classes are left. Normals in float32 are 2 to 5 times
    less exact, as the refined cage's vertices are rounded.
    """

    table: PatchTable  # Of the refined cage, whose faces are all elements, and whole
    matrix: sparse.csr_array  # (n, n_v) weights of the mesh's vertices at the refined cage's vertices

    def corners(self, patch_class: PatchClass) -> IndexArray:
        """``(p,)`` the corner of the cage's element that each patch covers, a half-edge of the cage's `elements`."""
        # As the scheme `splits_corners`, face h of the refined cage lies at half-edge h of the cage, and begins there.
        return self.table.topology.face[patch_class.corners]


def fan_codes(
    topology: Topology,
    *,
    near: bool = False,  # Whether fans consist of the faces of `Fan.near` only
) -> IntArray:
    """``(n_h,)`` code of the fan around the vertex at which each half-edge begins, seen from the half-edge's face."""
    t = topology
    far_vertices = _has_far_faces(t) if near else np.zeros(0, dtype=bool)
    face_count = np.where(far_vertices, NEAR_FACES, t.vertex_face_count) if far_vertices.any() else t.vertex_face_count
    columns, cut = [row_codes([face_count, _vertex_codes(t)])[t.face_vertices]], None
    if t.is_border_vertex.any():
        behind = _faces_clockwise(t)
        columns.append(behind)
        if far_vertices.any():
            far = np.flatnonzero(far_vertices[t.face_vertices])
            ahead = t.vertex_face_count[t.face_vertices[far]] - behind[far]
            behind[far] = near_behind(ahead, behind[far])
            cut = far, behind[far]
    face_codes = _face_codes(t)
    if (face_codes != face_codes[0]).any():
        columns += _codes_around(t, face_codes, face_count[t.face_vertices], cut)
    return row_codes(columns)


def row_codes(
    columns: Sequence[IntArray],  # sequence of (n,) int: the first column counts most in the order
) -> IntArray:
    """Number the rows of a table: equal rows get equal codes, in lexicographic order.

    Returns (n,) unsigned integers of a type of few bytes, where these suffice.
    """
    codes: IntArray = np.zeros(len(columns[0]), dtype=np.uint8)
    count = 1
    for column in columns:
        low, high = int(column.min(initial=0)), int(column.max(initial=0))
        if low == high:
            continue
        # Renumbering after every column keeps the product of the number of codes and the range of a column small.
        width = high - low + 1
        codes = codes.astype(np.min_scalar_type(count * width))
        codes *= width
        codes += (column - low).astype(codes.dtype)
        count *= width
        if count > 4 * len(codes):
            distinct, codes = np.unique(codes, return_inverse=True)
            count = len(distinct)
        elif count > FEW_CODES:
            is_present = np.zeros(count, dtype=bool)
            is_present[codes] = True
            count = int(np.count_nonzero(is_present))
            codes = (np.cumsum(is_present) - 1).astype(np.min_scalar_type(count))[codes]
    return codes


def _vertex_codes(topology: Topology) -> IntArray:
    """``(n_v,)`` code of each vertex's rule and sharpness, and of semi-sharp edges across a crease at the vertex."""
    t, semi = topology, topology.semi_sharpness
    if semi is None:
        return t.vertex_rules
    vertex = semi.across_vertex
    rows = np.stack([semi.across_sharpness, semi.across_refined, semi.across_sharpens], axis=1)
    order = np.lexsort((*rows.T[::-1], vertex))
    count = np.bincount(vertex, minlength=t.vertex_count)
    across = np.zeros((t.vertex_count, int(count.max(initial=0)), 3))
    across[vertex[order], ragged.index_in_row(count)] = rows[order]
    columns = [semi.vertices, *across.reshape(t.vertex_count, -1).T]
    return row_codes([t.vertex_rules, *map(_value_codes, columns)])


def _face_codes(topology: Topology) -> IntArray:
    """``(n_h,)`` code of each half-edge's face and edge: the size of the face, the sharpness of the edge."""
    t = topology
    size = np.broadcast_to(t.common_size, t.half_edge_count) if t.common_size else t.face_sizes[t.face]
    if t.semi_sharpness is None:
        return size
    return row_codes([size, *map(_value_codes, t.edge_sharpness.T)]).astype(np.int64)


def _faces_clockwise(topology: Topology) -> IntArray:
    """``(n_h,)`` number of faces clockwise of each half-edge's face up to the border; -1 around inner vertices."""
    t = topology
    behind = np.full(t.half_edge_count, -1, dtype=np.int64)
    current, face_count = t.open_fan_start[t.open_fan_start >= 0], 0
    while len(current):
        behind[current] = face_count
        current = t.turn[current]
        current, face_count = current[current >= 0], face_count + 1
    return behind


def _has_far_faces(topology: Topology) -> NDArray[np.bool_]:
    """``(n_v,)`` whether `Fan.near` leaves out faces of the fan around each vertex."""
    t = topology
    is_large = t.is_border_vertex & (t.vertex_face_count > NEAR_FACES)
    return is_large & (t.vertex_rules != VertexRule.DART) & ~t.is_semi_sharp_vertex if is_large.any() else is_large


def _codes_around(
    topology: Topology,
    face_codes: IntArray,  # (n_h,) int: code of each half-edge's face
    face_count: IntArray,  # (n_h,) int: number of faces of the fan around the half-edge's vertex
    # ((m,) int, (m,) int): half-edges whose fans are cut to `NEAR_FACES`, and how many of these faces lie clockwise of
    # the half-edge's face
    cut: tuple[IntArray, IntArray] | None,
) -> tuple[IntArray, IntArray]:
    """Two columns that encode the sequence of faces around the vertex of each half-edge.

    Around a vertex whose faces all have the same code, the first column is that code, and the second is 0. Around any
    other, the first column is 0, and the second is a code, from 1 on, of the sequence of face codes, counter-clockwise
    from the half-edge's face.
    """
    t = topology
    common, sequence = face_codes.astype(np.int64), np.zeros(t.half_edge_count, dtype=np.int64)
    # Past the border of an open fan, the sequence continues at the fan's other end.
    ahead, restart = face_count, t.open_fan_start[t.face_vertices]
    if cut is not None:
        far, behind = cut
        ahead, back = face_count.copy(), far
        for step in range(NEAR_FACES):
            back = np.where(step < behind, t.turn_back[back], back)
        ahead[far], restart[far] = NEAR_FACES - behind, back
    least, greatest = np.full(t.vertex_count, np.iinfo(np.int64).max), np.zeros(t.vertex_count, dtype=np.int64)
    np.minimum.at(least, t.face_vertices, face_codes)
    np.maximum.at(greatest, t.face_vertices, face_codes)
    mixed = np.flatnonzero((least != greatest)[t.face_vertices])
    for n in np.flatnonzero(np.bincount(face_count[mixed])):
        half_edges = mixed[face_count[mixed] == n]
        current, columns = half_edges, []
        for step in range(1, n + 1):
            columns.append(face_codes[current])
            following = t.turn[current]
            current = np.where((following < 0) | (step == ahead[half_edges]), restart[half_edges], following)
        differ = np.any([column != columns[0] for column in columns], axis=0)
        sequence_codes = 1 + row_codes(columns).astype(np.int64)
        common[half_edges] = np.where(differ, 0, columns[0])
        sequence[half_edges] = np.where(differ, sequence_codes, 0)
    return common, sequence


def _value_codes(values: FloatArray) -> IntArray:
    """Number distinct values in ascending order."""
    return np.unique(values, return_inverse=True)[1].ravel()
