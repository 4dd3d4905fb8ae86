"""One refinement of face-varying values, vertex by vertex and edge by edge, from OpenSubdiv's description of its rules.

Nothing of `mitsuba_subdivision` is used. A mesh is a list of faces (tuples of vertices), a channel a list of index
tuples of the same lengths and a dict of values by (vertex, index): the same index at two vertices is two values.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import cos, pi

import numpy as np


@dataclass
class Channel:
    """A mesh with tags and face-varying indices; ``values`` by (vertex, index)."""

    faces: list
    indices: list
    values: dict
    creases: set
    corners: set
    sharp_boundary_corners: bool
    mode: str


class _Around:
    """Incidences of a channel's mesh."""

    def __init__(self, channel):
        self.c = channel
        self.at_edge, self.at_vertex = {}, {}
        for f, face in enumerate(channel.faces):
            for i, vertex in enumerate(face):
                self.at_edge.setdefault(frozenset((vertex, face[(i + 1) % len(face)])), []).append((f, i))
                self.at_vertex.setdefault(vertex, []).append((f, i))

    def value(self, f, i):
        face = self.c.faces[f]
        i %= len(face)
        return self.c.values[face[i], self.c.indices[f][i]]

    def index_at(self, f, vertex):
        return self.c.indices[f][self.c.faces[f].index(vertex)]

    def face_mean(self, f):
        return np.mean([self.value(f, i) for i in range(len(self.c.faces[f]))], axis=0)

    def is_boundary(self, edge):
        return len(self.at_edge[edge]) == 1

    def is_seam(self, edge):
        (f, _), *other = self.at_edge[edge]
        return any(self.index_at(f, v) != self.index_at(g, v) for g, _ in other for v in edge)

    def edges(self, vertex):
        return {
            edge
            for f, i in self.at_vertex[vertex]
            for edge in (
                frozenset((vertex, self.c.faces[f][(i + 1) % len(self.c.faces[f])])),
                frozenset((vertex, self.c.faces[f][i - 1])),
            )
        }

    def is_corner(self, vertex):
        single = len(self.at_vertex[vertex]) == 1
        return vertex in self.c.corners or (self.c.sharp_boundary_corners and single)

    def faces_with(self, vertex, index):
        return [f for f, _ in self.at_vertex[vertex] if self.index_at(f, vertex) == index]

    def pieces(self, vertex, index):
        """Parts that the faces with an index fall into, joined by edges that are neither seams nor creases."""
        left, parts = set(self.faces_with(vertex, index)), 0
        while left:
            parts += 1
            reached = [left.pop()]
            while reached:
                f = reached.pop()
                for edge in self.edges(vertex) - self.c.creases:
                    sides = [g for g, _ in self.at_edge[edge]]
                    if f in sides and not self.is_seam(edge):
                        fresh = left.intersection(sides)
                        left -= fresh
                        reached += fresh
        return parts

    def rule_at_mismatch(self, vertex, index):
        """Whether a value stays or is on a border, by OpenSubdiv's six modes."""
        mode = self.c.mode
        indices = {self.index_at(f, vertex) for f, _ in self.at_vertex[vertex]}
        torn = {other: self.pieces(vertex, other) > 1 for other in indices}
        single = {other: len(self.faces_with(vertex, other)) == 1 for other in indices}
        sharp = self.is_corner(vertex) or torn[index] or mode == "boundaries"
        if mode != "none" and single[index]:
            sharp = True
        if mode.startswith("corners_plus"):
            two = len(indices) == 2
            sharp |= len(indices) > 2 or (two and any(torn.values()))
            if mode == "corners_plus2":
                sharp |= two and any(single.values())
                sharp |= len(indices) == 1 and not any(map(self.is_boundary, self.edges(vertex)))
        return "corner" if sharp else "border"

    def matches(self, vertex):
        """Whether the values at a vertex follow the rule of the surface there."""
        edges = self.edges(vertex)
        if any(map(self.is_seam, edges)):
            return False
        if not any(map(self.is_boundary, edges)):
            return True
        single = len(self.at_vertex[vertex]) == 1
        return self.c.mode != "boundaries" and (self.c.mode == "none" or not single)


