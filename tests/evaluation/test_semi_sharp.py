"""Semi-sharp creases and corners, the smooth triangle rule, holes, and the boundary rule `none`."""

from dataclasses import replace

import numpy as np
import pytest
from evaluation.common import both_sides, evaluate_from
from evaluation.random_cages import octahedron
from mitsuba_subdivision import ControlCage, LimitSurface, SchemeError
from mitsuba_subdivision.cage.named_cages import cube, extraordinary
from mitsuba_subdivision.evaluation.element import element_stencils
from mitsuba_subdivision.mesh.connectivity import Topology
from mitsuba_subdivision.schemes import CatmullClark
from patches.closed_cages import extraordinary_face, extraordinary_triangles, prism
from reference.exact_samples import angle, faces_of
from reference.refined_cages import differences_to_refined, sheet, spokes, tagged, upper_half, with_bumps
from reference.refinement import SharpMesh

# Of cages of size about 2, in float64.
POSITION = 1e-14
NORMAL = 1e-9
LADDER = (0.3, 0.5, 1, 1.7, 2.5, 4)


TOP = ((4, 5), (5, 7), (7, 6), (6, 4))
BALLS = {"catmull_clark": cube(), "loop": ControlCage(*octahedron())}


def ring(*sharpness, **options):
    """A cube with creases around its top, of one sharpness or of one each."""
    edges = zip(TOP, sharpness * 4 if len(sharpness) == 1 else sharpness, strict=True)
    return tagged(cube(), creases=[(a, b, s) for (a, b), s in edges], **options)


def sharp_ball(scheme, sharpness, spread, method, **options):
    """Creases along all edges, of sharpness from ``sharpness`` down to nearly ``spread`` less."""
    cage = BALLS[scheme]
    t = cage.topology
    ends = [(t.face_vertices[h], t.face_vertices[t.next[h]]) for h in t.edge_half_edge]
    fall = spread * np.arange(len(ends)) / len(ends)
    creases = [(int(a), int(b), sharpness - less) for (a, b), less in zip(ends, fall, strict=True)]
    return tagged(cage, creases=creases, crease_method=method, **options)


CAGES = {
    **{f"cube, ring of {s}": ("catmull_clark", ring(s)) for s in LADDER},
    "cube, one sharpness after the other": ("catmull_clark", ring(0.4, 1.3, 2.2, 3.1)),
    "sharp vertices": ("catmull_clark", tagged(cube(), corners=[(0, 0.7), (1, 1.0), (3, 2.4)])),
    "sharp vertex on a crease": ("catmull_clark", ring(10, corners=[(4, 1.6)])),
    "sharp vertex on a border": ("catmull_clark", sheet(3, 3, corners=[(1, 1.4), (5, 0.6)])),
    "along a border and from it": ("catmull_clark", sheet(3, 3, creases=[(1, 2, 0.7), (2, 3, 2.5), (2, 6, 1.5)])),
    "crease into a border": ("catmull_clark", sheet(3, 3, creases=[(1, 5, 1.5), (5, 9, 0.5)])),
    "pentagon": ("catmull_clark", tagged(upper_half(extraordinary_face(5)), creases=[(0, 1, 1.5), (1, 2, 0.7)])),
    "smooth triangles": ("catmull_clark", tagged(prism(), triangle_rule="smooth")),
    "triangle sheet": ("loop", sheet(3, 3, triangles=True, creases=[(5, 6, 1.5), (6, 10, 0.7)], corners=[(9, 1.2)])),
}
for kind, sharpness in {
    "dart": (1.5,),
    "crease": (1.5, 0, 2.5),
    "corner": (0.5, 1.5, 2.5),
    "into a crease": (10, 1.5, 10),
    "beyond a crease": (10, 0, 10, 1.5),
    "briefly beyond a crease": (10, 0, 10, 0.7),
    "both sides of a crease": (10, 0.8, 10, 2.5),
    "into a dart": (10, 1.5),
    "corner that becomes a dart": (10, 1.5, 0.5),
    "into a corner": (10, 10, 10, 1.5),
    "into a corner from several sides": (10, 1.5, 10, 10, 2.5),
}.items():
    CAGES[kind] = ("catmull_clark", spokes(extraordinary(5, closed=False), 5, sharpness))
    CAGES[f"loop {kind}"] = ("loop", spokes(upper_half(extraordinary_triangles(5)), 5, sharpness))
for name, (scheme, cage) in list(CAGES.items()):
    creases, corners = cage.tags.creases(cage.topology), cage.tags.corners()
    if len(creases) > 1 and "ring of" not in name:
        CAGES[f"chaikin {name}"] = scheme, tagged(cage, creases=creases, corners=corners, crease_method="chaikin")

EVERY_CAGE = pytest.mark.parametrize(("scheme", "cage"), CAGES.values(), ids=CAGES.keys())


