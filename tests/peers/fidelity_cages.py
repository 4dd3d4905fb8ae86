"""Cages with all features of OpenSubdiv, alone and together, small enough for deep refinement."""

from itertools import pairwise

import numpy as np
from mitsuba_subdivision import Attribute, ControlCage
from mitsuba_subdivision.cage import named_cages
from mitsuba_subdivision.cage.errors import without_warnings
from patches import closed_cages
from patches.closed_cages import bumpy, circle, polygons, tetrahedron
from reference.refined_cages import changed, half_disc, sheet, tagged
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

INFINITE = 10.0
# What OpenSubdiv keeps of a sharpness is a single-precision number: these are what it makes of 0.3, 1.7 and so on.
LADDER = [float(np.float32(s)) for s in (0.3, 0.5, 1, 1.75, 2.5, 4, 10, np.inf)]
MODES = ("none", "corners_only", "corners_plus1", "corners_plus2", "boundaries", "all")


def made(positions, faces, **options):
    """A cage, manifold or not, with its vertices moved by a tenth, so that no symmetry hides an error."""
    with without_warnings():
        return bumpy(ControlCage(positions, faces, **options), seed=1)


def triangulated(faces):
    return [(face[0], a, b) for face in faces for a, b in pairwise(face[1:])]


def edges_of(face):
    return list(zip(face, [*face[1:], face[0]], strict=True))


def cube(**options):
    return bumpy(tagged(named_cages.cube(), **options), seed=1)


TOP = [(4, 5), (5, 7), (7, 6), (6, 4)]


def grid(columns, rows, **options):
    return bumpy(sheet(columns, rows, **options), seed=1)


def bipyramid(sides, **options):
    """Vertex 0 is above and the last below a ring of the others."""
    return bumpy(tagged(closed_cages.bipyramid(sides), **options), seed=1)


def fan(valence, triangles=False, **options):
    """Open disc of faces around vertex 0; its spokes end at vertices 1 to the valence. Quads end at one more vertex."""
    turn = 2 * np.pi * np.arange(valence) / valence
    spokes = np.stack([np.cos(turn), np.sin(turn), 0.2 * np.cos(2 * turn)], axis=1)
    ring = edges_of([1 + k for k in range(valence)])
    if triangles:
        faces = [[0, here, ahead] for here, ahead in ring]
        return made(np.vstack([[[0, 0, 0.5]], spokes]), faces, scheme="loop", **options)
    between = 0.7 * (spokes + np.roll(spokes, -1, axis=0))
    faces = [[0, here, here + valence, ahead] for here, ahead in ring]
    return made(np.vstack([[[0, 0, 0.5]], spokes, between]), faces, **options)


def spoked(valence, sharpness, **options):
    return fan(valence, creases=[(0, spoke, s) for spoke, s in sharpness.items()], **options)


# Radius and height along the outline of something like a pawn.
OUTLINE = ((1.0, 0.0), (1.0, 0.3), (0.4, 0.6), (0.35, 1.2), (0.6, 1.5))
COLUMNS = 5


def lathe(**options):
    """Chess piece: rings of vertices along `OUTLINE`, closed by a polygon at each end."""
    positions = np.concatenate([radius * circle(COLUMNS) + [0, 0, height] for radius, height in OUTLINE])
    top = len(OUTLINE) - 1
    faces = [[a, b, b + COLUMNS, a + COLUMNS] for ring in range(top) for a, b in lathe_ring(ring)]
    faces += [[a for a, _ in lathe_ring(0)][::-1], [a for a, _ in lathe_ring(top)]]
    return made(positions, faces, **options)


def lathe_ring(ring):
    return edges_of(list(range(ring * COLUMNS, (ring + 1) * COLUMNS)))


def rings(sharpness):
    return [(a, b, s) for ring, s in sharpness.items() for a, b in lathe_ring(ring)]


def with_islands(cage, seams, mode):
    """The cage with face-varying values that are discontinuous across some edges, and random."""
    t, cut = cage.topology, {frozenset(edge) for edge in seams}
    ends = zip(t.face_vertices.tolist(), t.face_vertices[t.next].tolist(), strict=True)
    whole = np.flatnonzero((t.twin >= 0) & [frozenset(edge) not in cut for edge in ends])
    twin = t.twin[whole]
    here, there = np.concatenate([whole, t.next[whole]]), np.concatenate([t.next[twin], twin])
    count, indices = connected_components(coo_array((here >= 0, (here, there)), shape=(t.half_edge_count,) * 2))
    return with_values(cage, count, indices, mode)


