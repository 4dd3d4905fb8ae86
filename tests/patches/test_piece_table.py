"""Piece tables are flat copies of what patch tables and trees of pieces say."""

from __future__ import annotations

import numpy as np
import pytest
from mitsuba_subdivision import LimitSurface
from mitsuba_subdivision.cage.named_cages import cube, extraordinary
from mitsuba_subdivision.evaluation.piece_tree import NodeKind, piece_tree
from mitsuba_subdivision.patches.piece_table import NOTHING
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
    "crease": ("catmull_clark", spokes(extraordinary(5), 5, (INFINITE, 0, INFINITE))),
    "creased cube": ("catmull_clark", tagged(cube(), creases=[(4, 5, 1.5), (5, 7, INFINITE), (7, 6, INFINITE)])),
}


@pytest.fixture(params=CAGES)
def surface(request):
    scheme, cage = CAGES[request.param]
    return LimitSurface(bumpy(cage), scheme)


def test_half_edges_lead_to_their_neighbours(surface):
    t, table = surface.patches.elements, surface.pieces()
    twin, following, preceding, _ = table.half_edges.T.astype(np.int64)
    every = np.arange(t.half_edge_count)
    np.testing.assert_array_equal(following[preceding], every)
    np.testing.assert_array_equal(t.face_of(following), t.face)
    has_twin = twin != NOTHING
    np.testing.assert_array_equal(has_twin, t.twin >= 0)
    np.testing.assert_array_equal(twin[twin[has_twin]], every[has_twin])
    np.testing.assert_array_equal(t.face_vertices[twin[has_twin]], t.face_vertices[following[has_twin]])


def test_codes_lead_to_the_patch_that_covers_the_half_edge(surface):
    t, patches, table = surface.patches.elements, surface.patches, surface.pieces()
    code = table.patch_codes.astype(np.int64)
    is_whole, corner = (code >> 4 & 1).astype(bool), code & 3
    np.testing.assert_array_equal(is_whole, patches.is_whole[t.face])
    np.testing.assert_array_equal(corner[is_whole], (np.arange(t.half_edge_count) - t.face_offsets[t.face])[is_whole])
    assert not corner[~is_whole].any()
    for half_edge, class_index in enumerate(table.half_edges[:, 3]):
        begins = patches.classes[class_index].corners[code[half_edge] >> 5]
        for _ in range(code[half_edge] >> 2 & 3):
            begins = t.next[begins]
        assert begins == half_edge


def test_controls_of_every_patch_are_its_one_ring(surface):
    table, vertex = surface.pieces(), surface.cage.cut_mesh.vertex
    for (first, patch_count, control_count, _), patch_class in zip(table.classes, surface.patches.classes, strict=True):
        assert patch_class.controls.shape == (patch_count, control_count)
        at = first + patch_count * np.arange(control_count) + np.arange(patch_count)[:, None]
        np.testing.assert_array_equal(table.controls[at], vertex[patch_class.controls])


def test_nodes_and_weights_are_those_of_the_trees(surface):
    table = surface.pieces()
    for (_, _, control_count, begins), patch_class in zip(table.classes, surface.patches.classes, strict=True):
        tree = piece_tree(surface.scheme, patch_class.signature)
        nodes = table.nodes[begins : begins + len(tree.kinds)]
        np.testing.assert_array_equal(nodes[:, 0] & 7, tree.kinds)
        np.testing.assert_array_equal(nodes[:, 0] >> 3, tree.turns)
        np.testing.assert_array_equal(nodes[:, 2] & 3, tree.frames)
        np.testing.assert_array_equal(nodes[:, 2] >> 2, tree.levels)
        for slow_row, own in zip(nodes[:, 3], tree.slow_rows, strict=True):
            np.testing.assert_array_equal(
                table.slow[slow_row : slow_row + 3][: len(tree.slow)], tree.slow[own : own + 3]
            )
        np.testing.assert_array_equal(table.shrinking[begins : begins + len(tree.kinds)], tree.shrinking)
        for kind, first, own in zip(tree.kinds, nodes[:, 1], tree.first, strict=True):
            if kind in (NodeKind.DIVIDED, NodeKind.ONLY_CHILD):
                assert first == begins + own
            elif kind == NodeKind.OWN_POINTS:
                np.testing.assert_array_equal(table.orders[first], tree.orders[own])
            else:
                np.testing.assert_array_equal(table.weights[first : first + control_count], tree.blocks[own])


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
    # The patch at a half-edge is the refined face there.
    for half_edge, class_index in enumerate(table.half_edges[:, 3]):
        found = refined.table.classes[class_index].corners[table.patch_codes[half_edge] >> 5]
        assert found == refined.table.topology.face_offsets[half_edge]


def test_a_table_without_creases_has_the_controls_of_the_patches_themselves():
    """Nothing is copied."""
    surface = LimitSurface(extraordinary(5))
    assert np.shares_memory(surface.pieces().controls, surface.patches.controls)
