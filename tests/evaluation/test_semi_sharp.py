"""Semi-sharp creases and corners, the smooth triangle rule, holes, and the boundary rule `none`."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from evaluation.random_cages import octahedron
from mitsuba_subdivision import ControlCage, LimitSurface, SchemeError
from mitsuba_subdivision.cage.named_cages import cube, extraordinary, extraordinary_face, extraordinary_triangles
from mitsuba_subdivision.evaluation.element import element_stencils
from mitsuba_subdivision.mesh.connectivity import Topology
from mitsuba_subdivision.mesh.signature import signature_at
from mitsuba_subdivision.schemes import CatmullClark
from reference.exact_samples import angle, faces_of
from reference.refined_cages import differences_to_refined, refined, sheet, spokes, tagged, upper_half, with_bumps
from reference.sharp_refinement import SharpMesh

# Of cages of size about 2, in float64.
POSITION = 1e-14
NORMAL = 1e-9
LADDER = (0.3, 0.5, 1, 1.7, 2.5, 4)


TOP = ((4, 5), (5, 7), (7, 6), (6, 4))
BALLS = {"catmull_clark": cube(), "loop": ControlCage(*octahedron())}
# Segments per edge of a tessellation.
RATE = 8


def sharp_ball(scheme, sharpness, spread, method, **options):
    """Creases along all edges, of sharpness from ``sharpness`` down to nearly ``spread`` less."""
    cage = BALLS[scheme]
    t = cage.topology
    ends = [(t.face_vertices[h], t.face_vertices[t.next[h]]) for h in t.edge_half_edge]
    fall = spread * np.arange(len(ends)) / len(ends)
    creases = [(int(a), int(b), sharpness - less) for (a, b), less in zip(ends, fall, strict=True)]
    return tagged(cage, creases=creases, crease_method=method, **options)


CAGES = {
    **{f"cube, ring of {s}": ("catmull_clark", tagged(cube(), creases=[(a, b, s) for a, b in TOP])) for s in LADDER},
    "cube, one sharpness after the other": (
        "catmull_clark",
        tagged(cube(), creases=[(a, b, s) for (a, b), s in zip(TOP, (0.4, 1.3, 2.2, 3.1), strict=True)]),
    ),
    "sharp vertices": ("catmull_clark", tagged(cube(), corners=[(0, 0.7), (1, 1.0), (3, 2.4)])),
    "sharp vertex on a crease": (
        "catmull_clark",
        tagged(cube(), creases=[(a, b, 10) for a, b in TOP], corners=[(4, 1.6)]),
    ),
    "sharp vertex on a border": ("catmull_clark", sheet(3, 3, corners=[(1, 1.4), (5, 0.6)])),
    "along a border and from it": ("catmull_clark", sheet(3, 3, creases=[(1, 2, 0.7), (2, 3, 2.5), (2, 6, 1.5)])),
    "crease into a border": ("catmull_clark", sheet(3, 3, creases=[(1, 5, 1.5), (5, 9, 0.5)])),
    "pentagon": ("catmull_clark", tagged(upper_half(extraordinary_face(5)), creases=[(0, 1, 1.5), (1, 2, 0.7)])),
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
    if len(cage.tags.creases(cage.topology)) > 1 and "ring of" not in name:
        creases = cage.tags.creases(cage.topology)
        CAGES[f"chaikin {name}"] = (
            scheme,
            tagged(cage, creases=creases, corners=cage.tags.corners(), crease_method="chaikin"),
        )

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
    along = np_rng.random(60)
    sides = []
    for side, u in ((half_edge, along), (t.twin[half_edge], 1 - along)):
        face = t.face[side]
        sides.append(surface.evaluate(face, np.stack([u, np.zeros(60)], axis=1), side - t.face_offsets[face]))
    assert np.abs(sides[0].p - sides[1].p).max() <= POSITION * 4
    smooth = cage.tags.edges[half_edge] < 10
    assert angle(sides[0].n[smooth], sides[1].n[smooth]).max() <= NORMAL


@EVERY_CAGE
def test_patches_of_a_class_have_one_signature_and_others_another(scheme, cage):
    table = LimitSurface(cage, scheme).patches
    kind, corners = table.scheme.element, table.scheme.domain.corner_count
    seen = set()
    for group in table.classes:
        found = {
            signature_at(table.topology, half_edge, kind) for half_edge in table.half_edge_of_corner[group.corners]
        }
        assert found == {group.signature}
        turned = {group.signature.rotated(k) for k in range(corners if len(group.signature.fans) == corners else 1)}
        assert not turned & seen
        seen |= turned


def test_sharpness_10_is_infinite_and_9_nearly():
    cages = [with_bumps(tagged(cube(), creases=[(a, b, s) for a, b in TOP])) for s in (10, 9, 0)]
    infinite, nearly, smooth = (LimitSurface(cage).tessellate(4).positions for cage in cages)
    assert np.abs(smooth.max(axis=0) - infinite.max(axis=0)).max() > 0.05
    # The crease of 9 follows the other to half a thousandth of an edge.
    distance = np.linalg.norm(infinite[:, None] - nearly[None], axis=2).min(axis=1)
    assert 0 < distance.max() < 2e-3


@pytest.mark.parametrize("scheme", BALLS)
def test_a_vertex_of_sharpness_10_stays_and_one_of_9_nearly(scheme):
    for sharpness, stays in ((10, True), (9, False)):
        surface = LimitSurface(tagged(BALLS[scheme], corners=[(0, sharpness)]), scheme)
        half_edge = int(surface.cage.topology.vertex_half_edge[0])
        face = surface.cage.topology.face[half_edge]
        corner = half_edge - int(surface.cage.topology.face_offsets[face])
        moved = np.abs(surface.evaluate(face, [[0.0, 0.0]], corner).p[0] - surface.cage.positions[0]).max()
        # A cusp draws near its tip more slowly than by halves.
        assert (moved <= POSITION) if stays else (1e-5 < moved < 2e-2)


def test_greater_sharpness_pulls_further():
    heights = [
        LimitSurface(tagged(cube(), creases=[(a, b, s) for a, b in TOP])).tessellate(8).positions[:, 2].mean()
        for s in (0, *LADDER)
    ]
    assert (np.diff(heights) > 0).all()


@pytest.mark.core
def test_smooth_triangles_are_those_of_the_rules_and_differ():
    octahedron = ControlCage(
        [[1, 0, 0], [0, 1, 0], [-1, 0, 0], [0, -1, 0], [0, 0, 1], [0, 0, -1]],
        [[0, 1, 4], [1, 2, 4], [2, 3, 4], [3, 0, 4], [1, 0, 5], [2, 1, 5], [3, 2, 5], [0, 3, 5]],
        triangle_rule="smooth",
    )
    cage = with_bumps(octahedron)
    surface, slow = LimitSurface(cage), slow_mesh("catmull_clark", cage)
    for _ in range(3):
        surface, slow = refined(surface), slow.refined()
        expected = slow.points[np.concatenate(slow.faces)]
        assert np.abs(surface.cage.positions[surface.cage.face_vertices] - expected).max() <= POSITION * 10
    usual = LimitSurface(tagged(cage))
    assert np.abs(LimitSurface(cage).tessellate(2).positions - usual.tessellate(2).positions).max() > 1e-3


def test_rules_that_change_nothing_keep_the_scheme():
    assert (
        LimitSurface(tagged(cube(), triangle_rule="smooth", crease_method="chaikin")).scheme
        is LimitSurface(cube()).scheme
    )


def test_chaikin_mixes_what_uniform_keeps_apart():
    creases = [(4, 5, 0.5), (5, 7, 3.5)]
    uniform, chaikin = (
        LimitSurface(tagged(cube(), creases=creases, crease_method=method)).tessellate(4).positions
        for method in ("uniform", "chaikin")
    )
    assert np.abs(uniform - chaikin).max() > 1e-3


def test_a_scheme_without_rules_for_sharpness_refuses_it():
    with pytest.raises(SchemeError, match="the scheme doo_sabin has no rules for creases and corners"):
        LimitSurface(tagged(cube(), creases=[(0, 1, 2.5)]), "doo_sabin")

    class Plain(CatmullClark):
        name, crease_method = "plain", None

    with pytest.raises(SchemeError, match="the scheme plain has no rules for semi-sharp creases and corners"):
        LimitSurface(tagged(cube(), creases=[(0, 1, 2.5)]), Plain())


@pytest.mark.core
def test_holes_shape_the_surface_but_are_not_part_of_it():
    cage = with_bumps(sheet(3, 3))
    whole = LimitSurface(cage).tessellate(3)
    pierced = LimitSurface(tagged(cage, holes=[4, 0])).tessellate(3)
    assert set(pierced.element) == set(range(9)) - {0, 4}
    kept = ~np.isin(whole.element, [0, 4])
    # Another patch may be the one that evaluates what they share.
    assert np.abs(pierced.positions[pierced.triangles] - whole.positions[whole.triangles[kept]]).max() <= POSITION
    assert np.abs(pierced.normals[pierced.triangles] - whole.normals[whole.triangles[kept]]).max() <= POSITION
    # No vertex is left that no triangle uses.
    assert len(np.unique(pierced.triangles)) == len(pierced.positions)


def test_holes_are_no_elements():
    surface = LimitSurface(sheet(3, 3, holes=[4]))
    surface.evaluate(3, [[0.5, 0.5]])
    with pytest.raises(ValueError, match="element of sample 0 is 4; expected one that has a surface: no hole"):
        surface.evaluate(4, [[0.5, 0.5]])


def test_boundary_none_leaves_the_faces_that_do_not_touch_it():
    cage = with_bumps(sheet(4, 4))
    inner = LimitSurface(tagged(cage, boundary="none")).tessellate(2)
    assert set(inner.element) == {5, 6, 9, 10}
    whole = LimitSurface(cage).tessellate(2)
    kept = np.isin(whole.element, [5, 6, 9, 10])
    assert np.abs(inner.positions[inner.triangles] - whole.positions[whole.triangles[kept]]).max() <= POSITION
    with pytest.raises(SchemeError, match='boundary "none" leaves no face'):
        LimitSurface(sheet(2, 2, boundary="none"))


def test_the_pieces_of_a_long_lasting_crease_still_evaluate(np_rng):
    """Sharpness 9.5 takes ten refinements to go; each leaves the pieces along the crease to the next."""
    surface = LimitSurface(with_bumps(tagged(cube(), creases=[(a, b, 9.5) for a, b in TOP])))
    finer = surface
    uv = np_rng.random((50, 2)) * 2.0**-4
    here = surface.evaluate(1, uv)
    element = 4
    for _ in range(4):
        finer = refined(finer)
        uv = 2 * uv
        there = finer.evaluate(element, uv)
        assert np.abs(here.p - there.p).max() <= POSITION * 4
        element *= 4


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


def slow_limit(mesh, vertex):
    """Where a vertex comes to lie after many refinements of what is around it."""
    for _ in range(LASTING):
        mesh, vertex = around(mesh, vertex)
        mesh = mesh.refined()
    return mesh.points[vertex]


# Refinements, after which a vertex is nearer to its limit than this: ten with a crease, then each divides the distance,
# a thousandth of an edge at first, by about four.
LASTING, CLOSE = 22, 1e-9


@pytest.mark.core
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
        expected = slow_limit(mesh, mesh.faces[face][0])
        assert np.abs(surface.evaluate(element, uv).p[0] - expected).max() <= CLOSE


def grid_of(scheme, rate=RATE):
    uv = np.stack(np.meshgrid(np.arange(rate + 1), np.arange(rate + 1)), axis=-1).reshape(-1, 2) / rate
    return uv[scheme.domain.inside(uv) >= 0]


class RolledFaces(CatmullClark):
    """Begins with the last refined face."""

    def refine(self, topology):
        refinement = super().refine(topology)
        t = refinement.topology
        semi = t.semi_sharpness
        if semi is not None:
            semi = replace(semi, edges=np.roll(semi.edges, 4), edges_refined=np.roll(semi.edges_refined, 4))
        quads = np.roll(t.face_vertices, 4)
        return refinement._replace(topology=Topology(t.vertex_count, t.face_sizes, quads, None, t.rules, semi))

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
        edges, edges_refined = (
            np.where(sharp > 0, 2.5, 0) for sharp in (t.semi_sharpness.edges, t.semi_sharpness.edges_refined)
        )
        semi = replace(t.semi_sharpness, edges=edges, edges_refined=edges_refined)
        return refinement._replace(topology=t.with_rules(t.rules, semi))


def test_a_scheme_that_keeps_creases_semi_sharp_is_refused():
    surface = LimitSurface(tagged(cube(), creases=[(0, 1, 2.5)]), LastingCreases())
    with pytest.raises(SchemeError, match="18 refinements leave something of a face semi-sharp"):
        surface.evaluate(np.arange(6), np.zeros((6, 2)))
    with pytest.raises(SchemeError, match="18 refinements leave something of a face semi-sharp"):
        surface.tessellate(2)
