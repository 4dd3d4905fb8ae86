"""Refinement with creases and corners of any sharpness, and of face-varying values, vertex by vertex and edge by edge.

Nothing of `mitsuba_subdivision` is used. The rules are those that OpenSubdiv documents: a vertex with two sharp edges
moves along them, with more it stays; sharpness falls by one with each refinement; where that makes something smooth,
the rules before and after are mixed by what was left of it (for Chaikin's method, more than one at times).

A mesh is a list of faces (tuples of vertices), a channel a list of index tuples of the same lengths and a dict of
values by (vertex, index): the same index at two vertices is two values. Points are a channel without seams.
"""

from collections import defaultdict
from dataclasses import dataclass, replace
from math import cos, pi

import numpy as np

INFINITE = 10.0


def less(sharpness: float) -> float:
    return sharpness if sharpness >= INFINITE else max(sharpness - 1, 0)


def left_of(sharpness: float, others: list[float], method: str) -> float:
    """What a refinement leaves of an edge's sharpness, in its half at a vertex that has other edges."""
    semi = [other for other in others if 0 < other < INFINITE]
    if method == "chaikin" and 0 < sharpness < INFINITE and semi:
        return max(0.75 * sharpness + 0.25 * sum(semi) / len(semi) - 1, 0)
    return less(sharpness)


@dataclass
class Channel:
    """A mesh with tags and face-varying indices; ``values`` by (vertex, index).

    ``creases`` is the sharpness of edges, frozensets of two vertices, and ``corners`` that of vertices.
    ``followed`` holds the values whose sharpness is that of the other value at their vertex: (vertex, index) of both.
    It is found on the cage and kept from then on; None before.
    """

    faces: list
    indices: list
    values: dict
    creases: dict
    corners: dict
    sharp_boundary_corners: bool = False
    mode: str = "none"
    method: str = "uniform"
    smooth_triangles: bool = False
    followed: dict | None = None


