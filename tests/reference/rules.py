"""Refinement rules and limit masks of the three schemes, in decimal arithmetic.

Each rule takes the faces and points of a neighbourhood, and gives the refined faces as tuples of keys, and a function
from a key to its point. A key names what the new vertex comes from. Only the keys whose surroundings are all in the
neighbourhood may be asked for. Points are NumPy arrays of `Decimal`.
"""

from collections import defaultdict
from collections.abc import Callable, Hashable, Sequence
from contextlib import contextmanager
from decimal import Decimal, getcontext, localcontext
from functools import cache

import mpmath
import numpy as np

Face = tuple[Hashable, ...]


@contextmanager
def precision(digits: int):
    with localcontext() as context:
        context.prec = digits
        yield


@cache
def _cos_of_turn(k: int, n: int, digits: int) -> Decimal:
    with mpmath.workdps(digits + 10):
        return Decimal(mpmath.nstr(mpmath.cospi(mpmath.mpf(2 * k) / n), digits + 5))


def cos_of_turn(k: int, n: int) -> Decimal:
    """``cos(2 pi k / n)`` to the precision of the current context."""
    return _cos_of_turn(k, n, getcontext().prec)


def combine(weights: Sequence[Decimal], points: Sequence[np.ndarray]) -> np.ndarray:
    return np.dot(np.array(weights, dtype=object), np.stack(points))


def mean(points: Sequence[np.ndarray]) -> np.ndarray:
    return sum(points) / len(points)


def rotate(items: Sequence, k: int) -> tuple:
    k %= len(items)
    return tuple(items[k:]) + tuple(items[:k])


def incidence(faces: Sequence[Face]) -> tuple[dict, dict]:
    """Faces at each vertex, rotated to begin with it, and at each edge, rotated to begin with the edge."""
    at_vertex, at_edge = defaultdict(list), defaultdict(list)
    for i, face in enumerate(faces):
        for j, vertex in enumerate(face):
            turned = rotate(face, j)
            at_vertex[vertex].append((i, turned))
            at_edge[frozenset(turned[:2])].append((i, turned))
    return at_vertex, at_edge


def catmull_clark_rules(faces: Sequence[Face], points: dict) -> tuple[list, Callable]:
    """Quads (vertex, edge, face, edge), one for each corner of each face: those of face 0 first."""
    at_vertex, at_edge = incidence(faces)
    refined = []
    for i, face in enumerate(faces):
        for j in range(len(face)):
            a, b, *_, z = rotate(face, j)
            refined.append((("vertex", a), ("edge", frozenset((a, b))), ("face", i), ("edge", frozenset((z, a)))))

    @cache
    def face_point(i):
        return mean([points[v] for v in faces[i]])

    def point(key):
        kind, of = key
        if kind == "face":
            return face_point(of)
        if kind == "edge":
            (i, (a, b, *_)), (j, _) = at_edge[of]
            return mean([points[a], points[b], face_point(i), face_point(j)])
        around = at_vertex[of]
        n = Decimal(len(around))
        q = mean([face_point(i) for i, _ in around])
        r = mean([mean([points[of], points[face[1]]]) for _, face in around])
        return combine((1 / n, 2 / n, (n - 3) / n), (q, r, points[of]))

    return refined, point


def loop_rules(faces: Sequence[Face], points: dict) -> tuple[list, Callable]:
    """Triangles (vertex, edge, edge) at the three corners of each face, then the middle one: those of face 0 first."""
    at_vertex, at_edge = incidence(faces)
    refined = []
    for a, b, c in faces:
        v = [("vertex", x) for x in (a, b, c)]
        e = [("edge", frozenset(x)) for x in ((a, b), (b, c), (c, a))]
        refined += [(v[0], e[0], e[2]), (v[1], e[1], e[0]), (v[2], e[2], e[1]), (e[1], e[2], e[0])]

    def point(key):
        kind, of = key
        if kind == "edge":
            (_, (a, b, c)), (_, (_, _, d)) = at_edge[of]
            return combine([Decimal(w) / 8 for w in (3, 3, 1, 1)], [points[x] for x in (a, b, c, d)])
        neighbours = [points[face[1]] for _, face in at_vertex[of]]
        n = len(neighbours)
        beta = loop_beta(n)
        return combine((1 - n * beta, beta * n), (points[of], mean(neighbours)))

    return refined, point


def loop_beta(n: int) -> Decimal:
    return (Decimal("0.625") - (Decimal("0.375") + cos_of_turn(1, n) / 4) ** 2) / n


def doo_sabin_rules(faces: Sequence[Face], points: dict) -> tuple[list, Callable]:
    """For each face about the vertex, the four faces about its new vertex: of the face, the edge, the vertex, the edge.

    ``faces`` go counter-clockwise about one vertex and begin with it; so do the new ones.
    """
    m, centre, refined = len(faces), faces[0][0], []
    about_vertex = [(centre, k) for k in range(m)]
    for k, face in enumerate(faces):
        before, after = (k - 1) % m, (k + 1) % m
        refined += [
            tuple((v, k) for v in face),
            ((centre, k), (face[-1], k), (face[-1], after), (centre, after)),
            rotate(about_vertex, k),
            ((centre, k), (centre, before), (face[1], before), (face[1], k)),
        ]

    def point(key):
        vertex, k = key
        n = len(faces[k])
        weights = [(3 + 2 * cos_of_turn(j, n)) / (4 * n) for j in range(n)]
        weights[0] = Decimal(n + 5) / (4 * n)
        return combine(weights, [points[v] for v in rotate(faces[k], faces[k].index(vertex))])

    return refined, point


RULES = {"catmull_clark": catmull_clark_rules, "loop": loop_rules, "doo_sabin": doo_sabin_rules}


def limit_masks(scheme: str, valence: int) -> tuple[list[Decimal], list[Decimal], list[Decimal]]:
    """Weights of the limit point and two tangents over the centre, the edge ring and the face ring.

    Rings are counter-clockwise, face ``i`` between edges ``i`` and ``i + 1``. Doo-Sabin has the vertices of its face
    only, Loop no face ring. Tangents have edge weights ``cos`` and ``sin`` of ``2 pi i / valence``.
    """
    n = valence
    if n < 3:
        raise ValueError(f"no limit masks for valence {n}")
    cos, sin = ([cos_of_turn(4 * i - shift, 4 * n) for i in range(n)] for shift in (0, n))
    if scheme == "doo_sabin":
        return [Decimal(1) / n] * n, cos, sin
    if scheme == "loop":
        omega = 1 / (3 / (8 * loop_beta(n)) + n)
        return [1 - n * omega] + [omega] * n, [Decimal(0), *cos], [Decimal(0), *sin]
    total = Decimal(n * (n + 5))
    a = 1 + cos[1] + cos_of_turn(1, 2 * n) * (2 * (9 + cos[1])).sqrt()
    tangents = ([Decimal(0), *w, *((w[i] + w[i + 1 - n]) / a for i in range(n))] for w in (cos, sin))
    return [n * n / total] + [4 / total] * n + [1 / total] * n, *tangents
