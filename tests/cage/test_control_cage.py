import dataclasses
from collections import Counter
from functools import cached_property
from itertools import islice

import mitsuba
import numpy as np
import pytest
from mitsuba_subdivision.cage import Attribute, CageError, ControlCage, cage_of
from mitsuba_subdivision.cage.contents import RULES, CageContents, same
from mitsuba_subdivision.cage.named_cages import cube, extraordinary
from patches.closed_cages import mixed_torus, polygons, torus
from peers.fidelity_cages import SURFACES, edges_of
from reference.refined_cages import tagged
from scipy.spatial import cKDTree


def assert_same(cage, other):
    np.testing.assert_array_equal(cage.positions, other.positions)
    np.testing.assert_array_equal(cage.face_sizes, other.face_sizes)
    np.testing.assert_array_equal(cage.face_vertices, other.face_vertices)


def test_all_forms_of_faces_agree():
    positions, faces = cube().positions, cube().face_vertices.reshape(-1, 4)
    cage = ControlCage(positions, faces)
    assert_same(cage, ControlCage(positions.tolist(), faces.tolist()))
    assert_same(cage, ControlCage(positions.astype(np.float32), [tuple(face) for face in faces]))
    for kind in (np.int8, np.uint16, np.int32, np.uint32, np.int64, np.uint64):
        assert_same(cage, ControlCage(positions, faces.astype(kind)))
    assert_same(cage, ControlCage.from_arrays(positions, [4] * 6, faces.ravel()))
    assert (cage.vertex_count, cage.face_count) == (8, 6)
    assert cage.positions.dtype == np.float64
    assert (cage.face_sizes.dtype, cage.face_vertices.dtype) == (np.int64, np.int32)
    mixed = ControlCage(np.zeros((5, 3)), [[0, 1, 2, 3], (1, 0, 4)])
    np.testing.assert_array_equal(mixed.face_sizes, [4, 3])
    np.testing.assert_array_equal(mixed.face_vertices, [0, 1, 2, 3, 1, 0, 4])


def test_cages_are_immutable_and_compare_by_identity():
    cage, other = cube(), cube()
    for name in ("positions", "topology", "source"):
        with pytest.raises(dataclasses.FrozenInstanceError):
            setattr(cage, name, None)
    for array in (cage.positions, cage.face_sizes, cage.face_vertices):
        with pytest.raises(ValueError, match="read-only"):
            array[0] = 1
    alias = cage
    assert cage == alias
    assert cage != other
    assert len({cage, alias, other}) == 2
    assert repr(cage) == "ControlCage(cube, 8 vertices, 6 faces)"


def test_inputs_are_copied():
    positions, sizes, vertices = np.eye(3), np.array([3]), np.array([0, 1, 2])
    cage = ControlCage.from_arrays(positions, sizes, vertices)
    positions[:], sizes[:], vertices[:] = 7, 7, 7
    assert_same(cage, ControlCage(np.eye(3), [[0, 1, 2]]))
    # Those of attributes are when a cage takes them, and not before.
    values = np.zeros((8, 2))
    attribute = Attribute(values)
    assert attribute.values is values
    cage = tagged(cube(), texcoords=attribute)
    values[:] = 7
    np.testing.assert_array_equal(cage.texcoords.values, 0)


class NamedCage(ControlCage):
    label: str = "none"

    @cached_property
    def middle(self):
        return self.positions.mean(axis=0)


def test_new_positions_keep_class_and_topology_but_no_cached_values():
    cage = NamedCage.from_arrays(cube().positions, cube().topology.face_sizes, cube().face_vertices)
    given = set(vars(cage))
    assert len(cage.cut_mesh.topology.face_sizes) == 6
    np.testing.assert_array_equal(cage.middle, 0)
    moved = cage.with_positions(2 * cage.positions)
    assert type(moved) is NamedCage
    assert moved.label == "none"
    assert set(vars(moved)) == given
    assert moved.topology is cage.topology
    assert moved.source is cage.source
    np.testing.assert_array_equal(moved.positions, 2 * cage.positions)
    assert not moved.positions.flags.writeable
    with pytest.raises(CageError, match="7 new positions; expected 8"):
        cage.with_positions(np.zeros((7, 3)))
    with pytest.raises(CageError, match=r"vertex 5 has the coordinates .*nan"):
        cage.with_positions(np.where(np.arange(24).reshape(8, 3) == 16, np.nan, 0))