def slow_mesh(scheme, cage):
    t, creases = cage.topology, cage.tags.creases(cage.topology)
    ends_of_border = np.flatnonzero(t.is_border_vertex & (t.vertex_face_count == 1)).tolist()
    return SharpMesh(
        scheme,
        cage.positions,
        [tuple(face) for face in faces_of(cage)],
        {frozenset((int(a), int(b))): float(s) for a, b, s in creases},
        {**dict.fromkeys(ends_of_border, 10.0), **{int(v): float(s) for v, s in cage.tags.corners()}},
        cage.crease_method,
        cage.triangle_rule == "smooth",
    )


@pytest.mark.core
@EVERY_CAGE
def test_one_refinement_has_the_same_surface(scheme, cage, np_rng):
    points, normals = differences_to_refined(LimitSurface(with_bumps(cage), scheme), np_rng, levels=12)
    assert points <= POSITION * 4
    assert normals <= NORMAL


@pytest.mark.core
@EVERY_CAGE
def test_neighbours_agree_along_edges(scheme, cage, np_rng):
    surface = LimitSurface(with_bumps(cage), scheme)
    t = cage.topology
    whole = (cage.face_sizes == surface.scheme.domain.corner_count)[t.face]
    half_edge = np_rng.choice(np.flatnonzero((t.twin >= 0) & whole & whole[t.twin]), 60)
    one, other = both_sides(surface, half_edge, np_rng.random(60))
    assert np.abs(one.p - other.p).max() <= POSITION * 4
    smooth = cage.tags.edges[half_edge] < 10
    assert angle(one.n[smooth], other.n[smooth]).max() <= NORMAL


def test_sharpness_10_is_infinite_and_9_nearly():
    infinite, nearly, smooth = (LimitSurface(with_bumps(ring(s))).tessellate(4).positions for s in (10, 9, 0))
    assert np.abs(smooth.max(axis=0) - infinite.max(axis=0)).max() > 0.05
    # The crease of 9 follows the other to half a thousandth of an edge.
    distance = np.linalg.norm(infinite[:, None] - nearly[None], axis=2).min(axis=1)
    assert 0 < distance.max() < 2e-3


@pytest.mark.parametrize("scheme", BALLS)
def test_a_vertex_of_sharpness_10_stays_and_one_of_9_nearly(scheme):
    for sharpness, stays in ((10, True), (9, False)):
        surface = LimitSurface(tagged(BALLS[scheme], corners=[(0, sharpness)]), scheme)
        at_vertex = evaluate_from(surface, surface.cage.topology.vertex_half_edge[:1], [[0.0, 0.0]])
        moved = np.abs(at_vertex.p[0] - surface.cage.positions[0]).max()
        # A cusp draws near its tip more slowly than by halves.
        assert (moved <= POSITION) if stays else (1e-5 < moved < 2e-2)


def test_rules_that_change_nothing_keep_the_scheme():
    unchanged = LimitSurface(tagged(cube(), triangle_rule="smooth", crease_method="chaikin"))
    assert unchanged.scheme is LimitSurface(cube()).scheme


class Plain(CatmullClark):
    name, crease_method = "plain", None


@pytest.mark.parametrize(
    ("scheme", "sharpness", "message"),
    [
        ("doo_sabin", 10, "the scheme doo_sabin has no rules for creases and corners"),
        ("doo_sabin", 2.5, "the scheme doo_sabin has no rules for creases and corners"),
        (Plain(), 2.5, "the scheme plain has no rules for semi-sharp creases and corners"),
    ],
)
def test_a_scheme_without_rules_for_sharpness_refuses_it(scheme, sharpness, message):
    with pytest.raises(SchemeError, match=message):
        LimitSurface(tagged(cube(), creases=[(0, 1, sharpness)]), scheme)


def assert_part(part, whole, faces):
    """That a tessellation is that of some faces of another."""
    assert set(part.element) == faces
    kept = whole.triangles[np.isin(whole.element, list(faces))]
    # Another patch may be the one that evaluates what they share with others.
    assert np.abs(part.positions[part.triangles] - whole.positions[kept]).max() <= POSITION
    assert np.abs(part.normals[part.triangles] - whole.normals[kept]).max() <= POSITION
    # No vertex is left that no triangle uses.
    assert len(np.unique(part.triangles)) == len(part.positions)


@pytest.mark.core
def test_holes_shape_the_surface_but_are_not_part_of_it():
    cage = with_bumps(sheet(3, 3))
    pierced = LimitSurface(tagged(cage, holes=[4, 0])).tessellate(3)
    assert_part(pierced, LimitSurface(cage).tessellate(3), set(range(9)) - {0, 4})


def test_holes_are_no_elements():
    surface = LimitSurface(sheet(3, 3, holes=[4]))
    surface.evaluate(3, [[0.5, 0.5]])
    with pytest.raises(ValueError, match="element of sample 0 is 4; expected one that has a surface: no hole"):
        surface.evaluate(4, [[0.5, 0.5]])


