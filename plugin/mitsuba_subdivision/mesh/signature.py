"""Signatures: the shapes of one-rings, on which limit stencils depend.

An element is a part of the mesh with its own parameter domain: a face, or under Doo-Sabin a vertex. It is named by a
half-edge, which also determines the corner with parameters (0, 0). A face element is the face of the half-edge, and
(0, 0) is where the half-edge begins. A vertex element is the vertex where the half-edge begins, and (0, 0) is in the
half-edge's face. The one-ring of a face is all faces that share a vertex with it. The one-ring of a vertex is all faces
around it. The limit surface over an element depends on its one-ring only.

A mesh may have millions of elements, but has few kinds of one-rings. So the fans of a one-ring also have integer codes
(`fan_codes`), equal for equal fans, which whole-array operations compute for all half-edges of a mesh.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Literal, NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray

from . import ragged
from .connectivity import IntArray, Topology, VertexRule

ElementKind = Literal["face", "vertex"]
Number = TypeVar("Number", int, IntArray)

# Maximum number of faces of an open fan in a one-ring, see `Fan.near`.
NEAR_FACES = 64
# Range of codes up to which they are not renumbered: they fit into two bytes, which sort fast.
FEW_CODES = 1 << 16


class Fan(NamedTuple):
    """Faces around a vertex, from the first on, and semi-sharp features; without indices, so that fans can be equal."""

    ahead: tuple[int, ...]  # Sizes of the faces from the first on, counter-clockwise up to the border, or all around
    # Sizes of the other faces, clockwise from the first up to the border; None if the faces go all around
    behind: tuple[int, ...] | None = None
    rule: VertexRule = VertexRule.AUTOMATIC
    # (sharpness, refined sharpness of the half at the vertex, refined sharpness of the other half) of the first edge of
    # each face, from the most clockwise face on; empty where nothing is semi-sharp
    edges: tuple[tuple[float, float, float], ...] = ()
    vertex: float = 0.0  # Sharpness of the vertex
    # (sharpness, refined sharpness of the half at the vertex, whether the edge sharpens the vertex) of semi-sharp edges
    # across the cut, in increasing order
    across: tuple[tuple[float, float, bool], ...] = ()

    @property
    def is_closed(self) -> bool:
        """Whether the faces go all around the vertex."""
        return self.behind is None

    @property
    def is_inside(self) -> bool:
        """Whether the vertex is smooth and inside the mesh."""
        return self.is_closed and self.rule == VertexRule.AUTOMATIC and not self.is_semi_sharp

    @property
    def is_semi_sharp(self) -> bool:
        return bool(self.edges)

    @property
    def face_count(self) -> int:
        return len(self.ahead) + len(self.behind or ())

    def near(self) -> Fan:
        """Return the fan without faces whose influence on the first face is negligible.

        A large open fan is reduced to the `NEAR_FACES` around the first face, see section 6 of plugin/MATHEMATICS.md;
        its outermost neighbours remain those on the borders (`OneRing.open_fans`).
        """
        # At a dart, faces on both sides of its crease interact.
        is_dart = self.rule == VertexRule.DART
        if self.behind is None or is_dart or self.is_semi_sharp or self.face_count <= NEAR_FACES:
            return self
        behind = near_behind(len(self.ahead), len(self.behind))
        return self._replace(ahead=self.ahead[: NEAR_FACES - behind], behind=self.behind[:behind])

    def smoothed(self) -> Fan:
        """Return the fan without semi-sharp features."""
        return Fan(self.ahead, self.behind, self.rule)


def near_behind(ahead: Number, behind: Number) -> Number:
    """Return how many of `NEAR_FACES` lie behind the first face, which is in their middle unless a border is near."""
    return np.minimum(behind, NEAR_FACES - np.minimum(ahead, NEAR_FACES // 2))


@dataclass(frozen=True)
class Signature:
    """Shape of a one-ring, from the half-edge of the element on. Equal signatures have the same limit stencils."""

    kind: ElementKind
    # Of a face, the fans at its corners, counter-clockwise, which begin with the element; the one fan of a vertex
    fans: tuple[Fan, ...]

    def __hash__(self) -> int:
        return self._hash

    @cached_property
    def _hash(self) -> int:
        # Kept, as signatures are keys of many caches, and fans take long to hash.
        return hash(self.fans)

    @property
    def sharpness(self) -> float:
        """Largest sharpness of all semi-sharp features; 0 if there are none."""
        return max(max(fan.vertex, *(row[0] for row in (*fan.edges, *fan.across)), 0.0) for fan in self.fans)

    @cached_property
    def is_semi_sharp(self) -> bool:
        """Whether there are semi-sharp features."""
        return any(fan.edges for fan in self.fans)

    @cached_property
    def smoothed(self) -> Signature:
        """The signature without semi-sharp features."""
        return Signature(self.kind, tuple(fan.smoothed() for fan in self.fans)) if self.is_semi_sharp else self

    def rotated(self, corner: int) -> Signature:
        """Return the signature of the same element, named by a later corner, or face of its vertex."""
        if self.kind == "face":
            return Signature("face", self.fans[corner:] + self.fans[:corner])
        fan = self.fans[0]
        if not fan.is_closed:
            raise TypeError("a vertex on a border; expected one amid faces, as another has a first and a last face")
        ahead = fan.ahead[corner:] + fan.ahead[:corner]
        return Signature("vertex", (fan._replace(ahead=ahead, edges=fan.edges[corner:] + fan.edges[:corner]),))


def signatures_at(
    topology: Topology,
    half_edges: IntArray,
    kind: ElementKind,
    codes: IntArray | None = None,  # (n_h,) int: codes of fans, if known, see `fan_codes`
    *,
    near: bool = False,  # Whether to leave out faces of negligible influence, see `Fan.near`
) -> list[Signature]:
    """Return the signatures of many elements. Equal ones are the same object."""
    counts = topology.face_sizes[topology.face[half_edges]] if kind == "face" else np.ones(len(half_edges), dtype=int)
    corners = topology.along_faces(half_edges, counts)
    codes = corners if codes is None else codes[corners]
    _, first, which = np.unique(codes, return_index=True, return_inverse=True)
    fans, number = _fans_at(topology, corners[first])
    fans = [fan.near() for fan in fans] if near else fans
    keys = [*map(tuple, ragged.rows(number[which].tolist(), counts))]
    signatures = {key: Signature(kind, tuple(fans[number] for number in key)) for key in dict.fromkeys(keys)}
    return [signatures[key] for key in keys]


def _fans_at(topology: Topology, half_edges: IntArray) -> tuple[list[Fan], IntArray]:
    """Return the fans around vertices, from a half-edge's face on: the different ones, and that of each half-edge."""
    t, semi, vertices = topology, topology.semi_sharpness, topology.face_vertices[half_edges]
    starts, face_counts = t.open_fan_start[vertices], t.vertex_face_count[vertices]
    vertex_codes, fans, number = _vertex_codes(t), list[Fan](), np.empty(len(half_edges), dtype=np.int64)
    for face_count in np.flatnonzero(np.bincount(face_counts)).tolist():
        of_count = np.flatnonzero(face_counts == face_count)
        is_open = starts[of_count] >= 0
        rows = [np.where(is_open, starts[of_count], half_edges[of_count])]  # From the most clockwise half-edge on
        for _ in range(face_count - 1):
            rows.append(t.turn[rows[-1]])
        around = np.stack(rows, axis=1)
        behind = np.argmax(around == half_edges[of_count, None], axis=1)
        face_codes = _face_codes(t, np.concatenate(rows)).reshape(face_count, -1)
        columns = [vertex_codes[vertices[of_count]], is_open, behind, *face_codes]
        _, first, which = np.unique(row_codes(columns), return_index=True, return_inverse=True)
        number[of_count] = which + len(fans)
        centres, around, begin = vertices[of_count[first]], around[first], len(fans)
        facts = t.face_sizes[t.face[around]], behind[first], is_open[first], t.vertex_rules[centres]
        for sizes, count, has_border, rule in zip(*(fact.tolist() for fact in facts), strict=True):
            fans.append(Fan(tuple(sizes[count:]), tuple(sizes[:count][::-1]) if has_border else None, VertexRule(rule)))
        if semi is None:
            continue
        for index in np.flatnonzero(t.is_semi_sharp_vertex[centres]).tolist():
            here = semi.across_vertex == centres[index]
            features = semi.across_sharpness[here], semi.across_refined[here], semi.across_sharpens[here]
            across = tuple(sorted(zip(*(feature.tolist() for feature in features), strict=True)))
            edges = tuple(map(tuple, t.edge_sharpness[around[index]].tolist()))
            sharpness = float(semi.vertices[centres[index]])
            fans[begin + index] = fans[begin + index]._replace(edges=edges, vertex=sharpness, across=across)
    return fans, number


