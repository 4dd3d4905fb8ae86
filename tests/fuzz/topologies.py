"""Random small topologies, whose surfaces agree with those of their refined cages; see `main` for long runs.

A topology is a list of faces, which are tuples of vertices. It is made of polygons glued at random, or a known mesh; it
may be doubled, its border closed by a copy of itself, which makes surfaces that collapse.
"""

import argparse
import sys
import traceback
from collections import Counter
from pathlib import Path

import numpy as np
from tqdm import tqdm

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from mitsuba_subdivision import CageError, ControlCage, LimitSurface, SchemeError
from mitsuba_subdivision.cage import without_warnings
from mitsuba_subdivision.evaluation.equations import AT_EXTRAORDINARY_POINT
from mitsuba_subdivision.mesh.connectivity import VertexRule
from peers.fidelity_cages import edges_of, triangulated
from reference.refined_cages import refined

# Points and unit normals, of cages of a size of some units.
POINT = 1e-11
LENGTH, SINGLE_LENGTH = 1e-12, 1e-6
# Error of normals where tangents are at right angles and equally long; in radians.
NORMAL = 1e-9
# Tangents are known to so much of the cage's size, which matters where they are almost parallel or one is short.
TANGENT = 1e-12
# Where no more than this, times the longer tangent and the size of the cage, is left of their product, a fold is so
# near that rounding, other in the refined cage, may show in one of them alone.
FADING = 1e-9
SCHEMES = ("catmull_clark", "catmull_clark", "catmull_clark", "loop", "doo_sabin")
SEEDS = (
    [(0, 1, 2, 3)],
    [(0, 1, 2)],
    [(0, 1, 2, 3), (3, 2, 1, 0)],
    [(0, 1, 2), (2, 1, 0)],
    [(0, 2, 1), (0, 1, 3), (1, 2, 3), (2, 0, 3)],
    [(0, 3, 2, 1), (4, 5, 6, 7), (0, 1, 5, 4), (1, 2, 6, 5), (2, 3, 7, 6), (3, 0, 4, 7)],
    [(0, 1, 4, 3), (1, 2, 5, 4), (3, 4, 7, 6), (4, 5, 8, 7)],
    [(0, 1, 2), (0, 2, 3), (0, 3, 4), (0, 4, 1), (5, 2, 1), (5, 3, 2), (5, 4, 3), (5, 1, 4)],
)


def vertices_of(faces):
    return sorted({v for face in faces for v in face})


def new_vertex(faces):
    return 1 + max(vertices_of(faces))


def is_manifold(faces):
    """Whether no edge has two faces on one side, and the faces around every vertex are one fan."""
    directed = [edge for face in faces for edge in edges_of(face)]
    if any(len({*face}) < len(face) or len(face) < 3 for face in faces) or len({*directed}) < len(directed):
        return False
    # From the edge that leaves a vertex in a face to the one that enters it.
    entering = {(face[i], face[(i + 1) % len(face)]): face[i - 1] for face in faces for i in range(len(face))}
    for vertex in {v for v, _ in directed}:
        spokes = {b for a, b in directed if a == vertex}
        starts = spokes - {entering[vertex, b] for b in spokes}
        spoke, walked = min(starts or spokes), 0
        while (vertex, spoke) in entering and walked < len(spokes):
            spoke, walked = entering[vertex, spoke], walked + 1
        if walked < len(spokes):
            return False
    return True


def numbered(faces):
    number = {vertex: i for i, vertex in enumerate(vertices_of(faces))}
    return [tuple(number[v] for v in face) for face in faces]


def identified(faces, kept, dropped):
    return [tuple(kept if v == dropped else v for v in face) for face in faces]


def glued(rng):
    """Polygons whose edges are glued at random, as long as that leaves a manifold."""
    sizes = rng.choice([3, 4, 5, 6], rng.integers(2, 9), p=[0.35, 0.4, 0.15, 0.1])
    ends = np.cumsum(sizes)
    faces = [tuple(range(end - size, end)) for size, end in zip(sizes.tolist(), ends.tolist(), strict=True)]
    for _ in range(rng.integers(2, 10 * len(faces) + 4)):
        directed = [edge for face in faces for edge in edges_of(face)]
        border = [edge for edge in directed if edge[::-1] not in {*directed}]
        if len(border) < 2:
            break
        (a, b), (c, d) = (border[i] for i in rng.choice(len(border), 2, replace=False))
        joined = identified(identified(faces, a, d), b, c)
        if is_manifold(joined):
            faces = joined
    return faces


