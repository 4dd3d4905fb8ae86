"""Eigenbases by symmetry are those of the general method."""

from __future__ import annotations

import numpy as np
import pytest
from mitsuba_subdivision.evaluation.eigenbasis import eigenbasis
from mitsuba_subdivision.evaluation.element import element_stencils
from mitsuba_subdivision.evaluation.irregular_patch import irregular_patch
from mitsuba_subdivision.evaluation.patch_pieces import irregular_structure, isolated_signature
from mitsuba_subdivision.evaluation.ring_symmetry import LEAST_VALENCE, fan_ring, ring_orbits, symmetric_eigenbasis
from mitsuba_subdivision.evaluation.element import stencils_by_signature
from mitsuba_subdivision.mesh.connectivity import VertexRule
from mitsuba_subdivision.mesh.one_ring import one_ring
from mitsuba_subdivision.mesh.signature import NEAR_FACES, Signature, TaggedFan
from mitsuba_subdivision.schemes import CatmullClark, DooSabin, Loop

pytestmark = pytest.mark.core

SCHEMES = [CatmullClark(), Loop(), DooSabin()]
EVERY_SCHEME = pytest.mark.parametrize("scheme", SCHEMES, ids=lambda scheme: scheme.name)
EVERY_VALENCE = pytest.mark.parametrize("valence", [LEAST_VALENCE, LEAST_VALENCE + 1, 75])
# Some roundings of weights below one, times the length of vectors of the dual.
ROUNDED = 1e-12
# Computed eigenvalues of the general method, which splits a defective one by the root of a rounding.
SAME_EIGENVALUE = 1e-7
# Bases of the same eigenspaces, which are ill-conditioned by some hundreds.
SAME_SPACE = 1e-10
# Of valences so high that the general method takes minutes, for which the equations alone are checked.
HIGH_VALENCE = 400


def structure_of(scheme, valence):
    return irregular_structure(scheme, isolated_signature(scheme, valence))


def basis_of(structure):
    return symmetric_eigenbasis(structure.matrix, ring_orbits(structure.signature))


@EVERY_SCHEME
@pytest.mark.parametrize("valence", [LEAST_VALENCE, LEAST_VALENCE + 1, 75, HIGH_VALENCE])
def test_the_basis_satisfies_its_equations(scheme, valence):
    matrix = structure_of(scheme, valence).matrix
    basis = basis_of(structure_of(scheme, valence))
    np.testing.assert_allclose(basis.inverse @ basis.vectors, np.eye(len(matrix)), rtol=0, atol=ROUNDED)
    np.testing.assert_allclose(basis.vectors @ basis.block_matrix() @ basis.inverse, matrix, rtol=0, atol=ROUNDED)
    assert (basis.vectors[:, 0] == 1).all()
    assert (np.diff(basis.moduli) <= SAME_EIGENVALUE).all()


@EVERY_SCHEME
@EVERY_VALENCE
def test_bases_are_those_of_the_general_method(scheme, valence):
    structure = structure_of(scheme, valence)
    found, expected = basis_of(structure), eigenbasis(structure.matrix)
    np.testing.assert_allclose(found.eigenvalues, expected.eigenvalues, rtol=0, atol=SAME_EIGENVALUE)
    # The point, and the plane of the tangents: what projects on the first eigenspaces.
    for members in (slice(0, 1), slice(1, 3)):
        projections = [basis.vectors[:, members] @ basis.inverse[members] for basis in (found, expected)]
        np.testing.assert_allclose(*projections, rtol=0, atol=SAME_SPACE)


@EVERY_SCHEME
def test_orbits_are_the_ring_but_for_its_centre(scheme):
    orbits = ring_orbits(isolated_signature(scheme, 40))
    assert orbits.shape == ({"catmull_clark": 2}.get(scheme.name, 1), 40)
    assert len(set(orbits.ravel().tolist())) == orbits.size < len(structure_of(scheme, 40).matrix)


def test_rings_without_symmetry_have_no_orbits():
    quads = (4,) * 40
    rest = ((4,) * 4,) * 3
    assert ring_orbits(isolated_signature(CatmullClark(), LEAST_VALENCE - 1)) is None
    assert ring_orbits(isolated_signature(DooSabin(), LEAST_VALENCE - 1)) is None
    assert ring_orbits(Signature("face", ((*quads, 3), *rest))) is None
    assert ring_orbits(Signature("face", (TaggedFan(quads, ()), *rest))) is None
    assert ring_orbits(Signature("face", (TaggedFan(quads, (), VertexRule.DART, is_closed=True), *rest))) is None


def test_matrices_of_unlike_sectors_are_left_to_the_general_method():
    structure = structure_of(CatmullClark(), 40)
    orbits = ring_orbits(structure.signature)
    matrix = structure.matrix.copy()
    matrix[orbits[0, 3], [0, orbits[0, 3]]] += (0.01, -0.01)
    assert symmetric_eigenbasis(matrix, orbits) is None


