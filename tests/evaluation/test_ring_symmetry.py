"""Eigenvectors by symmetry are those of the general method."""

from __future__ import annotations

import numpy as np
import pytest
from mitsuba_subdivision.evaluation.eigenbasis import eigenbasis
from mitsuba_subdivision.evaluation.patch_pieces import irregular_structure, isolated_signature
from mitsuba_subdivision.evaluation.ring_symmetry import LEAST_VALENCE, eigen_pairs, ring_orbits
from mitsuba_subdivision.mesh.connectivity import VertexRule
from mitsuba_subdivision.mesh.signature import Signature, TaggedFan
from mitsuba_subdivision.schemes import CatmullClark, DooSabin, Loop

pytestmark = pytest.mark.core

EVERY_RING = pytest.mark.parametrize("scheme", [CatmullClark(), Loop()], ids=lambda scheme: scheme.name)
EVERY_VALENCE = pytest.mark.parametrize("valence", [LEAST_VALENCE, LEAST_VALENCE + 1, 75])
# Some roundings of weights below one.
ROUNDED = 1e-13
# Bases of the same eigenspaces, which are ill-conditioned by some hundreds.
SAME_SPACE = 1e-10


def structure_of(scheme, valence):
    return irregular_structure(scheme, isolated_signature(scheme, valence))


@EVERY_RING
@EVERY_VALENCE
def test_vectors_are_stretched_by_their_values(scheme, valence):
    structure = structure_of(scheme, valence)
    values, vectors = eigen_pairs(structure.matrix, ring_orbits(structure.signature))
    np.testing.assert_allclose(structure.matrix @ vectors, vectors * values, rtol=0, atol=ROUNDED)
    np.testing.assert_allclose(np.linalg.norm(vectors, axis=0), 1, rtol=0, atol=ROUNDED)


@EVERY_RING
@EVERY_VALENCE
def test_bases_are_those_of_the_general_method(scheme, valence):
    structure = structure_of(scheme, valence)
    found = eigenbasis(structure.matrix, ring_orbits(structure.signature))
    expected = eigenbasis(structure.matrix)
    np.testing.assert_allclose(found.eigenvalues, expected.eigenvalues, rtol=0, atol=ROUNDED)
    # The point, and the plane of the tangents: what projects on the first eigenspaces.
    for members in (slice(0, 1), slice(1, 3)):
        projections = [basis.vectors[:, members] @ basis.inverse[members] for basis in (found, expected)]
        np.testing.assert_allclose(*projections, rtol=0, atol=SAME_SPACE)


@pytest.mark.parametrize("scheme", [CatmullClark(), Loop()], ids=lambda scheme: scheme.name)
def test_orbits_are_the_ring_but_for_its_centre(scheme):
    orbits = ring_orbits(isolated_signature(scheme, 40))
    assert orbits.shape == (scheme.regular_face_size - 2, 40)
    ring = len(structure_of(scheme, 40).matrix)
    assert len(set(orbits.ravel().tolist()) | {0}) == orbits.size + 1 <= ring


def test_rings_without_symmetry_have_no_orbits():
    quads = (4,) * 40
    rest = ((4,) * 4,) * 3
    assert ring_orbits(isolated_signature(CatmullClark(), LEAST_VALENCE - 1)) is None
    assert ring_orbits(Signature("face", ((*quads, 3), *rest))) is None
    assert ring_orbits(Signature("face", (TaggedFan(quads, ()), *rest))) is None
    assert ring_orbits(Signature("face", (TaggedFan(quads, (), VertexRule.DART, is_closed=True), *rest))) is None
    assert ring_orbits(isolated_signature(DooSabin(), 40)) is None


def test_matrices_of_unlike_sectors_are_left_to_the_general_method():
    structure = structure_of(CatmullClark(), 40)
    orbits = ring_orbits(structure.signature)
    matrix = structure.matrix.copy()
    matrix[orbits[0, 3], [0, orbits[0, 3]]] += (0.01, -0.01)
    assert eigen_pairs(matrix, orbits) is None
    assert eigenbasis(matrix, orbits).subdominant < 1