def with_values(cage, count, indices, mode):
    values = np.random.default_rng(7).uniform(0, 1, (count, 2))
    return changed(cage, texcoords=Attribute(values, "face_varying", indices), face_varying=mode)


def _catmull_clark():
    around = [*((i, i + 1, INFINITE) for i in range(4)), (4, 9, INFINITE), (5, 10, 2.5)]
    halves = [(5, 6, 1.75), (6, 10, INFINITE)]
    cages = {
        "cube": cube(),
        "piece": lathe(),
        "sheet": grid(3, 3),
        "sheet without corners": grid(3, 2, boundary="edge_only"),
        "sheet, nothing interpolated": grid(4, 4, boundary="none"),
        "sheet, creases interpolated": grid(4, 4, boundary="none", creases=around),
        "one quad": grid(1, 1),
        "one quad without corners": grid(1, 1, boundary="edge_only"),
        "strip": grid(3, 1),
        "triangles": bipyramid(5),
        "smooth triangles": bipyramid(5, triangle_rule="smooth"),
        "smooth triangles, open and creased": grid(3, 3, triangles=True, triangle_rule="smooth", creases=halves),
        # The faces around one end of the crease are those around the other, and close around it.
        "crease of one edge on a tetrahedron": bumpy(tagged(tetrahedron(), creases=[(1, 3, INFINITE)])),
        **{f"half disc of {count} triangles": bumpy(half_disc(count)) for count in (1, 2, 3, 6)},
    }
    for valence in (3, 4, 5, 8):
        cages[f"fan {valence}"] = fan(valence)
        half = valence // 2
        for name, spokes in (("dart", [1]), ("crease", [1, 1 + half]), ("corner", [1, 2, 1 + half])):
            for s in (1.75, 4, INFINITE) if valence > 3 else (2.5, INFINITE):
                cages[f"{name} of {s:g} at valence {valence}"] = spoked(valence, dict.fromkeys(spokes, s))
    for s in LADDER:
        cages[f"cube, rim {s:.1f}"] = cube(creases=[(a, b, s) for a, b in TOP])
        cages[f"cube, edge {s:.1f}"] = cube(creases=[(4, 5, s)])
        cages[f"cube, corner {s:.1f}"] = cube(corners=[(7, s)])
        cages[f"piece, rings {s:.1f}"] = lathe(creases=rings({1: s, 3: s}))
        cages[f"sheet, corner {s:.1f}"] = grid(3, 3, corners=[(5, s)])
        cages[f"sheet, border corner {s:.1f}"] = grid(3, 3, corners=[(1, s), (0, s)], boundary="edge_only")
    return cages | {
        "piece, rings and rims": lathe(creases=rings({0: 2.5, 1: INFINITE, 2: 0.5, 4: INFINITE})),
        "three semi-sharp edges": spoked(5, {1: 0.5, 2: 1.5, 4: 2.5}),
        "five semi-sharp edges": spoked(5, {k + 1: 0.5 * k + 0.25 for k in range(5)}),
        "all edges semi-sharp": cube(creases=[(a, b, 1.25 + 0.5 * (a % 3)) for a, b in cube().edges]),
        "crease, semi-sharp on one side": spoked(6, {1: INFINITE, 4: INFINITE, 2: 1.5}),
        "crease, semi-sharp on both sides": spoked(6, {1: INFINITE, 4: INFINITE, 2: 1.5, 3: 2.25, 6: 0.75}),
        "dart with semi-sharp edges": spoked(5, {1: INFINITE, 3: 2.5}),
        "dart with a semi-sharp pair": spoked(6, {1: INFINITE, 3: 2.5, 5: 1.25}),
        "corner of creases, one semi-sharp": spoked(6, {1: INFINITE, 3: INFINITE, 5: INFINITE, 2: 1.5}),
        "semi-sharp corner on a crease": spoked(6, {1: INFINITE, 4: INFINITE}, corners=[(0, 1.5)]),
        "semi-sharp corner on a semi-sharp crease": spoked(6, {1: 2.5, 4: 2.5}, corners=[(0, 1.5)]),
        "corner on a semi-sharp crease": spoked(6, {1: 2.5, 4: 2.5}, corners=[(0, INFINITE)]),
        "corner at the end of a dart": spoked(5, {1: INFINITE}, corners=[(0, INFINITE)]),
        "semi-sharp crease to the border": grid(3, 3, creases=[(1, 5, 1.5), (5, 9, 1.5), (9, 13, 1.5)]),
        "semi-sharp along the border and from it": grid(3, 3, creases=[(1, 2, 0.75), (2, 3, 2.5), (2, 6, 1.5)]),
        "crease to the border": grid(3, 3, creases=[(1, 5, INFINITE), (5, 9, INFINITE)]),
        "semi-sharp edge to a border corner": grid(3, 3, creases=[(1, 5, 2.5)], boundary="edge_only"),
        "sharpness changes along a crease": grid(4, 2, creases=[(5 + i, 6 + i, 0.5 + i) for i in range(4)]),
        "sheet of creases, nothing interpolated": grid(4, 4, boundary="none", creases=[(6, 7, 1.5), (7, 8, INFINITE)]),
        "hole": grid(3, 3, holes=[4]),
        "hole beside the border": grid(3, 3, holes=[1, 4], boundary="edge_only"),
        "holes, creased": cube(holes=[1], creases=[(a, b, 2.5) for a, b in TOP]),
    }


