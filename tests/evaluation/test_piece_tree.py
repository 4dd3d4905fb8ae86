"""Trees of pieces: their polynomials are the limit stencils everywhere, and neighbours agree where they meet."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from mitsuba_subdivision import ControlCage, LimitSurface
from mitsuba_subdivision.cage.named_cages import cube, extraordinary, extraordinary_face, extraordinary_triangles
from mitsuba_subdivision.evaluation.element import element_stencils
from mitsuba_subdivision.evaluation.piece_tree import FrameKind, NodeKind, piece_tree
from mitsuba_subdivision.evaluation.polynomial_basis import polynomial_basis
from mitsuba_subdivision.evaluation.tip_levels import NEAREST
from mitsuba_subdivision.patches import PatchTable
from mitsuba_subdivision.schemes import CatmullClark
from patches.closed_cages import SURFACES, cage_of
from reference.refined_cages import half_disc, sheet, spokes, tagged

pytestmark = pytest.mark.core

SCENES = Path(__file__).parents[2] / "scenes"
INFINITE = 10.0
# From a line between pieces to parameters in them.
BESIDE = 2.0**-30
# Sums of some hundred products of weights; those at valence 50 are sums over eigen-coordinates, some of them large.
ROUNDING = 2e-13

CAGES = {
    **{f"{scheme} {name}": (scheme, cage_of(scheme, name)) for scheme, name in SURFACES},
    "valence 50": ("catmull_clark", extraordinary(50)),
    "loop valence 3": ("loop", extraordinary_triangles(3)),
    "loop valence 50": ("loop", extraordinary_triangles(50)),
    "doo_sabin face 50": ("doo_sabin", extraordinary_face(50)),
    "smooth triangles": ("catmull_clark", tagged(cage_of("catmull_clark", "prism"), triangle_rule="smooth")),
    "rook": ("catmull_clark", ControlCage.from_file(SCENES / "cages/rook.obj")),
    "sheet": ("catmull_clark", sheet(4, 3)),
    "sheet without corners": ("catmull_clark", sheet(3, 2, boundary="edge_only")),
    "half disc of 6": ("catmull_clark", half_disc(6)),
    "loop half disc of 6": ("loop", half_disc(6)),
    "loop sheet without corners": ("loop", sheet(3, 2, triangles=True, boundary="edge_only")),
    "dart": ("catmull_clark", spokes(extraordinary(5), 5, (INFINITE,))),
    "crease": ("catmull_clark", spokes(extraordinary(5), 5, (INFINITE, 0, INFINITE))),
    "corner": ("catmull_clark", spokes(extraordinary(5), 5, (INFINITE,) * 3)),
    "loop corner": ("loop", spokes(extraordinary_triangles(5), 5, (INFINITE,) * 3)),
    "semi-sharp": ("catmull_clark", spokes(extraordinary(5), 5, (INFINITE, 0, INFINITE, 1.5))),
    "loop semi-sharp": ("loop", spokes(extraordinary_triangles(5), 5, (0.5, 1.5, 2.5))),
    "chaikin": (
        "catmull_clark",
        tagged(cube(), creases=[(4, 5, 0.4), (5, 7, 1.3), (7, 6, 2.2), (6, 4, 4)], crease_method="chaikin"),
    ),
}
EVERY_CAGE = pytest.mark.parametrize(("scheme", "cage"), CAGES.values(), ids=CAGES.keys())


def trees(scheme, cage):
    """The scheme, and signature and tree of every class of patches."""
    surface = LimitSurface(cage, scheme)
    for patch_class in surface.patches.classes:
        yield surface.scheme, patch_class.signature, piece_tree(surface.scheme, patch_class.signature)


class Walker:
    """Evaluates a tree at one sample after the other, as its description says.

    Parameters are those of the piece that ``beside`` lies in: the same as the sample's, or others next to it.
    """

    def __init__(self, scheme, tree):
        self.scheme, self.tree, self.basis = scheme, tree, polynomial_basis(scheme)

    def stencil(self, uv, beside=None):
        """``(K,)`` weights of the control points."""
        domain, tree = self.scheme.domain, self.tree
        beside = uv if beside is None else beside
        node, points = 0, np.array([uv, beside])
        while True:
            points = domain.rotation(int(tree.turns[node]))(points)
            kind, first = tree.kinds[node], int(tree.first[node])
            if kind == NodeKind.ONLY_CHILD:
                node = first
            elif kind == NodeKind.DIVIDED:
                copy = self._copy_of(points[1], range(4))
                node, points = first + copy, domain.children[copy](points)
            else:
                break
        if kind == NodeKind.OWN_POINTS:
            weights = np.zeros(tree.blocks.shape[1])
            np.add.at(weights, tree.orders[first], self.scheme.regular_basis(points[:1], 1)[0, 0])
            return weights
        factor = 1.0
        if kind == NodeKind.IRREGULAR:
            count = int(tree.levels[node])
            extent = float(domain.extent(points[1]))
            level = count if extent <= 0 else min(int(-np.frexp(extent)[1]), count)
            points = np.ldexp(points, max(level, 0))
            first, factor = first + 3 * max(level, 0), float(tree.shrinking[node]) ** max(level, 0)
            if level < count:
                copy = self._copy_of(points[1], range(1, 4))
                first, points = first + copy - 1, domain.children[copy](points)
        monomials = self.basis.monomials(points[:1])[0]
        monomials[1:] *= factor
        weights = tree.blocks[first] @ monomials
        # The first row is not needed, as control points are relative to the first.
        weights[0] = 1 - weights[1:].sum()
        return weights

    def _copy_of(self, uv, among):
        return max(among, key=lambda k: float(self.scheme.domain.inside(self.scheme.domain.children[k](uv))))


def places(scheme, rng, count=24):
    """All over the domain, and down to 2^-22 at every corner."""
    domain = scheme.domain
    uv = rng.dirichlet(np.ones(domain.corner_count), count) @ domain.corners
    uv *= 2.0 ** -np.where(np.arange(count) < count // 3, 0, rng.integers(0, 23, count))[:, None]
    turns = rng.integers(0, domain.corner_count, count)
    return np.array([domain.rotation(turn)(each) for turn, each in zip(turns, uv, strict=True)])


@EVERY_CAGE
def test_polynomials_are_the_limit_stencils(scheme, cage, np_rng):
    for own, signature, tree in trees(scheme, cage):
        uv, walker = places(own, np_rng), Walker(own, tree)
        found = np.array([walker.stencil(each) for each in uv])
        np.testing.assert_allclose(found, element_stencils(own, signature, uv)[0], rtol=0, atol=ROUNDING)


@EVERY_CAGE
def test_pieces_agree_with_their_neighbours_where_they_meet(scheme, cage, np_rng):
    """On lines between copies of the domain, at every level, taken from either side."""
    for (own, _, tree), patch_class in zip(
        trees(scheme, cage), LimitSurface(cage, scheme).patches.classes, strict=True
    ):
        walker, domain = Walker(own, tree), own.domain
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
def test_rows_of_the_constant_sum_to_one_and_all_others_to_zero(scheme, cage):
    for own, _, tree in trees(scheme, cage):
        constant = (polynomial_basis(own).powers == 0).all(axis=1)
        blocks = [np.arange(k, k + 1) for k in tree.first[tree.kinds == NodeKind.REGULAR]]
        for first, count in zip(*of_kind(tree, NodeKind.IRREGULAR, tree.first, tree.levels), strict=True):
            blocks.append(np.arange(first, first + 3 * count + 1))
        for sums in tree.blocks[np.concatenate([[], *blocks]).astype(int)].sum(axis=1):
            np.testing.assert_allclose(sums, constant, rtol=0, atol=ROUNDING)


def of_kind(tree, kind, *columns):
    return (column[tree.kinds == kind].astype(int) for column in columns)


@EVERY_CAGE
def test_trees_are_whole(scheme, cage):
    """Every node but the first is the child of one other, and blocks follow each other without gaps."""
    for own, _, tree in trees(scheme, cage):
        children = [
            np.arange(first, first + (4 if kind == NodeKind.DIVIDED else 1))
            for kind, first in zip(tree.kinds, tree.first, strict=True)
            if kind in (NodeKind.DIVIDED, NodeKind.ONLY_CHILD)
        ]
        assert np.concatenate([[0], *children]).tolist() == list(range(len(tree.kinds)))
        assert (tree.turns < own.domain.corner_count).all()
        sizes = [(first, 1) for first in next(of_kind(tree, NodeKind.REGULAR, tree.first))]
        columns = of_kind(tree, NodeKind.IRREGULAR, tree.first, tree.levels, tree.frames, tree.slow_rows)
        uneven = []
        for first, count, frame, slow_row in zip(*columns, strict=True):
            sizes.append((first, (6 if frame == FrameKind.UNEVEN else 3) * count + 2))
            if frame == FrameKind.UNEVEN:
                uneven += range(slow_row, slow_row + 3)
        assert uneven == list(range(len(tree.slow)))
        begins = 0
        for first, size in sorted(sizes):
            assert first == begins
            begins += size
        assert begins == len(tree.blocks)
        (orders,) = of_kind(tree, NodeKind.OWN_POINTS, tree.first)
        assert orders.tolist() == list(range(len(tree.orders)))


@EVERY_CAGE
def test_the_last_level_is_as_near_as_single_precision_tells(scheme, cage):
    for _, _, tree in trees(scheme, cage):
        (shrinking, levels) = (values[tree.kinds == NodeKind.IRREGULAR] for values in (tree.shrinking, tree.levels))
        assert (shrinking < 1).all()
        assert (shrinking**levels <= NEAREST * (1 + 1e-9)).all()
        assert (levels >= -np.log2(NEAREST)).all()


@pytest.mark.parametrize(
    ("kind", "cage", "expected"),
    [
        ("regular", cage_of("catmull_clark", "torus"), {NodeKind.OWN_POINTS: 1}),
        ("one extraordinary corner", cage_of("doo_sabin", "trapezohedron"), None),
        ("pentagon's corner", extraordinary_face(5), None),
        ("border", sheet(3, 3), None),
    ],
    ids=lambda value: value if isinstance(value, str) else "",
)
def test_kinds_of_nodes(kind, cage, expected):
    patches = PatchTable(cage.cut_mesh.topology, CatmullClark())
    found = [piece_tree(patches.scheme, each.signature) for each in patches.classes]
    kinds = [dict(zip(*np.unique(tree.kinds, return_counts=True), strict=True)) for tree in found]
    if expected is not None:
        assert kinds == [expected]
    # A polygon's corner is refined once before it fits the domain.
    only = {"pentagon's corner"}
    assert any(NodeKind.ONLY_CHILD in each for each in kinds) == (kind in only)
    if kind == "border":
        assert all(set(each) <= {NodeKind.OWN_POINTS, NodeKind.REGULAR, NodeKind.DIVIDED} for each in kinds)
