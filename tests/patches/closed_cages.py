"""Closed control cages with all features that schemes must support."""

from itertools import pairwise

import numpy as np
from mitsuba_subdivision.cage import CageSource, ControlCage, named_cages
from mitsuba_subdivision.schemes import Loop


def torus(columns, rows, major_radius=2.0, minor_radius=1.0):
    """Torus about the z axis, of quads around vertices of valence 4.

    Vertex and face (column, row) have the index ``column * rows + row``. The first edge of face (0, 0) runs from vertex
    0, which is on the x axis, to vertex (1, 0).
    """
    column, row = np.indices((columns, rows)).reshape(2, -1)
    around_axis, around_tube = 2 * np.pi * column / columns, 2 * np.pi * row / rows
    radius = major_radius + minor_radius * np.cos(around_tube)
    height = minor_radius * np.sin(around_tube)
    positions = np.stack([radius * np.cos(around_axis), radius * np.sin(around_axis), height], axis=1)
    next_column, next_row = (column + 1) % columns, (row + 1) % rows
    corners = [(column, row), (next_column, row), (next_column, next_row), (column, next_row)]
    return ControlCage(positions, np.stack([c * rows + r for c, r in corners], axis=1), source=CageSource("torus"))


def tetrahedron():
    positions = [[1, 1, 1], [-1, -1, 1], [-1, 1, -1], [1, -1, -1]]
    return ControlCage(positions, [[0, 1, 3], [0, 2, 1], [0, 3, 2], [1, 2, 3]], source=CageSource("tetrahedron"))