def test_boundary_none_leaves_the_faces_that_do_not_touch_it():
    cage = with_bumps(sheet(4, 4))
    inner = LimitSurface(tagged(cage, boundary="none")).tessellate(2)
    assert_part(inner, LimitSurface(cage).tessellate(2), {5, 6, 9, 10})
    with pytest.raises(SchemeError, match='boundary "none" leaves no face'):
        LimitSurface(sheet(2, 2, boundary="none"))


def around(mesh, vertex):
    """What one refinement beside a vertex depends on, two rings of faces, and the vertex's number in it."""
    near = {vertex}
    for _ in range(2):
        faces = [face for face in mesh.faces if near & {*face}]
        near = {v for face in faces for v in face}
    number = {v: k for k, v in enumerate(sorted(near))}
    kept = SharpMesh(
        mesh.scheme,
        mesh.points[sorted(near)],
        [tuple(number[v] for v in face) for face in faces],
        {frozenset(number[v] for v in edge): s for edge, s in mesh.edges.items() if edge <= near},
        {number[v]: s for v, s in mesh.vertices.items() if v in near},
        mesh.method,
    )
    return kept, number[vertex]


# Refinements, after which a vertex is nearer to its limit than this: ten with a crease, then each divides the distance,
# a thousandth of an edge at first, by about four.
LASTING, CLOSE = 22, 1e-9


@pytest.mark.parametrize("method", ["uniform", "chaikin"])
@pytest.mark.parametrize("scheme", BALLS)
def test_lasting_features_have_the_limits_of_brute_force(scheme, method, np_rng):
    cage = with_bumps(sharp_ball(scheme, 9.9, 0.9, method, corners=[(0, 9.6), (2, 4.3)]))
    surface, slow = LimitSurface(cage, scheme), slow_mesh(scheme, cage)
    sizes = cage.topology.face_sizes
    element = np_rng.integers(0, cage.face_count)
    descents = [[int(np_rng.integers(0, sizes[0])) for _ in range(3)] for _ in range(4)]
    # The face at corner 0 of the one at corner 0 keeps a vertex of the cage.
    for corners in [[0, 0, 0], *descents]:
        face, mesh, uv = int(element), slow, np.zeros((1, 2))
        for corner in corners:
            face, mesh = face * int(sizes[0]) + corner, mesh.refined()
        for corner in corners[::-1]:
            uv = surface.scheme.domain.rotation(corner)(uv / 2)
        vertex = mesh.faces[face][0]
        for _ in range(LASTING):
            mesh, vertex = around(mesh, vertex)
            mesh = mesh.refined()
        assert np.abs(surface.evaluate(element, uv).p[0] - mesh.points[vertex]).max() <= CLOSE


class RolledFaces(CatmullClark):
    """Begins with the last refined face."""

    def refine(self, topology):
        refinement = super().refine(topology)
        t = refinement.topology
        semi = t.semi_sharpness
        if semi is not None:
            semi = replace(semi, edges=np.roll(semi.edges, 4), edges_refined=np.roll(semi.edges_refined, 4))
        quads = np.roll(t.face_vertices, 4)
        return refinement._replace(topology=Topology(t.vertex_count, t.face_sizes, quads, None, t.vertex_rules, semi))

    def children(self, topology, refined, half_edge):
        parts = super().children(topology, refined, half_edge)
        return [(domain, (part + 4) % refined.half_edge_count) for domain, part in parts]


def test_the_order_in_which_a_scheme_numbers_faces_does_not_matter(np_rng):
    cage = with_bumps(sharp_ball("catmull_clark", 4.9, 0.9, "chaikin"))
    scheme = RolledFaces()
    scheme.crease_method = "chaikin"
    signature = LimitSurface(cage).patches.classes[0].signature
    uv = np_rng.random((20, 2))
    expected, rolled = (element_stencils(s, signature, uv) for s in (LimitSurface(cage).scheme, scheme))
    assert np.abs(rolled - expected).max() <= POSITION


class LastingCreases(CatmullClark):
    """Leaves what is semi-sharp as sharp as it was."""

    def refine(self, topology):
        refinement = super().refine(topology)
        t = refinement.topology
        if t.semi_sharpness is None:
            return refinement
        sharpness = {name: getattr(t.semi_sharpness, name) for name in ("edges", "edges_refined")}
        semi = replace(t.semi_sharpness, **{name: np.where(s > 0, 2.5, 0) for name, s in sharpness.items()})
        return refinement._replace(topology=t.with_rules(t.vertex_rules, semi))


@pytest.mark.parametrize("use", [lambda s: s.evaluate(np.arange(6), np.zeros((6, 2))), lambda s: s.tessellate(2)])
def test_a_scheme_that_keeps_creases_semi_sharp_is_refused(use):
    surface = LimitSurface(tagged(cube(), creases=[(0, 1, 2.5)]), LastingCreases())
    with pytest.raises(SchemeError, match="18 refinements leave something of a face semi-sharp"):
        use(surface)
