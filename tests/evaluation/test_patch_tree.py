"""Elements divided completely: parts cover them once, and what lies beyond a level of a tip stays within its bound."""

import numpy as np
import pytest
from evaluation.common import classes
from kernels.surfaces import RING, SURFACES, surface_named
from mitsuba_subdivision import LimitSurface
from mitsuba_subdivision.cage.named_cages import cube
from mitsuba_subdivision.evaluation.element import element_stencils
from mitsuba_subdivision.evaluation.irregular_patch import level_domains, level_rows, rest_rows
from mitsuba_subdivision.evaluation.patch_tree import PartKind, patch_tree, patch_trees
from mitsuba_subdivision.evaluation.refined_rings import refined_children
from mitsuba_subdivision.patches import PatchTable
from mitsuba_subdivision.schemes import CatmullClark, SchemeError
from mitsuba_subdivision.schemes.domain import ParameterMap
from reference.refined_cages import tagged

pytestmark = pytest.mark.core

EVERY_SURFACE = pytest.mark.parametrize("name", SURFACES)
# What the closed form of a bound may lose to rounding, in parts of it.
ROUNDED = 1 + 1e-9


def divided(surface):
    return patch_trees(*classes(surface))


def tips(surface):
    return [tip for element in divided(surface) for tip in element.tips]


def outward(element):
    """Maps of all pieces, regular ones and tips, to the element's parameters."""
    regular = [ParameterMap(*each) for each in zip(*element.regular_domains, strict=True)]
    return regular, [tip.domain.inverse() for tip in element.tips]


def area(domain_map):
    # Not by LAPACK, which rounds: entries are powers of two.
    (a, b), (c, d) = domain_map.matrix
    return abs(a * d - b * c)


@EVERY_SURFACE
def test_nodes_lead_to_pieces_by_copies_of_the_domain_and_pieces_cover_an_element_once(name):
    surface = surface_named(name)
    domain = surface.scheme.domain
    for element in divided(surface):
        pieces = dict(zip((PartKind.REGULAR, PartKind.TIP), outward(element), strict=True))
        # Halves of halves.
        assert sum(area(each) for kind in pieces.values() for each in kind) == 1
        waiting, met, parts = [(0, ParameterMap(np.eye(2), np.zeros(2)))], [], []
        while waiting:
            node, inward = waiting.pop()
            parts.append(node)
            kind, turn, first = element.nodes[node].tolist()
            inward = domain.rotation(turn) @ inward
            if kind in pieces:
                met.append((kind, first))
                corners = pieces[kind][first](domain.corners)
                np.testing.assert_array_equal(inward(corners), domain.corners)
            elif kind == PartKind.ONLY_CHILD:
                waiting.append((first, inward))
            else:
                waiting += [(first + number, copy @ inward) for number, copy in enumerate(domain.children)]
        assert sorted(met) == [(kind, number) for kind, found in pieces.items() for number in range(len(found))]
        # Every part but the element is a child once.
        assert sorted(parts) == list(range(len(element.nodes)))


def below(elements):
    """All elements that some elements are divided into, and these themselves, as often as they are met."""
    found, begin = list(elements), 0
    while begin < len(found):
        begin, end = len(found), begin
        found += [child for element in dict.fromkeys(found[end:]) for child, _ in element.children]
    return found


@EVERY_SURFACE
def test_equal_one_rings_are_one_object(name):
    found = {}
    for element in below(divided(surface_named(name))):
        assert found.setdefault(element.signature, element) is element


@EVERY_SURFACE
def test_children_do_not_depend_on_the_one_rings_refined_beside_them(name):
    scheme, signatures = classes(surface_named(name))
    # Semi-sharp ones beside smooth ones.
    signatures = [*signatures, *{signature.smoothed for signature in signatures}]
    together = refined_children(scheme, signatures)
    for signature, children in zip(signatures, together, strict=True):
        (alone,) = refined_children(scheme, [signature])
        assert [child.signature for child in children] == [child.signature for child in alone]
        for child, same in zip(children, alone, strict=True):
            np.testing.assert_array_equal(child.stencils, same.stencils)
            assert child.domain.is_same(same.domain)