def _chaikin():
    ring = [(a, b, s) for (a, b), s in zip(lathe_ring(1), [1.0, 2.5, 0.5, 3.0, 1.75], strict=True)]
    chain = [(5 + i, 6 + i, s) for i, s in enumerate([0.5, 2.0, 3.0, 1.0])]
    plain = {
        "equal ring": lathe(creases=rings({1: 2.5})),
        "unequal ring": lathe(creases=ring),
        "unequal chain": grid(4, 2, creases=chain),
        "chain with an end inside": grid(4, 2, creases=chain[:2]),
        "chain with an infinite part": grid(4, 2, creases=[*chain[:2], (7, 8, INFINITE), chain[3]]),
        "three edges": spoked(5, {1: 0.5, 2: 1.5, 4: 2.5}),
        "two pairs": spoked(6, {1: 2.0, 4: 1.0, 2: 0.5, 5: 3.0}),
        "semi-sharp beside a crease": spoked(6, {1: INFINITE, 4: INFINITE, 2: 1.5}),
        "semi-sharp corner": lathe(creases=ring, corners=[(6, 1.5)]),
        "to the border": grid(3, 3, creases=[(1, 5, 1.5), (5, 9, 3.0)]),
    }
    return {f"Chaikin, {name}": changed(cage, crease_method="chaikin") for name, cage in plain.items()}


def _loop():
    def triangles(columns=3, rows=3, **options):
        return grid(columns, rows, triangles=True, scheme="loop", **options)

    rising = [(4, 5, 1.5), (5, 6, 2.5), (6, 7, INFINITE)]
    cages = {
        "sheet": triangles(),
        "sheet without corners": triangles(boundary="edge_only"),
        "sheet, nothing interpolated": triangles(4, 4, boundary="none"),
        "hole": triangles(holes=[8]),
        "semi-sharp crease to the border": triangles(creases=[(1, 5, 1.5), (5, 9, 2.5)]),
        "semi-sharp crease and corner": triangles(creases=rising, corners=[(5, 1.25)]),
        "Chaikin": triangles(creases=[(4, 5, 0.5), (5, 6, 2.5), (6, 7, 1.0)], crease_method="chaikin"),
        "crease of one edge on a tetrahedron": bumpy(tagged(tetrahedron(), scheme="loop", creases=[(1, 3, INFINITE)])),
        **{f"half disc of {count}": bumpy(tagged(half_disc(count), scheme="loop")) for count in (1, 2, 3, 4, 6)},
    }
    for sides in (3, 4, 5, 6, 7):
        cages[f"bipyramid {sides}"] = bipyramid(sides, scheme="loop")
    for s in LADDER:
        ring = [(a, b, s) for a, b in edges_of([1, 2, 3, 4, 5])]
        cages[f"bipyramid, ring {s:.1f}"] = bipyramid(5, scheme="loop", creases=ring)
        cages[f"bipyramid, edge {s:.1f}"] = bipyramid(5, scheme="loop", creases=[(0, 1, s)])
        cages[f"bipyramid, corner {s:.1f}"] = bipyramid(5, scheme="loop", corners=[(0, s)])
    for valence in (3, 5, 8):
        half = valence // 2
        for name, spokes in (("dart", [1]), ("crease", [1, 1 + half]), ("corner", [1, 2, 1 + half])):
            for s in (1.75, INFINITE):
                sharpness = dict.fromkeys(spokes, s)
                cages[f"{name} of {s:g} at valence {valence}"] = spoked(valence, sharpness, triangles=True)
    cages["semi-sharp beside a crease"] = spoked(6, {1: INFINITE, 4: INFINITE, 2: 1.5, 5: 0.75}, triangles=True)
    cages["three semi-sharp edges"] = spoked(5, {1: 0.5, 2: 1.5, 4: 2.5}, triangles=True)
    return {f"Loop, {name}": cage for name, cage in cages.items()}


