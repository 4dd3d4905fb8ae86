"""Cuts of a mesh along its infinitely sharp edges, so that every crease becomes a border."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from . import ragged
from .connectivity import IntArray, Topology, VertexRule
from .manifold import NonManifold
from .sharpness import INFINITE, CreaseMethod, FloatArray, SemiSharpness


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
    """A mesh and its sharp features."""

    topology: Topology
    sharpness: Sharpness
    is_corner: NDArray[np.bool_]  # (n_v,) bool: vertices that are corners regardless of their edges
    is_boundary_vertex: NDArray[np.bool_]  # (n_v,) bool: vertices with an edge that belongs to one face only
    crease_method: CreaseMethod = "uniform"  # How semi-sharp edges decay
    non_manifold: NonManifold | None = None  # None for a manifold

    @cached_property
    def cut(self) -> CutMesh:
        """The mesh cut along its infinitely sharp edges, with the rules of its vertices."""
        return cut_along_creases(self)


def cut_along_creases(mesh: SharpMesh) -> CutMesh:
    """Cut a mesh along its infinitely sharp edges, and at vertices that several fans of faces share.

    Refined points on a crease depend on points on the crease only, and points on one side never depend on points on the
    other side. So each side can be refined separately, with the crease as its border.
    """
    t = mesh.topology
    is_cut = mesh.sharpness.is_infinite & (t.twin >= 0)
    is_border = is_cut | (t.twin < 0)
    rules = _vertex_rules(mesh, is_cut, is_border)
    if mesh.non_manifold is None and not is_cut.any():
        cut = CutMesh(t.with_rules(rules, None), np.arange(t.vertex_count))
    else:
        face_vertices, vertex = _split_vertices(mesh, is_border)
        edge_names = np.where(is_cut, t.edge_count + np.arange(t.half_edge_count), t.edge)
        cut = CutMesh(Topology(len(vertex), t.face_sizes, face_vertices, edge_names, rules[vertex]), vertex)
    semi_sharpness = semi_sharpness_of_cut(mesh, cut, is_cut)
    if semi_sharpness is None:
        return cut
    return CutMesh(cut.topology.with_rules(cut.topology.rules, semi_sharpness), cut.vertex)


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
        current, number = t.turn(current[continues]).astype(np.int64), number[continues]
        is_new = face_vertices[current] != number
        current, number = current[is_new], number[is_new]
    return face_vertices, vertex


def _uncut_fans(topology: Topology, is_border: NDArray[np.bool_], closed_fans: IntArray) -> IntArray:
    """Return the closed fans, each named by a half-edge, that no border edge divides."""
    is_divided = is_border[closed_fans]
    current, fan = closed_fans, np.arange(len(closed_fans))
    while len(current):
        current = topology.turn(current)
        continues = current != closed_fans[fan]
        current, fan = current[continues], fan[continues]
        is_divided[fan] |= is_border[current]
    return closed_fans[~is_divided]


def semi_sharpness_of_cut(
    mesh: SharpMesh,  # The mesh before the cut
    cut: CutMesh,  # The mesh after it, with the rules of its vertices
    is_cut: NDArray[np.bool_],  # (n_h,) bool: whether each half-edge lies on the cut
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
    t, sharpness, method = mesh.topology, mesh.sharpness, mesh.crease_method
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