def fan_codes(
    topology: Topology,
    *,
    near: bool = False,  # Whether fans consist of the faces of `Fan.near` only
) -> IntArray:
    """``(n_h,)`` code of the fan around the vertex at which each half-edge begins, seen from the half-edge's face."""
    t = topology
    # Vertices at which `Fan.near` leaves out faces
    far_vertices = t.is_border_vertex & (t.vertex_face_count > NEAR_FACES) & near
    if far_vertices.any():
        far_vertices &= (t.vertex_rules != VertexRule.DART) & ~t.is_semi_sharp_vertex
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
    """Number the rows of a table in lexicographic order, equal rows alike, by unsigned integers of few bytes."""
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


def _face_codes(topology: Topology, half_edges: IntArray | slice = slice(None)) -> IntArray:
    """Return the code of each half-edge's face and edge: the size of the face, the sharpness of the edge."""
    t, face = topology, topology.face[half_edges]
    size = np.broadcast_to(t.common_size, len(face)) if t.common_size else t.face_sizes[face]
    if t.semi_sharpness is None:
        return size
    return row_codes([size, *map(_value_codes, t.edge_sharpness[half_edges].T)]).astype(np.int64)


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


def _codes_around(
    topology: Topology,
    face_codes: IntArray,  # (n_h,) int: code of each half-edge's face
    face_count: IntArray,  # (n_h,) int: number of faces of the fan around the half-edge's vertex
    # ((m,) int, (m,) int): half-edges whose fans are cut to `NEAR_FACES`, and the number of near faces clockwise
    cut: tuple[IntArray, IntArray] | None,
) -> tuple[IntArray, IntArray]:
    """Two columns that encode the sequence of faces around the vertex of each half-edge.

    Where all faces have the same code, that code, and 0. Elsewhere 0, and a code, from 1 on, of the sequence of face
    codes, counter-clockwise from the half-edge's face.
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


def _value_codes(values: NDArray[np.float64]) -> IntArray:
    """Number distinct values ``>= 0`` in ascending order."""
    codes = np.zeros(len(values), dtype=np.int64)
    # Most are zero, and sorting takes long.
    positive = np.flatnonzero(values)
    codes[positive] = 1 + np.unique(values[positive], return_inverse=True)[1]
    return codes