def book(pages, triangles=False, **options):
    """Sheets of 3 by 2 quads that share their first row of vertices, 0 to 3; page k has 4 + 8 k and so on."""
    positions, faces = [[i, 0, 0.1 * i * i] for i in range(4)], []
    for page in range(pages):
        turn, before = np.pi * page / pages, list(range(4))
        for row in (1, 2):
            here = list(range(len(positions), len(positions) + 4))
            positions += [[i, row * np.cos(turn), row * np.sin(turn)] for i in range(4)]
            faces += [[before[i], before[i + 1], here[i + 1], here[i]] for i in range(3)]
            before = here
    if triangles:
        faces, options["scheme"] = triangulated(faces), "loop"
    return made(positions, faces, **options)


def joined(one, other, shared, **options):
    """Two cages, some vertices of the second being vertices of the first."""
    kept = [vertex for vertex in range(other.vertex_count) if vertex not in shared]
    number = shared | {vertex: one.vertex_count + k for k, vertex in enumerate(kept)}
    faces = [*polygons(one.topology), *([number[vertex] for vertex in face] for face in polygons(other.topology))]
    return made(np.vstack([one.positions, other.positions[kept] + 2]), faces, scheme=one.scheme, **options)


def strip(twists, **options):
    """Ring of seven quads between vertices 0, 2, ... and 1, 3, ..., closed with a number of half turns."""
    turn = 2 * np.pi * np.arange(7) / 7
    across = np.stack([np.cos(turn) * np.cos(turn / 2), np.sin(turn) * np.cos(turn / 2), np.sin(turn / 2)], axis=1)
    middle = 3 * circle(7)
    ahead = [(2 * i + 2, 2 * i + 3) for i in range(6)] + [(0, 1) if twists % 2 == 0 else (1, 0)]
    faces = [[2 * i, a, b, 2 * i + 1] for i, (a, b) in enumerate(ahead)]
    return made(np.stack([middle - across, middle + across], axis=1).reshape(-1, 3), faces, **options)


def pole(count, triangles=False, **options):
    """Cone whose faces have its tip, vertex 0, twice, with a second ring of quads, or of triangles, below."""
    ring = edges_of([1 + k for k in range(count)])
    quads = [[here, here + count, ahead + count, ahead] for here, ahead in ring]
    tip = [[0, 0, here, ahead] for here, ahead in ring]
    if triangles:
        quads, tip, options["scheme"] = triangulated(quads), triangulated(tip), "loop"
    positions = np.vstack([[[0, 0, 1]], circle(count), 2 * circle(count) - [0, 0, 1]])
    return made(positions, [*quads, *tip], **options)


