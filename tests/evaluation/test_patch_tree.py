import numpy as np
import pytest
from evaluation.common import ChangedCatmullClark, classes, patch_of
from kernels.surfaces import RING, SURFACES, surface_named
from mitsuba_subdivision import LimitSurface
from mitsuba_subdivision.cage.named_cages import cube
from mitsuba_subdivision.evaluation.divided_tile import part_of_tile
from mitsuba_subdivision.evaluation.element import element_stencils
from mitsuba_subdivision.evaluation.patch_tree import isolated_signature, patch_tree, patch_trees, refined_children
from mitsuba_subdivision.mesh.signature import Fan, Signature
from mitsuba_subdivision.patches.patch_table import PatchTable
from mitsuba_subdivision.schemes import CatmullClark, SchemeError
from mitsuba_subdivision.schemes.domain import ParameterMap
from reference.refined_cages import tagged

pytestmark = pytest.mark.core

SCHEME = CatmullClark()


@pytest.mark.parametrize("valence", [2, 3, *range(5, 13)])
def test_old_and_new_points_of_one_refinement_are_as_many_as_published(valence):
    """And an isolated extraordinary vertex needs no refinement, whichever corner of the element it is."""
    patch, old = patch_of("catmull_clark", valence), 2 * valence + 8
    assert patch.matrix.shape == (old, old)
    assert patch.children.shape == (3, 16, old)
    assert len(np.unique(np.vstack([patch.matrix, *patch.children]), axis=0)) == 2 * valence + 17
    for corner in range(4):
        assert patch_tree(SCHEME, patch.signature.rotated(corner)).piece.patch.signature == patch.signature


def test_tiles_of_equal_division_are_shared():
    (element,) = patch_trees(*classes(surface_named("cube")))
    tile, again = (part_of_tile(element, np.eye(element.control_count))[0] for _ in range(2))
    assert tile is again
    tips = [tip for tip, _ in tile.children]
    assert all(tip.is_self_similar and tip in [child for child, _ in tip.children] for tip in tips)


@pytest.mark.parametrize("name", SURFACES)
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
    elements = patch_trees(*classes(LimitSurface(tagged(cube(), creases=[(a, b, 8.7) for a, b in RING]))))
    # There are 2^9 parts along each crease, of some kinds after each of ten refinements.
    faces, parts = sum(topology.face_count for topology in refined), sum(len(element.nodes) for element in elements)
    assert 20 * faces < 9 * parts
    # Those of one depth are refined together; tips are looked for among them one by one.
    assert len(refined) < 30


class NeverIsolates(CatmullClark):
    regular_valence = 5


def test_scheme_that_isolates_nothing_is_refused():
    with pytest.raises(SchemeError, match="catmull_clark: refinement leaves a face with fans"):
        element_stencils(NeverIsolates(), Signature("face", (Fan((5,) * 3),) * 5), np.zeros((1, 2)))


def test_weights_must_sum_to_one():
    halved = ChangedCatmullClark("halved", lambda matrix, _: 0.5 * matrix)
    with pytest.raises(SchemeError, match=r"halved: a refined vertex near a face .* sum to 0\.5; expected 1"):
        refined_children(halved, [isolated_signature(SCHEME, 5)])


class Skewed(CatmullClark):
    def children(self, topology, refined, half_edge):
        parts = super().children(topology, refined, half_edge)
        return [(ParameterMap(domain.matrix, domain.offset + 0.25), child) for domain, child in parts]


def test_children_must_be_copies_of_the_domain():
    patches = PatchTable(cube().topology, Skewed())
    with pytest.raises(SchemeError, match="a child's domain is none of"):
        patch_trees(patches.scheme, [patches.classes[0].signature])


@pytest.mark.usefixtures("nothing_divided")
@pytest.mark.parametrize(
    "use",
    [
        lambda scheme, signature: patch_trees(scheme, [signature]),
        lambda scheme, signature: element_stencils(scheme, signature, np.array([[0.0, 1e-30]])),
    ],
    ids=["divided", "sampled"],
)
def test_patches_that_stay_irregular_are_an_error(use, monkeypatch):
    monkeypatch.setattr("mitsuba_subdivision.evaluation.patch_tree.irregular_patch", lambda *_: None)
    scheme, (signature, *_) = classes(surface_named("cube"))
    with pytest.raises(SchemeError, match="expected a scheme that isolates extraordinary points"):
        use(scheme, signature)
