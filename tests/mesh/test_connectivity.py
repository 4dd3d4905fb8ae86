from itertools import pairwise

import numpy as np
import pytest
from mitsuba_subdivision import ControlCage
from mitsuba_subdivision.mesh.connectivity import paired
from mitsuba_subdivision.refinement.cage_refinement import differences
from patches.closed_cages import torus
from reference.exact_samples import mesh_of

pytestmark = pytest.mark.core


def test_next_and_prev_walk_the_vertices_of_each_face_in_order(any_cage):
    t = any_cage.topology
    for begin, end in pairwise(t.face_offsets.tolist()):
        face = np.arange(begin, end)
        np.testing.assert_array_equal(t.next[face], np.roll(face, -1))
        np.testing.assert_array_equal(t.prev[face], np.roll(face, 1))
    np.testing.assert_array_equal(np.diff(t.face_offsets), t.face_sizes)
    np.testing.assert_array_equal(t.face, np.repeat(np.arange(t.face_count), t.face_sizes))


def test_turns_pass_the_edge_before_and_back_the_edge_after(any_cage):
    t = any_cage.topology
    for half_edge in range(t.half_edge_count):
        ahead, behind = t.twin[t.prev[half_edge]], t.twin[half_edge]
        assert t.turn[half_edge] == ahead
        assert t.turn_back[half_edge] == (-1 if behind < 0 else t.next[behind])
        assert ahead < 0 or t.turn_back[ahead] == half_edge


def test_twin_is_the_same_edge_backwards_and_edges_are_numbered_without_gaps(any_cage):
    t = any_cage.topology
    inner = np.flatnonzero(t.twin >= 0)
    twin = t.twin[inner]
    assert (twin != inner).all()
    np.testing.assert_array_equal(t.twin[twin], inner)
    np.testing.assert_array_equal(t.edge[twin], t.edge[inner])
    np.testing.assert_array_equal(t.face_vertices[twin], t.face_vertices[t.next[inner]])
    edges, lowest = np.unique(t.edge, return_index=True)
    np.testing.assert_array_equal(edges, np.arange(t.edge_count))
    np.testing.assert_array_equal(t.edge_half_edge, lowest)


@pytest.mark.parametrize(("unit", "kind"), [(1, np.int64), (1 << 58, np.int64), (1 << 26, np.int32)])
def test_half_edges_of_equal_keys_are_edges(unit, kind, np_rng):
    """Of few bits, so many that a half-edge does not fit beside them, and of half as many."""
    keys = np_rng.permutation(np.repeat(np.arange(20), [1, 2] * 10))
    edge, twin, count = paired((unit * keys).astype(kind))
    np.testing.assert_array_equal(edge, keys)
    assert count == 20
    for half_edge, other in enumerate(twin.tolist()):
        same = set(np.flatnonzero(keys == keys[half_edge]).tolist()) - {half_edge}
        assert same == ({other} if other >= 0 else set())


def test_refinement_differs_where_one_mesh_is_sharp():
    smooth = torus(5, 6)
    sharp = ControlCage(smooth.positions, smooth.face_vertices.reshape(-1, 4).tolist(), creases=[(13, 14, 2.0)])
    meshes = [cage.cut_mesh.topology for cage in (smooth, sharp)]
    for expected, other in (meshes, meshes[::-1]):
        *others, is_wrong = differences(expected, other, np.array(False))
        assert not np.any(others)
        np.testing.assert_array_equal(is_wrong, sharp.cut_mesh.topology.semi_sharpness.edges > 0)
    assert not np.any(differences(*[meshes[0]] * 2, np.array(False)))


def test_fans_are_all_turns_about_each_inner_vertex_from_the_lowest_half_edge(any_cage):
    t = any_cage.topology
    offsets, half_edges = t.vertex_fans
    for vertex in range(t.vertex_count):
        fan = half_edges[offsets[vertex] : offsets[vertex + 1]]
        leaving = np.flatnonzero(t.face_vertices == vertex)
        np.testing.assert_array_equal(np.sort(fan), [] if t.is_border_vertex[vertex] else leaving)
        np.testing.assert_array_equal(t.turn[fan], np.roll(fan, -1))
        assert not len(fan) or fan[0] == fan.min()


def test_open_faces_have_boundary():
    t = mesh_of(5, [[0, 1, 2], [2, 1, 3]])
    np.testing.assert_array_equal(t.twin, [-1, 3, -1, 1, -1, -1])
    np.testing.assert_array_equal(t.is_border_vertex, [True] * 4 + [False])
    np.testing.assert_array_equal(t.vertex_half_edge, [0, 1, 2, 5, -1])
    np.testing.assert_array_equal(t.vertex_face_count, [1, 2, 2, 1, 0])
    assert (t.turn[0], t.turn[2]) == (-1, 3)
