"""Refinement with creases and corners of any sharpness, and of face-varying values, vertex by vertex and edge by edge.

Nothing of `mitsuba_subdivision` is used. The rules are those that OpenSubdiv documents: a vertex with two sharp edges
moves along them, with more it stays; sharpness falls by one with each refinement; where that makes something smooth,
the rules before and after are mixed by what was left of it (for Chaikin's method, more than one at times).

A mesh is a list of faces (tuples of vertices), a channel a list of index tuples of the same lengths and a dict of
values by (vertex, index): the same index at two vertices is two values. Points are a channel without seams.
"""

from __future__ import annotations

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
    sharp_boundary_corners: bool
    mode: str
    method: str = "uniform"
    smooth_triangles: bool = False
    followed: dict | None = None


@dataclass
class SharpMesh:
    """Polygon mesh with a sharpness for each edge, a frozenset of two vertices, and vertex; border edges are infinite.

    ``scheme`` is "catmull_clark" or "loop", ``method`` "uniform" or "chaikin".
    """

    scheme: str
    points: np.ndarray
    faces: list[tuple[int, ...]]
    edges: dict[frozenset, float]
    vertices: dict[int, float]
    method: str = "uniform"
    smooth_triangles: bool = False

    def refined(self) -> SharpMesh:
        """One refinement, with the faces of `refined`. Vertices keep their numbers; new ones come after them."""
        values = {(vertex, 0): point for vertex, point in enumerate(self.points)}
        indices, options = [(0,) * len(face) for face in self.faces], (self.method, self.smooth_triangles)
        channel = Channel(self.faces, indices, values, self.edges, self.vertices, False, "none", *options)
        finer, _ = refined(channel, self.scheme)
        number = {("vertex", vertex): vertex for vertex in range(len(self.points))}
        for vertex, _ in finer.values:
            number.setdefault(vertex, len(number))
        points = {number[vertex]: point for (vertex, _), point in finer.values.items()}
        return replace(
            self,
            points=np.array([points[k] for k in range(len(points))]),
            faces=[tuple(number[vertex] for vertex in face) for face in finer.faces],
            edges={frozenset(number[vertex] for vertex in edge): s for edge, s in finer.creases.items()},
            vertices={number[vertex]: s for vertex, s in finer.corners.items()},
        )


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
    """Refine once; also what becomes of each face's corners: ``{(face, corner): refined face}``, its corner first."""
    around, c = _Around(channel), channel
    values, faces, indices, child = {}, [], [], {}

    def add(vertex, index, value):
        values[vertex, index] = value
        return vertex, index

    def edge_value(edge, f):
        i = next(i for g, i in around.at_edge[edge] if g == f)
        middle = (around.value(f, i) + around.value(f, i + 1)) / 2
        key, cut, sharpness = ("edge", edge), around.is_seam(edge), around.sharpness(edge)
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
        vertex, index = c.faces[f][i], c.indices[f][i]
        key = "vertex", vertex
        return (key, index) if (key, index) in values else add(key, index, _moved(around, vertex, index, scheme))

    middles: list[list] = []
    for f, face in enumerate(c.faces):
        n = len(face)
        corners = [vertex_value(f, i) for i in range(n)]
        edges = [edge_value(frozenset((face[i], face[(i + 1) % n])), f) for i in range(n)]
        centre = None if scheme == "loop" else add(("face", f), None, around.face_means[f])
        for i in range(n):
            child[f, i] = len(faces)
            ring = [corners[i], edges[i], *([] if centre is None else [centre]), edges[i - 1]]
            faces.append(tuple(vertex for vertex, _ in ring))
            indices.append(tuple(index for _, index in ring))
        if centre is None:
            middles.append(edges)
    # As the package, with the middle triangles of Loop's scheme after all others.
    faces += [tuple(vertex for vertex, _ in middle) for middle in middles]
    indices += [tuple(index for _, index in middle) for middle in middles]
    creases = {frozenset((("vertex", v), ("edge", edge))): around.left(edge, v) for edge in c.creases for v in edge}
    corners = {("vertex", vertex): less(sharpness) for vertex, sharpness in c.corners.items()}
    followed = {(("vertex", v), i): (("vertex", w), j) for (v, i), (w, j) in c.followed.items()}
    of_mesh = {"faces": faces, "indices": indices, "values": values, "creases": creases, "corners": corners}
    return replace(c, **of_mesh, smooth_triangles=False, followed=followed), child


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
    """The rule of a crease, along its two edges."""
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