def doubled(faces):
    """The faces and, turned over, a copy of them with the same border; and the vertex that each is a copy of."""
    faces = numbered(faces)
    directed = {edge for face in faces for edge in edges_of(face)}
    border = {v for a, b in directed if (b, a) not in directed for v in (a, b)}
    count = new_vertex(faces)
    copied = [tuple(v if v in border else v + count for v in face[::-1]) for face in faces]
    origin = {v: v % count for face in faces + copied for v in face}
    return numbered(faces + copied), [origin[v] for v in sorted(origin)]


def random_topology(rng):
    """Faces, and for each vertex one that may have the same position."""
    faces = numbered(SEEDS[rng.integers(len(SEEDS))] if rng.random() < 0.15 else glued(rng))
    origin = list(range(new_vertex(faces)))
    if rng.random() < 0.3:
        both, copy_of = doubled(faces)
        if is_manifold(both):
            faces, origin = both, copy_of
    return faces, origin


def random_positions(count, origin, rng):
    """Anywhere, in a plane, on a small lattice, where many coincide, on a line, or in a point."""
    points = rng.uniform(-1, 1, (count, 3))
    kind = rng.choice(["space", "plane", "lattice", "line", "point"], p=[0.65, 0.2, 0.09, 0.03, 0.03])
    if kind == "plane":
        points = points @ np.diag([1, 1, 0])
    elif kind == "lattice":
        points = np.rint(1.2 * points)
    elif kind == "line":
        points = points[:, :1] * rng.uniform(-1, 1, 3)
    elif kind == "point":
        points[:] = points[0]
    if rng.random() < 0.8:
        points = points[origin]
    if rng.random() < 0.3:
        points = points @ np.linalg.qr(rng.standard_normal((3, 3)))[0] + rng.uniform(-3, 3, 3)
    return points


def random_tags(faces, rng):
    """Creases, corners and rules, in two of five cages."""
    if rng.random() < 0.6:
        return {}
    edges = sorted({tuple(sorted(edge)) for face in faces for edge in edges_of(face)})

    def sharpness():
        return float("inf") if rng.random() < 0.6 else float(rng.choice([0.3, 0.5, 1.0, 1.5, 2.25]))

    share = rng.choice([0.1, 0.4, 1.0], p=[0.6, 0.3, 0.1])
    creases = [(*edge, sharpness()) for edge in edges if rng.random() < share]
    corners = [(v, sharpness()) for v in vertices_of(faces) if rng.random() < 0.1]
    return {"creases": creases, "corners": corners, "crease_method": "chaikin" if rng.random() < 0.3 else "uniform"}


def random_cage(rng):
    scheme = SCHEMES[rng.integers(len(SCHEMES))]
    faces, origin = random_topology(rng)
    if scheme == "loop":
        faces = triangulated(faces)
    points = random_positions(len(origin), origin, rng)
    rules = {}
    if scheme != "doo_sabin":
        rules = random_tags(faces, rng)
        rules["boundary"] = "edge_and_corner" if rng.random() < 0.5 else "edge_only"
    if scheme == "catmull_clark" and rng.random() < 0.2:
        rules["triangle_rule"] = "smooth"
    return ControlCage(points, faces, **rules), scheme


def some_samples(surface, rng, count):
    """Half-edges that name elements, and parameters: inside, on edges, near corners and at them.

    At three corners only: each new one-ring takes longer than many samples.
    """
    corner = rng.choice(rng.integers(0, surface.patches.elements.half_edge_count, 3), count)
    uv = rng.random((count, 2))
    uv[rng.random(count) < 0.2, rng.integers(2)] = 0
    if surface.scheme.domain.corner_count == 3:
        uv = np.where(uv.sum(axis=1, keepdims=True) > 1, 1 - uv, uv)
    uv *= 0.5 ** rng.choice([0, 0, 1, 3, 8], (count, 1))
    uv[rng.random(count) < 0.2] = 0
    return surface.patches.half_edge_of_corner[corner], uv


def evaluate_at(surface, half_edge, uv):
    """Evaluate parameters of the elements that half-edges of the cut mesh name."""
    table = surface.patches
    corner = np.empty(table.topology.half_edge_count, dtype=np.int64)
    corner[table.half_edge_of_corner] = np.arange(len(table.half_edge_of_corner))
    return surface._sampler.evaluate(corner[half_edge], uv)


def is_convention(surface, half_edge, samples):
    """Whether each normal is one of the conventions that depend on the level: at tips of sharp vertices."""
    t = surface.patches.topology
    sharp = t.vertex_rules == VertexRule.CORNER
    if t.semi_sharpness is not None:
        sharp |= t.semi_sharpness.vertices > 0
    return (samples.level == AT_EXTRAORDINARY_POINT) & sharp[t.face_vertices[half_edge]]


