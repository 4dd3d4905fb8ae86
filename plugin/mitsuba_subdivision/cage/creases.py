"""Cutting a mesh along its sharp edges, after which every crease is a border."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from .connectivity import IntArray, Topology, VertexRule


@dataclass(frozen=True, eq=False)
class CutMesh:
    """A mesh cut along its sharp edges. Faces and half-edges keep their numbers.

    Attributes
    ----------
    topology : Topology
        Every sharp edge is two border edges. A vertex has a copy for each sector between its sharp edges; the first
        keeps the vertex's number.
    vertex : (n,) int64
        The vertex that each vertex of the cut mesh is a copy of.
    """

    topology: Topology
    vertex: IntArray


def cut_along(topology: Topology, is_sharp: NDArray[np.bool_], is_corner: NDArray[np.bool_]) -> CutMesh:
    """Cut a mesh along sharp edges.

    The two sides of a crease do not know of each other but for the crease's own points, which follow from each other.
    A vertex with two sharp or boundary edges is on a crease, with more a corner; with one, the crease ends there: a
    dart, where the faces stay together.

    Parameters
    ----------
    topology : Topology
    is_sharp : (n_h,) bool
        Of half-edges; both of an edge are equal.
    is_corner : (n_v,) bool
        Vertices that are corners whatever meets there.
    """
    t = topology
    cut = is_sharp & (t.twin >= 0)
    edge_names = np.where(cut, t.edge_count + np.arange(t.half_edge_count), t.edge)
    border = cut | (t.twin < 0)
    # Every sharp edge at a vertex is outgoing from it or the last of an open fan; inside, there are as many outgoing.
    sharp_edges = np.bincount(t.face_vertices[border], minlength=t.vertex_count) + t.is_boundary_vertex
    rules = np.full(t.vertex_count, VertexRule.AUTOMATIC, dtype=np.int8)
    rules[(sharp_edges == 1) & ~is_corner] = VertexRule.DART
    rules[is_corner | (sharp_edges > 2)] = VertexRule.CORNER

    if not cut.any():
        return CutMesh(t.with_rules(rules), np.arange(t.vertex_count))

    # Sectors begin at border edges that leave a vertex; all but a vertex's first get a copy of it.
    begins = np.flatnonzero(border)
    begins = begins[np.argsort(t.face_vertices[begins], kind="stable")]
    is_later = np.zeros(len(begins), dtype=bool)
    is_later[1:] = np.diff(t.face_vertices[begins]) == 0
    copied = begins[is_later]
    vertex = np.concatenate([np.arange(t.vertex_count), t.face_vertices[copied]])
    face_vertices = t.face_vertices.copy()
    current, number = copied, t.vertex_count + np.arange(len(copied))
    while len(current):
        face_vertices[current] = number
        goes_on = ~border[t.prev[current]]
        current, number = t.turn(current[goes_on]), number[goes_on]
    return CutMesh(Topology(len(vertex), t.face_sizes, face_vertices, edge_names, rules[vertex]), vertex)
