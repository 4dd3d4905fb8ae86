"""Cutting a mesh along its sharp edges, after which every crease is a border."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from . import ragged
from .connectivity import IntArray, Topology, VertexRule
from .manifold import NonManifold
from .sharpness import CreaseMethod, SemiSharpness, Sharpness


@dataclass(frozen=True, eq=False)
class CutMesh:
    """A mesh cut along its sharp edges. Faces and half-edges keep their numbers.

    Attributes
    ----------
    topology : Topology
        Every sharp edge is a border edge of each of its faces. A vertex has a copy for each sector between its sharp
        edges; the first keeps the vertex's number.
    vertex : (n,) int64
        The vertex that each vertex of the cut mesh is a copy of.
    """

    topology: Topology
    vertex: IntArray


@dataclass(frozen=True, eq=False)
class SharpMesh:
    """A mesh and what is sharp about it.

    Attributes
    ----------
    topology : Topology
    sharpness : Sharpness
    is_corner : (n_v,) bool
        Vertices that are corners whatever meets there.
    is_boundary_vertex : (n_v,) bool
        Whether an edge ends there that belongs to one face only.
    crease_method : "uniform" or "chaikin"
        How semi-sharp edges decay.
    non_manifold : NonManifold or None
        Where the mesh is no manifold, if anywhere.
    """

    topology: Topology
    sharpness: Sharpness
    is_corner: NDArray[np.bool_]
    is_boundary_vertex: NDArray[np.bool_]
    crease_method: CreaseMethod = "uniform"
    non_manifold: NonManifold | None = None

    @cached_property
    def cut(self) -> CutMesh:
        """The mesh cut along its infinitely sharp edges, with the rules of its vertices."""
        return cut_along(self.topology, self.sharpness, self.is_corner, self.crease_method, self.non_manifold)


def cut_along(
    topology: Topology,
    tags: Sharpness,
    is_corner: NDArray[np.bool_],
    method: CreaseMethod = "uniform",
    non_manifold: NonManifold | None = None,
) -> CutMesh:
    """Cut a mesh along sharp edges, and apart where fans share a vertex.

    The two sides of a crease do not know of each other but for the crease's own points, which follow from each other.
    A vertex with two sharp or boundary edges is on a crease, with more a corner; with one, the crease ends there: a
    dart, where the faces stay together.

    Parameters
    ----------
    topology : Topology
    tags : Sharpness
    is_corner : (n_v,) bool
        Vertices that are corners whatever meets there.
    method : "uniform" or "chaikin"
        How semi-sharp edges decay.
    non_manifold : NonManifold, optional
        Where the mesh is no manifold.
    """
    t = topology
    cut = tags.is_sharp & (t.twin >= 0)
    border = cut | (t.twin < 0)
    # Every sharp edge at a vertex is outgoing from it or the last of an open fan; inside, there are as many outgoing.
    sharp_edges = np.bincount(t.face_vertices[border], minlength=t.vertex_count) + t.is_boundary_vertex
    if non_manifold is not None:
        # Two edges whose many sides count once, and those that are sharp besides.
        along = np.bincount(t.face_vertices[cut], minlength=t.vertex_count) + 2
        sharp_edges = np.where(non_manifold.is_crease, along, sharp_edges)
    rules = np.full(t.vertex_count, VertexRule.AUTOMATIC, dtype=np.int8)
    rules[(sharp_edges == 1) & ~is_corner] = VertexRule.DART
    rules[is_corner | (sharp_edges > 2)] = VertexRule.CORNER

    if non_manifold is None and not cut.any():
        vertex, feels = np.arange(t.vertex_count), np.ones(t.vertex_count, dtype=bool)
        sharpness = cut_sharpness(t, tags, cut, t.face_vertices, vertex, rules, feels, method)
        return CutMesh(t.with_rules(rules, sharpness), vertex)

    # Sectors begin at border edges that leave a vertex; all but a vertex's first get a copy of it. So does a fan that
    # goes all around, beside others.
    begins = np.flatnonzero(border)
    if non_manifold is not None:
        begins = np.concatenate([begins, _uncut(t, border, non_manifold.closed_fans)])
    begins = begins[np.argsort(t.face_vertices[begins], kind="stable")]
    is_later = np.zeros(len(begins), dtype=bool)
    is_later[1:] = np.diff(t.face_vertices[begins]) == 0
    copied = begins[is_later]
    vertex = np.concatenate([np.arange(t.vertex_count), t.face_vertices[copied]])
    face_vertices = t.face_vertices.copy()
    current, number = copied, t.vertex_count + np.arange(len(copied))
    while len(current):
        face_vertices[current] = number
        goes_on = ~border[t.preceding(current)]
        current, number = t.turn(current[goes_on]), number[goes_on]
        is_new = face_vertices[current] != number
        current, number = current[is_new], number[is_new]
    rules = rules[vertex]
    feels = np.ones(len(vertex), dtype=bool)
    semi_sharpness = cut_sharpness(topology, tags, cut, face_vertices, vertex, rules, feels, method)
    edge_names = np.where(cut, t.edge_count + np.arange(t.half_edge_count), t.edge)
    return CutMesh(Topology(len(vertex), t.face_sizes, face_vertices, edge_names, rules, semi_sharpness), vertex)


def _uncut(topology: Topology, border: NDArray[np.bool_], closed_fans: IntArray) -> IntArray:
    """Those of some half-edges, of closed fans, about whose vertices no border edge is met."""
    met = border[closed_fans]
    current, place = closed_fans, np.arange(len(closed_fans))
    while len(current):
        current = topology.turn(current)
        goes_on = current != closed_fans[place]
        current, place = current[goes_on], place[goes_on]
        met[place] |= border[current]
    return closed_fans[~met]


def cut_sharpness(
    topology: Topology,
    tags: Sharpness,
    is_cut: NDArray[np.bool_],
    face_vertices: NDArray[np.integer],
    vertex: IntArray,
    rules: NDArray[np.int8],
    feels: NDArray[np.bool_],
    method: CreaseMethod,
) -> SemiSharpness | None:
    """Semi-sharp features of a cut mesh, whose vertices also know those on other sides of their cuts.

    Parameters
    ----------
    topology, tags
        Of the mesh before.
    is_cut : (n_h,) bool
    face_vertices : (n_h,) int
        Of the cut mesh.
    vertex, rules : (n,)
        The vertex that each vertex of the cut mesh is a copy of, and its rule.
    feels : (n,) bool
        Whether semi-sharp edges on other sides sharpen it.
    method : "uniform" or "chaikin"
    """
    t = topology
    if not tags.any:
        return None
    tagged = np.where(tags.is_sharp | (t.twin < 0), 0, tags.edges)
    vertices = np.where(rules == VertexRule.CORNER, 0, tags.vertices[vertex])

    # Every semi-sharp edge at every copy of its vertex but the one where it begins.
    semi = np.flatnonzero(tagged > 0)
    copies = np.argsort(vertex, kind="stable")
    if method == "uniform":
        # Corners stay whatever is beyond, and there may be thousands of them at a vertex of as many fans.
        copies = copies[rules[copies] != VertexRule.CORNER]
    counts = np.bincount(vertex[copies], minlength=t.vertex_count)
    origin = t.face_vertices[semi]
    half_edge = np.repeat(semi, counts[origin])
    copy = copies[ragged.ranges(ragged.starts(counts)[origin], counts[origin])]
    acts = feels[copy] & ~is_cut[half_edge]
    beyond = (copy != face_vertices[half_edge]) | is_cut[half_edge]
    if method == "uniform":
        beyond &= acts
    edges = np.where(is_cut, 0, tagged)
    return SemiSharpness.decaying(
        face_vertices, edges, vertices, copy[beyond], tagged[half_edge[beyond]], acts[beyond], method
    )