@pytest.mark.parametrize("scheme", SCHEMES[:2], ids=lambda scheme: scheme.name)
@pytest.mark.parametrize("rule", VertexRule, ids=lambda rule: rule.name.lower())
@pytest.mark.parametrize("valence", [LEAST_VALENCE, 45])
def test_faces_of_an_open_fan_share_the_basis_of_its_ring(scheme, rule, valence):
    size, rest = scheme.regular_face_size, isolated_signature(scheme, 3).fans[1:]
    for behind in (5, valence // 2):
        fan = TaggedFan((size,) * (valence - behind), (size,) * behind, rule)
        structure = irregular_structure(scheme, Signature("face", (fan, *rest)))
        assert fan_ring(structure.signature) is not None
        found, expected = irregular_patch(scheme, structure).basis, eigenbasis(structure.matrix)
        matrix = found.vectors @ found.block_matrix() @ found.inverse
        np.testing.assert_allclose(matrix, structure.matrix, rtol=0, atol=ROUNDED)
        np.testing.assert_allclose(found.inverse @ found.vectors, np.eye(len(matrix)), rtol=0, atol=ROUNDED)
        sign = np.where(np.arange(len(matrix)) == 2, -1, 1)
        np.testing.assert_array_equal(found.turned_over().vectors, found.vectors * sign)
        np.testing.assert_array_equal(found.turned_over().inverse, found.inverse * sign[:, None])
        np.testing.assert_allclose(found.eigenvalues, expected.eigenvalues, rtol=0, atol=SAME_EIGENVALUE)
        for members in (slice(0, 1), slice(1, 2), slice(2, 3)):
            projections = [basis.vectors[:, members] @ basis.inverse[members] for basis in (found, expected)]
            np.testing.assert_allclose(*projections, rtol=0, atol=SAME_SPACE)


def fan_signature(scheme, rule, ahead=30, behind=9):
    size, rest = scheme.regular_face_size, isolated_signature(scheme, 3).fans[1:]
    return Signature("face", (TaggedFan((size,) * ahead, (size,) * behind, rule), *rest))


HIGH_VALENCES = [
    *((scheme, isolated_signature(scheme, valence)) for scheme in SCHEMES for valence in (39, 40)),
    *((scheme, fan_signature(scheme, rule)) for scheme in SCHEMES[:2] for rule in VertexRule),
    # Of so many faces that they share the fan's refinement and its limit.
    *(
        (scheme, fan_signature(scheme, VertexRule.DART, NEAR_FACES + 6 - behind, behind))
        for scheme in SCHEMES[:2]
        for behind in (1, 40)
    ),
]


@pytest.mark.parametrize(("scheme", "signature"), HIGH_VALENCES)
def test_high_valences_are_alike_refined_and_by_their_bases(scheme, signature, np_rng):
    ring = one_ring(signature)
    points = np_rng.standard_normal((ring.vertex_count, 3))
    fan = signature.fans[0]
    if isinstance(fan, TaggedFan) and fan.rule == VertexRule.DART:
        # The far end of the crease, which both of its sides see.
        first, *_, last = ring.edge_neighbours()
        points[last] = points[first]
    assert irregular_patch(scheme, irregular_structure(scheme, signature)).limit_in_ring is not None
    # The point itself, samples in levels that are refined, and one beyond.
    uv = np.array([[0, 0], [0.9, 0.05], [0.5, 0], [0.2, 0.125], [0, 0.125], [0.03, 0.01]])
    for samples in (uv, uv[:-1], uv[:1]):
        (refined,) = stencils_by_signature(scheme, [signature], samples)
        by_basis = element_stencils(scheme, signature, samples)
        np.testing.assert_allclose(refined[0] @ points, by_basis[0] @ points, rtol=0, atol=ROUNDED)
        normals = [np.cross(*(each[1:] @ points)) for each in (refined, by_basis)]
        np.testing.assert_allclose(*(each / np.linalg.norm(each, axis=1)[:, None] for each in normals), atol=SAME_SPACE)


@pytest.mark.parametrize("scheme", SCHEMES[:2], ids=lambda scheme: scheme.name)
def test_a_corner_amid_faces_has_the_symmetry_of_its_ring(scheme):
    size, rest = scheme.regular_face_size, isolated_signature(scheme, 3).fans[1:]
    fan = TaggedFan((size,) * 40, (), VertexRule.CORNER, is_closed=True)
    structure = irregular_structure(scheme, Signature("face", (fan, *rest)))
    found, expected = basis_of(structure), eigenbasis(structure.matrix)
    matrix = found.vectors @ found.block_matrix() @ found.inverse
    np.testing.assert_allclose(matrix, structure.matrix, rtol=0, atol=ROUNDED)
    np.testing.assert_allclose(found.eigenvalues, expected.eigenvalues, rtol=0, atol=SAME_EIGENVALUE)
