"""Faces of a cage made an oriented manifold as far as that goes, with a warning or an error about the rest."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..mesh.connectivity import IntArray, Topology
from ..mesh.manifold import NonManifold, fan_counts, fan_labels, is_manifold, is_repeated, runs_with_twin, separated
from ..mesh.orientation import turning_order
from .errors import warn
from .source import CageSource, number_of

# So many of a kind are named in a warning.
SHOWN = 3


@dataclass(frozen=True, eq=False)
class Faces:
    """Validated faces of a cage.

    Attributes
    ----------
    topology : Topology
        Non-manifold edges are borders of each of their faces; a non-manifold vertex has several fans.
    non_manifold : NonManifold or None
        None where the faces are an oriented manifold.
    order : (n_h,) int64 or None
        The given corner that each corner was, where faces were turned.
    """

    topology: Topology
    non_manifold: NonManifold | None = None
    order: IntArray | None = None


def oriented_faces(given: Topology, source: CageSource, strict: bool) -> Faces:
    """Make an oriented manifold of a mesh as far as it goes, and find out where it is none.

    Raises
    ------
    CageError
        If ``strict``, for the first of: a vertex twice in a face, an edge of more than two faces, neighbouring faces of
        opposite orientation, a vertex whose faces are not one fan.

    Warns
    -----
    CageWarning
        If not ``strict``: of faces that were turned, and of what is no manifold.
    """
    if is_manifold(given):
        return Faces(given)
    if strict:
        _raise_first(given, source)
    topology, order = given, turning_order(given)
    if order is not None:
        topology = Topology(given.vertex_count, given.face_sizes, given.face_vertices[order])
        turned = np.unique(given.face[order != np.arange(len(order))])
        warn(
            f"{source.name}: {len(turned)} of {number_of(given.face_count, 'face')} turned over, to run along their "
            f"edges in the opposite direction of their neighbours: {source.faces(turned, SHOWN)} (numbers count from "
            f"{source.index_base})"
        )
    separate, found = separated(topology)
    if found is None:
        return Faces(separate, None, order)
    warn(_description(separate, found, source))
    return Faces(separate, found, order)


def _description(topology: Topology, found: NonManifold, source: CageSource) -> str:
    """What is no manifold, for a warning: how much of each kind, and the first ones."""
    t = topology
    repeats = np.unique(t.face[is_repeated(t)])
    crowded = np.unique(found.edge[found.is_edge & ~found.is_own_edge], return_index=True)[1]
    crowded = np.flatnonzero(found.is_edge & ~found.is_own_edge)[crowded]
    fans = np.flatnonzero(fan_counts(t, fan_labels(t)[1]) > 1)
    fans = fans[~t.ends_of(found.is_edge)[fans]]
    kinds = (
        (len(crowded), "edge", "of more than two faces, or of two in one direction", crowded, _edge_at),
        (len(fans), "vertex", "between separate fans", fans, _vertex_at),
        (len(repeats), "face", "with a vertex more than once", repeats, _face_at),
    )
    parts = []
    for count, noun, what, places, name in kinds:
        if count:
            names = ", ".join(name(t, place, source) for place in places[:SHOWN].tolist())
            parts.append(f"{number_of(count, noun)} {what} ({names}{', ...' if count > SHOWN else ''})")
    return (
        f"{source.name}: the faces are no manifold: {'; '.join(parts)}. Such edges are infinitely sharp and such "
        "vertices corners, or creases along them, as in OpenSubdiv; strict makes this an error (numbers count from "
        f"{source.index_base})"
    )


def _raise_first(topology: Topology, source: CageSource) -> None:
    """Raise an error for the first thing that is no manifold."""
    t = topology
    repeated = np.flatnonzero(is_repeated(t))
    if len(repeated):
        faces = np.unique(t.face[repeated])
        first = repeated[t.face[repeated] == faces[0]]
        problem = f"has {source.vertex(t.face_vertices[first].min())} more than once"
        raise source.error(source.at_face(faces[0]), problem, "distinct vertices", len(faces), "face")
    crowded = np.flatnonzero(np.bincount(t.edge) > 2)
    if len(crowded):
        half_edges = np.flatnonzero(t.edge == crowded[0])
        faces = t.face[half_edges]
        problem = f"is one of {len(faces)} at {_edge_at(t, half_edges[0], source)}: {source.faces(faces)}"
        expected = "a manifold surface, at most 2 faces at an edge"
        raise source.error(source.at_face(faces[0]), problem, expected, len(crowded), "edge")
    same_way = np.flatnonzero(runs_with_twin(t))
    if len(same_way):
        first = same_way[0]
        neighbour = source.faces(t.face[t.twin[[first]]])
        problem = f"and {neighbour} both run along {_edge_at(t, first, source)} in this direction"
        expected = "opposite directions, all faces counter-clockwise from outside"
        raise source.error(source.at_face(t.face[first]), problem, expected, len(same_way) // 2, "edge")
    fan, is_first = fan_labels(t)
    pinched = np.flatnonzero(fan_counts(t, is_first) > 1)
    if len(pinched):
        corners = np.flatnonzero(t.face_vertices == pinched[0])
        labels = np.unique(fan[corners])
        fans = [source.faces(t.face[corners[fan[corners] == label]]) for label in labels[:SHOWN]]
        more = " | ..." if len(labels) > SHOWN else ""
        problem = f"joins {len(labels)} separate fans: " + " | ".join(fans) + more
        expected = "one fan of faces around a vertex"
        raise source.error(source.at_vertex(pinched[0]), problem, expected, len(pinched), "vertex")


def _edge_at(topology: Topology, half_edge: int, source: CageSource) -> str:
    start, end = topology.face_vertices[[half_edge, topology.next[half_edge]]]
    return source.edge(start, end)


def _vertex_at(_: Topology, vertex: int, source: CageSource) -> str:
    return source.vertex(vertex)


def _face_at(_: Topology, face: int, source: CageSource) -> str:
    return source.faces(np.array([face]))
