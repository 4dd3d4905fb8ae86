"""Seams of face-varying data: the mesh on which its values are subdivided as points are."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from .connectivity import IntArray, Topology, VertexRule
from .cuts import CutMesh, SharpMesh, Sharpness, cut_along_creases, semi_sharpness_of_cut
from .manifold import NonManifold
from .sharpness import INFINITE


def seams(topology: Topology, indices: IntArray) -> NDArray[np.bool_]:
    """``(n_h,)`` whether each half-edge lies on a seam: its two faces have different indices at one end of the edge.

    As in OpenSubdiv, indices are compared, not their values.
    """
    t = topology
    inside = np.flatnonzero(t.twin >= 0)
    twin = t.twin[inside]
    found = np.zeros(t.half_edge_count, dtype=bool)
    found[inside] = (indices[inside] != indices[t.next[twin]]) | (indices[t.next[inside]] != indices[twin])
    return found


def cut_along_seams(topology: Topology, seam: NDArray[np.bool_]) -> CutMesh:
    """Cut a mesh along seams that is cut along creases already. The rules of its vertices are left to the caller."""
    sharpness = Sharpness(np.where(seam, INFINITE, 0.0), np.zeros(topology.vertex_count))
    no_corners = np.zeros(topology.vertex_count, dtype=bool)
    return cut_along_creases(SharpMesh(topology, sharpness, no_corners, topology.is_border_vertex))


def value_mesh(
    mesh: SharpMesh,
    mode: str,  # Which values are corners, as listed above
    indices: IntArray,  # (n_h,) int64: 0-based row of the attribute's values at each face corner
) -> tuple[Topology, IntArray]:
    """Mesh on which face-varying values are subdivided, in every mode but "all".

    The rules are those of OpenSubdiv 3.5. An edge is a seam as a whole, also if its sides have the same index at one of
    its ends. At a vertex without a seam the values follow the rule that the vertex has on the surface, be that of a
    crease, a dart or a corner. At a vertex with a seam each index has a rule of its own: that of a border, or that of a
    corner

    - where the vertex is a corner of the surface or no manifold, and in mode "boundaries";
    - where its faces are not all joined to each other at the vertex, across edges that are neither seams nor creases;
    - where it has one face only, in every mode but "none";
    - in "corners_plus1" and "corners_plus2", at a vertex with more than two indices; and at one with two, where the
      other is a corner by the second condition, in "corners_plus2" also by the third;
    - in "corners_plus2", where a seam ends inside the mesh.

    A semi-sharp vertex, and semi-sharp edges between the faces of an index, make it a corner instead of a border until
    they have decayed. In "corners_plus1" and "corners_plus2" those of one of two indices at a vertex make the other one
    a corner as well, if it has none itself. Semi-sharp edges that lie on a seam do not, nor do others across it.

    In the other cases a seam that ends inside the mesh is a border up to its very end, whose neighbours on the border
    are the values on the two sides of the seam. Mode "boundaries" also makes corners of all vertices on the boundary;
    the other modes but "none" make corners of vertices with one face, whatever the boundary rule. An edge with corners
    at both ends is interpolated linearly.

    Two things differ from OpenSubdiv. Where two indices alternate around a vertex (A B A B), OpenSubdiv 3.5 counts the
    second one twice and may then treat its two parts as if they had nothing in common; here both indices are corners.
    And where semi-sharp edges of one index sharpen the other while the seam itself is semi-sharp for longer, OpenSubdiv
    lets the other become smooth one refinement late; here both become smooth together.

    Returns the cage's mesh, cut along creases and seams, with the rules that the values follow; faces and half-edges
    keep their numbers. And (n,) int64, the 0-based row of the attribute's values at each vertex.
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
    """``(n_v,)`` whether values at each vertex have rules of their own, not those of the surface."""
    t = mesh.topology
    found = np.zeros(t.vertex_count, dtype=bool)
    found[t.face_vertices[seam]] = True
    if mesh.non_manifold is not None:
        found |= _differs(t, mesh.non_manifold, indices)
    if mode == "boundaries":
        found |= mesh.is_boundary_vertex
    elif mode != "none":
        found |= mesh.is_boundary_vertex & (t.vertex_face_count == 1)
    return found


