"""Piece tables are flat copies of what patch tables and trees of pieces say."""

import numpy as np
import pytest
from mitsuba_subdivision import LimitSurface
from mitsuba_subdivision.cage.named_cages import cube, extraordinary
from mitsuba_subdivision.evaluation.patch_tree import PartKind
from mitsuba_subdivision.evaluation.polynomials import polynomial_basis
from mitsuba_subdivision.evaluation.tree_arrays import PIECE_LEVELS, tree_arrays
from mitsuba_subdivision.patches import PieceTable
from mitsuba_subdivision.patches import piece_table as layout
from patches.closed_cages import SURFACES, bumpy, cage_of, mixed_torus
from reference.refined_cages import refine_first, sheet, spokes, tagged

pytestmark = pytest.mark.core

INFINITE = 10.0
# Sums of some tens of weights.
ROUNDING = 1e-14

CAGES = {
    **{f"{scheme} {name}": (scheme, cage_of(scheme, name)) for scheme, name in SURFACES},
    "holes": ("catmull_clark", tagged(mixed_torus(), holes=[0, 3])),
    "boundary none": ("catmull_clark", sheet(4, 4, boundary="none")),
    "doo_sabin sheet": ("doo_sabin", sheet(4, 4)),
    "crease": ("catmull_clark", spokes(extraordinary(5, closed=False), 5, (INFINITE, 0, INFINITE))),
    "creased cube": ("catmull_clark", tagged(cube(), creases=[(4, 5, 1.5), (5, 7, INFINITE), (7, 6, INFINITE)])),
}


@pytest.fixture(params=CAGES)
def surface(request):
    scheme, cage = CAGES[request.param]
    return LimitSurface(bumpy(cage), scheme)