def _non_manifold():
    """Cages that are no manifold. Faces agree in orientation, or cannot, as OpenSubdiv does not turn them."""
    pages, squares, far = book(4), grid(5, 5), [[1.5, -1, 1], [1, -1, 1], [2, -2, 2]]
    page = [1, 2, pages.vertex_count, pages.vertex_count + 1]
    with_hair = [face if k != 12 else [face[0], 36, *face] for k, face in enumerate(polygons(squares.topology))]
    three = [[0, 0, 0], [1, 0, 0.1], [1, 1, 0], [0, 1.2, 0], [1, -0.5, 1], [0, -0.6, 1], [1, -0.7, -1], [0, -0.5, -1]]
    cages = {
        "book, a page to nowhere": made(np.vstack([pages.positions, far]), [*polygons(pages.topology), page]),
        "sheet with a hair": made(np.vstack([squares.positions, [[2, 2, 3]]]), with_hair, boundary="none"),
        "three quads at an edge": made(three, [[0, 1, 2, 3], [1, 0, 5, 4], [0, 1, 6, 7]]),
        "book of three": book(3),
        "book of four without corners": book(4, boundary="edge_only"),
        "book, nothing interpolated": book(3, boundary="none"),
        "book, semi-sharp edge on a page": book(3, creases=[(1, 5, 1.75), (5, 9, 1.75)]),
        "book, crease on a page": book(3, creases=[(1, 5, INFINITE), (5, 9, INFINITE)]),
        "book, semi-sharp corner on the spine": book(3, corners=[(1, 1.5)]),
        "book, semi-sharp spine": book(3, creases=[(1, 2, 1.5)]),
        "book, hole": book(3, holes=[1]),
        "quads that touch in a vertex": joined(grid(2, 2), grid(1, 1), {0: 8}),
        "cones that touch in their tips": joined(fan(4), fan(5), {0: 0}),
        "cones that touch, creased": joined(fan(5), fan(6), {0: 0}, creases=[(0, 1, 10), (0, 3, 10), (0, 12, 1.5)]),
        "cone on a border": joined(grid(2, 2), fan(5), {0: 1}),
        "cubes that share an edge": joined(cube(), cube(), {0: 7, 1: 6}),
        "cubes that share a face": joined(cube(), cube(), {0: 4, 1: 5, 2: 6, 3: 7}),
        "Moebius strip": strip(1),
        "Moebius strip, creased": strip(1, creases=[(2, 4, 1.75), (4, 6, INFINITE)]),
        "pole of quads": pole(6),
        "spike": made([[0, 0, 0], [1, 0, 0], [1.2, 1, 0.3], [0, 1, 0.1], [2, 1.5, 1]], [[0, 1, 2, 4, 2, 3]]),
        "Loop, book": book(3, triangles=True),
        "Loop, book, semi-sharp edge on a page": book(3, triangles=True, creases=[(1, 5, 1.75)]),
        "Loop, cones that touch in their tips": joined(fan(4, triangles=True), fan(5, triangles=True), {0: 0}),
        "Loop, pole": pole(6, triangles=True),
        "Loop, valence 2 inside": made(
            [[0, 0, 0], [1, 0, 0.2], [0.4, 1, 0], [0.5, -0.7, 0.3], [0.6, 0.7, 1]],
            [[0, 1, 2], [1, 0, 2], [3, 1, 0]],
            scheme="loop",
        ),
    }
    return {f"no manifold, {name}": cage for name, cage in cages.items()}


def _non_manifold_islands():
    """With a face-varying value at each vertex, and others at some (face, corner)."""
    plain = {
        "book": (book(3), []),
        "book, a page apart": (book(3), [(face, corner) for face in (0, 1, 2) for corner in (0, 1)]),
        "book, torn at a vertex of the spine": (book(3), [(0, 1), (1, 0)]),
        "book, seam on a page": (book(3), [(0, 1), (0, 2)]),
        "book, creased page": (book(3, creases=[(1, 5, INFINITE), (5, 9, 1.5)]), []),
        "cones that touch": (joined(fan(4), fan(5), {0: 0}), []),
        "cones that touch, apart": (joined(fan(4), fan(5), {0: 0}), [(face, 0) for face in range(4)]),
        "cubes that share an edge": (joined(cube(), cube(), {0: 7, 1: 6}), [(1, 2), (1, 3)]),
        "pole": (pole(6), [(6, 1), (7, 0)]),
        "Moebius strip": (strip(1), [(2, 0), (2, 3)]),
        "Loop, book": (book(3, triangles=True), [(0, 0)]),
    }
    islands = {}
    for name, (cage, moved) in plain.items():
        indices, count = cage.face_vertices.astype(np.int64), cage.vertex_count + len(moved)
        indices[[cage.topology.face_offsets[face] + corner for face, corner in moved]] = range(cage.vertex_count, count)
        islands |= {f"no manifold, {name}, {mode}": with_values(cage, count, indices, mode) for mode in MODES}
    return islands


