"""Creases and corners as arrays."""

import numpy as np
import pytest
from mitsuba_subdivision.cage import CageError, CageWarning, ControlCage
from mitsuba_subdivision.cage.named_cages import cube, torus
from reference.refined_cages import tagged


def test_tags_reach_both_half_edges_and_no_other_and_the_last_of_equal_ones_counts():
    cage = tagged(cube(), creases=[(0, 1, 3), (6, 2, 20)], corners=[(7, 2.5)])
    t = cage.topology
    ends = np.sort(np.stack([t.face_vertices, t.face_vertices[t.next]]), axis=0).T
    expected = np.select([(ends == (0, 1)).all(axis=1), (ends == (2, 6)).all(axis=1)], [3.0, 10.0])
    assert np.count_nonzero(expected) == 4
    np.testing.assert_array_equal(cage.tags.edges, expected)
    np.testing.assert_array_equal(cage.tags.vertices, 2.5 * (np.arange(8) == 7))
    cage = tagged(cube(), creases=[(0, 1, 3), (1, 0, 4), (0, 1, 5), (1, 0, 2)])
    np.testing.assert_array_equal(cage.tags.creases(cage.topology)[:, 2], [2])


def test_creases_of_large_cages_are_found():
    """From 46,341 vertices on, pairs of vertices need more than 32 bits."""
    plain = torus(256, 200)
    wanted = plain.face_vertices.reshape(-1, 4)[-3:, [0, 3]]
    cage = tagged(plain, creases=[(*edge, 10) for edge in wanted.tolist()])
    found = np.sort(cage.tags.creases(cage.topology)[:, :2], axis=1)
    np.testing.assert_array_equal(np.unique(found, axis=0), np.unique(np.sort(wanted, axis=1), axis=0))


def test_tags_are_read_only_and_what_is_equal_everywhere_takes_no_memory():
    for cage in (torus(8, 6), tagged(cube(), creases=[(0, 1, 10)], corners=[(0, 10)])):
        for values in (cage.tags.edges, cage.tags.vertices):
            with pytest.raises(ValueError, match="read-only"):
                values[0] = 1
            assert (values.strides == (0,)) == (not cage.tags.any)
        assert cage.face_sizes.strides == (0,)


@pytest.mark.parametrize(
    ("tags", "message"),
    [
        ({"creases": [(0, 7, 10), (0, 1, 3)]}, r"crease along edge \(0, 7\), which is no edge of a face, is ignored"),
        ({"creases": [(0, 1, 3), (-1, 99, 1)]}, r"along edge \(-1, 99\), .* \(1 such crease; numbers count from 0"),
        ({"creases": [(0, 1, 3)], "corners": [(8, 1), (-1, 1)]}, r"corner at vertex 8, which .* \(2 such corners; n"),
    ],
)
def test_what_no_face_has_is_ignored_and_told(tags, message):
    with pytest.warns(CageWarning, match=message) as record:
        cage = tagged(cube(), **tags)
    assert len(record) == 1
    np.testing.assert_array_equal(cage.tags.creases(cage.topology)[:, 2], [3])
    assert not cage.tags.vertices.any()


@pytest.mark.parametrize("vertex", [10**400, 1e300, -1e300, 2**60, float("inf")])
def test_vertices_beyond_all_integers_are_errors_and_no_warnings(vertex):
    for tags in ({"creases": [(0, vertex, 1)]}, {"corners": [(vertex, 1)]}):
        with pytest.raises(CageError, match=r"expected (rows )?\(vertex, "):
            ControlCage(np.eye(3), [[0, 1, 2]], **tags)
