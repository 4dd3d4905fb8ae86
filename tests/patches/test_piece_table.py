"""Contents and sharing of piece tables; tests of kernels compare their polynomials with the surface."""

import numpy as np
import pytest
from mitsuba_subdivision import LimitSurface
from mitsuba_subdivision.cage.named_cages import cube, extraordinary
from mitsuba_subdivision.evaluation.irregular_patch import PIECE_LEVELS
from mitsuba_subdivision.evaluation.patch_tree import patch_trees
from mitsuba_subdivision.patches import piece_table as layout
from mitsuba_subdivision.patches.piece_table import PACKET, PieceTable, piece_packets
from patches.closed_cages import bumpy, mixed_torus
from reference.refined_cages import refine_first, sheet, tagged

pytestmark = pytest.mark.core

INFINITE = 10.0
# Sums of some tens of weights.
ROUNDING = 1e-14


def test_tips_keep_fewer_levels_as_pieces_where_these_would_take_too_much_memory(monkeypatch):
    # A valence of no other test, of which nothing keeps the table.
    surface = LimitSurface(extraordinary(13))

    def made(levels=3):
        table = PieceTable.build(surface.patches, piece_levels=levels)
        return table.piece_levels, PACKET * piece_packets(16) * table.piece_count

    every = [made(levels) for levels in range(4)]
    assert [levels for levels, _ in every] == [0, 1, 2, 3]
    _, without = every[0]
    for levels, numbers in every:
        monkeypatch.setattr(layout, "COEFFICIENT_BYTES", 4 * (numbers - without))
        assert made() == (levels, numbers)
        monkeypatch.setattr(layout, "COEFFICIENT_BYTES", 4 * (numbers - without) - 1)
        assert levels == 0 or made() == every[levels - 1]


def test_regular_pieces_do_not_take_levels_from_tips(monkeypatch):
    monkeypatch.setattr(layout, "COEFFICIENT_BYTES", 1)
    assert PieceTable.build(LimitSurface(sheet(5, 4)).patches).piece_levels == PIECE_LEVELS


def test_copies_of_control_points_share_a_value_and_refined_ones_a_column(monkeypatch):
    refine_first(monkeypatch)
    cage = tagged(mixed_torus(), creases=[(0, 8, INFINITE), (8, 16, INFINITE)])
    surface = LimitSurface(bumpy(cage))
    table, (refined, stencils) = surface.pieces(), surface.patches.refined
    controls, refinement = surface.patches.control_rows()
    assert surface.patches.topology.vertex_count > cage.vertex_count
    assert (refinement.row_count, refinement.column_count) == (refined.topology.vertex_count, cage.vertex_count)
    np.testing.assert_allclose(refinement.matrix.sum(axis=1), 1, rtol=0, atol=ROUNDING)
    positions = surface.cage.positions
    expected = stencils.matrix @ positions[surface.cage.cut_mesh.vertex]
    np.testing.assert_allclose(refinement.matrix @ positions, expected, rtol=0, atol=ROUNDING)
    np.testing.assert_array_equal(controls, refined.controls)
    assert surface.patches.control_rows(table.control_of_vertex, table.control_count)[1] is refinement
    # The patch at a half-edge is the refined face there.
    corners = np.concatenate([group.corners for group in refined.classes])
    for half_edge, code in enumerate(table.half_edges[:, layout.CODE]):
        assert corners[code // layout.PATCH] == refined.topology.face_offsets[half_edge]


def test_parts_of_equal_division_share_pieces():
    """A semi-sharp crease has thousands of pieces, of few kinds."""
    surface = LimitSurface(tagged(cube(), creases=[(4, 5, 8.0), (5, 7, 8.0), (7, 6, 8.0), (6, 4, 8.0)]))
    elements = patch_trees(surface.scheme, [patch_class.signature for patch_class in surface.patches.classes])
    pieces = [of_part for element in elements for *_, of_part in layout.tree_arrays(element).maps]
    count = sum(map(len, pieces))
    assert count > 3000
    assert sum(len(shared) for shared in {id(shared): shared for shared in pieces}.values()) < count / 3


def test_tables_without_creases_use_the_patches_control_points():
    surface = LimitSurface(extraordinary(5))
    assert np.shares_memory(surface.patches.control_rows()[0], surface.patches.controls)