def _face_varying():
    five, every = fan(5), cube().edges.tolist()
    cut = {
        "one island": (grid(3, 3), []),
        "one closed island": (cube(), []),
        "seam": (grid(3, 3), [(1, 5), (5, 9), (9, 13)]),
        "seam that ends": (grid(4, 4), [(2, 7), (7, 12)]),
        "seam that turns": (grid(4, 4), [(2, 7), (7, 12), (12, 11), (11, 10)]),
        "crossing seams": (grid(4, 4), [(2, 7), (7, 12), (12, 17), (17, 22), (10, 11), (11, 12), (12, 13), (13, 14)]),
        "faces apart": (cube(), every),
        "two halves": (cube(), [(0, 1), (1, 5), (5, 7), (7, 6), (6, 2), (2, 0)]),
        "ring of seams": (lathe(), [*lathe_ring(1), (0, 5), (5, 10)]),
        "polygon apart": (lathe(), lathe_ring(4)),
        **{f"{n} seams at valence 5": (five, [(0, 1 + k) for k in (0, 1, 3)[:n]]) for n in (1, 2, 3)},
        "crease along the seam": (grid(3, 3, creases=[(1, 5, INFINITE), (5, 9, INFINITE)]), [(1, 5), (5, 9), (9, 13)]),
        "crease across the seam": (grid(3, 3, creases=[(4, 5, 2.5), (5, 6, 2.5)]), [(1, 5), (5, 9), (9, 13)]),
        "crease without a seam": (spoked(5, {1: INFINITE, 3: INFINITE}), []),
        "semi-sharp crease without a seam": (cube(creases=[(a, b, 1.5) for a, b in TOP]), []),
        "semi-sharp crease, seam beside it": (spoked(6, {1: 1.5, 4: 1.5, 2: 0.5}), [(0, 2), (0, 5)]),
        "corner in an island": (grid(3, 3, corners=[(5, INFINITE), (10, 1.5)]), [(1, 5), (5, 9), (9, 13)]),
        "border without corners": (grid(3, 3, boundary="edge_only"), [(1, 5), (5, 9)]),
        "triangles": (bipyramid(5), [(0, 1), (1, 6), (0, 3)]),
        "Loop, one island": (grid(3, 3, triangles=True, scheme="loop"), []),
        "Loop, seam that ends": (grid(3, 3, triangles=True, scheme="loop"), [(1, 5), (5, 10)]),
        "Loop, crossing seams": (bipyramid(6, scheme="loop"), [(0, 1), (0, 4), (0, 2), (1, 2)]),
        "Loop, creased": (bipyramid(5, scheme="loop", creases=[(1, 2, 2.5), (2, 3, INFINITE)]), [(0, 1), (1, 6)]),
    }
    return {f"{name}, {mode}": with_islands(cage, seams, mode) for name, (cage, seams) in cut.items() for mode in MODES}


SURFACES = {**_catmull_clark(), **_chaikin(), **_loop(), **_non_manifold()}
ISLANDS = {**_face_varying(), **_non_manifold_islands()}


def lattice(cage, steps):
    """Elements, parameters and corners of all (i, j) / steps on every element; a polygon's from each corner."""
    size = 3 if cage.scheme == "loop" else 4
    t = cage.topology
    starts = np.flatnonzero((cage.face_sizes[t.face] != size) | np.isin(np.arange(t.half_edge_count), t.face_offsets))
    j, i = np.divmod(np.arange((steps + 1) ** 2), steps + 1)
    kept = (i + j <= steps) | (size == 4)
    uv = np.stack([i[kept], j[kept]], axis=1) / steps
    element = t.face[starts]
    corner = starts - t.face_offsets[element]
    return np.repeat(element, len(uv)), np.tile(uv, (len(starts), 1)), np.repeat(corner, len(uv))


def scattered(cage, count, closest):
    """Elements, parameters and corners of random samples, as many at each of the distances 1, 1/2, .. 2^-closest."""
    rng = np.random.default_rng(3)
    element = rng.integers(0, cage.face_count, count)
    corner = rng.integers(0, cage.face_sizes[element])
    uv = rng.uniform(0.25, 1, (count, 2)) * 2.0 ** -rng.integers(0, closest + 1, (count, 1))
    if cage.scheme == "loop":
        uv = np.where(uv.sum(axis=1, keepdims=True) > 1, uv / 2, uv)
    return element, uv, corner
