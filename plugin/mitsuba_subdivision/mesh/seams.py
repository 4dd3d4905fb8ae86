"""Seams of face-varying data: the mesh on which its values are subdivided as points are."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from .connectivity import IntArray, Topology, VertexRule
from .cuts import CutMesh, SharpMesh, cut_along, cut_sharpness
from .manifold import NonManifold
from .sharpness import INFINITE, Sharpness


@dataclass(frozen=True, eq=False)
class ValueMesh:
    """The cage's mesh as the values of an attribute see it. Faces and half-edges keep their numbers.

    Attributes
    ----------
    topology : Topology
        Cut along creases and seams, with the rules that the values follow.
    row : (n,) int64
        The 0-based row of the attribute's values at each vertex.
    """

    topology: Topology
    row: IntArray


def seams(topology: Topology, indices: IntArray) -> NDArray[np.bool_]:
    """``(n_h,)`` whether each half-edge lies on a seam: the faces beside its edge differ in the index at either end.

    Indices are compared, as in OpenSubdiv, not what they point to.
    """
    t = topology
    inside = np.flatnonzero(t.twin >= 0)
    twin = t.twin[inside]
    found = np.zeros(t.half_edge_count, dtype=bool)
    found[inside] = (indices[inside] != indices[t.following(twin)]) | (indices[t.following(inside)] != indices[twin])
    return found


def cut_along_seams(topology: Topology, seam: NDArray[np.bool_]) -> CutMesh:
    """Cut a mesh along seams, one that is cut along creases already. Its vertices get no rules of their own."""
    tags = Sharpness(np.where(seam, INFINITE, 0.0), np.zeros(topology.vertex_count))
    return cut_along(topology, tags, np.zeros(topology.vertex_count, dtype=bool))


def value_mesh(mesh: SharpMesh, mode: str, indices: IntArray) -> ValueMesh:
    """Mesh on which face-varying values are subdivided, in every mode but "all".

    The rules are those of OpenSubdiv 3.5. An edge is a seam as a whole, also where its sides agree at one end. A vertex
    without a seam follows the rule that it has on the surface, creases, darts and corners included. At a vertex with
    one, each index there has a rule of its own: the border's, or that of a corner

    - where the vertex is a corner of the surface or no manifold, and in mode "boundaries";
    - where its faces are not all joined to each other at the vertex, across edges that are neither seams nor creases;
    - where it has one face only, in every mode but "none";
    - in "corners_plus1" and "corners_plus2", at a vertex with more than two indices, and where one of the two is a
      corner by the second condition (in "corners_plus2" also by the third) the other is one as well;
    - in "corners_plus2", where a seam ends inside.

    Semi-sharp edges between the faces of an index, and semi-sharp vertices, make corners of borders until they have
    decayed; in "corners_plus1" and "corners_plus2", those of one of two indices at a vertex do so for the other, too,
    if that has none. Others on a seam or beyond do not.

    A seam that ends inside is otherwise a border up to its very end, with the values of its two sides beyond. Mode
    "boundaries" makes corners of the boundary's vertices too; the other modes but "none" make corners of vertices with
    one face, whatever the boundary rule. With corners at both its ends an edge is interpolated linearly.

    Two things differ. Where two indices alternate around a vertex (A B A B), OpenSubdiv 3.5 counts the second one twice
    and may then treat its two parts as if they had nothing in common; here they are corners, like those of the first.
    And where semi-sharp edges of one index sharpen the other while the seam itself is semi-sharp for longer, it lets
    the other go one refinement late; here both become smooth together.

    Parameters
    ----------
    mesh : SharpMesh
        Of the mesh.
    mode : str
        Which values are corners, as listed above.
    indices : (n_h,) int64
        0-based rows of values at the face corners.
    """
    t = mesh.topology
    seam = seams(t, indices)
    has_own_rules = np.zeros(t.vertex_count, dtype=bool)
    has_own_rules[t.face_vertices[seam]] = True
    if mesh.non_manifold is not None:
        has_own_rules |= _differs(t, mesh.non_manifold, indices)
    if mode == "boundaries":
        has_own_rules |= mesh.is_boundary_vertex
    elif mode != "none":
        has_own_rules |= mesh.is_boundary_vertex & (t.vertex_face_count == 1)
    creased = mesh.cut
    topology, vertex = creased.topology, creased.vertex
    rules = topology.vertex_rules.copy()
    if seam.any():
        cut = cut_along_seams(topology, seam)
        topology, vertex, rules = cut.topology, vertex[cut.vertex], rules[cut.vertex]
    row = np.zeros(len(vertex), dtype=np.int64)
    row[topology.face_vertices] = indices
    copies = np.flatnonzero(has_own_rules[vertex])
    rules[copies] = _rules_at_seams(mesh, mode, vertex[copies], row[copies], topology.vertex_face_count[copies])
    if topology is creased.topology and np.array_equal(rules, topology.vertex_rules):
        return ValueMesh(topology, row)

    feels = ~has_own_rules[vertex]
    if mode in ("corners_plus1", "corners_plus2"):
        feels[copies] = _feels_other(mesh, seam, topology.face_vertices, vertex, copies)
    semi_sharpness = cut_sharpness(
        t,
        mesh.sharpness,
        seam | mesh.sharpness.is_sharp,
        topology.face_vertices,
        vertex,
        rules,
        feels,
        mesh.crease_method,
    )
    return ValueMesh(replace(topology, rules=rules, semi_sharpness=semi_sharpness), row)


def _differs(topology: Topology, non_manifold: NonManifold, indices: IntArray) -> NDArray[np.bool_]:
    """``(n_v,)`` whether indices differ at a non-manifold vertex, or at either end of a non-manifold edge there."""
    t = topology

    def varies(place: IntArray, values: IntArray, count: int) -> NDArray[np.bool_]:
        """Whether values at the same place differ."""
        one = np.zeros(count, dtype=np.int64)
        one[place] = values
        found = np.zeros(count, dtype=bool)
        found[place[one[place] != values]] = True
        return found

    sides = np.flatnonzero(non_manifold.is_edge & ~non_manifold.is_own_edge)
    start, end = sides, t.following(sides)
    # By the edge and the end of it, the lower vertex first.
    is_down = t.face_vertices[start] > t.face_vertices[end]
    place = 2 * non_manifold.edge[sides].astype(np.int64)
    count = 2 * int(non_manifold.edge.max()) + 2
    places = np.concatenate([place + is_down, place + ~is_down])
    torn = varies(places, indices[np.concatenate([start, end])], count).reshape(-1, 2).any(axis=1)
    found = np.zeros(t.half_edge_count, dtype=bool)
    found[sides] = torn[non_manifold.edge[sides]]
    vertices = np.flatnonzero(non_manifold.is_vertex[t.face_vertices])
    return t.ends_of(found) | varies(t.face_vertices[vertices], indices[vertices], t.vertex_count)


def _rules_at_seams(
    mesh: SharpMesh, mode: str, vertex: IntArray, row: IntArray, face_count: IntArray
) -> NDArray[np.int8]:
    """``(c,)`` rules of copies of vertices, given the vertex, the row and the number of faces of every copy."""
    t = mesh.topology
    # Copies of one vertex with the same index are one value. It is torn if there are several: they lie on different
    # sides of another seam or of a crease, or touch at the vertex only.
    values, value_of = np.unique(np.stack([vertex, row], axis=1), axis=0, return_inverse=True)
    value_of = value_of.ravel()
    is_torn = np.bincount(value_of) > 1
    is_single = np.bincount(value_of, face_count) == 1
    vertex = values[:, 0]

    def anywhere(holds: NDArray[np.bool_]) -> NDArray[np.bool_]:
        """For each value, whether something holds for any value of the same vertex."""
        return np.bincount(vertex, holds, minlength=t.vertex_count)[vertex] > 0

    count = np.bincount(vertex, minlength=t.vertex_count)[vertex]
    is_corner = mesh.is_corner[vertex] | is_torn
    if mesh.non_manifold is not None:
        is_corner |= mesh.non_manifold.is_vertex[vertex]
    if mode == "boundaries":
        is_corner[:] = True
    if mode != "none":
        is_corner |= is_single
    if mode in ("corners_plus1", "corners_plus2"):
        is_corner |= (count > 2) | ((count == 2) & anywhere(is_torn))
    if mode == "corners_plus2":
        is_corner |= (count == 2) & anywhere(is_single)
        is_corner |= (count == 1) & ~mesh.is_boundary_vertex[vertex]
    return np.where(is_corner, VertexRule.CORNER, VertexRule.AUTOMATIC).astype(np.int8)[value_of]


def _feels_other(
    mesh: SharpMesh, seam: NDArray[np.bool_], face_vertices: IntArray, vertex: IntArray, copies: IntArray
) -> NDArray[np.bool_]:
    """``(c,)`` whether each of some copies has no semi-sharp edges, but the one other copy of its vertex may have."""
    t, tags = mesh.topology, mesh.sharpness
    semi = (tags.edges > 0) & ~tags.is_sharp & (t.twin >= 0) & ~seam
    has_semi = np.bincount(face_vertices, semi, minlength=len(vertex)) > 0
    is_one_of_two = np.bincount(vertex, minlength=t.vertex_count)[vertex[copies]] == 2
    return is_one_of_two & ~has_semi[copies] & (tags.vertices[vertex[copies]] == 0)