def test_half_edges_lead_to_their_neighbours_and_the_patch_that_covers_them(surface):
    t, patches, table = surface.patches.elements, surface.patches, surface.pieces()
    twin, following, preceding, code = table.half_edges.T.astype(np.int64)
    every = np.arange(t.half_edge_count)
    np.testing.assert_array_equal(following[preceding], every)
    np.testing.assert_array_equal(t.face[following], t.face)
    has_twin = twin != layout.NOTHING
    np.testing.assert_array_equal(has_twin, t.twin >= 0)
    np.testing.assert_array_equal(twin[twin[has_twin]], every[has_twin])
    np.testing.assert_array_equal(t.face_vertices[twin[has_twin]], t.face_vertices[following[has_twin]])
    is_whole, corner = (code & layout.WHOLE) != 0, code & layout.CORNERS
    np.testing.assert_array_equal(is_whole, patches.is_whole[t.face])
    np.testing.assert_array_equal(corner, np.where(is_whole, every - t.face_offsets[t.face], 0))
    corners = np.concatenate([each.corners for each in patches.classes])
    for half_edge, own in enumerate(code):
        begins = corners[own // layout.PATCH]
        for _ in range(own // layout.PATCH_CORNER & layout.CORNERS):
            begins = t.next[begins]
        assert begins == half_edge


def test_controls_of_every_patch_are_its_one_ring(surface):
    table, vertex = surface.pieces(), surface.cage.cut_mesh.vertex
    for columns, patch_class in zip(table.classes, surface.patches.classes, strict=True):
        first, patch_count, control_count, *_ = columns
        assert patch_class.controls.shape == (patch_count, control_count)
        at = first + patch_count * np.arange(control_count) + np.arange(patch_count)[:, None]
        np.testing.assert_array_equal(table.controls[at], vertex[patch_class.controls])


def test_patches_have_the_trees_of_their_classes_and_pieces_of_their_own(surface):
    table, patch, end, row = surface.pieces(), 0, 0, 0
    count_of_monomials = len(polynomial_basis(surface.scheme).powers)
    packets = -(-3 * count_of_monomials // 4)
    weights = table.weights(count_of_monomials + 3)
    assert not weights[:, count_of_monomials:].any()
    ring_end = packets * int(table.classes[:, 1] @ table.classes[:, 4])
    for columns, patch_class in zip(table.classes.tolist(), surface.patches.classes, strict=True):
        _, count, control_count, first_piece, size, first_ring, ring = columns
        tree = tree_arrays(surface.scheme, patch_class.signature)
        assert ring == (control_count if len(tree.blocks) else 0)
        assert (first_piece, size) == (end, tree.piece_count)
        start, begins = table.patch_starts[patch : patch + count].T.astype(int)
        np.testing.assert_array_equal(start, end + size * np.arange(count))
        if ring:
            assert first_ring == ring_end
            np.testing.assert_array_equal(table.rings[patch : patch + count], ring_end + ring * np.arange(count))
        assert (begins == begins[0]).all()
        nodes = table.nodes[begins[0] :][: len(tree.kinds)].astype(int)
        np.testing.assert_array_equal(nodes[:, 0] & layout.KINDS, tree.kinds)
        np.testing.assert_array_equal(nodes[:, 0] // layout.TURN, tree.turns)
        is_leaf = tree.kinds >= PartKind.REGULAR
        np.testing.assert_array_equal(nodes[~is_leaf, 1], begins[0] + tree.first[~is_leaf])
        np.testing.assert_array_equal(nodes[is_leaf, 1], tree.first[is_leaf])
        np.testing.assert_array_equal(nodes[:, 2], row + tree.first_block * control_count)
        np.testing.assert_array_equal(nodes[:, 3] & layout.FRAMES, tree.frames)
        np.testing.assert_array_equal(nodes[:, 3] // layout.LEVEL & layout.LEVELS, tree.levels)
        assert (nodes[:, 3] // layout.CONTROL == control_count).all()
        rows = len(tree.blocks) * control_count
        own = weights[row : row + rows, :count_of_monomials]
        np.testing.assert_array_equal(own, tree.blocks.reshape(-1, count_of_monomials))
        patch, end, ring_end, row = patch + count, end + count * size, ring_end + count * ring, row + rows
    assert (patch, row) == (len(table.patch_starts), len(weights))
    # Whole pieces.
    assert table.packet_count % packets == 0
    assert 0 <= table.packet_count - ring_end < packets


def test_tips_keep_fewer_levels_as_pieces_where_these_would_take_too_much_memory(monkeypatch):
    surface = LimitSurface(extraordinary(5))

    def made(levels=3):
        # Made anew each time, as nothing keeps it.
        cage = surface.cage
        table = PieceTable.build(surface.patches, cage.cut_mesh.vertex, cage.vertex_count, levels)
        return table.piece_levels, table.packet_count

    every = [made(levels) for levels in range(4)]
    assert [levels for levels, _ in every] == [0, 1, 2, 3]
    _, without = every[0]
    for levels, packets in every:
        monkeypatch.setattr(layout, "COEFFICIENT_BYTES", 16 * (packets - without))
        assert made() == (levels, packets)
        monkeypatch.setattr(layout, "COEFFICIENT_BYTES", 16 * (packets - without) - 1)
        assert levels == 0 or made() == every[levels - 1]


def test_regular_pieces_do_not_take_levels_from_tips(monkeypatch):
    monkeypatch.setattr(layout, "COEFFICIENT_BYTES", 1)
    surface = LimitSurface(sheet(5, 4))
    table = PieceTable.build(surface.patches, surface.cage.cut_mesh.vertex, surface.cage.vertex_count)
    assert table.piece_levels == PIECE_LEVELS


def test_copies_of_control_points_share_a_value_and_refined_ones_a_column(monkeypatch):
    refine_first(monkeypatch)
    cage = tagged(mixed_torus(), creases=[(0, 8, INFINITE), (8, 16, INFINITE)])
    surface = LimitSurface(bumpy(cage))
    table, refined = surface.pieces(), surface.patches.refined
    assert surface.patches.topology.vertex_count > cage.vertex_count
    assert table.refinement.shape == (refined.table.topology.vertex_count, cage.vertex_count)
    np.testing.assert_allclose(table.refinement.sum(axis=1), 1, rtol=0, atol=ROUNDING)
    positions = surface.cage.positions
    np.testing.assert_allclose(
        table.refinement @ positions, refined.matrix @ positions[surface.cage.cut_mesh.vertex], rtol=0, atol=ROUNDING
    )
    np.testing.assert_array_equal(table.controls, refined.table.controls)
    assert surface.sampling(1).refinement is table.refinement
    # The patch at a half-edge is the refined face there.
    corners = np.concatenate([each.corners for each in refined.table.classes])
    for half_edge, code in enumerate(table.half_edges[:, layout.CODE]):
        assert corners[code // layout.PATCH] == refined.table.topology.face_offsets[half_edge]


def test_a_table_without_creases_has_the_controls_of_the_patches_themselves():
    """Nothing is copied."""
    surface = LimitSurface(extraordinary(5))
    assert np.shares_memory(surface.pieces().controls, surface.patches.controls)
