from collections import Counter
from functools import lru_cache

import numpy as np
import pytest
from evaluation.common import ChangedCatmullClark
from mitsuba_subdivision.evaluation.element import element_stencils
from mitsuba_subdivision.evaluation.patch_tree import irregular_patch, lattice_stencils, patch_tree, rotation_order
from mitsuba_subdivision.evaluation.refined_rings import refined_children
from mitsuba_subdivision.mesh.one_ring import one_ring
from mitsuba_subdivision.mesh.signature import Fan, Signature, signature_at
from mitsuba_subdivision.schemes import CatmullClark, SchemeError
from mitsuba_subdivision.schemes.domain import SQUARE
from patches.closed_cages import CLOSED_CAGES

pytestmark = pytest.mark.core

SCHEME = CatmullClark()
VALENCES = [3, *range(5, 13)]
# Stencils of a piece are products of at most three refinements, of some tens of weights each.
ROUNDING = 1e-14
REGULAR_FAN = Fan((4,) * 4)


def isolated(valence, corner=0):
    """Quad amid quads with one corner of the given valence."""
    return Signature("face", (Fan((4,) * valence), *(REGULAR_FAN,) * 3)).rotated(-corner % 4)


@lru_cache
def pieces(signature, scheme=SCHEME):
    """All pieces of an element."""
    element = patch_tree(scheme, signature)
    if element.piece is not None:
        return [element.piece]
    return [
        piece.inside(domain, stencils)
        for domain, (child, stencils) in zip(element.domains, element.children, strict=True)
        for piece in pieces(child.signature, scheme)
    ]


def all_signatures():
    found = {isolated(n, corner) for n in (2, 3, 4, 5, 8) for corner in range(4)}
    for make in CLOSED_CAGES.values():
        topology = make().topology
        found |= {signature_at(topology, h, "face") for h in range(topology.half_edge_count)}
    return sorted(found, key=lambda signature: signature.fans)


SIGNATURES = all_signatures()


def test_a_piece_has_at_most_one_extraordinary_point_at_its_origin_and_all_of_the_element_have_one():
    """They sit at corners of the element and, for a polygon's sub-quad, at the middle of the polygon."""
    corners = [tuple(corner) for corner in SQUARE.corners.tolist()]
    for signature in SIGNATURES:
        found = Counter()
        for piece in pieces(signature):
            if piece.patch is not None:
                fan, *others = piece.patch.signature.fans
                assert set(fan.ahead) == {4}
                assert fan.face_count != 4
                assert others == [REGULAR_FAN] * 3
                origin = piece.domain.inverse()(np.zeros((1, 2)))[0]
                found[tuple(origin.tolist()), fan.face_count] += 1
        if len(signature.fans) == 4:
            valences = dict(zip(corners, signature.valences, strict=True))
        else:
            valences = {corners[0]: signature.valences[0], corners[2]: len(signature.fans)}
        assert found == Counter({(at, n): 1 for at, n in valences.items() if n != 4})


@pytest.mark.parametrize("corner", range(4))
@pytest.mark.parametrize("valence", [2, *VALENCES])
def test_isolated_extraordinary_vertex_needs_no_refinement(valence, corner):
    (piece,) = pieces(isolated(valence, corner))
    assert piece.patch.signature == isolated(valence)
    np.testing.assert_array_equal(piece.domain(SQUARE.corners[corner]), [0, 0])
    # A permutation, which turns the one-ring.
    order = rotation_order(isolated(valence, corner), corner)
    np.testing.assert_array_equal(np.sort(order), np.arange(len(piece.stencils)))
    np.testing.assert_array_equal(piece.stencils, np.eye(len(order))[order])


@pytest.mark.parametrize("valence", VALENCES)
def test_old_and_new_points_of_one_refinement_are_as_many_as_published(valence):
    patch = irregular_patch(SCHEME, isolated(valence))
    old = 2 * valence + 8
    assert patch.matrix.shape == (old, old)
    assert patch.children.shape == (3, 16, old)
    new = np.unique(np.vstack([patch.matrix, *patch.children]), axis=0)
    assert len(new) == 2 * valence + 17
    if valence == 5:
        assert (old, len(new)) == (18, 27)


@pytest.mark.parametrize("signature", [Signature("face", (REGULAR_FAN,) * 4), isolated(5), isolated(3)])
def test_refining_and_turning_commute(signature):
    """Child k of an element is child 0 of the element turned to its corner k, turned back."""
    (parts,) = refined_children(SCHEME, [signature])
    for k in range(4):
        _, child, stencils = parts[k]
        _, first, turned = refined_children(SCHEME, [signature.rotated(k)])[0][0]
        # The child's own (0, 0) is k corners before the corner that it shares with the element.
        assert child.rotated(k) == first
        expected = np.zeros_like(turned)
        expected[:, rotation_order(signature, k)] = turned
        np.testing.assert_allclose(stencils[rotation_order(child, k)], expected, rtol=0, atol=ROUNDING)


def test_regular_control_points_reproduce_the_lattice():
    """The refined lattice is the lattice at half the size, in the order of each child."""
    regular = Signature("face", (REGULAR_FAN,) * 4)
    assert lattice_stencils(SCHEME, regular) is not None
    order = lattice_stencils(SCHEME, regular).argmax(axis=1)
    assert sorted(order) == list(range(16))
    place = np.empty((16, 2))
    place[order] = SCHEME.regular_lattice
    np.testing.assert_array_equal(place[:4], SQUARE.corners)
    for affine, child, stencils in refined_children(SCHEME, [regular])[0]:
        assert lattice_stencils(SCHEME, child) is not None
        np.testing.assert_allclose(affine(stencils @ place), place, rtol=0, atol=ROUNDING)


@pytest.mark.parametrize(
    "signature",
    [isolated(3), isolated(5), Signature("vertex", (REGULAR_FAN,)), Signature("face", (Fan((3,) * 4),) * 3)],
    ids=["valence 3", "valence 5", "vertex", "triangle"],
)
def test_only_the_regular_one_ring_is_regular(signature):
    assert lattice_stencils(SCHEME, signature) is None


class NeverIsolates(CatmullClark):
    """A scheme whose every vertex and face is extraordinary."""

    regular_valence = 5


def test_scheme_that_isolates_nothing_is_refused():
    with pytest.raises(SchemeError, match="catmull_clark: refinement leaves a face with fans"):
        element_stencils(NeverIsolates(), Signature("face", (Fan((5,) * 3),) * 5), np.zeros((1, 2)))


def test_refined_children_run_the_rules_of_the_scheme():
    # Stencils averaged with those of vertex 0.
    marked_scheme = ChangedCatmullClark("marked", lambda matrix, _: (matrix + matrix[0]) / 2)
    first = SCHEME.refine(one_ring(isolated(5)).topology).stencils.matrix.toarray()[0]
    children = (refined_children(scheme, [isolated(5)])[0] for scheme in (marked_scheme, SCHEME))
    for (_, _, marked), (_, _, stencils) in zip(*children, strict=True):
        np.testing.assert_allclose(marked, (stencils + first) / 2, rtol=0, atol=1e-15)


def test_weights_that_do_not_sum_to_one_are_an_error():
    halved = ChangedCatmullClark("halved", lambda matrix, _: 0.5 * matrix)
    with pytest.raises(SchemeError, match=r"halved: a refined vertex near a face .* sum to 0\.5; expected 1"):
        refined_children(halved, [isolated(5)])