@pytest.fixture
def nothing_divided():
    """Elements of other tests are forgotten, and those of this test after it."""
    patch_tree.cache_clear()
    yield
    patch_tree.cache_clear()


@pytest.mark.usefixtures("nothing_divided")
def test_equal_parts_of_a_crease_are_refined_once(monkeypatch):
    refined = []

    def counted(scheme, topology):
        refined.append(topology)
        return refine(scheme, topology)

    refine = CatmullClark.refine
    monkeypatch.setattr(CatmullClark, "refine", counted)
    elements = divided(LimitSurface(tagged(cube(), creases=[(a, b, 8.7) for a, b in RING])))
    inner = {element for element in below(elements) if element.piece is None}
    # All parts of one depth are refined together; tips are looked for among them one by one.
    assert len(refined) < len(inner) / 2
    # There are 2^9 parts along each crease, of some kinds after each of ten refinements.
    assert 20 * sum(topology.face_count for topology in refined) < 9 * sum(len(each.nodes) for each in elements)


@EVERY_SURFACE
def test_weights_of_control_points_sum_to_one(name):
    for element in divided(surface_named(name)):
        controls = element.coefficients(np.eye(len(element.scheme.regular_lattice)))
        assert len(controls) == element.regular_count == np.count_nonzero(element.nodes[:, 0] == PartKind.REGULAR)
        assert len(element.tips) == np.count_nonzero(element.nodes[:, 0] == PartKind.TIP)
        np.testing.assert_allclose(controls.sum(axis=2), 1, rtol=0, atol=1e-13)
    for tip in tips(surface_named(name)):
        # Of all eigenvectors, the first one only is not zero in the sum of the weights.
        np.testing.assert_allclose(level_rows(tip.patch, 3) @ tip.coordinates.sum(axis=1), 1, rtol=0, atol=1e-11)


@EVERY_SURFACE
def test_levels_and_the_rest_cover_a_tip_and_bounds_of_the_rest_contain_all_later_levels(name, np_rng):
    for tip in tips(surface_named(name)):
        assert sum(area(each) for level in range(4) for each in level_domains(tip.patch, level)) == 1 - 4.0**-4
        coordinates = tip.coordinates @ np_rng.normal(size=(tip.coordinates.shape[1], 3))
        for level in (0, 1, 4):
            reach = (rest_rows(tip.patch) @ np.abs(tip.patch.basis.block_matrix(level) @ coordinates)).max(axis=0)
            for later in range(level, level + 12):
                away = np.abs(level_rows(tip.patch, later) @ coordinates - coordinates[0])
                assert (away <= ROUNDED * reach).all()


class Skewed(CatmullClark):
    """States children in other places than they are."""

    def children(self, topology, refined, half_edge):
        parts = super().children(topology, refined, half_edge)
        return [(ParameterMap(each.matrix, each.offset + 0.25), child) for each, child in parts]


def test_children_that_are_no_copies_of_the_domain_are_an_error():
    patches = PatchTable(cube().topology, Skewed())
    with pytest.raises(SchemeError, match="a child's domain is none of"):
        patch_trees(patches.scheme, [patches.classes[0].signature])


@pytest.mark.usefixtures("nothing_divided")
@pytest.mark.parametrize(
    "use",
    [
        lambda scheme, signature: patch_trees(scheme, [signature]),
        lambda *own: element_stencils(*own, np.array([[0.0, 1e-30]])),
    ],
    ids=["divided", "sampled"],
)
def test_patches_that_no_refinement_isolates_are_an_error(use, monkeypatch):
    monkeypatch.setattr("mitsuba_subdivision.evaluation.patch_tree.irregular_patch", lambda *_: None)
    scheme, (signature, *_) = classes(surface_named("cube"))
    with pytest.raises(SchemeError, match="expected a scheme that isolates extraordinary points"):
        use(scheme, signature)
