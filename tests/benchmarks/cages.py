"""The cages of the benchmarks: closed, of quadrilaterals, always the same; made by whole-array operations and
cached."""

import tempfile
from pathlib import Path

import numpy as np
from mitsuba_subdivision import ControlCage
from mitsuba_subdivision.cage import named_cages
from scipy.sparse import csr_array
from scipy.spatial import ConvexHull

CACHE = Path(tempfile.gettempdir()) / "mitsuba-subdivision-benchmarks"
# Four corners of each of three golden rectangles.
SHORT, LONG = np.array([(-1, 1, -1, 1), np.repeat([1, -1], 2) * (1 + 5**0.5) / 2])
ICOSAHEDRON = np.block([[SHORT, 0 * LONG, LONG], [LONG, SHORT, 0 * LONG], [0 * LONG, LONG, SHORT]]).T


def cube():
    cage = named_cages.cube()
    return cage.positions, cage.face_vertices.reshape(-1, 4)


def torus(n=256):
    i, j = np.divmod(np.arange(n * n), n)
    u, v = 2 * np.pi * i / n, 2 * np.pi * j / n
    radius = 1 + 0.4 * np.cos(v)
    right, up = (i + 1) % n, (j + 1) % n
    faces = np.stack([i * n + j, right * n + j, right * n + up, i * n + up], axis=1)
    return np.stack([radius * np.cos(u), radius * np.sin(u), 0.4 * np.sin(v)], axis=1), faces


def split_sphere(frequency, low, high, rounds, bump):
    """A bumpy sphere of triangles with valences from low to high, each cut into three quadrilaterals.

    Every quadrilateral has an extraordinary vertex at a triangle's centre, and most have a second one opposite.
    """
    points, triangles = _geodesic_sphere(frequency)
    points, triangles = _flip_edges(points, triangles, low, high, rounds)
    points = _relax(points, triangles, 10)
    points, quads = refined(points, triangles)
    points = points / np.linalg.norm(points, axis=1, keepdims=True)
    x, y, z = points.T
    return points * (1 + bump * np.sin(5 * x + 1) * np.sin(4 * y) + bump * np.cos(6 * z))[:, None], quads


def refined(points, faces, times=1):
    """Once, each face is cut into quadrilaterals, one at each corner."""
    cage = ControlCage(points, faces)
    for _ in range(times):
        cage = cage.refined()
    return cage.positions, cage.face_vertices.reshape(-1, 4)


MAKERS = {
    "cube": cube,
    "star": lambda: split_sphere(2, 3, 8, 10, 0.25),
    "ev50k": lambda: split_sphere(29, 5, 7, 8, 0.06),
    "mix50k": lambda: refined(*split_sphere(7, 3, 8, 8, 0.12), times=2),
    "torus": torus,
    "ev500k": lambda: split_sphere(91, 5, 7, 8, 0.06),
    "ev2m": lambda: split_sphere(183, 5, 7, 8, 0.06),
}


def cage_files(name, folder):
    """Files of a cage, made where missing: ``.bin`` of points and quadrilaterals in 32 bits, ``.obj`` and ``.ply``."""
    stem = Path(folder) / name
    files = {kind: stem.with_suffix(f".{kind}") for kind in ("obj", "ply", "bin")}
    if not all(path.exists() for path in files.values()):
        stem.parent.mkdir(parents=True, exist_ok=True)
        points, quads = MAKERS[name]()
        for kind in ("obj", "ply"):
            ControlCage(points, quads).save(files[kind])
        arrays = np.array([len(points), len(quads)], np.int32), points.astype(np.float32), quads.astype(np.int32)
        files["bin"].write_bytes(b"".join(array.tobytes() for array in arrays))
    return files


def read_bin(path):
    """Points and quadrilaterals as the peers read them."""
    with Path(path).open("rb") as file:
        point_count, quad_count = np.fromfile(file, np.int32, 2)
        points = np.fromfile(file, np.float32, 3 * point_count).reshape(-1, 3)
        return points, np.fromfile(file, np.int32, 4 * quad_count).reshape(-1, 4)


def _edges(faces, vertex_count):
    """Ends of each undirected edge, and the edge from each corner of a face to the next."""
    start, end = faces, np.roll(faces, -1, axis=1)
    keys = np.minimum(start, end) * vertex_count + np.maximum(start, end)
    unique, edge = np.unique(keys, return_inverse=True)
    return np.stack(np.divmod(unique, vertex_count), axis=1), edge.reshape(faces.shape)


def _geodesic_sphere(frequency):
    """An icosahedron with each triangle cut into frequency^2, on the sphere."""
    i, j = np.indices((frequency + 1, frequency + 1)).reshape(2, -1)
    weights = np.stack([frequency - i - j, i, j], axis=1)[i + j <= frequency]
    points = np.einsum("sk,fkx->fsx", weights, ICOSAHEDRON[ConvexHull(ICOSAHEDRON).simplices]).reshape(-1, 3)
    points /= np.linalg.norm(points, axis=1, keepdims=True)
    # Points on edges are there once for each of two faces, equal to rounding. They stay in order, so that neighbours
    # lie near each other in memory, as in most models; and so do triangles.
    _, first = np.unique(np.rint(points * 1e8).astype(np.int64), axis=0, return_index=True)
    points = points[np.sort(first)]
    triangles = ConvexHull(points).simplices
    triangles = triangles[np.argsort(triangles.min(axis=1), kind="stable")].astype(np.int64)
    is_inside_out = np.linalg.det(points[triangles]) < 0
    triangles[is_inside_out] = triangles[is_inside_out, ::-1]
    return points, triangles


def _flip_edges(points, triangles, low, high, rounds):
    """Flip random edges while valences stay from low to high; in each round those that share no vertex."""
    rng = np.random.default_rng(1)
    count = len(points)
    for _ in range(rounds):
        ends, edge = _edges(triangles, count)
        one, other = np.argsort(edge.ravel(), kind="stable").reshape(-1, 2).T
        face, at = np.divmod(one, 3)
        other_face, other_at = np.divmod(other, 3)
        a, b, c = (triangles[face, (at + k) % 3] for k in range(3))
        d = triangles[other_face, (other_at + 2) % 3]
        valence = np.bincount(triangles.ravel())
        priority = rng.permutation(len(ends))
        best = np.full(count, len(ends))
        for vertex in (a, b, c, d):
            np.minimum.at(best, vertex, priority)
        flips = np.all([best[vertex] == priority for vertex in (a, b, c, d)], axis=0)
        flips &= (valence[a] > low) & (valence[b] > low) & (valence[c] < high) & (valence[d] < high)
        flips &= ~np.isin(np.minimum(c, d) * count + np.maximum(c, d), ends[:, 0] * count + ends[:, 1])
        for corners in ((a, d, c), (b, c, d)):
            flips &= np.linalg.det(points[np.stack(corners, axis=1)]) > 1e-9
        triangles = triangles.copy()
        triangles[face[flips]] = np.stack([a, d, c], axis=1)[flips]
        triangles[other_face[flips]] = np.stack([b, c, d], axis=1)[flips]
    return points, triangles


def _relax(points, triangles, steps):
    """Move points towards their neighbours' middle, on the sphere."""
    start, end = triangles.ravel(), np.roll(triangles, -1, axis=1).ravel()
    neighbours = csr_array((1 / np.bincount(start)[start], (start, end)), shape=(len(points),) * 2)
    for _ in range(steps):
        points = (points + neighbours @ points) / 2
        points /= np.linalg.norm(points, axis=1, keepdims=True)
    return points
