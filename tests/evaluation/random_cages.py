"""Random closed cages for property tests, that shrink well: a ball of triangles and a list of moves."""

from itertools import product

import numpy as np
from hypothesis import strategies as st
from mitsuba_subdivision import ControlCage

# Of the parallelepiped of a triangle's corners, as seen from the centre: no sliver, and none that faces inward.
LEAST_VOLUME = 0.02


def octahedron():
    points = np.kron(np.eye(3), [[1.0], [-1.0]])
    octants = product((0, 1), (2, 3), (4, 5))
    return points, [(a, b, c) if (a + b + c) % 2 == 0 else (a, c, b) for a, b, c in octants]


def halved(points, faces):
    """Each triangle cut into four, new vertices pushed out to the unit sphere."""
    points, middle = list(points), {}

    def number(a, b):
        key = min(a, b), max(a, b)
        if key not in middle:
            middle[key] = len(points)
            points.append((points[a] + points[b]) / np.linalg.norm(points[a] + points[b]))
        return middle[key]

    cut = []
    for a, b, c in faces:
        ab, bc, ca = number(a, b), number(b, c), number(c, a)
        cut += [(a, ab, ca), (b, bc, ab), (c, ca, bc), (ab, bc, ca)]
    return np.array(points), cut


def flipped(points, faces, move):
    """One edge flipped, the ``move``-th of those whose flip leaves good triangles and valences of 3 or more."""
    across = {(f[i], f[i - 2]): (k, f[i - 1]) for k, f in enumerate(faces) for i in range(3)}
    valence = np.bincount(np.ravel(faces))
    edges = {tuple(sorted(edge)) for edge in across}

    def allowed(a, b):
        (_, c), (_, d) = across[a, b], across[b, a]
        new = np.linalg.det(points[[a, d, c]]), np.linalg.det(points[[b, c, d]])
        return valence[[a, b]].min() > 3 and tuple(sorted((c, d))) not in edges and min(new) > LEAST_VOLUME

    candidates = [edge for edge in sorted(edges) if allowed(*edge)]
    if not candidates:
        return faces
    a, b = candidates[move % len(candidates)]
    (first, c), (second, d) = across[a, b], across[b, a]
    faces = list(faces)
    faces[first], faces[second] = (a, d, c), (b, c, d)
    return faces


def dissolved(faces, move):
    """Two faces made one across the ``move``-th edge that is all they share, and whose ends keep valence 3."""
    across = {(f[i - 1], f[i]): k for k, f in enumerate(faces) for i in range(len(f))}
    valence = np.bincount(np.concatenate(faces))
    candidates = [
        (a, b)
        for a, b in sorted(across)
        if a < b
        and valence[[a, b]].min() > 3
        and len({*faces[across[a, b]]} & {*faces[across[b, a]]}) == 2
        and len(faces[across[a, b]]) + len(faces[across[b, a]]) <= 8
    ]
    if not candidates:
        return faces
    a, b = candidates[move % len(candidates)]
    left, right = across[a, b], across[b, a]
    # From b along the left face to a, then from a along the right one to b.
    left_path, right_path = (
        (faces[face] * 2)[faces[face].index(end) :][: len(faces[face])] for face, end in ((left, b), (right, a))
    )
    merged = left_path + right_path[1:-1]
    return [f for k, f in enumerate(faces) if k not in (left, right)] + [merged]


def dual(points, faces):
    """Vertices for faces and faces for vertices; all valences are 3 where the faces are triangles."""
    # Counter-clockwise about the first vertex of a face, the edge to the second is followed by that to the third.
    following = {(f[i - 2], f[i - 1]): (f[i], k) for k, f in enumerate(faces) for i in range(3)}
    around = []
    for vertex in range(len(points)):
        start = next(b for a, b in following if a == vertex)
        fan, spoke = [], start
        while not fan or spoke != start:
            spoke, face = following[vertex, spoke]
            fan.append(face)
        around.append(tuple(fan))
    return np.array([points[list(f)].mean(axis=0) for f in faces]), around


@st.composite
def triangle_cages(draw):
    """For Loop: 8 or 32 triangles with some edges flipped and vertices moved."""
    points, faces = octahedron()
    if draw(st.booleans()):
        points, faces = halved(points, faces)
    for move in draw(st.lists(st.integers(0, 99), max_size=15)):
        faces = flipped(points, faces, move)
    return points, faces


@st.composite
def polygon_cages(draw):
    """For the other schemes: a dual, whose vertices have valence 3, or triangles some of which are made polygons."""
    points, faces = draw(triangle_cages())
    if draw(st.booleans()):
        return dual(points, faces)
    for move in draw(st.lists(st.integers(0, 99), max_size=12)):
        faces = dissolved(faces, move)
    return points, faces


@st.composite
def cages(draw, scheme):
    """A cage that the scheme takes, with vertices moved at random."""
    points, faces = draw(triangle_cages() if scheme == "loop" else polygon_cages())
    noise = np.random.default_rng(draw(st.integers(0, 99))).uniform(-0.05, 0.05, points.shape)
    return ControlCage(points + noise, faces)
