"""Edges, triangles and the Laplacian of a cage's own mesh."""

import numpy as np
import pytest
from mitsuba_subdivision.cage import named_cages
from patches.closed_cages import mixed_torus, polygons, torus
from peers.fidelity_cages import SURFACES

ROUNDING = 1e-12
pytestmark = pytest.mark.filterwarnings("ignore::mitsuba_subdivision.cage.CageWarning")


@pytest.fixture(params=["mixed torus", "cube", "no manifold, book of three", "no manifold, pole of quads"])
def cage(request):
    manifolds = {"mixed torus": mixed_torus, "cube": named_cages.cube}
    return manifolds[request.param]() if request.param in manifolds else SURFACES[request.param]


def test_every_edge_is_there_once_and_triangles_cover_the_faces(cage):
    faces = polygons(cage.topology)
    expected = {tuple(sorted((face[i - 1], face[i]))) for face in faces for i in range(len(face))}
    assert sorted(map(tuple, cage.edges.tolist())) == sorted(expected)
    assert [(b, a) for a, b in cage.edges.tolist()] == sorted((b, a) for a, b in expected)
    triangles = [(face[0], face[i], face[i + 1]) for face in faces for i in range(1, len(face) - 1)]
    np.testing.assert_array_equal(cage.triangles, triangles)


def test_points_of_refined_edges_come_in_the_order_of_the_edges():
    cage = mixed_torus()
    step = cage.refinement()
    points = step.matrix[cage.vertex_count :][: len(cage.edges)]
    rows, columns = np.repeat(np.arange(len(cage.edges)), 2), cage.edges.ravel()
    others = points.toarray()
    ends = others[rows, columns]
    others[rows, columns] = 0
    assert (ends.reshape(-1, 2).min(axis=1) > others.max(axis=1)).all()


def test_the_laplacian_is_the_sum_of_squares_along_edges(cage, np_rng):
    laplacian = cage.laplacian()
    assert laplacian.format == "csr"
    assert (laplacian != laplacian.T).nnz == 0
    values = np_rng.standard_normal(cage.vertex_count)
    squares = ((values[cage.edges[:, 0]] - values[cage.edges[:, 1]]) ** 2).sum()
    assert abs(values @ laplacian @ values - squares) <= ROUNDING * squares
    assert np.abs(laplacian.sum(axis=1)).max() == 0


def test_edges_of_many_vertices():
    """Numbers of pairs of vertices are beyond 32 bits from 46,341 vertices on."""
    cage = torus(230, 210)
    t = cage.topology
    ends = np.stack([t.face_vertices, t.face_vertices[t.next]], axis=1)[t.edge_half_edge]
    expected = np.sort(ends, axis=1)
    np.testing.assert_array_equal(cage.edges, expected[np.lexsort(expected.T)])