def extraordinary_triangles(valence, rows=4):
    """Ball of triangles, a double pyramid split to 2 or 4 rows, with poles of this valence, isolated with 4 rows.

    Vertex 0 is the pole at (0, 0, 1). Faces 0 to ``valence - 1`` are its one-ring, counter-clockwise, and each begins
    at it. The corners of the pyramids' polygon have valence 4, all other vertices 6.
    """
    t, points = bipyramid(valence).topology, bipyramid(valence).positions
    for _ in range(rows // 2):
        middles = points[t.face_vertices[t.edge_half_edge]] + points[t.face_vertices[t.next[t.edge_half_edge]]]
        points = np.concatenate([points, middles / np.linalg.norm(middles, axis=1, keepdims=True)])
        t = Loop().refine(t).topology
    faces = t.face_vertices.reshape(-1, 3)
    source = CageSource(f"extraordinary_triangles({valence})")
    return ControlCage(points, faces[np.argsort(faces[:, 0] != 0, kind="stable")], source=source)


def extraordinary_face(corners):
    """Ball with a face of any size on top, face 0, amid quads; all vertices have valence 4. Dual of `extraordinary`."""
    cage = named_cages.extraordinary(corners)
    offsets, half_edges = cage.topology.vertex_fans
    centres = cage.positions[cage.face_vertices.reshape(-1, 4)].mean(axis=1)
    return ControlCage.from_arrays(
        centres / np.linalg.norm(centres, axis=1, keepdims=True),
        np.diff(offsets),
        cage.topology.face[half_edges],
        source=CageSource(f"extraordinary_face({corners})"),
    )


def circle(n, radius=1.0, height=0.0, shift=0.0):
    angle = 2 * np.pi * (np.arange(n) + shift) / n
    return np.stack([radius * np.cos(angle), radius * np.sin(angle), np.full(n, height)], axis=1)


def prism(n=5):
    """Two n-gons, a band of quads and one of triangles; valences 3 to 5."""
    positions = [*circle(n, 0.8, 1), *circle(n, 1.2, 0.2), *circle(n, 0.9, -0.9)]
    a, b, c = range(n), range(n, 2 * n), range(2 * n, 3 * n)
    faces = [tuple(a), tuple(reversed(c))]
    for i, j in pairwise([*range(n), 0]):
        faces += [(b[i], b[j], a[j], a[i]), (c[i], c[j], b[j]), (c[i], b[j], b[i])]
    return ControlCage(positions, faces)


def bipyramid(n=7):
    """Triangles only; two poles of valence n, and n vertices of valence 4 between them."""
    faces = [f for i in range(n) for f in ((0, 1 + i, 1 + (i + 1) % n), (n + 1, 1 + (i + 1) % n, 1 + i))]
    return ControlCage([(0, 0, 1), *circle(n, 1, 0), (0, 0, -1)], faces)


def trapezohedron(n=7):
    """Quads only; two poles of valence n, vertices of valence 3 between, no extraordinary vertex isolated."""
    positions = [(0, 0, 1), *circle(n, 1, 0.3), *circle(n, 1, -0.3, 0.5), (0, 0, -1)]
    top, low = range(1, n + 1), range(n + 1, 2 * n + 1)
    faces = [(0, top[i], low[i], top[i - n + 1]) for i in range(n)]
    faces += [(2 * n + 1, low[i], top[i], low[i - 1]) for i in range(n)]
    return ControlCage(positions, faces)


def cube_with_valence_2(*, beside_triangle=False):
    """Cube with two quads, or a quad and a triangle, that meet in two edges at a vertex of valence 2."""
    cube = named_cages.cube()
    (a, b, c, d), *others = cube.face_vertices.reshape(-1, 4).tolist()[::-1]
    middle = cube.positions[[a, b, c, d]].mean(axis=0)
    rest = [(a, 8, c), (a, c, d)] if beside_triangle else [(a, 8, c, d)]
    return ControlCage([*cube.positions, middle], [(a, b, c, 8), *rest, *others])


def cube_with_hexagon():
    """Cube of two triangles, quads, and an L-shaped hexagon that meets one neighbour in two edges."""
    faces = [[0, 2, 3, 1], [4, 5, 7], [4, 7, 6], [3, 2, 6, 7], [0, 4, 6, 2], [1, 3, 7, 5, 4, 0]]
    return ControlCage(named_cages.cube().positions, faces)


def mixed_torus():
    """Torus of quads with a hexagon, a pentagon and two triangles, so large that one-rings never meet themselves."""
    rows = 8
    base = torus(9, rows)
    faces = {divmod(f, rows): tuple(face) for f, face in enumerate(base.face_vertices.reshape(-1, 4).tolist())}
    a, b, c, f = faces.pop((1, 1))
    _, d, e, _ = faces.pop((2, 1))
    others = [(a, b, d, e, c, f)]
    a, b, c, d = faces.pop((3, 4))
    others += [(a, b, c), (a, c, d)]
    a, b, c, d = faces.pop((6, 5))
    _, e, f, _ = faces.pop((7, 5))
    others += [(a, b, d), (b, e, f, c, d)]
    return ControlCage(base.positions, [*others, *faces.values()])


CLOSED_CAGES = {
    "cube": named_cages.cube,
    "tetrahedron": tetrahedron,
    "torus": lambda: torus(5, 4),
    "torus 3 x 3": lambda: torus(3, 3),
    "prism": prism,
    "bipyramid": bipyramid,
    "trapezohedron": trapezohedron,
    "valence 2": cube_with_valence_2,
    "valence 2 beside triangle": lambda: cube_with_valence_2(beside_triangle=True),
    "valence 5": lambda: named_cages.extraordinary(5),
    "hexagon": cube_with_hexagon,
    "mixed torus": mixed_torus,
}


def triangulated(cage):
    faces = [(f[0], f[i], f[i + 1]) for f in polygons(cage.topology) for i in range(1, len(f) - 1)]
    return ControlCage(cage.positions, faces)


TRIANGLE_CAGES = {
    "tetrahedron": tetrahedron,
    "bipyramid": bipyramid,
    "cube": lambda: triangulated(named_cages.cube()),
    "torus": lambda: triangulated(torus(5, 4)),
    "mixed torus": lambda: triangulated(mixed_torus()),
}
# Scheme and cage, wherever the scheme takes the cage.
SURFACES = [
    *(("catmull_clark", name) for name in CLOSED_CAGES),
    *(("loop", name) for name in TRIANGLE_CAGES),
    # Faces as small as the prism's are extraordinary points enough; vertices of valence 2 are refused.
    *(("doo_sabin", name) for name in CLOSED_CAGES if not name.startswith("valence") and name != "hexagon"),
]


def cage_of(scheme, name):
    return (TRIANGLE_CAGES if scheme == "loop" else CLOSED_CAGES)[name]()


def bumpy(cage, seed=0, size=0.1):
    noise = np.random.default_rng(seed).uniform(-size, size, cage.positions.shape)
    return cage.with_positions(cage.positions + noise)


def polygons(topology):
    return [tuple(map(int, face)) for face in np.split(topology.face_vertices, topology.face_offsets[1:-1])]
