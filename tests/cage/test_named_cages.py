import numpy as np
import pytest
from mitsuba_subdivision.cage import CageError
from mitsuba_subdivision.cage.named_cages import cube, extraordinary, tetrahedron, torus

VALENCES = [3, 4, 5, 6, 8, 13, 40]


def enclosed_volume(cage):
    """Volume by signed tetrahedra over a fan of each face: positive where faces are counter-clockwise from outside."""
    topology, volume = cage.topology, 0.0
    for face in range(cage.face_count):
        begin, end = topology.face_offsets[face : face + 2]
        corners = cage.positions[cage.face_vertices[begin:end]]
        volume += sum(np.linalg.det(corners[[0, i, i + 1]]) for i in range(1, len(corners) - 1)) / 6
    return volume


def test_cube_and_tetrahedron():
    box, pyramid = cube(), tetrahedron()
    assert (box.vertex_count, box.face_count) == (8, 6)
    assert set(map(tuple, np.abs(box.positions))) == {(1, 1, 1)}
    assert (pyramid.face_sizes == 3).all()
    edges = np.linalg.norm(pyramid.positions[:, None] - pyramid.positions, axis=-1)[np.triu_indices(4, 1)]
    np.testing.assert_allclose(edges, np.sqrt(8))
    for cage, volume in ((box, 8), (pyramid, 8 / 3)):
        assert (cage.topology.twin >= 0).all()
        assert (cage.topology.vertex_face_count == 3).all()
        assert enclosed_volume(cage) == pytest.approx(volume)


def test_torus():
    cage = torus(7, 5, major_radius=3, minor_radius=0.5)
    assert (cage.topology.twin >= 0).all()
    assert (cage.vertex_count, cage.face_count) == (35, 35)
    assert (cage.topology.vertex_face_count == 4).all()
    np.testing.assert_array_equal(cage.face_vertices[:4], [0, 5, 6, 1])
    np.testing.assert_allclose(cage.positions[0], [3.5, 0, 0])
    from_tube = np.hypot(np.hypot(cage.positions[:, 0], cage.positions[:, 1]) - 3, cage.positions[:, 2])
    np.testing.assert_allclose(from_tube, 0.5)
    assert enclosed_volume(cage) > 0


def test_less_than_three_of_each_is_an_error():
    with pytest.raises(CageError, match="torus of 2 columns and 5 rows; expected at least 3 of each"):
        torus(2, 5)
    with pytest.raises(CageError, match="5 columns and 2 rows"):
        torus(5, 2)
    with pytest.raises(CageError, match="valence 2; expected at least 3"):
        extraordinary(2)


@pytest.mark.parametrize("valence", VALENCES)
def test_extraordinary_is_a_closed_convex_symmetric_ball_of_these_valences(valence):
    cage = extraordinary(valence)
    assert (cage.topology.twin >= 0).all()
    np.testing.assert_allclose(np.linalg.norm(cage.positions, axis=1), 1)
    corners = cage.positions[cage.face_vertices.reshape(-1, 4)]
    for i in range(4):
        a, b, c = (corners[:, (i + k) % 4] for k in range(3))
        # Every corner of every quad is convex as seen from outside.
        assert (np.einsum("ij,ij->i", b, np.cross(b - a, c - b)) > 0).all()
    valences = cage.topology.vertex_face_count
    assert valences[0] == valence
    expected = np.bincount([valence] * 2 + [3] * (2 * valence), minlength=5)
    expected[4] += len(valences) - 2 - 2 * valence
    np.testing.assert_array_equal(np.bincount(valences, minlength=5), expected)

    angle = 2 * np.pi / valence
    turned = cage.positions @ [[np.cos(angle), np.sin(angle), 0], [-np.sin(angle), np.cos(angle), 0], [0, 0, 1]]
    for same in (turned, cage.positions * [1, 1, -1], cage.positions * [1, -1, 1]):
        assert max(np.linalg.norm(cage.positions - point, axis=1).min() for point in same) < 1e-12


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