def _differs(topology: Topology, non_manifold: NonManifold, indices: IntArray) -> NDArray[np.bool_]:
    """``(n_v,)`` whether indices differ at a non-manifold vertex, or at an end of a non-manifold edge there."""
    t = topology

    def varies(group: IntArray, values: IntArray, count: int) -> NDArray[np.bool_]:
        """``(count,)`` whether the values of each group differ."""
        one = np.zeros(count, dtype=np.int64)
        one[group] = values
        found = np.zeros(count, dtype=bool)
        found[group[one[group] != values]] = True
        return found

    sides = np.flatnonzero(non_manifold.is_edge & ~non_manifold.is_own_edge)
    start, end = sides, t.next[sides]
    # The ends of an edge: first the one with the lower vertex, then the other one.
    is_down = t.face_vertices[start] > t.face_vertices[end]
    edge_end = 2 * non_manifold.edge[sides].astype(np.int64)
    count = 2 * int(non_manifold.edge.max()) + 2
    edge_ends = np.concatenate([edge_end + is_down, edge_end + ~is_down])
    torn = np.logical_or(*varies(edge_ends, indices[np.concatenate([start, end])], count).reshape(-1, 2).T)
    found = np.zeros(t.half_edge_count, dtype=bool)
    found[sides] = torn[non_manifold.edge[sides]]
    vertices = np.flatnonzero(non_manifold.is_vertex[t.face_vertices])
    return t.ends_of(found) | varies(t.face_vertices[vertices], indices[vertices], t.vertex_count)


# Conditions of `_corner_conditions` that make a value at a seam a corner, in each mode.
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
    """``(c,)`` rules of copies of vertices, given each copy's vertex, value and number of faces."""
    # As one number, pairs are sorted several times as fast.
    value_count = int(value_index.max(initial=0)) + 1
    found, value_of = np.unique(vertex * value_count + value_index, return_inverse=True)
    holds = _corner_conditions(mesh, found // value_count, np.bincount(value_of), np.bincount(value_of, face_count))
    is_corner = np.any([holds[condition] for condition in _CORNERS[mode]], axis=0)
    return np.where(is_corner, VertexRule.CORNER, VertexRule.AUTOMATIC).astype(np.int8)[value_of]


def _corner_conditions(
    mesh: SharpMesh,
    vertex: IntArray,  # (c,) int: the mesh's vertex of each value
    # (c,) int: number of copies of the vertex, and of faces at it, of each value
    copy_count: IntArray,
    face_count: IntArray,
) -> dict[str, NDArray[np.bool_]]:
    """Conditions that may make a value at a seam a corner, each ``(c,)``.

    A value is all copies of one vertex that have the same row of the attribute.
    """
    count = mesh.topology.vertex_count
    values_there = np.bincount(vertex, minlength=count)[vertex]
    is_corner = mesh.is_corner if mesh.non_manifold is None else mesh.is_corner | mesh.non_manifold.is_vertex
    # Its faces are not all joined: they lie on different sides of another seam or crease, or touch only there.
    is_torn, has_one_face = copy_count > 1, face_count == 1

    def one_of_two(holds: NDArray[np.bool_]) -> NDArray[np.bool_]:
        """Whether the value is one of two at its vertex, and something holds for either of them."""
        return (values_there == 2) & (np.bincount(vertex, holds, minlength=count)[vertex] > 0)

    return {
        "always": np.ones(len(vertex), dtype=bool),
        "corner": is_corner[vertex],
        "torn": is_torn,
        "one_face": has_one_face,
        "many": values_there > 2,
        "beside_torn": one_of_two(is_torn),
        "beside_one_face": one_of_two(has_one_face),
        "end_of_seam": (values_there == 1) & ~mesh.is_boundary_vertex[vertex],
    }


def _is_sharpened_by_other(
    mesh: SharpMesh, seam: NDArray[np.bool_], cut: CutMesh, copies: IntArray
) -> NDArray[np.bool_]:
    """``(c,)`` whether some copies are one of two at their vertex, smooth themselves, so that the other sharpens them.

    A copy is smooth if no semi-sharp edges lie between its faces and its vertex is not semi-sharp.
    """
    t, sharpness = mesh.topology, mesh.sharpness
    semi_sharp = (sharpness.edges > 0) & ~sharpness.is_infinite & (t.twin >= 0) & ~seam
    is_sharp = np.bincount(cut.topology.face_vertices, semi_sharp, minlength=len(cut.vertex)) > 0
    vertex = cut.vertex[copies]
    is_one_of_two = np.bincount(cut.vertex, minlength=t.vertex_count)[vertex] == 2
    return is_one_of_two & ~is_sharp[copies] & (sharpness.vertices[vertex] == 0)
