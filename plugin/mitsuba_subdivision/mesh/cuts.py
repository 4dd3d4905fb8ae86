"""Cuts of a mesh, which make borders of edges: along its infinitely sharp edges, and along seams of face-varying data.

Values of face-varying data are subdivided like points, on the mesh that is cut along seams as well.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from . import ragged
from .connectivity import IntArray, Topology, VertexRule
from .manifold import NonManifold
from .shared import Content, Shared
from .sharpness import INFINITE, CreaseMethod, FloatArray, SemiSharpness

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
        return _SHARED.get((t.vertex_count, *map(Content, arrays), *rules), lambda: self)

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
        if self.non_manifold is None:
            return self.topology.is_border_vertex
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
            edge_names = np.where(is_cut, t.edge_count + np.arange(t.half_edge_count), t.edge)
            cut = CutMesh(Topology(len(vertex), t.face_sizes, face_vertices, edge_names, rules[vertex]), vertex)
        semi_sharpness = semi_sharpness_of_cut(self, cut, is_cut)
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


_SHARED: Shared[SharpMesh] = Shared()


def _vertex_rules(mesh: SharpMesh, is_cut: NDArray[np.bool_], is_border: NDArray[np.bool_]) -> NDArray[np.int8]:
    """Return ``(n_v,)`` the `VertexRule` of each vertex, from its number of sharp edges and border edges.

    A vertex without such edges is smooth. With one edge it is a dart, where a crease ends and the faces stay connected.
    With two edges it is on a crease, and with more it is a corner. Smooth and crease vertices have the automatic rule.
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
    """Create a copy of a vertex for each of its sides, see `CutMesh`.

    Returns ``face_vertices`` of the cut mesh, (n_h,) int32, and `CutMesh.vertex`.
    """
    t = mesh.topology
    # Counter-clockwise, a side begins at an outgoing border edge. A closed fan is a side, too, if the vertex has other
    # fans.
    begins = np.flatnonzero(is_border)
    if mesh.non_manifold is not None:
        begins = np.concatenate([begins, _uncut_fans(t, is_border, mesh.non_manifold.closed_fans)])
    begins = begins[np.argsort(t.face_vertices[begins], kind="stable")]
    is_later = np.zeros(len(begins), dtype=bool)
    is_later[1:] = np.diff(t.face_vertices[begins]) == 0
    copied = begins[is_later]
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


def _uncut_fans(topology: Topology, is_border: NDArray[np.bool_], closed_fans: IntArray) -> IntArray:
    """Return the closed fans, each named by a half-edge, that no border edge divides."""
    is_divided = is_border[closed_fans]
    current, fan = closed_fans, np.arange(len(closed_fans))
    while len(current):
        current = topology.turn[current]
        continues = current != closed_fans[fan]
        current, fan = current[continues], fan[continues]
        is_divided[fan] |= is_border[current]
    return closed_fans[~is_divided]


def semi_sharpness_of_cut(
    mesh: SharpMesh,  # The mesh before the cut
    cut: CutMesh,  # The mesh after it, with the rules of its vertices
    is_cut: NDArray[np.bool_],  # (n_h,) bool: whether each half-edge lies on the cut; not read where infinitely sharp
    # (n,) bool: whether semi-sharp edges across the cut sharpen each vertex of the cut mesh. By default all vertices.
    is_sharpened_across: NDArray[np.bool_] | None = None,
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
    semi_sharp = np.where(is_semi_sharp, sharpness.edges, 0)

    # The copies of all vertices, grouped by vertex.
    copies = np.argsort(cut.vertex, kind="stable")
    if method == "uniform":
        # Edges across the cut do not affect corners, and a vertex with thousands of fans has as many corners.
        copies = copies[rules[copies] != VertexRule.CORNER]
    counts = np.bincount(cut.vertex[copies], minlength=t.vertex_count)

    # Every pair of a semi-sharp half-edge and a copy of its origin.
    half_edges = np.flatnonzero(is_semi_sharp)
    origin = t.face_vertices[half_edges]
    half_edge = np.repeat(half_edges, counts[origin])
    copy = copies[ragged.ranges(ragged.starts(counts)[origin], counts[origin])]
    sharpens = ~is_cut[half_edge]
    if is_sharpened_across is not None:
        sharpens &= is_sharpened_across[copy]
    is_across = (copy != face_vertices[half_edge]) | is_cut[half_edge]
    if method == "uniform":
        is_across &= sharpens
    across = copy[is_across], semi_sharp[half_edge[is_across]], sharpens[is_across]
    vertices = np.where(rules == VertexRule.CORNER, 0, sharpness.vertices[cut.vertex])
    return SemiSharpness.decaying(face_vertices, np.where(is_cut, 0, semi_sharp), vertices, *across, method)


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
    tags = Sharpness(np.where(seam, INFINITE, 0.0), np.zeros(topology.vertex_count))
    return SharpMesh(topology, None, tags).cut


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
    differs = _differs_from_surface(mesh, mode, seam, indices)
    creased = mesh.cut
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
    is_sharpened_across = ~differs[vertex]
    if mode in _SHARPENED_ACROSS:
        is_sharpened_across[copies] = _is_sharpened_by_other(mesh, seam, cut, copies)
    semi_sharpness = semi_sharpness_of_cut(mesh, cut, seam, is_sharpened_across)
    return cut.topology.with_rules(rules, semi_sharpness), value_index


def _differs_from_surface(mesh: SharpMesh, mode: str, seam: NDArray[np.bool_], indices: IntArray) -> NDArray[np.bool_]:
    """Return ``(n_v,)``: whether the rules of values at each vertex may differ from those of the surface."""
    t = mesh.topology
    differs = np.zeros(t.vertex_count, dtype=bool)
    differs[t.face_vertices[seam]] = True
    if mesh.non_manifold is not None:
        differs |= _differs(t, mesh.non_manifold, indices)
    if mode == "boundaries":
        differs |= mesh.is_boundary_vertex
    elif mode != "none":
        differs |= mesh.is_boundary_vertex & (t.vertex_face_count == 1)
    return differs


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

    sides = np.flatnonzero(non_manifold.is_edge & ~non_manifold.has_one_face)
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
    t, sharpness = mesh.topology, mesh.tags
    semi_sharp = (sharpness.edges > 0) & ~sharpness.is_infinite & (t.twin >= 0) & ~seam
    is_sharp = np.bincount(cut.topology.face_vertices, semi_sharp, minlength=len(cut.vertex)) > 0
    vertex = cut.vertex[copies]
    is_one_of_two = np.bincount(cut.vertex, minlength=t.vertex_count)[vertex] == 2
    return is_one_of_two & ~is_sharp[copies] & (sharpness.vertices[vertex] == 0)