class _Around:
    """Incidences of a channel's mesh."""

    def __init__(self, channel):
        self.c = channel
        self.at_edge, self.at_vertex, self.edges_at = defaultdict(list), defaultdict(list), defaultdict(set)
        for f, face in enumerate(channel.faces):
            for i, vertex in enumerate(face):
                edge = frozenset((vertex, face[(i + 1) % len(face)]))
                self.at_vertex[vertex].append((f, i))
                self.at_edge[edge].append((f, i))
                for end in edge:
                    self.edges_at[end].add(edge)
        sizes = map(len, channel.faces)
        self.face_means = [sum(self.value(f, i) for i in range(size)) / size for f, size in enumerate(sizes)]
        if channel.followed is None:
            channel.followed = self._followed()

    def value(self, f, i):
        face = self.c.faces[f]
        i %= len(face)
        return self.c.values[face[i], self.c.indices[f][i]]

    def index_at(self, f, vertex):
        return self.c.indices[f][self.c.faces[f].index(vertex)]

    def is_boundary(self, edge):
        return len(self.at_edge[edge]) == 1

    def is_seam(self, edge):
        (f, _), *other = self.at_edge[edge]
        return any(self.index_at(f, v) != self.index_at(g, v) for g, _ in other for v in edge)

    def sharpness(self, edge):
        return INFINITE if self.is_boundary(edge) else self.c.creases.get(edge, 0)

    def left(self, edge, vertex):
        others = [self.sharpness(other) for other in self.edges_at[vertex] if other != edge]
        return left_of(self.sharpness(edge), others, self.c.method)

    def vertex_sharpness(self, vertex):
        single = len(self.at_vertex[vertex]) == 1
        return INFINITE if self.c.sharp_boundary_corners and single else self.c.corners.get(vertex, 0)

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
                for edge in self.edges_at[vertex]:
                    sides = [g for g, _ in self.at_edge[edge]]
                    if f in sides and self.sharpness(edge) < INFINITE and not self.is_seam(edge):
                        fresh = left.intersection(sides)
                        left -= fresh
                        reached += fresh
        return parts

    def semi_sharp_within(self, vertex, index):
        """Semi-sharp edges between the faces with an index at a vertex."""
        faces = set(self.faces_with(vertex, index))
        inner = [edge for edge in self.edges_at[vertex] if faces.issuperset(f for f, _ in self.at_edge[edge])]
        return [edge for edge in inner if 0 < self.sharpness(edge) < INFINITE and not self.is_seam(edge)]

    def _followed(self):
        """Where one of two values at a vertex, not sharp itself, has semi-sharp edges, the other follows it."""
        followed = {}
        if not self.c.mode.startswith("corners_plus"):
            return followed
        for vertex, faces in self.at_vertex.items():
            indices = {self.index_at(f, vertex) for f, _ in faces}
            if len(indices) == 2 and not self.vertex_sharpness(vertex):
                sharp = {index for index in indices if self.semi_sharp_within(vertex, index)}
                if len(sharp) == 1:
                    followed[vertex, min(indices - sharp)] = vertex, min(sharp)
        return followed

    def rule_at_mismatch(self, vertex, index):
        """Whether a value stays or is on a border, by OpenSubdiv's six modes."""
        mode = self.c.mode
        indices = {self.index_at(f, vertex) for f, _ in self.at_vertex[vertex]}
        torn = {other: self.pieces(vertex, other) > 1 for other in indices}
        single = {other: len(self.faces_with(vertex, other)) == 1 for other in indices}
        sharp = self.vertex_sharpness(vertex) >= INFINITE or torn[index] or mode == "boundaries"
        sharp |= mode != "none" and single[index]
        if mode.startswith("corners_plus"):
            two = len(indices) == 2
            sharp |= len(indices) > 2 or (two and any(torn.values()))
            if mode == "corners_plus2":
                sharp |= two and any(single.values())
                sharp |= len(indices) == 1 and not any(map(self.is_boundary, self.edges_at[vertex]))
        return "corner" if sharp else "border"

    def matches(self, vertex):
        """Whether the values at a vertex follow the rule of the surface there."""
        edges = self.edges_at[vertex]
        if any(map(self.is_seam, edges)):
            return False
        if not any(map(self.is_boundary, edges)):
            return True
        return self.c.mode == "none" or (self.c.mode != "boundaries" and len(self.at_vertex[vertex]) > 1)


def refined(channel: Channel, scheme: str) -> tuple[Channel, dict]:
    """Refine once; also what becomes of each face's corners: ``{(face, corner): refined face}``, its corner first.

    Vertices keep their numbers; new ones come after them.
    """
    around, c = _Around(channel), channel
    count, values, rings, middles, child = 1 + max(map(max, c.faces)), {}, [], [], {}
    numbers = {}

    def number(origin):
        """The vertex that an edge, or a face by its number, becomes."""
        return numbers.setdefault(origin, count + len(numbers))

    def add(vertex, index, value):
        values[vertex, index] = value
        return vertex, index

    def edge_value(edge, f):
        i = next(i for g, i in around.at_edge[edge] if g == f)
        middle = (around.value(f, i) + around.value(f, i + 1)) / 2
        key, cut, sharpness = number(edge), around.is_seam(edge), around.sharpness(edge)
        side = f if cut else None
        if (key, side) in values:
            return key, side
        if c.mode == "all" or cut or sharpness >= INFINITE or all(around.left(edge, v) > 0 for v in edge):
            return add(key, side, middle)
        sides = around.at_edge[edge]
        if scheme == "loop":
            smooth = 0.75 * middle + sum(around.value(g, j + 2) for g, j in sides) / 8
        else:
            share = np.mean([0.47 if c.smooth_triangles and len(c.faces[g]) == 3 else 0.25 for g, _ in sides])
            smooth = (1 - 2 * share) * middle + share * sum(around.face_means[g] for g, _ in sides)
        return add(key, side, sharpness * middle + (1 - sharpness) * smooth)

    def vertex_value(f, i):
        key = c.faces[f][i], c.indices[f][i]
        return key if key in values else add(*key, _moved(around, *key, scheme))

    for f, face in enumerate(c.faces):
        n = len(face)
        corners = [vertex_value(f, i) for i in range(n)]
        edges = [edge_value(frozenset((face[i], face[(i + 1) % n])), f) for i in range(n)]
        centre = [] if scheme == "loop" else [add(number(f), None, around.face_means[f])]
        for i in range(n):
            child[f, i] = len(rings)
            rings.append([corners[i], edges[i], *centre, edges[i - 1]])
        if not centre:
            middles.append(edges)
    # As the package, with the middle triangles of Loop's scheme after all others.
    faces, indices = ([tuple(key[k] for key in ring) for ring in rings + middles] for k in (0, 1))
    creases = {frozenset((v, number(edge))): around.left(edge, v) for edge in c.creases for v in edge}
    corners = {vertex: less(sharpness) for vertex, sharpness in c.corners.items()}
    of_mesh = {"faces": faces, "indices": indices, "values": values, "creases": creases, "corners": corners}
    return replace(c, **of_mesh, smooth_triangles=False), child