def test_properties_are_mitsuba_tensors():
    mi, cage = mitsuba.scalar_rgb, torus(3, 4)
    properties = cage.as_properties(mi)
    types = {"positions": mi.TensorXd, "face_sizes": mi.TensorXu, "face_vertices": mi.TensorXu}
    assert {name: type(properties[name]) for name in types} == types
    assert_same(ControlCage.from_arrays(**properties), cage)


def test_bare_arrays_have_a_row_for_each_vertex(np_rng):
    values = np_rng.random((8, 2))
    for array in (values, values.tolist()):
        cage = tagged(cube(), texcoords=array, attributes={"pair": array})
        for attribute in (cage.texcoords, cage.attributes["pair"]):
            assert attribute.interpolation == "vertex"
            np.testing.assert_array_equal(attribute.values, values)


@pytest.mark.parametrize("values", [[[0, 1], [2, 3]], ((0.0, 1.0),), np.zeros((2, 2), np.float32), "uv", [[1], [2, 3]]])
def test_values_and_indices_of_attributes_are_arrays(values):
    attribute = Attribute(values, "face_varying", [0, 1])
    assert isinstance(attribute.values, np.ndarray)
    assert isinstance(attribute.indices, np.ndarray)
    assert Attribute(values).indices is None


def named(**attributes):
    return {"attributes": attributes}


RAGGED = Attribute(np.zeros((2, 1)), "face_varying", [[0, 1], [0]])
# More indices than corners, which would take 800 GB if they were copied.
MANY = Attribute([[0, 0]], "face_varying", np.broadcast_to(0, 10**11))


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"texcoords": np.zeros((24, 2))}, 'attribute "texcoords" has 24 values; expected 8, one per vertex'),
        ({"texcoords": np.zeros((8, 3))}, r'attribute "texcoords" has values of shape \(8, 3\); expected \(n, 2\)'),
        ({"texcoords": "uv"}, 'attribute "texcoords" has values that are no table of numbers'),
        ({"attributes": [1]}, r"attributes are \[1\]; expected a dict of attributes by name"),
        (named(age=Attribute([[1], [2, 3]])), '"age" has values that are no table of numbers: .*inhomogeneous'),
        (named(age=RAGGED), 'attribute "age" has indices of .*; expected 24 integers, one per face'),
        (named(texcoords=np.zeros((8, 2))), 'control cage: an attribute is called "texcoords"; expected another name'),
        ({"texcoords": MANY}, r"indices of shape \(100000000000,\).*; expected 24 integers"),
    ],
)
def test_malformed_attributes_are_errors_with_their_names(options, message):
    with pytest.raises(CageError, match=message):
        tagged(cube(), **options)


def test_a_cage_from_its_contents_is_equal(np_rng):
    base = extraordinary(5, closed=False)
    indices = np_rng.integers(7, size=len(base.face_vertices))
    values = {"texcoords": Attribute(np_rng.random((7, 2)), "face_varying", indices)}
    values["attributes"] = {"weight": np_rng.random((base.vertex_count, 1))}
    tags = {"creases": [(0, 1, 0.3), (0, 2, 12)], "corners": [(3, 1 / 3)], "holes": [4, 2]}
    rules = {rule: values[-1] for rule, values in RULES.items()}
    cage = tagged(base, **tags, **values, **rules, scheme="loop")
    again = cage_of(cage.contents)
    assert same(again.contents, cage.contents)
    assert same(again.tags, cage.tags)
    assert again.source == cage.source
    assert {rule: getattr(again, rule) for rule in RULES} == rules
    box = cube()
    cage = cage_of(CageContents(box.positions, box.face_sizes, box.face_vertices))
    assert {rule: getattr(cage, rule) for rule in RULES} == {rule: values[0] for rule, values in RULES.items()}
    assert (cage.scheme, cage.texcoords, cage.attributes, len(cage.holes)) == (None, None, {}, 0)
    assert not cage.tags.any
    assert cage.source.name == "control cage"