def difference_to_refined(surface, rng, count=24):
    """What is wrong with samples beside those of the surface of the cage refined once, at the same points.

    Returns nothing where they agree; and how many normals are zero.
    """
    topology, scheme = surface.patches.topology, surface.scheme
    finer = refined(surface)
    half_edge, uv = some_samples(surface, rng, count)
    child, child_uv = np.empty(count, dtype=np.int64), np.empty((count, 2))
    for i in range(count):
        parts = scheme.children(topology, finer.cage.topology, int(half_edge[i]))
        placed = np.array([domain(uv[i]) for domain, _ in parts])
        best = int(np.argmax(scheme.domain.inside(placed)))
        child[i], child_uv[i] = parts[best][1], placed[best]
    here, there = evaluate_at(surface, half_edge, uv), evaluate_at(finer, child, child_uv)
    lengths = np.linalg.norm([here.n, there.n], axis=2)
    zero, unit = lengths == 0, np.abs(lengths - 1) <= LENGTH
    product = np.linalg.norm(np.cross(here.dp_du, here.dp_dv), axis=1)
    longer = np.maximum(np.linalg.norm(here.dp_du, axis=1), np.linalg.norm(here.dp_dv, axis=1))
    size = np.ptp(surface.cage.positions, axis=0).max()
    with np.errstate(divide="ignore", invalid="ignore"):
        left = np.where(longer > 0, product / (longer * np.maximum(longer, size)), 0)
        # Of what is allowed.
        angle = np.linalg.norm(here.n - there.n, axis=1) / (NORMAL + TANGENT / left)
    is_comparable = ~is_convention(surface, half_edge, here)
    point, normal = np.abs(here.p - there.p).max(), angle[unit.all(axis=0) & is_comparable].max(initial=0)
    # One normal is zero and the other is not, though tangents are far from parallel.
    unlike = np.count_nonzero((zero[0] != zero[1]) & (left > FADING) & is_comparable)
    problem = None
    if not point <= POINT:
        problem = f"points differ by {point:.1e}"
    elif not (zero | unit).all():
        problem = f"{np.count_nonzero(~(zero | unit))} normals neither unit nor zero"
    elif unlike:
        problem = f"{unlike} normals zero on one side only"
    elif not normal <= 1:
        problem = f"normals differ by {normal:.1e} of what is allowed"
    return problem, np.count_nonzero(zero)


# Share of the cages whose whole surface is tessellated, too.
TESSELLATED = 0.04


def tessellation_problem(surface):
    """What is wrong with the normals of a tessellation, in either precision, if anything."""
    table = surface.sampling(2)
    start, uv = table.locations()
    normals = [table.apply(surface.cage.positions)[1], surface._sampler.evaluate(start, uv).n]
    lengths = np.linalg.norm(normals, axis=2)
    if not ((lengths == 0) | (np.abs(lengths - 1) < SINGLE_LENGTH)).all():
        return "normals of a tessellation neither unit nor zero"
    if ((lengths[0] == 0) != (lengths[1] == 0)).any():
        return "normals of a tessellation zero where those of samples are not"
    return None


def outcome(seed):
    """What one random cage shows: "ok", "refused ..", or what is wrong; and how many normals are zero, if compared."""
    rng = np.random.default_rng(seed)
    with without_warnings():
        try:
            surface = LimitSurface(*random_cage(rng))
        except CageError:
            return "refused as a cage", None
        except SchemeError:
            return "refused by the scheme", None
        problem, zero_count = difference_to_refined(surface, rng)
        if problem is None and rng.random() < TESSELLATED:
            problem = tessellation_problem(surface)
    return problem or "ok", zero_count


def main():
    parser = argparse.ArgumentParser(description="Compare random cages' surfaces with those of their refined cages.")
    parser.add_argument("--count", type=int, default=1000, help="cages to try")
    parser.add_argument("--first", type=int, default=0, help="seed of the first")
    options = parser.parse_args()
    counts = Counter()
    for seed in tqdm(range(options.first, options.first + options.count), leave=False, disable=None):
        try:
            result, _ = outcome(seed)
        except Exception:
            result = f"raises {traceback.format_exc().splitlines()[-1]}"
        kind = result if result == "ok" or result.startswith("refused") else "wrong"
        counts[kind] += 1
        if kind == "wrong":
            tqdm.write(f"seed {seed}: {result}")
    print(dict(counts))
    return int(counts["wrong"] > 0)


if __name__ == "__main__":
    sys.exit(main())