def refined(channel: Channel, scheme: str) -> tuple[Channel, dict]:
    """Refine once; also what becomes of each face's corners: ``{(face, corner): refined face}``, its corner first."""
    around, c = _Around(channel), channel
    values, faces, indices, child = {}, [], [], {}

    def add(vertex, index, value):
        values[vertex, index] = value
        return vertex, index

    def edge_value(edge, f):
        i = next(i for g, i in around.at_edge[edge] if g == f)
        own = (around.value(f, i) + around.value(f, i + 1)) / 2
        key = ("edge", edge)
        cut = around.is_seam(edge)
        side = f if cut else None
        if c.mode == "all" or cut or around.is_boundary(edge) or edge in c.creases:
            return add(key, side, own)
        sides = around.at_edge[edge]
        if scheme == "loop":
            return add(key, side, 0.75 * own + sum(around.value(g, j + 2) for g, j in sides) / 8)
        return add(key, side, own / 2 + sum(around.face_mean(g) for g, _ in sides) / 4)

    def vertex_value(f, i):
        vertex, index = c.faces[f][i], c.indices[f][i]
        return add(("vertex", vertex), index, _moved(around, vertex, index, scheme))

    for f, face in enumerate(c.faces):
        n = len(face)
        corners = [vertex_value(f, i) for i in range(n)]
        edges = [edge_value(frozenset((face[i], face[(i + 1) % n])), f) for i in range(n)]
        centre = None if scheme == "loop" else add(("face", f), None, around.face_mean(f))
        for i in range(n):
            child[f, i] = len(faces)
            ring = [corners[i], edges[i], *([] if centre is None else [centre]), edges[i - 1]]
            faces.append(tuple(vertex for vertex, _ in ring))
            indices.append(tuple(index for _, index in ring))
        if centre is None:
            faces.append(tuple(vertex for vertex, _ in edges))
            indices.append(tuple(index for _, index in edges))
    creases = {frozenset((("vertex", v), ("edge", edge))) for edge in c.creases for v in edge}
    corners = {("vertex", vertex) for vertex in c.corners}
    return Channel(faces, indices, values, creases, corners, c.sharp_boundary_corners, c.mode), child


def _moved(around, vertex, index, scheme):
    c = around.c
    own = c.values[vertex, index]
    if c.mode == "all":
        return own
    edges = around.edges(vertex)
    if around.matches(vertex):
        sharp = [edge for edge in edges if edge in c.creases or around.is_boundary(edge)]
        rule = "corner" if around.is_corner(vertex) or len(sharp) > 2 else "crease" if len(sharp) == 2 else "smooth"
    else:
        sharp = [edge for edge in edges if around.is_seam(edge) or around.is_boundary(edge)]
        rule = around.rule_at_mismatch(vertex, index)
    if rule == "corner":
        return own
    if rule == "smooth":
        return _smooth(around, vertex, own, scheme)
    # The first edge of a face at the vertex ends in the next corner, the last in the one before.
    ends = []
    for f, i in around.at_vertex[vertex]:
        if around.index_at(f, vertex) == index:
            face = c.faces[f]
            ends += [(frozenset((vertex, face[(i + 1) % len(face)])), around.value(f, i + 1))]
            ends += [(frozenset((vertex, face[i - 1])), around.value(f, i - 1))]
    beyond = [value for edge, value in ends if edge in sharp]
    # A crease without a seam is seen from the faces on both its sides.
    return 0.75 * own + 0.25 * np.mean(beyond, axis=0)


def _smooth(around, vertex, own, scheme):
    corners = around.at_vertex[vertex]
    n = len(corners)
    following = np.mean([around.value(f, i + 1) for f, i in corners], axis=0)
    if scheme == "loop":
        beta = 5 / 8 - (3 / 8 + cos(2 * pi / n) / 4) ** 2
        return (1 - beta) * own + beta * following
    middle = np.mean([around.face_mean(f) for f, _ in corners], axis=0)
    return (middle + own + following + (n - 3) * own) / n
