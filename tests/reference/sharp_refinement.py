"""Refinement with creases and corners of any sharpness, face by face and vertex by vertex, on a mesh that is not cut.

Nothing of `mitsuba_subdivision` is used. The rules are those that OpenSubdiv documents: a vertex with two sharp edges
moves along them, with more it stays; sharpness falls by one with each refinement; where that makes something smooth,
the rules before and after are mixed by what was left of it (for Chaikin's method, more than one at times).
"""

from __future__ import annotations

from collections import defaultdict
from dataclasses import dataclass

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
        """One refinement: the faces at the corners of face 0 come first, each from its old vertex on."""
        faces_at, spokes = defaultdict(list), defaultdict(set)
        for face in self.faces:
            for a, b in zip(face, face[1:] + face[:1], strict=True):
                faces_at[frozenset((a, b))].append(face)
                spokes[a].add(b)
                spokes[b].add(a)
        sharp = {edge: INFINITE if len(faces) == 1 else self.edges.get(edge, 0) for edge, faces in faces_at.items()}
        left = {}
        for v, ends in spokes.items():
            at = {far: sharp[frozenset((v, far))] for far in ends}
            left |= {(v, far): left_of(at[far], [at[x] for x in ends if x != far], self.method) for far in ends}
        centres = {face: self.points[list(face)].sum(axis=0) / len(face) for face in self.faces}
        points, number = [], {}

        def add(key, point):
            number[key] = len(points)
            points.append(point)

        for vertex in range(len(self.points)):
            around = {face for far in spokes[vertex] for face in faces_at[frozenset((vertex, far))]}
            add(vertex, self._vertex_point(vertex, spokes[vertex], sharp, left, [centres[face] for face in around]))
        for edge, faces in faces_at.items():
            add(edge, self._edge_point(edge, faces, sharp[edge], left, [centres[face] for face in faces]))
        if self.scheme == "catmull_clark":
            for index, face in enumerate(self.faces):
                add(("face", index), centres[face])
        new_faces, middles = [], []
        for index, face in enumerate(self.faces):
            ends = [frozenset(pair) for pair in zip(face, face[1:] + face[:1], strict=True)]
            for k, vertex in enumerate(face):
                quad = [vertex, ends[k], ("face", index), ends[k - 1]]
                kept = quad if self.scheme == "catmull_clark" else [quad[0], quad[1], quad[3]]
                new_faces.append(tuple(number[key] for key in kept))
            if self.scheme == "loop":
                middles.append(tuple(number[edge] for edge in ends))
        new_edges = {frozenset((v, number[frozenset((v, far))])): value for (v, far), value in left.items()}
        vertices = {v: less(s) for v, s in self.vertices.items()}
        return SharpMesh(self.scheme, np.array(points), new_faces + middles, new_edges, vertices, self.method)

    def _edge_point(self, edge, faces, sharpness, left, centres):
        a, b = edge
        middle = (self.points[a] + self.points[b]) / 2
        if left[a, b] > 0 and left[b, a] > 0:
            return middle
        if self.scheme == "loop":
            opposite = sum(self.points[v] for face in faces for v in face if v not in edge)
            smooth = 0.75 * middle + opposite / 8
        else:
            shares = [0.47 if self.smooth_triangles and len(face) == 3 else 0.25 for face in faces]
            share = sum(shares) / len(shares)
            smooth = (1 - 2 * share) * middle + share * sum(centres)
        return sharpness * middle + (1 - sharpness) * smooth

    def _vertex_point(self, vertex, ends, sharp, left, centres):
        own = self.vertices.get(vertex, 0)
        before = {far: sharp[frozenset((vertex, far))] for far in ends}
        after = {far: left[vertex, far] for far in ends}
        first = self._by_rule(vertex, own, before, centres)
        rule, next_rule = self._rule(own, before), self._rule(less(own), after)
        if rule in ("smooth", next_rule):
            return first
        second = self._by_rule(vertex, less(own), after, centres)
        lost = [s for far, s in before.items() if s > 0 and after[far] == 0] + [own] * (own > 0 and less(own) == 0)
        share = min(sum(lost) / len(lost), 1) if lost else 0
        return share * first + (1 - share) * second

    @staticmethod
    def _rule(own, sharpness):
        count = sum(s > 0 for s in sharpness.values())
        return "corner" if own > 0 or count > 2 else "crease" if count == 2 else "smooth"

    def _by_rule(self, vertex, own, sharpness, centres):
        rule, point = self._rule(own, sharpness), self.points[vertex]
        if rule == "corner":
            return point
        if rule == "crease":
            return 0.75 * point + sum(self.points[far] for far, s in sharpness.items() if s > 0) / 8
        n = len(sharpness)
        neighbours = sum(self.points[far] for far in sharpness) / n
        if self.scheme == "loop":
            beta = 5 / 8 - (3 / 8 + np.cos(2 * np.pi / n) / 4) ** 2
            return (1 - beta) * point + beta * neighbours
        return (sum(centres) / len(centres) + (point + neighbours) + (n - 3) * point) / n
