"""Trees of pieces: their polynomials are the limit stencils everywhere, and neighbours agree where they meet."""

import numpy as np
import pytest
from kernels.surfaces import SURFACES
from mitsuba_subdivision import LimitSurface
from mitsuba_subdivision.cage.named_cages import cube, extraordinary, extraordinary_face, extraordinary_triangles
from mitsuba_subdivision.evaluation.element import element_stencils
from mitsuba_subdivision.evaluation.irregular_patch import FLOAT32_SIZE
from mitsuba_subdivision.evaluation.patch_tree import PartKind, patch_trees
from mitsuba_subdivision.evaluation.polynomials import polynomial_basis
from mitsuba_subdivision.evaluation.tree_arrays import PIECE_LEVELS, FrameKind, tree_arrays
from mitsuba_subdivision.mesh import ragged
from mitsuba_subdivision.patches import PatchTable
from mitsuba_subdivision.schemes import CatmullClark
from patches.closed_cages import SURFACES as CLOSED
from patches.closed_cages import cage_of
from reference.refined_cages import sheet, spokes, tagged, upper_half

pytestmark = pytest.mark.core

INFINITE = 10.0
# From a line between pieces to parameters in them.
BESIDE = 2.0**-30
# Sums of some hundred products of weights; those at valence 50 are sums over eigen-coordinates, some of them large.
ROUNDING = 2e-13

CAGES = {
    **{f"{scheme} {name}": (scheme, cage_of(scheme, name)) for scheme, name in CLOSED},
    **{name: (scheme, make()) for name, (scheme, make) in SURFACES.items()},
    "loop infinite corner": ("loop", spokes(upper_half(extraordinary_triangles(5)), 5, (INFINITE,) * 3)),
    "semi-sharp": ("catmull_clark", spokes(extraordinary(5, closed=False), 5, (INFINITE, 0, INFINITE, 1.5))),
    "loop semi-sharp": ("loop", spokes(upper_half(extraordinary_triangles(5)), 5, (0.5, 1.5, 2.5))),
}
# Their elements are like those of others.
for name in ("holes", "boundary none", "non-manifold", "propeller", "face of 20", "semi-sharp torus"):
    del CAGES[name]
for name in ("cube", "torus", "mixed torus", "hexagon", "valence 2 beside triangle", "torus 3 x 3"):
    del CAGES[f"catmull_clark {name}"]
EVERY_CAGE = pytest.mark.parametrize(("scheme", "cage"), CAGES.values(), ids=CAGES.keys())


def trees(scheme, cage, piece_levels=(0, PIECE_LEVELS)):
    """The scheme, and every class of patches and its tree, with pieces at some levels of tips or none."""
    surface = LimitSurface(cage, scheme)
    for each in surface.patches.classes:
        for levels in piece_levels:
            yield surface.scheme, each, tree_arrays(surface.scheme, each.signature, levels), levels


