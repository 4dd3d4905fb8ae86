"""Seams of face-varying data, and the mesh on which its values are subdivided like points."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from .connectivity import IntArray, Topology, VertexRule
from .cuts import CutMesh, SharpMesh, Sharpness, cut_along_creases, semi_sharpness_of_cut
from .manifold import NonManifold
from .sharpness import INFINITE


def seams(topology: Topology, indices: IntArray) -> NDArray[np.bool_]:
    """Return ``(n_h,)``: whether each half-edge is on a seam: its faces have different indices at an end of the edge.

    As in OpenSubdiv, indices are compared, not their values.
    """
    t = topology
    inside = np.flatnonzero(t.twin >= 0)
    twin = t.twin[inside]
    is_seam = np.zeros(t.half_edge_count, dtype=bool)
    is_seam[inside] = (indices[inside] != indices[t.next[twin]]) | (indices[t.next[inside]] != indices[twin])
    return is_seam


def cut_along_seams(topology: Topology, seam: NDArray[np.bool_]) -> CutMesh:
    """Cut a mesh along seams, after it was cut along creases. The caller sets the rules of its vertices."""
    sharpness = Sharpness(np.where(seam, INFINITE, 0.0), np.zeros(topology.vertex_count))
    no_corners = np.zeros(topology.vertex_count, dtype=bool)
    return cut_along_creases(SharpMesh(topology, sharpness, no_corners, topology.is_border_vertex))


def value_mesh(
    mesh: SharpMesh,
    mode: str,  # Face-varying interpolation rule, a key of `_CORNERS`
    indices: IntArray,  # (n_h,) int64: 0-based row of the attribute's values at each face corner
) -> tuple[Topology, IntArray]:
    """Return the mesh on which face-varying values are subdivided, in every mode except "all".

    The rules are those of OpenSubdiv 3.5. An edge is a seam as a whole, even if its sides have the same index at one
    end. At a vertex without a seam the values follow the rule of the vertex on the surface: crease, dart or corner. At
    a vertex with a seam each index has a separate rule. It is that of a corner

    - if the vertex is a corner of the surface or non-manifold, and in mode "boundaries";
    - if the faces with this index are not all connected at the vertex, across edges that are neither seams nor creases;
    - if only one face has this index, in every mode except "none";
    - if the vertex has more than two indices, in "corners_plus1" and "corners_plus2";
    - if the vertex has two indices, and the other is a corner by the second condition, in "corners_plus1" and
      "corners_plus2", or by the third condition, in "corners_plus2";
    - if a seam ends at the vertex inside the mesh, in "corners_plus2".

    Otherwise the rule is that of a border. A semi-sharp vertex, or semi-sharp edges between the faces of an index, make
    the index a corner until they have decayed. In "corners_plus1" and "corners_plus2", if a vertex has two indices, the
    semi-sharp edges of one also make the other a corner, if the other has no semi-sharp edges. Semi-sharp edges on a
    seam, and other edges across a seam, have no influence.

    Where a seam ends inside the mesh without a corner, it is a border up to its end; the neighbours of the end on the
    border are the values on the two sides of the seam. At boundary vertices without a seam, mode "boundaries" has
    corners; the other modes except "none" have corners at vertices with one face, for every boundary rule. An edge with
    corners at both ends is interpolated linearly.

    There are two differences from OpenSubdiv 3.5. Where two indices alternate around a vertex (A B A B), OpenSubdiv
    counts the second index twice, and may treat its two parts as unrelated; here both indices are corners. Where
    semi-sharp edges of one index sharpen the other and the seam itself is semi-sharp for longer, in OpenSubdiv the
    other index becomes smooth one refinement late; here both become smooth together.

    Returns the cage's mesh, cut along creases and seams, with the rules that the values follow (faces and half-edges
    keep their indices), and (n,) int64, the 0-based row of the attribute's values at each vertex.
    """
    t = mesh.topology
    seam = seams(t, indices)
    has_own_rules = _has_own_rules(mesh, mode, seam, indices)
    creased = mesh.cut
    topology, vertex = creased.topology, creased.vertex
    rules = topology.vertex_rules.copy()
    if seam.any():
        cut = cut_along_seams(topology, seam)
        topology, vertex, rules = cut.topology, vertex[cut.vertex], rules[cut.vertex]
    value_index = np.zeros(len(vertex), dtype=np.int64)
    value_index[topology.face_vertices] = indices
    copies = np.flatnonzero(has_own_rules[vertex])
    rules[copies] = _rules_at_seams(mesh, mode, vertex[copies], value_index[copies], topology.vertex_face_count[copies])
    if topology is creased.topology and np.array_equal(rules, topology.vertex_rules):
        return topology, value_index

    cut = CutMesh(topology.with_rules(rules, None), vertex)
    is_sharpened_across = ~has_own_rules[vertex]
    if mode in _SHARPENED_ACROSS:
        is_sharpened_across[copies] = _is_sharpened_by_other(mesh, seam, cut, copies)
    semi_sharpness = semi_sharpness_of_cut(mesh, cut, seam | mesh.sharpness.is_infinite, is_sharpened_across)
    return cut.topology.with_rules(rules, semi_sharpness), value_index


def _has_own_rules(mesh: SharpMesh, mode: str, seam: NDArray[np.bool_], indices: IntArray) -> NDArray[np.bool_]:
    """Return ``(n_v,)``: whether the rules of values at each vertex may differ from those of the surface."""
    t = mesh.topology
    has_own_rules = np.zeros(t.vertex_count, dtype=bool)
    has_own_rules[t.face_vertices[seam]] = True
    if mesh.non_manifold is not None:
        has_own_rules |= _differs(t, mesh.non_manifold, indices)
    if mode == "boundaries":
        has_own_rules |= mesh.is_boundary_vertex
    elif mode != "none":
        has_own_rules |= mesh.is_boundary_vertex & (t.vertex_face_count == 1)
    return has_own_rules


def _differs(topology: Topology, non_manifold: NonManifold, indices: IntArray) -> NDArray[np.bool_]:
    """Return ``(n_v,)``: whether indices differ at a non-manifold vertex, or at an end of a non-manifold edge there."""
    t = topology

    def varies(group: IntArray, values: IntArray, count: int) -> NDArray[np.bool_]:
        """Return ``(count,)``: whether the values of each group differ."""
        last = np.zeros(count, dtype=np.int64)
        last[group] = values
        differs = np.zeros(count, dtype=bool)
        differs[group[last[group] != values]] = True
        return differs

    sides = np.flatnonzero(non_manifold.is_edge & ~non_manifold.is_own_edge)
    start, end = sides, t.next[sides]
    # Two ends of each edge: first the end at the lower vertex, then the other.
    is_down = t.face_vertices[start] > t.face_vertices[end]
    edge_end = 2 * non_manifold.edge[sides].astype(np.int64)
    count = 2 * int(non_manifold.edge.max()) + 2
    edge_ends = np.concatenate([edge_end + is_down, edge_end + ~is_down])
    torn = np.logical_or(*varies(edge_ends, indices[np.concatenate([start, end])], count).reshape(-1, 2).T)
    is_torn = np.zeros(t.half_edge_count, dtype=bool)
    is_torn[sides] = torn[non_manifold.edge[sides]]
    vertices = np.flatnonzero(non_manifold.is_vertex[t.face_vertices])
    return t.ends_of(is_torn) | varies(t.face_vertices[vertices], indices[vertices], t.vertex_count)


# For each mode, the `_corner_conditions` under which a value at a seam is a corner.
_NONE = ("corner", "torn")
_CORNERS_ONLY = (*_NONE, "one_face")
_CORNERS_PLUS1 = (*_CORNERS_ONLY, "many", "beside_torn")
_CORNERS_PLUS2 = (*_CORNERS_PLUS1, "beside_one_face", "end_of_seam")
_CORNERS = {
    "none": _NONE,
    "corners_only": _CORNERS_ONLY,
    "corners_plus1": _CORNERS_PLUS1,
    "corners_plus2": _CORNERS_PLUS2,
    "boundaries": ("always",),
}
# Modes in which semi-sharp edges of one of two values at a vertex sharpen the other.
_SHARPENED_ACROSS = ("corners_plus1", "corners_plus2")


def _rules_at_seams(
    mesh: SharpMesh, mode: str, vertex: IntArray, value_index: IntArray, face_count: IntArray
) -> NDArray[np.int8]:
    """Return ``(c,)`` rules of copies of vertices, given each copy's vertex, value and number of faces."""
    # Pairs encoded as one number are sorted several times faster.
    value_count = int(value_index.max(initial=0)) + 1
    pairs, value_of = np.unique(vertex * value_count + value_index, return_inverse=True)
    holds = _corner_conditions(mesh, pairs // value_count, np.bincount(value_of), np.bincount(value_of, face_count))
    is_corner = np.any([holds[condition] for condition in _CORNERS[mode]], axis=0)
    return np.where(is_corner, VertexRule.CORNER, VertexRule.AUTOMATIC).astype(np.int8)[value_of]


def _corner_conditions(
    mesh: SharpMesh,
    vertex: IntArray,  # (c,) int: the mesh's vertex of each value
    copy_count: IntArray,  # (c,) int: number of the vertex's copies with each value
    face_count: IntArray,  # (c,) int: number of the vertex's faces with each value
) -> dict[str, NDArray[np.bool_]]:
    """Return the conditions under which a value at a seam may be a corner, each ``(c,)``.

    A value stands for all copies of one vertex that have the same row of the attribute.
    """
    count = mesh.topology.vertex_count
    vertex_value_count = np.bincount(vertex, minlength=count)[vertex]
    is_corner = mesh.is_corner if mesh.non_manifold is None else mesh.is_corner | mesh.non_manifold.is_vertex
    # Torn: the faces with the value are on different sides of another seam or crease, or touch only at the vertex.
    is_torn, has_one_face = copy_count > 1, face_count == 1

    def one_of_two(holds: NDArray[np.bool_]) -> NDArray[np.bool_]:
        """Return whether the value is one of two at its vertex, and a condition holds for either of them."""
        return (vertex_value_count == 2) & (np.bincount(vertex, holds, minlength=count)[vertex] > 0)

    return {
        "always": np.ones(len(vertex), dtype=bool),
        "corner": is_corner[vertex],
        "torn": is_torn,
        "one_face": has_one_face,
        "many": vertex_value_count > 2,
        "beside_torn": one_of_two(is_torn),
        "beside_one_face": one_of_two(has_one_face),
        "end_of_seam": (vertex_value_count == 1) & ~mesh.is_boundary_vertex[vertex],
    }


def _is_sharpened_by_other(
    mesh: SharpMesh, seam: NDArray[np.bool_], cut: CutMesh, copies: IntArray
) -> NDArray[np.bool_]:
    """Return ``(c,)``: whether each copy is smooth and one of two at its vertex, so that the other copy sharpens it.

    A copy is smooth if no semi-sharp edges are between its faces and its vertex is not semi-sharp.
    """
    t, sharpness = mesh.topology, mesh.sharpness
    semi_sharp = (sharpness.edges > 0) & ~sharpness.is_infinite & (t.twin >= 0) & ~seam
    is_sharp = np.bincount(cut.topology.face_vertices, semi_sharp, minlength=len(cut.vertex)) > 0
    vertex = cut.vertex[copies]
    is_one_of_two = np.bincount(cut.vertex, minlength=t.vertex_count)[vertex] == 2
    return is_one_of_two & ~is_sharp[copies] & (sharpness.vertices[vertex] == 0)