def _moved(around, vertex, index, scheme):
    c, value = around.c, around.c.values[vertex, index]
    if c.mode == "all":
        return value
    edges = around.edges_at[vertex]
    if around.matches(vertex):
        at_vertex = around.vertex_sharpness(vertex)
        before = {edge: around.sharpness(edge) for edge in edges}
        after = {edge: around.left(edge, vertex) for edge in edges}

        def by_rule(vertex_sharpness, sharpness):
            sharp = [edge for edge in edges if sharpness[edge] > 0]
            if vertex_sharpness > 0 or len(sharp) > 2:
                return "corner", value
            if len(sharp) == 2:
                return "crease", _along(around, vertex, index, value, sharp)
            return "smooth", _smooth(around, vertex, value, scheme)

        rule, first = by_rule(at_vertex, before)
        next_rule, second = by_rule(less(at_vertex), after)
        if rule in ("smooth", next_rule):
            return first
        pairs = [(at_vertex, less(at_vertex)), *((before[edge], after[edge]) for edge in edges)]
    else:
        if around.rule_at_mismatch(vertex, index) == "corner":
            return value
        # Until what is semi-sharp has decayed, the end of a border is a corner.
        place = c.followed.get((vertex, index), (vertex, index))
        pairs = [(around.sharpness(edge), around.left(edge, vertex)) for edge in around.semi_sharp_within(*place)]
        at_vertex = around.vertex_sharpness(vertex)
        pairs.append((at_vertex, less(at_vertex)))
        sharp = [edge for edge in edges if around.is_seam(edge) or around.is_boundary(edge)]
        first, second = value, _along(around, vertex, index, value, sharp)
        if any(after > 0 for _, after in pairs):
            return first
    lost = [before for before, after in pairs if before > 0 and after == 0]
    share = min(np.mean(lost), 1) if lost else 0
    return share * first + (1 - share) * second


def _along(around, vertex, index, value, sharp):
    # The first edge of a face at the vertex ends in the next corner, the last in the one before.
    ends = []
    for f, i in around.at_vertex[vertex]:
        if around.index_at(f, vertex) == index:
            face = around.c.faces[f]
            ends += [(frozenset((vertex, face[(i + 1) % len(face)])), around.value(f, i + 1))]
            ends += [(frozenset((vertex, face[i - 1])), around.value(f, i - 1))]
    beyond = [value for edge, value in ends if edge in sharp]
    # A crease without a seam is seen from the faces on both its sides.
    return 0.75 * value + 0.25 * sum(beyond) / len(beyond)


def _smooth(around, vertex, value, scheme):
    corners = around.at_vertex[vertex]
    n = len(corners)
    following = sum(around.value(f, i + 1) for f, i in corners) / n
    if scheme == "loop":
        beta = 5 / 8 - (3 / 8 + cos(2 * pi / n) / 4) ** 2
        return (1 - beta) * value + beta * following
    middle = sum(around.face_means[f] for f, _ in corners) / n
    return (middle + value + following + (n - 3) * value) / n