class Walker:
    """Evaluates a tree at one sample after the other, as its description says.

    Parameters are those of the piece that ``beside`` lies in: the same as the sample's, or others next to it.
    """

    def __init__(self, scheme, tree, levels):
        self.scheme, self.tree, self.basis, self.levels = scheme, tree, polynomial_basis(scheme), levels
        # Over the element's one-ring.
        over_ring = (each.pieces if each.stencils is None else each.pieces @ each.stencils for each in tree.maps)
        self.pieces = [piece for pieces in over_ring for piece in pieces]

    def stencil(self, uv, beside=None):
        """``(K,)`` weights of the control points."""
        domain, tree = self.scheme.domain, self.tree
        beside = uv if beside is None else beside
        node, points = 0, np.array([uv, beside])
        while True:
            points = domain.rotation(int(tree.turns[node]))(points)
            kind, first = tree.kinds[node], int(tree.first[node])
            if kind == PartKind.ONLY_CHILD:
                node = first
            elif kind == PartKind.DIVIDED:
                copy = self._copy_of(points[1], range(4))
                node, points = first + copy, domain.children[copy](points)
            else:
                break
        if kind == PartKind.REGULAR:
            return self.basis.monomials(points[:1])[0] @ self.pieces[first]
        count = int(tree.levels[node])
        extent = float(domain.extent(points[1]))
        level = max(count if extent <= 0 else min(int(-np.frexp(extent)[1]), count), 0)
        points, number = np.ldexp(points, level), 3 * level
        if level < count:
            copy = self._copy_of(points[1], range(1, 4))
            number, points = number + copy - 1, domain.children[copy](points)
        monomials = self.basis.monomials(points[:1])[0]
        if level < self.levels:
            return monomials @ self.pieces[first + number]
        block = tree.blocks[tree.first_block[node] + number - 3 * self.levels]
        weights = block @ monomials
        # The first row holds something else, as control points are relative to the first.
        weights[0] = 1 - weights[1:].sum()
        return weights

    def _copy_of(self, uv, among):
        return max(among, key=lambda k: float(self.scheme.domain.inside(self.scheme.domain.children[k](uv))))


