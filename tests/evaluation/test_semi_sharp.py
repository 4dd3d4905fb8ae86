"""Semi-sharp creases and corners, the smooth triangle rule, holes, and the boundary rule `none`."""

from dataclasses import replace

import numpy as np
import pytest
from evaluation.common import evaluate_from
from mitsuba_subdivision import LimitSurface, SchemeError
from mitsuba_subdivision.cage.named_cages import cube
from mitsuba_subdivision.evaluation.element import element_stencils
from mitsuba_subdivision.mesh.connectivity import Topology
from mitsuba_subdivision.schemes import CatmullClark
from patches.closed_cages import bipyramid, bumpy
from peers.fidelity_cages import TOP
from reference.refined_cages import channel_of, sheet, tagged
from reference.refinement import refined

# Of cages of size about 2, in float64.
POSITION = 1e-14
BALLS = {"catmull_clark": cube(), "loop": bipyramid(4)}


def sharp_ball(scheme, sharpness, spread, method, **options):
    """Creases along all edges, of sharpness from ``sharpness`` down to nearly ``spread`` less."""
    cage = BALLS[scheme]
    fall = spread * np.arange(len(cage.edges)) / len(cage.edges)
    creases = np.column_stack([cage.edges, sharpness - fall])
    return tagged(cage, creases=creases, crease_method=method, **options)


def test_sharpness_10_is_infinite_and_9_nearly():
    cages = (bumpy(tagged(cube(), creases=[(*edge, s) for edge in TOP])) for s in (10, 9, 0))
    infinite, nearly, smooth = (LimitSurface(cage).tessellate(4).positions for cage in cages)
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
    cage = bumpy(sheet(3, 3))
    pierced = LimitSurface(tagged(cage, holes=[4, 0])).tessellate(3)
    assert_part(pierced, LimitSurface(cage).tessellate(3), set(range(9)) - {0, 4})


def test_boundary_none_leaves_the_faces_that_do_not_touch_it():
    cage = bumpy(sheet(4, 4))
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
    values = {v: value for (v, _), value in mesh.values.items()}
    kept = replace(
        mesh,
        faces=[tuple(number[v] for v in face) for face in faces],
        indices=[(0,) * len(face) for face in faces],
        values={(k, 0): values[v] for v, k in number.items()},
        creases={frozenset(number[v] for v in edge): s for edge, s in mesh.creases.items() if edge <= near},
        corners={number[v]: s for v, s in mesh.corners.items() if v in near},
    )
    return kept, number[vertex]


# Refinements, after which a vertex is nearer to its limit than this: ten with a crease, then each divides the distance,
# a thousandth of an edge at first, by about four.
LASTING, CLOSE = 22, 1e-9


@pytest.mark.parametrize("method", ["uniform", "chaikin"])
@pytest.mark.parametrize("scheme", BALLS)
def test_lasting_features_have_the_limits_of_brute_force(scheme, method, np_rng):
    cage = bumpy(sharp_ball(scheme, 9.9, 0.9, method, corners=[(0, 9.6), (2, 4.3)]))
    surface, points = LimitSurface(cage, scheme), channel_of(cage, cage.positions, cage.face_vertices)
    size = int(cage.face_sizes[0])
    element = int(np_rng.integers(0, cage.face_count))
    descents = np_rng.integers(0, size, (2, 3)).tolist()
    # The face at corner 0 of the one at corner 0 keeps a vertex of the cage.
    for corners in [[0, 0, 0], *descents]:
        face, mesh, uv = element, points, np.zeros((1, 2))
        for corner in corners:
            face, (mesh, _) = face * size + corner, refined(mesh, scheme)
        for corner in corners[::-1]:
            uv = surface.scheme.domain.rotation(corner)(uv / 2)
        vertex = mesh.faces[face][0]
        for _ in range(LASTING):
            mesh, vertex = around(mesh, vertex)
            mesh, _ = refined(mesh, scheme)
        (limit,) = (value for (v, _), value in mesh.values.items() if v == vertex)
        assert np.abs(surface.evaluate(element, uv).p[0] - limit).max() <= CLOSE


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
    cage = bumpy(sharp_ball("catmull_clark", 4.9, 0.9, "chaikin"))
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
