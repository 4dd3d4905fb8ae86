"""Schemes of users: a worked example, and what is refused."""

from __future__ import annotations

import numpy as np
import pytest
from mitsuba_subdivision import LimitSurface, SchemeError, register_scheme
from mitsuba_subdivision.cage.named_cages import extraordinary, extraordinary_triangles
from mitsuba_subdivision.schemes import CatmullClark, DooSabin, Loop, Refinement, StencilTable, scheme_named
from mitsuba_subdivision.schemes.domain import SQUARE
from mitsuba_subdivision.schemes.scheme import tensor_basis

# Rounding over some levels of refinement of the unit ball.
POINT = 1e-12


class Warren(Loop):
    """Loop's scheme with Warren's simpler weights: the example of the guide."""

    name = "warren"

    def vertex_weight(self, valence):
        return np.where(valence == 3, 3 / 16, 3 / (8 * valence))


class Bilinear:
    """The simplest scheme that states every rule itself: quads split at midpoints, whose limit is the cage itself."""

    name = "bilinear"
    element = "face"
    domain = SQUARE
    regular_face_size = 4
    regular_valence = 4
    regular_lattice = np.array([(0, 0), (1, 0), (0, 1), (1, 1)], dtype=float)
    first_edge = np.array([(0, 0), (1, 0)], dtype=float)
    edge_turn = np.array([(0, -1), (1, 0)], dtype=float)

    def unsupported(self, topology):
        return CatmullClark().unsupported(topology)

    def refine(self, topology):
        t = topology
        smooth = CatmullClark().refine(t)
        edges, faces = t.vertex_count + t.edge, t.vertex_count + t.edge_count + t.face
        first = t.edge_half_edge
        vertices = np.arange(t.vertex_count)
        stencils = StencilTable.of(
            smooth.topology.vertex_count,
            t.vertex_count,
            (vertices, vertices, 1.0),
            (edges[first], t.face_vertices[first], 0.5),
            (edges[first], t.face_vertices[t.next[first]], 0.5),
            (faces, t.face_vertices, 1 / t.face_sizes[t.face]),
        )
        return Refinement(smooth.topology, stencils)

    def children(self, topology, refined, half_edge):
        return CatmullClark().children(topology, refined, half_edge)

    def regular_basis(self, uv, derivatives):
        one = np.ones_like(uv[:, 0])
        rows = [np.array([np.stack(row, 1) for row in ((1 - t, t), (-one, one), (0 * one, 0 * one))]) for t in uv.T]
        return tensor_basis(*(row[: derivatives + 1] for row in rows), derivatives)


@pytest.fixture
def known(monkeypatch):
    """Forget registered schemes after the test."""
    from mitsuba_subdivision.schemes import scheme_table

    monkeypatch.setattr(scheme_table, "_SCHEMES", dict(scheme_table._SCHEMES))


def refined_limit(scheme, cage, levels):
    """The cage's vertices after some refinements of the whole mesh: they approach their limits."""
    topology, points = cage.topology, cage.positions
    for _ in range(levels):
        refinement = scheme.refine(topology)
        topology, points = refinement.topology, refinement.apply(points)
    return points[: cage.vertex_count]


@pytest.mark.usefixtures("known")
def test_a_users_scheme_is_known_by_its_name_and_exact():
    register_scheme(Warren())
    cage = extraordinary_triangles(5, rows=2)
    surface = LimitSurface(cage, "warren")
    limit = surface.tessellate(1).positions
    coarse, fine = (np.abs(refined_limit(Warren(), cage, level) - limit).max() for level in (3, 5))
    # Vertices approach the limit by a factor of about 4 a level.
    assert fine < coarse / 10 < 1e-3
    # One refinement of the whole mesh has the same surface.
    refinement = scheme_named("warren").refine(cage.topology)
    refined = type(cage).from_arrays(
        refinement.apply(cage.positions), refinement.topology.face_sizes, refinement.topology.face_vertices
    )
    assert np.abs(LimitSurface(refined, "warren").tessellate(1).positions[: cage.vertex_count] - limit).max() < POINT
    assert np.abs(limit - LimitSurface(cage, "loop").tessellate(1).positions).max() > 1e-3


