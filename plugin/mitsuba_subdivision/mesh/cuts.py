"""Cuts of a mesh, which make borders of edges: along its infinitely sharp edges, and along seams of face-varying data.

Values of face-varying data are subdivided like points, on the mesh that is cut along seams as well.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from . import ragged
from .connectivity import INFINITE, CreaseMethod, FloatArray, IntArray, SemiSharpness, Topology, VertexRule
from .manifold import NonManifold, fan_labels
from .shared import Content, shared_by_key

# Modes in which one of two values at a vertex may make the other a corner, or sharpen it by its semi-sharp edges.
_CORNERS_PLUS = ("corners_plus1", "corners_plus2")


@dataclass(frozen=True, eq=False)
class Sharpness:
    """Sharpness of edges and vertices: 0 smooth, `INFINITE` or more infinitely sharp, between them semi-sharp."""

    # (n_h,) float64: sharpness of the edge of each half-edge, equal for both half-edges of an edge
    edges: FloatArray
    vertices: FloatArray  # (n_v,) float64: sharpness of each vertex

    @property
    def is_infinite(self) -> NDArray[np.bool_]:
        """``(n_h,)`` whether each half-edge is infinitely sharp."""
        return self.edges >= INFINITE

    @property
    def is_corner(self) -> NDArray[np.bool_]:
        """``(n_v,)`` whether each vertex is infinitely sharp."""
        return self.vertices >= INFINITE

    @property
    def any(self) -> bool:
        """Whether any edge or vertex is sharp."""
        return bool(self.edges.any() or self.vertices.any())

    def creases(self, topology: Topology) -> FloatArray:
        """Return rows (vertex, vertex, sharpness), one for each sharp edge."""
        t = topology
        sharp = t.edge_half_edge[self.edges[t.edge_half_edge] > 0]
        return np.stack([t.face_vertices[sharp], t.face_vertices[t.next[sharp]], self.edges[sharp]], axis=1)

    def corners(self) -> FloatArray:
        """Return rows (vertex, sharpness), one for each sharp vertex."""
        sharp = np.flatnonzero(self.vertices)
        return np.stack([sharp, self.vertices[sharp]], axis=1)


@dataclass(frozen=True, eq=False)
class CutMesh:
    """A mesh cut along some of its edges. Faces and half-edges keep their indices."""

    # Every edge of the cut is a border edge of each of its faces. The faces of a vertex between two cuts are a side. A
    # vertex has a copy for each side; the first copy keeps the index of the vertex.
    topology: Topology
    vertex: IntArray  # (n,) int64: for each vertex of the cut mesh, the original vertex


@dataclass(frozen=True, eq=False)
class SharpMesh:
    """The faces, tags and rules of a control cage: all that does not depend on positions.

    Attributes are as in `ControlCage`. Cages with equal ones share one object, see `shared`.
    """

    topology: Topology
    non_manifold: NonManifold | None  # None for a manifold
    tags: Sharpness
    boundary: str = "edge_only"
    crease_method: CreaseMethod = "uniform"
    triangle_rule: str = "catmull_clark"
    face_varying: str = "corners_plus1"
    holes: IntArray = field(default_factory=lambda: np.zeros(0, dtype=np.int64))

    def shared(self) -> SharpMesh:
        """Return the shared mesh that equals this one, or this one if there is none yet."""
        t = self.topology
        arrays = (t.edge_names, t.face_sizes, t.face_vertices, self.tags.edges, self.tags.vertices, self.holes)
        rules = (self.boundary, self.crease_method, self.triangle_rule, self.face_varying)
        return shared_by_key((SharpMesh, t.vertex_count, *map(Content, arrays), *rules), lambda: self)

    @cached_property
    def is_corner(self) -> NDArray[np.bool_]:
        t, is_corner = self.topology, self.tags.is_corner
        if self.non_manifold is not None:
            is_corner = is_corner | self.non_manifold.is_corner
        if self.boundary == "edge_and_corner":
            is_corner = is_corner | t.is_border_vertex & (t.vertex_face_count == 1)
        return is_corner

    @cached_property
    def is_boundary(self) -> NDArray[np.bool_]:
        is_border, non_manifold = self.topology.twin < 0, self.non_manifold
        return is_border if non_manifold is None else is_border & ~non_manifold.is_edge | non_manifold.has_one_face

    @cached_property
    def is_boundary_vertex(self) -> NDArray[np.bool_]:
        return self.topology.ends_of(self.is_boundary)

    @cached_property
    def cut(self) -> CutMesh:
        """The mesh cut along its infinitely sharp edges, and at vertices that several fans of faces share.

        Refined points on a crease depend on points on the crease only, and points on one side never depend on points
        on the other side. So each side can be refined separately, with the crease as its border.
        """
        t = self.topology
        is_cut = self.tags.is_infinite & (t.twin >= 0)
        is_border = is_cut | (t.twin < 0)
        rules = _vertex_rules(self, is_cut, is_border)
        if self.non_manifold is None and not is_cut.any():
            cut = CutMesh(t.with_rules(rules, None), np.arange(t.vertex_count))
        else:
            face_vertices, vertex = _split_vertices(self, is_border)
            edge_names = np.where(is_cut, t.edge_count + np.arange(t.half_edge_count, dtype=np.int32), t.edge)
            cut = CutMesh(Topology(len(vertex), t.face_sizes, face_vertices, edge_names, rules[vertex]), vertex)
        semi_sharpness = semi_sharpness_of_cut(self, cut)
        return CutMesh(cut.topology.with_rules(cut.topology.vertex_rules, semi_sharpness), cut.vertex)

    @cached_property
    def is_hole(self) -> NDArray[np.bool_]:
        t = self.topology
        is_hole = np.zeros(t.face_count, dtype=bool)
        is_hole[self.holes] = True
        if self.boundary == "none":
            # Faces at infinitely sharp boundary edges are part of the surface.
            at_boundary = t.ends_of(self.is_boundary & ~self.tags.is_infinite)
            is_hole[t.face[np.flatnonzero(at_boundary[t.face_vertices])]] = True
        return is_hole


def _vertex_rules(mesh: SharpMesh, is_cut: NDArray[np.bool_], is_border: NDArray[np.bool_]) -> NDArray[np.int8]:
    """Return ``(n_v,)`` the `VertexRule` of each vertex, from its number of sharp edges and border edges.

    With one it is a dart, with more than two a corner; smooth and crease vertices have the automatic rule.
    """
    t = mesh.topology
    rules = np.full(t.vertex_count, VertexRule.AUTOMATIC, dtype=np.int8)
    if not (is_border.any() or mesh.is_corner.any()):
        return rules
    # The half-edge of each such edge begins at the vertex, except for the last edge of an open fan, which ends there.
    sharp_edges = np.bincount(t.face_vertices[is_border], minlength=t.vertex_count) + t.is_border_vertex
    if mesh.non_manifold is not None:
        # Each of the two non-manifold edges of a crease counts once, whatever its number of faces.
        along = np.bincount(t.face_vertices[is_cut], minlength=t.vertex_count) + 2
        sharp_edges = np.where(mesh.non_manifold.is_crease, along, sharp_edges)
    rules[(sharp_edges == 1) & ~mesh.is_corner] = VertexRule.DART
    rules[mesh.is_corner | (sharp_edges > 2)] = VertexRule.CORNER
    return rules


def _split_vertices(
    mesh: SharpMesh,
    is_border: NDArray[np.bool_],  # (n_h,) bool: whether each half-edge lies on a border after the cut
) -> tuple[NDArray[np.int32], IntArray]:
    """Create a copy of a vertex for each of its sides: ``face_vertices`` of the cut mesh, and `CutMesh.vertex`."""
    t = mesh.topology
    # Counter-clockwise, a side begins at an outgoing border edge. A closed fan beside other fans is a side, too.
    begins = np.flatnonzero(is_border)
    if mesh.non_manifold is not None:
        closed_fans = mesh.non_manifold.closed_fans
        is_divided = np.isin(closed_fans, fan_labels(t)[0][is_border])
        begins = np.concatenate([begins, closed_fans[~is_divided]])
    begins = begins[np.argsort(t.face_vertices[begins], kind="stable")]
    copied = begins[np.diff(t.face_vertices[begins], prepend=-1) == 0]
    vertex = np.concatenate([np.arange(t.vertex_count), t.face_vertices[copied]])
    face_vertices = t.face_vertices.copy()
    # Walk through all sides except the first ones simultaneously, face by face.
    current, number = copied, t.vertex_count + np.arange(len(copied))
    while len(current):
        face_vertices[current] = number
        continues = ~is_border[t.prev[current]]
        current, number = t.turn[current[continues]].astype(np.int64), number[continues]
        is_new = face_vertices[current] != number
        current, number = current[is_new], number[is_new]
    return face_vertices, vertex


def semi_sharpness_of_cut(
    mesh: SharpMesh,  # The mesh before the cut
    cut: CutMesh,  # The mesh after it, with the rules of its vertices
    seam: NDArray[np.bool_] | None = None,  # (n_h,) bool: whether each half-edge lies on a seam that is cut as well
    # (n_v,) bool: vertices at which semi-sharp edges across the cut sharpen no copy
    has_separate_copies: NDArray[np.bool_] | None = None,
    # Whether these edges sharpen such copies nevertheless that are not semi-sharp themselves
    sharpens_smooth: bool = False,
) -> SemiSharpness | None:
    """Return the semi-sharp features of a cut mesh, including semi-sharp edges across the cut.

    A cut creates copies A and B of a vertex V on a crease. Both must move as V does, so a semi-sharp edge that ends at
    A sharpens B, too. B has a row for it among the edges across the cut::

         one side   |   other side         one side   | |   other side
                    |                                 | |
        semi-sharp  |                     semi-sharp  | |
        ------------V          becomes    ------------A B
                    |                                 | |
                  crease                              cut

    There is a row for every pair of a semi-sharp half-edge and a copy of its origin, except the copy at which it begins
    in the cut mesh: that pair is in `SemiSharpness.edges`. A semi-sharp edge that is itself cut, along a seam, belongs
    to neither side and sharpens no copy, but Chaikin's method averages over it.
    """
    t, sharpness, method = mesh.topology, mesh.tags, mesh.crease_method
    if not sharpness.any:
        return None
    rules, face_vertices = cut.topology.vertex_rules, cut.topology.face_vertices
    is_semi_sharp = ~sharpness.is_infinite & (t.twin >= 0) & (sharpness.edges > 0)
    on_seam = np.zeros(t.half_edge_count, dtype=bool) if seam is None else seam
    edges, vertices = np.where(is_semi_sharp & ~on_seam, sharpness.edges, 0), sharpness.vertices[cut.vertex]
    is_sharpened = rules != VertexRule.CORNER
    if has_separate_copies is not None:
        is_smooth = (np.bincount(face_vertices, edges > 0, minlength=len(vertices)) == 0) & (vertices == 0)
        is_sharpened &= ~has_separate_copies[cut.vertex] | (is_smooth & sharpens_smooth)

    # Every pair of a semi-sharp half-edge and a copy of its origin. Copies are grouped by vertex.
    copies, counts = np.argsort(cut.vertex, kind="stable"), np.bincount(cut.vertex, minlength=t.vertex_count)
    half_edges = np.flatnonzero(is_semi_sharp)
    origin = t.face_vertices[half_edges]
    half_edge = np.repeat(half_edges, counts[origin])
    copy = copies[ragged.ranges(ragged.starts(counts)[origin], counts[origin])]
    sharpens = ~on_seam[half_edge] & is_sharpened[copy]
    is_across = (copy != face_vertices[half_edge]) | on_seam[half_edge]
    if method == "uniform":
        is_across &= sharpens
    across = copy[is_across], sharpness.edges[half_edge[is_across]], sharpens[is_across]
    vertices = np.where(rules == VertexRule.CORNER, 0, vertices)
    return SemiSharpness.decaying(face_vertices, edges, vertices, *across, method)


def seams(topology: Topology, indices: IntArray) -> NDArray[np.bool_]:
    """Return ``(n_h,)``: whether the faces beside each half-edge have different indices, not values, at an end."""
    t = topology
    inside = np.flatnonzero(t.twin >= 0)
    twin = t.twin[inside]
    is_seam = np.zeros(t.half_edge_count, dtype=bool)
    is_seam[inside] = (indices[inside] != indices[t.next[twin]]) | (indices[t.next[inside]] != indices[twin])
    return is_seam


def cut_along_seams(topology: Topology, seam: NDArray[np.bool_]) -> CutMesh:
    """Cut a mesh along seams, after it was cut along creases. The caller sets the rules of its vertices."""
    tags = Sharpness(np.where(seam, INFINITE, 0.0), np.zeros(topology.vertex_count))
    return SharpMesh(topology, None, tags).cut


def value_mesh(
    mesh: SharpMesh,
    mode: str,  # Face-varying interpolation rule, a key of `_CORNERS`
    indices: IntArray,  # (n_h,) int64: 0-based row of the attribute's values at each face corner
) -> tuple[Topology, IntArray]:
    """Return the mesh on which face-varying values are subdivided, in every mode except "all".

    The rules are those of OpenSubdiv 3.5: section 12 of plugin/MATHEMATICS.md. An edge is a seam as a whole, even if
    its sides have the same index at one end. At a vertex without a seam the values follow its rule on the surface.

    A semi-sharp vertex, or semi-sharp edges between the faces of an index, make the index a corner until they have
    decayed. In "corners_plus1" and "corners_plus2", semi-sharp edges of one of two indices also make the other a
    corner, if it has none. Semi-sharp edges on a seam, and other edges across a seam, have no influence.

    Where a seam ends inside the mesh without a corner, it is a border up to its end; the neighbours of the end on the
    border are the values on the two sides of the seam. At boundary vertices without a seam, mode "boundaries" has
    corners; the other modes except "none" have corners at vertices with one face, for every boundary rule.

    There are two differences from OpenSubdiv 3.5. Where two indices alternate around a vertex (A B A B), OpenSubdiv
    counts the second index twice, and may treat its two parts as unrelated; here both indices are corners. Where
    semi-sharp edges of one index sharpen the other and the seam itself is semi-sharp for longer, in OpenSubdiv the
    other index becomes smooth one refinement late; here both become smooth together.

    Returns the cage's mesh, cut along creases and seams, with the rules that the values follow (faces and half-edges
    keep their indices), and (n,) int64, the 0-based row of the attribute's values at each vertex.
    """
    t, creased = mesh.topology, mesh.cut
    seam = seams(t, indices)
    differs = _differs_from_surface(mesh, mode, seam, indices)
    topology, vertex = creased.topology, creased.vertex
    rules = topology.vertex_rules.copy()
    if seam.any():
        cut = cut_along_seams(topology, seam)
        topology, vertex, rules = cut.topology, vertex[cut.vertex], rules[cut.vertex]
    value_index = np.zeros(len(vertex), dtype=np.int64)
    value_index[topology.face_vertices] = indices
    copies = np.flatnonzero(differs[vertex])
    rules[copies] = _rules_at_seams(mesh, mode, vertex[copies], value_index[copies], topology.vertex_face_count[copies])
    if topology is creased.topology and np.array_equal(rules, topology.vertex_rules):
        return topology, value_index
    cut = CutMesh(topology.with_rules(rules, None), vertex)
    # Each of two copies may sharpen the other. Three or more are corners in these modes.
    semi_sharpness = semi_sharpness_of_cut(mesh, cut, seam, differs, sharpens_smooth=mode in _CORNERS_PLUS)
    return cut.topology.with_rules(rules, semi_sharpness), value_index


def _differs_from_surface(mesh: SharpMesh, mode: str, seam: NDArray[np.bool_], indices: IntArray) -> NDArray[np.bool_]:
    """Return ``(n_v,)``: whether the rules of values at each vertex may differ from those of the surface.

    They may at seams; where indices differ at a non-manifold vertex, or at an end of a non-manifold edge there; and at
    boundary vertices that the mode makes corners.
    """
    t, non_manifold = mesh.topology, mesh.non_manifold
    differs = t.ends_of(seam)
    if non_manifold is not None:
        at_vertices = np.flatnonzero(non_manifold.is_vertex[t.face_vertices])
        vertices = t.face_vertices[at_vertices]
        differs[vertices[_vary(vertices, indices[at_vertices])]] = True
        sides = np.flatnonzero(non_manifold.is_edge & ~non_manifold.has_one_face)
        edge, ends = non_manifold.edge[sides], np.stack([sides, t.next[sides]])
        low, high = np.where(t.face_vertices[ends[0]] < t.face_vertices[ends[1]], ends, ends[::-1])
        is_torn = _vary(edge, indices[low]) | _vary(edge, indices[high])
        differs[t.face_vertices[ends[:, is_torn]]] = True
    if mode == "boundaries":
        differs |= mesh.is_boundary_vertex
    elif mode != "none":
        differs |= mesh.is_boundary_vertex & (t.vertex_face_count == 1)
    return differs


def _vary(group: IntArray, values: IntArray) -> NDArray[np.bool_]:
    last = np.zeros(int(group.max(initial=-1)) + 1, dtype=np.int64)
    last[group] = values
    differs = np.zeros(len(last), dtype=bool)
    differs[group[last[group] != values]] = True
    return differs[group]


def _rules_at_seams(
    mesh: SharpMesh, mode: str, vertex: IntArray, value_index: IntArray, face_count: IntArray
) -> NDArray[np.int8]:
    """Return ``(c,)`` rules of copies of vertices, which are equal for those of equal vertex and value."""
    # Pairs encoded as one number are sorted several times faster.
    value_count = int(value_index.max(initial=0)) + 1
    pairs, value_of = np.unique(vertex * value_count + value_index, return_inverse=True)
    vertex, count = pairs // value_count, mesh.topology.vertex_count
    vertex_value_count = np.bincount(vertex, minlength=count)[vertex]
    # Torn: the faces with the value are on different sides of another seam or crease, or touch only at the vertex.
    is_torn, has_one_face = np.bincount(value_of) > 1, np.bincount(value_of, face_count) == 1

    def one_of_two(holds: NDArray[np.bool_]) -> NDArray[np.bool_]:
        """Return whether the value is one of two at its vertex, and a condition holds for either of them."""
        return (vertex_value_count == 2) & (np.bincount(vertex, holds, minlength=count)[vertex] > 0)

    is_corner = mesh.is_corner[vertex] | is_torn | (mode == "boundaries")
    if mesh.non_manifold is not None:
        is_corner |= mesh.non_manifold.is_vertex[vertex]
    if mode != "none":
        is_corner |= has_one_face
    if mode in _CORNERS_PLUS:
        is_corner |= (vertex_value_count > 2) | one_of_two(is_torn)
    if mode == "corners_plus2":
        is_corner |= one_of_two(has_one_face) | ((vertex_value_count == 1) & ~mesh.is_boundary_vertex[vertex])
    return np.where(is_corner, VertexRule.CORNER, VertexRule.AUTOMATIC).astype(np.int8)[value_of]
