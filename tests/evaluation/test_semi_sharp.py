from dataclasses import replace

import numpy as np
import pytest
from mitsuba_subdivision import LimitSurface, SchemeError
from mitsuba_subdivision.cage.named_cages import cube
from mitsuba_subdivision.evaluation.element import element_stencils
from mitsuba_subdivision.mesh.connectivity import Topology
from mitsuba_subdivision.schemes import CatmullClark
from patches.closed_cages import bumpy
from reference.refined_cages import sheet, tagged

# Rounding of points of cages of size about 2, in float64.
POSITION = 1e-14


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
    assert len(np.unique(part.triangles)) == len(part.positions)


@pytest.mark.core
def test_holes_shape_the_surface_but_are_not_part_of_it():
    cage = bumpy(sheet(3, 3))
    pierced = LimitSurface(tagged(cage, holes=[4, 0])).tessellate(3)
    assert_part(pierced, LimitSurface(cage).tessellate(3), set(range(9)) - {0, 4})


def test_boundary_none_keeps_only_faces_away_from_the_boundary():
    cage = bumpy(sheet(4, 4))
    inner = LimitSurface(tagged(cage, boundary="none")).tessellate(2)
    assert_part(inner, LimitSurface(cage).tessellate(2), {5, 6, 9, 10})
    with pytest.raises(SchemeError, match='boundary "none" leaves no face'):
        LimitSurface(sheet(2, 2, boundary="none"))


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


def test_results_do_not_depend_on_a_schemes_numbering_of_faces(np_rng):
    creases = np.column_stack([cube().edges, np.linspace(4, 4.9, 12)])
    cage = bumpy(tagged(cube(), creases=creases, crease_method="chaikin"))
    scheme = RolledFaces()
    scheme.crease_method = "chaikin"
    signature, uv = LimitSurface(cage).patches.classes[0].signature, np_rng.random((20, 2))
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
def test_schemes_with_permanent_semi_sharp_creases_are_refused(use):
    surface = LimitSurface(tagged(cube(), creases=[(0, 1, 2.5)]), LastingCreases())
    with pytest.raises(SchemeError, match="18 refinements leave something of a face semi-sharp"):
        use(surface)