@pytest.mark.usefixtures("known")
def test_a_users_scheme_works_in_a_scene(variant_scalar_rgb):  # noqa: ARG001
    import mitsuba as mi

    register_scheme(Warren())
    properties = extraordinary_triangles(5).as_properties(mi)
    shape = mi.load_dict({"type": "subdivision", "scheme": "warren", "tessellation_rate": 2, **properties})
    assert 'scheme = "warren"' in str(shape)


def test_a_scheme_can_be_used_without_registering():
    cage = extraordinary_triangles(5)
    assert np.isfinite(LimitSurface(cage, Warren()).evaluate(0, [[0.0, 0.0], [0.2, 0.3]]).n).all()


def test_a_scheme_may_state_every_rule_itself(known):  # noqa: ARG001
    register_scheme(Bilinear())
    cage = extraordinary(4)
    found = LimitSurface(cage, "bilinear").evaluate(0, [[0.25, 0.5]])
    a, b, c, d = cage.positions[cage.face_vertices[:4]]
    assert np.abs(found.p[0] - (0.375 * a + 0.125 * b + 0.125 * c + 0.375 * d)).max() < POINT


class TooWide(Warren):
    name = "too_wide"

    def vertex_weight(self, valence):
        return 1.9 / valence


class Leaking(CatmullClark):
    name = "leaking"

    def refine(self, topology):
        refinement = super().refine(topology)
        return refinement._replace(stencils=StencilTable.from_matrix(1.001 * refinement.stencils.matrix))


class Turned(CatmullClark):
    """Rows and columns of the matrix are exchanged."""

    name = "turned"

    def refine(self, topology):
        refinement = super().refine(topology)
        return refinement._replace(stencils=StencilTable.from_matrix(refinement.stencils.matrix.T))


class OtherBasis(DooSabin):
    name = "other_basis"

    def regular_basis(self, uv, derivatives):
        return super().regular_basis(uv**1.01, derivatives)


class Standing(CatmullClark):
    """Refined vertices around an extraordinary one stay where they are."""

    name = "standing"

    def refine(self, topology):
        t = topology
        refinement = super().refine(t)
        if (t.vertex_face_count[~t.is_border_vertex] == 4).all():
            return refinement
        matrix = refinement.stencils.matrix.tolil()
        for h in range(t.half_edge_count):
            matrix[t.vertex_count + t.edge[h]] = 0
            matrix[t.vertex_count + t.edge[h], t.face_vertices[t.edge_half_edge[t.edge[h]]]] = 1
        return refinement._replace(stencils=StencilTable.from_matrix(matrix))


@pytest.mark.parametrize(
    ("scheme", "message"),
    [
        (object(), "object is no scheme: it has no name, element, domain"),
        (Leaking(), "leaking: .* has weights that sum to 1.001; expected 1"),
        (Turned(), r"stencils of (\d+) vertices over (\d+); expected stencils of \2 refined vertices over \1"),
        (OtherBasis(), "other_basis: the regular basis does not fit the rules: child 0 of a regular patch is"),
        (TooWide(), r"too_wide: "),
        (
            Standing(),
            "standing: subdivision matrix of a face .*: the second eigenvalue has modulus 1; expected below 1",
        ),
    ],
)
@pytest.mark.usefixtures("known")
def test_rules_that_make_no_surface_are_refused(scheme, message):
    with pytest.raises(SchemeError, match=message):
        register_scheme(scheme)


@pytest.mark.parametrize("scheme", [CatmullClark(), DooSabin(), Loop()])
def test_the_packages_own_schemes_pass_the_check(scheme, known):  # noqa: ARG001
    register_scheme(scheme)


@pytest.mark.parametrize(
    ("cage", "scheme", "message"),
    [
        (extraordinary(5), "loop", r"extraordinary\(5\): face 0 has 4 corners; the scheme loop expects triangles only"),
    ],
)
def test_faces_without_rules_are_named(cage, scheme, message):
    with pytest.raises(SchemeError, match=message):
        LimitSurface(cage, scheme)