def places(scheme, rng, count=12):
    """All over the domain, and down to 2^-22 at every corner."""
    domain = scheme.domain
    uv = rng.dirichlet(np.ones(domain.corner_count), count) @ domain.corners
    uv *= 2.0 ** -np.where(np.arange(count) < count // 3, 0, rng.integers(0, 23, count))[:, None]
    # Nearer, the surface is linear.
    uv = uv[domain.extent(uv) > FLOAT32_SIZE]
    turns = rng.integers(0, domain.corner_count, len(uv))
    return np.array([domain.rotation(turn)(each) for turn, each in zip(turns, uv, strict=True)])


@EVERY_CAGE
def test_polynomials_are_the_limit_stencils(scheme, cage, np_rng):
    for own, patch_class, tree, levels in trees(scheme, cage):
        uv, walker = places(own, np_rng), Walker(own, tree, levels)
        found, expected = [walker.stencil(each) for each in uv], element_stencils(own, patch_class.signature, uv)[0]
        np.testing.assert_allclose(found, expected, rtol=0, atol=ROUNDING)


@EVERY_CAGE
def test_pieces_agree_with_their_neighbours_where_they_meet(scheme, cage, np_rng):
    """On lines between copies of the domain, at every level, from either side: pieces at one level, and blocks."""
    for own, patch_class, tree, levels in trees(scheme, cage, [1]):
        walker, domain = Walker(own, tree, levels), own.domain
        # Both sides of a dart have their own copies of the vertices on it.
        vertices = cage.cut_mesh.vertex[patch_class.controls[0]]
        for _ in range(8):
            depth = int(np_rng.integers(1, 7))
            u, v = np_rng.dirichlet(np.ones(domain.corner_count)) @ domain.corners
            u = np.round(u * 2**depth) / 2**depth
            if not 0 < u < 1 or (domain.corner_count == 3 and u + v > 1 - BESIDE):
                continue
            sides = [walker.stencil(np.array([u, v]), np.array([u + shift, v])) for shift in (-BESIDE, BESIDE)]
            left, right = (np.bincount(vertices, weights) for weights in sides)
            np.testing.assert_allclose(left, right, rtol=0, atol=ROUNDING)


@EVERY_CAGE
def test_trees_are_whole_and_rows_of_the_constant_sum_to_one_and_all_others_to_zero(scheme, cage):
    """Every node but the first is the child of one other, and pieces and blocks follow each other without gaps."""
    for own, _, tree, piece_levels in trees(scheme, cage):
        constant = (polynomial_basis(own).powers == 0).all(axis=1)
        for each in tree.maps:
            sums = each.pieces.sum(axis=2)
            np.testing.assert_allclose(sums, np.broadcast_to(constant, sums.shape), rtol=0, atol=ROUNDING)
            if each.stencils is not None:
                np.testing.assert_allclose(each.stencils.sum(axis=1), 1, rtol=0, atol=ROUNDING)
        is_inner, is_tip = np.isin(tree.kinds, (PartKind.DIVIDED, PartKind.ONLY_CHILD)), tree.kinds == PartKind.TIP
        counts = np.where(tree.kinds == PartKind.DIVIDED, 4, 1)[is_inner]
        np.testing.assert_array_equal(
            np.sort(ragged.ranges(tree.first[is_inner], counts)), np.arange(1, len(tree.kinds))
        )
        assert (tree.turns < own.domain.corner_count).all()
        first = [(number, 1) for number in tree.first[tree.kinds == PartKind.REGULAR].tolist()]
        first += [(number, 3 * piece_levels) for number in tree.first[is_tip].tolist()]
        assert followed(first) == tree.piece_count
        assert followed([(each.first_piece, len(each.pieces)) for each in tree.maps]) == tree.piece_count
        uneven = np.where(tree.frames == FrameKind.UNEVEN, 2, 1)
        sizes = (3 * uneven * (tree.levels - piece_levels) + 2)[is_tip]
        assert followed(zip(tree.first_block[is_tip].tolist(), sizes.tolist(), strict=True)) == len(tree.blocks)


def followed(runs):
    """Where runs end, each given by its first number and its length, that follow each other from 0 on."""
    end = 0
    for first, size in sorted(runs):
        assert first == end or not size
        end += size
    return end


@EVERY_CAGE
def test_the_last_level_is_as_near_as_single_precision_tells(scheme, cage):
    for own, patch_class, tree, _ in trees(scheme, cage):
        (element,) = patch_trees(own, [patch_class.signature])
        eigenvalues = [tip.irregular_patch.basis.subdominant for tip in element.tips]
        is_tip = np.flatnonzero(tree.kinds == PartKind.TIP)
        in_order = is_tip[np.argsort(tree.first_block[is_tip])]
        for levels, eigenvalue in zip(tree.levels[in_order], eigenvalues, strict=True):
            assert eigenvalue**levels <= FLOAT32_SIZE * (1 + 1e-9)
            assert levels >= -np.log2(FLOAT32_SIZE)


def test_parts_that_are_divided_alike_share_their_pieces():
    """A semi-sharp crease has thousands of pieces, of few kinds."""
    cage = tagged(cube(), creases=[(4, 5, 8.0), (5, 7, 8.0), (7, 6, 8.0), (6, 4, 8.0)])
    maps = [each for _, _, tree, levels in trees("catmull_clark", cage) if levels for each in tree.maps]
    assert sum(len(each.pieces) for each in maps) > 3000
    assert sum(len(pieces) for pieces in {id(each.pieces): each.pieces for each in maps}.values()) < 1000


@pytest.mark.parametrize(
    ("cage", "allowed"),
    [
        (cage_of("catmull_clark", "torus"), {PartKind.REGULAR}),
        (cage_of("doo_sabin", "trapezohedron"), {PartKind.REGULAR, PartKind.DIVIDED, PartKind.TIP}),
        # A polygon's corner is refined once before it fits the domain.
        (extraordinary_face(5), set(PartKind)),
        (sheet(3, 3), {PartKind.REGULAR, PartKind.DIVIDED}),
    ],
    ids=["regular", "one extraordinary corner", "pentagon's corner", "border"],
)
def test_kinds_of_nodes(cage, allowed):
    patches = PatchTable(cage.cut_mesh.topology, CatmullClark())
    kinds = [tree_arrays(patches.scheme, each.signature).kinds.tolist() for each in patches.classes]
    found = {kind for tree in kinds for kind in tree}
    assert found <= allowed
    assert (PartKind.ONLY_CHILD in found) == (PartKind.ONLY_CHILD in allowed)
    if allowed == {PartKind.REGULAR}:
        assert kinds == [[PartKind.REGULAR]]
