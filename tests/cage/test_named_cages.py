import numpy as np
import pytest
from mitsuba_subdivision.cage import CageError
from mitsuba_subdivision.cage.named_cages import cube, extraordinary
from scipy.spatial import cKDTree

VALENCES = [3, 4, 5, 6, 8, 13, 40]


def are_corners_convex(cage):
    """Whether every corner of the quads of a star-shaped cage is convex as seen from outside."""
    corners = cage.positions[cage.face_vertices.reshape(-1, 4)]
    before, after = np.roll(corners, 1, axis=1), np.roll(corners, -1, axis=1)
    return (np.einsum("fki,fki->fk", corners, np.cross(corners - before, after - corners)) > 0).all()


def test_cube():
    cage = cube()
    assert (cage.vertex_count, cage.face_count) == (8, 6)
    assert set(map(tuple, np.abs(cage.positions))) == {(1, 1, 1)}
    assert (cage.topology.twin >= 0).all()
    assert (cage.topology.vertex_face_count == 3).all()
    assert are_corners_convex(cage)


def test_less_than_three_faces_around_a_vertex_are_an_error():
    with pytest.raises(CageError, match="valence 2; expected at least 3"):
        extraordinary(2)


@pytest.mark.parametrize("valence", VALENCES)
def test_extraordinary_is_a_closed_convex_symmetric_ball_of_these_valences(valence):
    cage = extraordinary(valence)
    assert (cage.topology.twin >= 0).all()
    np.testing.assert_allclose(np.linalg.norm(cage.positions, axis=1), 1)
    assert are_corners_convex(cage)
    valences = cage.topology.vertex_face_count
    assert valences[0] == valence
    expected = np.bincount([valence] * 2 + [3] * (2 * valence), minlength=5)
    expected[4] += len(valences) - 2 - 2 * valence
    np.testing.assert_array_equal(np.bincount(valences, minlength=5), expected)
    angle = 2 * np.pi / valence
    turned = cage.positions @ [[np.cos(angle), np.sin(angle), 0], [-np.sin(angle), np.cos(angle), 0], [0, 0, 1]]
    for same in (turned, cage.positions * [1, 1, -1], cage.positions * [1, -1, 1]):
        assert cKDTree(cage.positions).query(same)[0].max() < 1e-12


@pytest.mark.parametrize("closed", [True, False])
@pytest.mark.parametrize("valence", VALENCES)
def test_pole_is_isolated_and_numbered_first(valence, closed):
    cage = extraordinary(valence, closed=closed)
    topology = cage.topology
    np.testing.assert_array_equal(cage.positions[0], [0, 0, 1])
    faces = cage.face_vertices.reshape(-1, 4)
    assert (faces[:valence, 0] == 0).all()
    np.testing.assert_array_equal(topology.turn[4 * np.arange(valence)], 4 * np.roll(np.arange(valence), -1))
    # Without its lower half, it has one boundary, above the equator.
    assert (topology.twin < 0).sum() == (0 if closed else 6 * valence)
    assert (cage.positions[:, 2].min() > 0) == (not closed)
