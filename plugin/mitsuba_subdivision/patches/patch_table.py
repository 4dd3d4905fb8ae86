"""The patch table: every element of a cage, grouped by the signature of its one-ring."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from ..mesh import ragged
from ..mesh.connectivity import IndexArray, IntArray, Topology, gathered
from ..mesh.one_ring import one_ring
from ..mesh.signature import Signature, signature_at
from ..progress import counted
from ..schemes.domain import FloatArray
from ..schemes.members import optional_member
from ..schemes.scheme import Scheme

if TYPE_CHECKING:
    from scipy import sparse

# With more classes than this, and fewer patches in each, those of the refined cage are used if they are fewer by a
# factor: a class costs some milliseconds, refining a patch some microseconds.
MANY_CLASSES = 100
FEW_PATCHES = 200
FEWER = 4
# So many codes need not be numbered anew: they fit into two bytes, which sort fast.
FEW_CODES = 1 << 16


@dataclass(frozen=True, eq=False)
class PatchClass:
    """Patches of one class.

    Attributes
    ----------
    signature : Signature
    corners : (p,) int32
        The corner of its element that each patch begins at, a half-edge of `PatchTable.elements`.
    controls : (p, K) int32
        0-based cage vertices of each patch's one-ring.
    first_control : int
        Place of the first one in `PatchTable.controls`, where the others follow, column by column.
    """

    signature: Signature
    corners: IndexArray
    controls: IndexArray
    first_control: int


@dataclass(frozen=True, eq=False)
class PatchTable:
    """All patches of a cage. An element that fits the scheme's domain is one patch, another has one at every corner.

    Parameters
    ----------
    topology : Topology
        Of the cage, cut along its creases.
    scheme : Scheme
    is_hole : (n_f,) bool, optional
        Faces that are no elements.
    may_turn : bool
        Whether a patch may begin at any corner of its element, so that turned copies share a class. Else each begins at
        its element's first corner.
    """

    topology: Topology
    scheme: Scheme
    is_hole: NDArray[np.bool_] | None = None
    may_turn: bool = True

    @cached_property
    def elements(self) -> Topology:
        """The mesh whose faces are the elements: the cage, or its dual, whose vertices are the cage's faces.

        Dual faces begin at the lowest half-edge of their vertex. What is no element, a hole or a vertex on a boundary,
        is a face without corners.
        """
        t = self.topology
        if self.scheme.element == "face":
            if not self._has_holes:
                return t
            kept = self.half_edge_of_corner
            sizes = np.where(self.is_hole, 0, t.face_sizes)
            return Topology(t.vertex_count, sizes, t.face_vertices[kept], t.edge[kept])
        offsets, half_edges = t.vertex_fans
        # A dual edge crosses the cage's edge that two successive faces about a vertex share.
        return Topology(t.face_count, np.diff(offsets), t.face_of(half_edges), t.edge[t.preceding(half_edges)])

    @cached_property
    def half_edge_of_corner(self) -> IndexArray:
        """``(n_h,)`` the cage's half-edge that names the element, for each half-edge of `elements`."""
        if self.scheme.element == "face":
            if self._has_holes:
                return self.topology.half_edges_of(~self.is_hole).astype(np.int32)
            return np.arange(self.topology.half_edge_count, dtype=np.int32)
        return self.topology.vertex_fans[1]

    def half_edges(self, corners: IndexArray) -> IndexArray:
        """The cage's half-edges that name the elements, for some corners of `elements`."""
        if self.elements is self.topology:
            return corners
        return gathered(self.half_edge_of_corner, corners)

    @property
    def _has_holes(self) -> bool:
        return self.is_hole is not None and bool(self.is_hole.any())

    @cached_property
    def is_whole(self) -> NDArray[np.bool_]:
        """``(n_e,)`` whether each element has as many corners as the scheme's domain, and so is one patch."""
        return self.elements.face_sizes == self.scheme.domain.corner_count

    @property
    def classes(self) -> tuple[PatchClass, ...]:
        """The classes of its patches."""
        return self._classes[0]

    @property
    def controls(self) -> IndexArray:
        """Those of all classes, flat."""
        return self._classes[1]

    @cached_property
    def _classes(self) -> tuple[tuple[PatchClass, ...], IndexArray]:
        corners, codes = self._patch_codes
        # Few codes sort faster in few bits.
        order = np.argsort(codes.astype(np.min_scalar_type(codes.max())), kind="stable")
        bounds = np.flatnonzero(np.diff(codes[order])) + 1
        members = np.split(gathered(corners, order), bounds)
        signatures = [
            signature_at(self.topology, int(self.half_edges(corners[:1])[0]), self.scheme.element)
            for corners in counted(members, "Classes of patches")
        ]
        counts = [one_ring(signature).vertex_count for signature in signatures]
        begins = ragged.offsets([count * len(corners) for count, corners in zip(counts, members, strict=True)]).tolist()
        controls = np.empty(begins[-1], dtype=np.int32)
        classes = []
        for signature, corners, count, begin in zip(signatures, members, counts, begins[:-1], strict=True):
            columns = controls[begin : begin + count * len(corners)].reshape(count, -1)
            own = one_ring(signature).gather(self.topology, self.half_edges(corners), columns)
            classes.append(PatchClass(signature, corners, own, begin))
        return tuple(classes), controls

    @property
    def patch_count(self) -> int:
        return len(self._patch_codes[0])

    @cached_property
    def class_count(self) -> int:
        return int(np.count_nonzero(np.bincount(self._patch_codes[1])))

    @cached_property
    def refined(self) -> RefinedPatches | None:
        """The patches of the cage refined once, where they save many classes; else None."""
        if self.class_count <= max(MANY_CLASSES, self.patch_count // FEW_PATCHES):
            return None
        if self._has_holes or not optional_member(self.scheme, "splits_corners"):
            return None
        refinement = self.scheme.refine(self.topology)
        table = PatchTable(refinement.topology, self.scheme, may_turn=False)
        if FEWER * table.class_count > self.class_count:
            return None
        return RefinedPatches(table, refinement.stencils.matrix)

    @cached_property
    def place_of_corner(self) -> tuple[IntArray, IntArray, IntArray]:
        """For each half-edge of `elements`, the class, the patch in it, and which corner of the patch this is."""
        t = self.elements
        group, patch, turn = (np.full(t.half_edge_count, -1, dtype=np.int64) for _ in range(3))
        for index, members in enumerate(self.classes):
            current = members.corners
            whole = self.is_whole[t.face_of(current[0])]
            for turned in range(self.scheme.domain.corner_count if whole else 1):
                group[current], patch[current], turn[current] = index, np.arange(len(current)), turned
                current = t.following(current)
        return group, patch, turn

    @cached_property
    def _patch_codes(self) -> tuple[IndexArray, IntArray]:
        """The corner that each patch begins at, and a number that is equal for patches of equal signature."""
        t, fan_codes = self.elements, self._fan_codes()
        whole_corners = t.face_offsets[:-1][self.is_whole]
        if self.may_turn:
            begins, whole_codes = self._turned_to_least(fan_codes, whole_corners)
        else:
            begins = whole_corners
            whole_codes = _row_codes(self._keys(fan_codes, begins, self.scheme.domain.corner_count))
        corners, codes = [begins], [whole_codes]
        if self.is_whole.all():
            return begins, whole_codes
        partial = t.half_edges_of(~self.is_whole)
        sizes = t.face_sizes[t.face_of(partial)]
        for size in np.unique(sizes):
            members = partial[sizes == size]
            offset = 1 + max(int(code.max(initial=0)) for code in codes)
            codes.append(_row_codes(self._keys(fan_codes, members, int(size))).astype(np.int64) + offset)
            corners.append(members)
        return np.concatenate(corners, dtype=np.int32), np.concatenate(codes)

    def _fan_codes(self) -> IntArray:
        """``(n_h,)`` code of the fan that each corner of `elements` sees."""
        codes = _fan_codes(self.topology)
        return codes if self.elements is self.topology else codes[self.half_edge_of_corner]

    def _keys(self, fan_codes: IntArray, corners: IntArray, corner_count: int) -> list[IntArray]:
        """Columns that tell the signatures of elements apart: the fans' codes at their corners."""
        if self.scheme.element == "vertex":
            return [fan_codes[corners]]
        columns = []
        for _ in range(corner_count):
            columns.append(fan_codes[corners])
            corners = self.elements.following(corners)
        return columns

    def _turned_to_least(self, fan_codes: IntArray, corners: IntArray) -> tuple[IntArray, IntArray]:
        """Begin each whole element at the corner that makes its key least, so that turned copies share a class.

        Parameters
        ----------
        fan_codes : (n_h,) int
        corners : (n,) int32
            First corners of the elements.

        Returns
        -------
        corners, codes : (n,) int
            The codes stand for the keys.
        """
        count = self.scheme.domain.corner_count
        if fan_codes.size == count * len(corners):
            # All elements are whole, and their corners follow each other.
            fans = np.ascontiguousarray(fan_codes.reshape(-1, count).T)
        else:
            fans = fan_codes[corners + np.arange(count)[:, None]]
        if self.scheme.element == "vertex":
            codes = _row_codes([fans.ravel()]).reshape(fans.shape)
        else:
            turned = [np.roll(fans, -turn, axis=0) for turn in range(count)]
            codes = _row_codes([np.concatenate(column) for column in zip(*turned, strict=True)]).reshape(fans.shape)
        least, turns = codes[0].copy(), np.zeros(len(corners), dtype=np.int32)
        for turn in range(1, count):
            is_less = codes[turn] < least
            turns[is_less] = turn
            np.minimum(least, codes[turn], out=least)
        return corners + turns, least


@dataclass(frozen=True, eq=False)
class RefinedPatches:
    """Patches of a cage refined once, for the scheme that makes a quadrilateral of every corner.

    Next to each vertex of the refined cage lie new vertices only, of few kinds, whatever polygons meet in the cage.

    Attributes
    ----------
    table : PatchTable
        Of the refined cage: patch ``h`` is the corner at half-edge ``h`` of the cage, and begins there.
    matrix : (n, n_v) sparse array
        The refined cage's vertices as combinations of the cage's.
    """

    table: PatchTable
    matrix: sparse.csr_array


def _fan_codes(topology: Topology) -> IntArray:
    """For each half-edge, a number that stands for the fan of its vertex, seen from its own face."""
    t = topology
    columns = [gathered(_row_codes([t.vertex_face_count, _vertex_codes(t)]), t.face_vertices)]
    if t.is_boundary_vertex.any():
        columns.append(_place_in_fan(t))
    begins = _face_codes(t)
    if (begins != begins[0]).any():
        columns += _codes_around(t, begins)
    return _row_codes(columns)


def _codes_around(topology: Topology, begins: IntArray) -> tuple[IntArray, IntArray]:
    """For each half-edge, the code of its face and 0; at vertices where faces differ, 0 and a code of them all."""
    t = topology
    valence = t.vertex_face_count[t.face_vertices]
    own, around = begins.copy(), np.zeros(t.half_edge_count, dtype=np.int64)
    mixed = np.flatnonzero(_sees_different(t, begins)[t.face_vertices])
    for n in np.unique(valence[mixed]):
        members = mixed[valence[mixed] == n]
        current = members
        columns = []
        for _ in range(n):
            # Past the border of an open fan, begin again at its other end.
            columns.append(begins[current])
            ahead = t.turn(current)
            current = np.where(ahead < 0, t.open_fan_start[t.face_vertices[current]], ahead)
        own[members], around[members] = 0, 1 + _row_codes(columns).astype(np.int64)
    return own, around


def _face_codes(topology: Topology) -> IntArray:
    """For each half-edge, a number for its face's size and the sharpness of the edge at which the face begins."""
    t, semi = topology, topology.semi_sharpness
    size = np.broadcast_to(t.common_size, t.half_edge_count) if t.common_size else t.face_sizes[t.face]
    if semi is None:
        return size
    other = np.where(t.twin < 0, 0, semi.edges_left[t.twin])
    codes = _row_codes([size, *(_value_codes(values) for values in (semi.edges, semi.edges_left, other))])
    return codes.astype(np.int64)


def _vertex_codes(topology: Topology) -> IntArray:
    """For each vertex, a number for its rule and its sharpness, with that of edges beyond a crease."""
    t, semi = topology, topology.semi_sharpness
    if semi is None:
        return t.vertex_rules
    vertex = semi.beyond.vertex
    rows = np.stack([semi.beyond.sharpness, semi.beyond_left, semi.beyond.sharpens], axis=1)
    order = np.lexsort((*rows.T[::-1], vertex))
    count = np.bincount(vertex, minlength=t.vertex_count)
    beyond = np.zeros((t.vertex_count, int(count.max(initial=0)), 3))
    beyond[vertex[order], ragged.places(count)] = rows[order]
    columns = [semi.vertices, *beyond.reshape(t.vertex_count, -1).T]
    return _row_codes([t.vertex_rules, *map(_value_codes, columns)])


def _value_codes(values: FloatArray) -> IntArray:
    """A number for each value, equal for equal values."""
    return np.unique(values, return_inverse=True)[1].ravel()


def _row_codes(columns: Sequence[IntArray]) -> IntArray:
    """A number for each row of some columns, equal for equal rows, ordered as the rows are; of a small type."""
    codes, count = np.zeros(len(columns[0]), dtype=np.uint8), 1
    for column in columns:
        low, high = int(column.min(initial=0)), int(column.max(initial=0))
        if low == high:
            continue
        # Column by column the codes stay few, and their product with a column's range small.
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


def _sees_different(topology: Topology, begins: IntArray) -> NDArray[np.bool_]:
    """``(n_v,)`` whether the faces around each vertex begin differently."""
    t = topology
    smallest = np.full(t.vertex_count, np.iinfo(np.int64).max)
    largest = np.zeros(t.vertex_count, dtype=np.int64)
    np.minimum.at(smallest, t.face_vertices, begins)
    np.maximum.at(largest, t.face_vertices, begins)
    return smallest != largest


def _place_in_fan(topology: Topology) -> IntArray:
    """For each half-edge, how many faces lie clockwise of its own up to the border; -1 around interior vertices."""
    t = topology
    place = np.full(t.half_edge_count, -1, dtype=np.int64)
    current, faces = t.open_fan_start[t.open_fan_start >= 0], 0
    while len(current):
        place[current] = faces
        current = t.turn(current)
        current, faces = current[current >= 0], faces + 1
    return place