ROUNDING = 1e-12
cut_anywhere = pytest.mark.filterwarnings("ignore::mitsuba_subdivision.cage.CageWarning")


@pytest.fixture(params=["mixed torus", "cube", "no manifold, book of three", "no manifold, pole of quads"])
def cage(request):
    manifolds = {"mixed torus": mixed_torus, "cube": cube}
    return manifolds[request.param]() if request.param in manifolds else SURFACES[request.param]


def uncancelled(sides):
    return Counter(sides) - Counter((end, start) for start, end in sides)


@cut_anywhere
def test_every_edge_is_there_once_and_triangles_cover_the_faces(cage):
    faces = polygons(cage.topology)
    expected = {tuple(sorted((face[i - 1], face[i]))) for face in faces for i in range(len(face))}
    assert sorted(map(tuple, cage.edges.tolist())) == sorted(expected)
    assert [(b, a) for a, b in cage.edges.tolist()] == sorted((b, a) for a, b in expected)
    # Of the sides of a face's triangles, its edges are left where opposite ones, the diagonals, cancel.
    triangles = iter(cage.triangles.tolist())
    for face in faces:
        sides = [side for triangle in islice(triangles, len(face) - 2) for side in edges_of(triangle)]
        assert uncancelled(sides) == uncancelled(edges_of(face))
    assert not list(triangles)


def test_points_of_refined_edges_come_in_the_order_of_the_edges():
    cage = mixed_torus()
    points = cage.refinement().matrix[cage.vertex_count :][: len(cage.edges)]
    rows, columns = np.repeat(np.arange(len(cage.edges)), 2), cage.edges.ravel()
    others = points.toarray()
    ends = others[rows, columns]
    others[rows, columns] = 0
    assert (ends.reshape(-1, 2).min(axis=1) > others.max(axis=1)).all()


@cut_anywhere
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


VALENCES = [3, 4, 5, 6, 8, 13, 40]


def test_less_than_three_faces_around_a_vertex_are_an_error():
    with pytest.raises(CageError, match="valence 2; expected at least 3"):
        extraordinary(2)


@pytest.mark.parametrize("valence", VALENCES)
def test_extraordinary_is_a_closed_convex_symmetric_ball_of_these_valences(valence):
    cage = extraordinary(valence)
    np.testing.assert_allclose(np.linalg.norm(cage.positions, axis=1), 1)
    corners = cage.positions[cage.face_vertices.reshape(-1, 4)]
    before, after = np.roll(corners, 1, axis=1), np.roll(corners, -1, axis=1)
    # As seen from outside; around the origin, the ball is star-shaped.
    assert (np.einsum("fki,fki->fk", corners, np.cross(corners - before, after - corners)) > 0).all()
    expected = Counter([valence] * 2 + [3] * (2 * valence))
    expected[4] += cage.vertex_count - 2 - 2 * valence
    assert Counter(cage.topology.vertex_face_count.tolist()) == expected
    angle = 2 * np.pi / valence
    turned = cage.positions @ [[np.cos(angle), np.sin(angle), 0], [-np.sin(angle), np.cos(angle), 0], [0, 0, 1]]
    for image in (turned, cage.positions * [1, 1, -1], cage.positions * [1, -1, 1]):
        assert cKDTree(cage.positions).query(image)[0].max() < 1e-12


@pytest.mark.parametrize("closed", [True, False])
@pytest.mark.parametrize("valence", VALENCES)
def test_pole_is_isolated_and_numbered_first(valence, closed):
    cage = extraordinary(valence, closed=closed)
    topology = cage.topology
    np.testing.assert_array_equal(cage.positions[0], [0, 0, 1])
    assert (cage.face_vertices.reshape(-1, 4)[:valence, 0] == 0).all()
    np.testing.assert_array_equal(topology.turn[4 * np.arange(valence)], 4 * np.roll(np.arange(valence), -1))
    # Without its lower half, it has one boundary, above the equator.
    assert (topology.twin < 0).sum() == (0 if closed else 6 * valence)
    assert (cage.positions[:, 2].min() > 0) == (not closed)
