"""Samples towards one isolated extraordinary point of each scheme and valence, with their exact values."""

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from mitsuba_subdivision import ControlCage
from mitsuba_subdivision.cage.named_cages import extraordinary
from mitsuba_subdivision.mesh.connectivity import Topology
from patches.closed_cages import extraordinary_face, extraordinary_triangles, torus

from reference.brute_force import BruteForce

LEVELS = (0, 1, 2, 5, 10, 17, 24, 31, 38, 45)
SCHEMES = ("catmull_clark", "loop", "doo_sabin")
# With this valence (for Doo-Sabin, size of a face) the point is an ordinary one.
ORDINARY = {"catmull_clark": 4, "loop": 6, "doo_sabin": 4}
_BALLS = {"catmull_clark": extraordinary, "loop": extraordinary_triangles, "doo_sabin": extraordinary_face}


@dataclass(frozen=True)
class ExactSamples:
    """A bumpy cage, samples of element 0 towards the extraordinary point at its corner 0, and values to 17 digits.

    ``second`` holds the derivatives by uu, uv, vv, ``curvature`` the Gaussian and the mean.
    """

    scheme: str
    valence: int
    cage: ControlCage
    uv: np.ndarray
    p: np.ndarray
    dp_du: np.ndarray
    dp_dv: np.ndarray
    n: np.ndarray
    second: np.ndarray
    curvature: np.ndarray
    limit_p: np.ndarray
    limit_n: np.ndarray

    @property
    def size(self) -> float:
        return float(np.ptp(self.cage.positions, axis=0).max())

    def derivative_scale(self, level: np.ndarray, order: int = 1) -> np.ndarray:
        """``(2^order lambda_2)^n``, the size of derivatives at each level."""
        return (2**order * subdominant(self.scheme, self.valence)) ** level


def subdominant(scheme: str, valence: int) -> float:
    """The eigenvalue lambda_2 in closed form."""
    c = np.cos(2 * np.pi / valence)
    if scheme == "catmull_clark":
        return (c + 5 + np.sqrt((c + 9) * (c + 1))) / 16
    return 3 / 8 + c / 4 if scheme == "loop" else 1 / 2


def faces_of(cage: ControlCage) -> list[np.ndarray]:
    return np.split(cage.face_vertices, cage.topology.face_offsets[1:-1])


def mesh_of(vertex_count: int, faces: list) -> Topology:
    """Topology of one vertex list per face, not validated."""
    return Topology(vertex_count, np.array([len(face) for face in faces]), np.concatenate(faces).astype(np.int64))


def bumpy(cage: ControlCage, seed: int, amount: float = 0.2) -> ControlCage:
    """Move each vertex by up to ``amount`` times its shortest edge in each direction."""
    start, end = cage.face_vertices, cage.face_vertices[cage.topology.next]
    shortest = np.full(cage.vertex_count, np.inf)
    np.minimum.at(shortest, start, np.linalg.norm(cage.positions[end] - cage.positions[start], axis=1))
    noise = np.random.default_rng(seed).uniform(-1, 1, cage.positions.shape)
    return cage.with_positions(cage.positions + amount * shortest[:, None] * noise)


def bumpy_ball(scheme: str, valence: int) -> ControlCage:
    """Cage whose element 0 has the extraordinary point at its corner 0 (for Doo-Sabin the face 0) and no other.

    For Catmull-Clark and valence 2 the vertex 0 amid a torus, next to extraordinary ones. Positions have few bits, so
    that rounding them to float32 changes nothing.
    """
    cage = bumpy(_torus_with_valence_2() if valence == 2 else _BALLS[scheme](valence), valence)
    return cage.with_positions(cage.positions.astype(np.float32).astype(float))


def _torus_with_valence_2() -> ControlCage:
    """Torus of quads, one of which is cut in two along two edges that meet in its middle, vertex 0."""
    cage = torus(8, 6)
    (a, b, c, d), *others = 1 + cage.face_vertices.reshape(-1, 4)
    positions = np.concatenate([cage.positions[[a - 1, b - 1, c - 1, d - 1]].mean(axis=0)[None], cage.positions])
    return ControlCage(positions, [(0, a, b, c), (0, c, d, a), *others])


def angle(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Angles between unit vectors in degrees, accurate for tiny ones; nan where a vector is."""
    a, b = (np.asarray(c, dtype=float) / np.linalg.norm(c, axis=-1, keepdims=True) for c in (a, b))
    return np.degrees(2 * np.arctan2(np.linalg.norm(a - b, axis=-1), np.linalg.norm(a + b, axis=-1)))


def curvature_error(computed: np.ndarray, exact: np.ndarray) -> np.ndarray:
    """Errors ``(2, s)`` of Gaussian and mean curvature relative to the principal curvatures k1, k2.

    The unit is ``k1^2 + k2^2 = 4 H^2 - 2 K`` and its root, as either curvature alone may be zero by chance.
    """
    unit = 4 * exact[1] ** 2 - 2 * exact[0]
    return np.abs(computed - exact) / np.stack([unit, np.sqrt(unit)])


def uv_towards_corner(scheme: str, seed: int, levels: tuple[int, ...] = LEVELS) -> np.ndarray:
    """Two places inside and three on the borders of an element, shrunk towards (0, 0) by each level."""
    inside = np.random.default_rng(seed).random((len(levels), 2, 2))
    borders = np.array([(1, 0.75), (1, 0), (0, 1)])
    if scheme == "loop":
        borders[0] = 0.5, 0.5
        beyond = inside.sum(axis=2) > 1
        inside[beyond] = 1 - inside[beyond]
    places = [np.concatenate([here, borders]) for here in inside]
    return np.concatenate([place * 2.0**-level for place, level in zip(places, levels, strict=True)])


@lru_cache(maxsize=64)
def samples_at(scheme: str, valence: int, levels: tuple[int, ...] = LEVELS) -> ExactSamples:
    cage = bumpy_ball(scheme, valence)
    uv = uv_towards_corner(scheme, 100 + valence, levels)
    if valence == 2:
        # Its neighbours are extraordinary as well.
        uv = uv[uv.max(axis=1) < 1]
    reference = BruteForce(scheme, cage.positions, faces_of(cage))
    samples = [reference.evaluate(0, 0, *at) for at in uv]
    if valence == 2:
        # No masks; but lambda_2 is 1/4, and so is the subdominant part after 60 levels less than 1e-36.
        deep = reference.evaluate(0, 0, 2.0**-60, 0)
        limit = deep.p, deep.n
    else:
        limit = reference.limit(0)
    p, dp_du, dp_dv, *second, n, curvature, _ = (np.array(values, dtype=float) for values in zip(*samples, strict=True))
    limit = np.array(limit, dtype=float)
    return ExactSamples(scheme, valence, cage, uv, p, dp_du, dp_dv, n, np.stack(second), curvature.T, *limit)
