"""Integer codes of one-rings, equal for elements of equal signatures, computed by whole-array operations.

A one-ring consists of the fans of faces around the vertices of an element. Each fan first gets a code for all that a
`Signature` records of it: the number of faces, their sizes, and the positions of borders and sharp edges, all as seen
from one of the faces. The codes of an element's fans, in order, determine its one-ring. No `Signature` is made per
element, as a cage may have millions of elements, but has few classes.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from ..mesh import ragged
from ..mesh.connectivity import IntArray, Topology, VertexRule
from ..mesh.signature import NEAR_FACES, near_behind
from ..schemes.domain import FloatArray

# Range of codes up to which they are not renumbered: they fit into two bytes, which sort fast.
FEW_CODES = 1 << 16


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
    t, semi = topology, topology.semi_sharpness
    size = np.broadcast_to(t.common_size, t.half_edge_count) if t.common_size else t.face_sizes[t.face]
    if semi is None:
        return size
    left_at_other_end = np.where(t.twin < 0, 0, semi.edges_refined[t.twin])
    sharpness = (semi.edges, semi.edges_refined, left_at_other_end)
    return row_codes([size, *map(_value_codes, sharpness)]).astype(np.int64)


def _faces_clockwise(topology: Topology) -> IntArray:
    """``(n_h,)`` number of faces clockwise of each half-edge's face up to the border; -1 around inner vertices."""
    t = topology
    behind = np.full(t.half_edge_count, -1, dtype=np.int64)
    current, face_count = t.open_fan_start[t.open_fan_start >= 0], 0
    while len(current):
        behind[current] = face_count
        current = t.turn(current)
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
            back = np.where(step < behind, t.turn_back(back), back)
        ahead[far], restart[far] = NEAR_FACES - behind, back
    mixed = np.flatnonzero(_sees_different_faces(t, face_codes)[t.face_vertices])
    for n in np.flatnonzero(np.bincount(face_count[mixed])):
        half_edges = mixed[face_count[mixed] == n]
        current, columns = half_edges, []
        for step in range(1, n + 1):
            columns.append(face_codes[current])
            following = t.turn(current)
            current = np.where((following < 0) | (step == ahead[half_edges]), restart[half_edges], following)
        differ = np.any([column != columns[0] for column in columns], axis=0)
        sequence_codes = 1 + row_codes(columns).astype(np.int64)
        common[half_edges] = np.where(differ, 0, columns[0])
        sequence[half_edges] = np.where(differ, sequence_codes, 0)
    return common, sequence


def _sees_different_faces(topology: Topology, face_codes: IntArray) -> NDArray[np.bool_]:
    """``(n_v,)`` whether the faces around each vertex have different codes."""
    t = topology
    least = np.full(t.vertex_count, np.iinfo(np.int64).max)
    greatest = np.zeros(t.vertex_count, dtype=np.int64)
    np.minimum.at(least, t.face_vertices, face_codes)
    np.maximum.at(greatest, t.face_vertices, face_codes)
    return least != greatest


def _value_codes(values: FloatArray) -> IntArray:
    """Number distinct values in ascending order."""
    return np.unique(values, return_inverse=True)[1].ravel()
