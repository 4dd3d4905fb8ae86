"""Cages that are no oriented manifolds. `tests/peers` compares their surfaces with OpenSubdiv's."""

import re
import warnings

import mitsuba_subdivision as msub
import numpy as np
import pytest
from fuzz import topologies
from mitsuba_subdivision.cage import CageError, CageWarning, ControlCage
from mitsuba_subdivision.cage.named_cages import cube
from mitsuba_subdivision.mesh import manifold
from mitsuba_subdivision.mesh.connectivity import VertexRule
from patches.closed_cages import polygons, tetrahedron, torus
from peers.fidelity_cages import MODES, book, fan, joined, strip
from reference.exact_samples import faces_of, mesh_of
from reference.non_manifold import NonManifoldParts
from reference.refined_cages import changed, sheet, tagged

pytestmark = [pytest.mark.core, pytest.mark.filterwarnings("ignore::mitsuba_subdivision.cage.CageWarning")]


def cage_of(faces, **options):
    return ControlCage(np.random.default_rng(1).random((1 + max(map(max, faces)), 3)), faces, **options)


def rules(cage, vertex):
    """Of the copies of a vertex on the surface."""
    cut = cage.cut_mesh
    return [VertexRule(int(rule)) for rule in cut.topology.vertex_rules[cut.vertex == vertex]]


def test_manifold_cages_do_not_warn():
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        for cage in (cube(), tetrahedron(), torus(5, 4), fan(5), strip(2)):
            assert changed(cage, strict=True).non_manifold is None


def test_pages_are_creased_along_their_spine_with_corners_at_its_ends_and_creases():
    cage, creased = book(3), book(3, creases=[(1, 5, 10)])
    assert rules(cage, 0) == 3 * [VertexRule.CORNER]
    assert set(rules(creased, 1)) == {VertexRule.CORNER}
    assert rules(cage, 1) == rules(creased, 2) == 3 * [VertexRule.AUTOMATIC]
    assert np.array_equal(np.flatnonzero(cage.non_manifold.is_vertex), [0, 1, 2, 3])
    assert np.array_equal(np.flatnonzero(cage.non_manifold.is_crease), [1, 2])


@pytest.mark.parametrize("spokes", [[], [1], [2], [11], [13], [1, 3], [3, 5], [11, 13, 1], [12, 3]], ids=str)
def test_fans_that_share_a_vertex_are_separate(spokes):
    cage = joined(fan(5), fan(6), {0: 0}, creases=[(0, spoke, 10) for spoke in spokes])
    cut = cage.cut_mesh.topology
    assert set(rules(cage, 0)) == {VertexRule.CORNER}
    assert (cut.vertex_face_count > 0).all()
    corners = np.flatnonzero(cage.face_vertices == 0)
    of_fan = [set(cut.face_vertices[of_one].tolist()) for of_one in np.split(corners, [5])]
    assert of_fan[0].isdisjoint(of_fan[1])
    # Each crease at the vertex makes one more copy of its fan than the first.
    for copies_of_fan, first in zip(of_fan, (range(1, 6), range(11, 17)), strict=True):
        assert len(copies_of_fan) == max(1, sum(spoke in first for spoke in spokes))


def turned_over(cage, faces):
    return [face[:: -1 if f in faces else 1].tolist() for f, face in enumerate(faces_of(cage))]


def volume(cage):
    t = msub.LimitSurface(cage).tessellate(2)
    a, b, c = (t.positions[t.triangles[:, corner]] for corner in range(3))
    return np.einsum("ij,ij", a, np.cross(b, c)) / 6


@pytest.mark.parametrize("faces", [{1}, {0, 4}, {2, 3}])
def test_faces_against_their_neighbours_are_turned(faces):
    named = ", ".join(str(face) for face in sorted(faces))
    with pytest.warns(CageWarning, match=rf"{len(faces)} of 6 faces turned over.*faces? {named} \(numbers"):
        cage = ControlCage(cube().positions, turned_over(cube(), faces))
    assert cage.non_manifold is None
    assert volume(cage) == pytest.approx(volume(cube()), rel=1e-12)


def test_the_fewest_faces_of_each_piece_are_turned():
    one, count = torus(5, 4), torus(5, 4).face_count
    other = np.vstack([one.positions, one.positions + 5])
    second = np.array(turned_over(one, set(range(count)) - {2})) + one.vertex_count
    faces = [*turned_over(one, {3, 7}), *second.tolist()]
    cage = ControlCage(other, faces)
    assert cage.non_manifold is None
    changed = (cage.face_vertices.reshape(-1, 4) != np.array(faces)).any(axis=1)
    assert np.array_equal(np.flatnonzero(changed), [3, 7, count + 2])


def test_data_at_the_corners_of_turned_faces_stays_at_their_vertices():
    plain = cube()
    values, faces = np.random.default_rng(2).random((8, 2)), turned_over(plain, {1, 5})
    indices = np.concatenate(faces), plain.face_vertices
    given, at_vertices = (msub.Attribute(values, "face_varying", corners) for corners in indices)
    cage, whole = ControlCage(plain.positions, faces, texcoords=given), tagged(plain, texcoords=at_vertices)
    assert np.array_equal(cage.texcoords.indices, cage.face_vertices)
    for face in range(6):
        corner = plain.face_vertices[4 * face :][:4].tolist().index(cage.face_vertices[4 * face])
        uv = np.array([[0.0, 0.0], [0.3, 0.3]])
        ours = msub.LimitSurface(cage).evaluate_attribute("texcoords", face, uv)
        theirs = msub.LimitSurface(whole).evaluate_attribute("texcoords", face, uv, corner)
        np.testing.assert_allclose(ours, theirs, atol=1e-14)


@pytest.mark.parametrize(
    "faces",
    [
        # Two sheets that share a pole, where each face has an edge from the pole to itself.
        [[0, 0, 1, 2], [1, 3, 4, 2], [3, 5, 6, 4], [0, 0, 7, 8], [7, 9, 10, 8], [9, 11, 12, 10]],
        [[0, 0, 1], [0, 0, 2]],
        [[0, 1, 2, 0, 1, 3], [1, 0, 4]],
    ],
)
def test_faces_that_share_no_edge_are_not_turned(faces):
    assert np.array_equal(cage_of(faces).face_vertices, np.concatenate(faces))


@pytest.mark.parametrize("collapsed", [{1: 0}, {1: 0, 2: 0}])
def test_a_face_beside_a_pole_is_turned(collapsed):
    faces = [[collapsed.get(vertex, vertex) for vertex in face] for face in polygons(sheet(4, 4).topology)]
    turned = cage_of([*faces[:-1], [faces[-1][0], *faces[-1][:0:-1]]])
    assert np.array_equal(turned.face_vertices, np.concatenate(faces))


def test_only_faces_that_can_agree_are_turned_and_edges_between_the_others_are_sharp():
    cage, beside = strip(1), joined(strip(1), sheet(6, 6), {0: 2, 1: 4})
    assert np.array_equal(np.flatnonzero(cage.non_manifold.is_vertex), [0, 1])
    faces = [face[:: -1 if f == 27 else 1] for f, face in enumerate(polygons(beside.topology))]
    for twisted in (cage, beside, ControlCage(beside.positions, faces)):
        assert twisted.non_manifold.is_edge.sum() == 2


def test_fans_beside_a_spine_are_corners():
    # A closed fan, and a page that comes back to its own side of the spine.
    coming_back = [*polygons(book(3).topology), [1, 2, 28, 29], [2, 1, 30, 31], [1, 29, 28, 30]]
    for cage in (joined(book(3), fan(5), {0: 1}), cage_of(coming_back)):
        assert set(rules(cage, 1)) == {VertexRule.CORNER}


def test_thousands_of_fans_are_not_compared_pairwise():
    """Semi-sharp edges of one fan do not matter to the copies of the vertex that the others have: these are corners."""
    ring = np.arange(1, 18_001).reshape(-1, 6)
    faces = np.concatenate([np.c_[0 * ring[:, 0], ring[:, [i, i + 1, (i + 2) % 6]]] for i in (0, 2, 4)])
    cage = cage_of(faces.tolist(), creases=[(0, first, 1.5) for first in ring[:, 0]])
    assert len(cage.cut_mesh.topology.semi_sharpness.across_vertex) == 0


def test_boundary_none_keeps_faces_at_edges_of_many_faces():
    assert not joined(cube(), cube(), {0: 7, 1: 6}, boundary="none").is_hole.any()
    # Of the pages' faces only those in the middle beside the spine touch no open edge; they do touch its ends.
    assert book(3, boundary="none").is_hole.sum() == 15


def test_the_first_ones_are_named():
    with pytest.warns(CageWarning) as record:
        cage_of([[0, 1, 2], [1, 0, 3], [0, 1, 4], [5, 6, 6], [2, 7, 8]])
    assert [str(warning.message) for warning in record] == [
        "control cage: the faces are no manifold: 1 edge of more than two faces, or of two in one direction (edge (0, "
        "1)); 1 vertex between separate fans (vertex 2); 1 face with a vertex more than once (face 3). Such edges are "
        "infinitely sharp, and such vertices are corners or lie on creases along these edges, as in OpenSubdiv; strict "
        "makes this an error (numbers count from 0)"
    ]
    assert record[0].filename == __file__


def test_messages_name_three_of_a_kind_and_edges_of_one_face_apart():
    spines = [[2 * k, 2 * k + 1, 8 + 3 * k + page] for k in range(4) for page in range(3)]
    for count, more in ((3, ""), (4, ", ...")):
        with pytest.warns(CageWarning) as record:
            cage_of([[20, 21, 21], *spines[: 3 * count]])
        message, names = str(record[0].message), f"edge (0, 1), edge (2, 3), edge (4, 5){more}"
        assert f"{count} edges of more than two faces, or of two in one direction ({names}); 1 face with" in message
        assert "more than once (face 0)" in message
        # Both ends of such an edge are no fans.
        assert "fans" not in message


def test_strict_cages_are_manifolds(tmp_path):
    path, cage = tmp_path / "book.obj", book(3)
    cage.save(path)
    with pytest.raises(CageError, match=re.escape('book.obj", line 30: face 1 is one of 3 at edge (1, 2)')):
        ControlCage.from_file(path, strict=True)
    with pytest.warns(CageWarning, match="no manifold"):
        again = ControlCage.from_file(path)
    assert np.array_equal(again.face_vertices, cage.face_vertices)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        again.with_positions(again.positions + 1)
    with pytest.raises(CageError, match="strict is 'no'; expected True or False"):
        ControlCage(cube().positions, [[0, 1, 2]], strict="no")


def test_each_fan_at_a_shared_vertex_has_its_own_surface_under_doo_sabin():
    surface = msub.LimitSurface(joined(fan(4), fan(5), {0: 0}), "doo_sabin")
    assert np.isfinite(surface.tessellate(3).positions).all()
    assert surface.patches.patch_count == 1 + 5


@pytest.mark.parametrize(("triangles", "mode"), [*((False, m) for m in MODES[:5]), *((True, m) for m in MODES[2:5:2])])
def test_values_that_differ_along_the_spine_of_pages_stay(triangles, mode, np_rng):
    """Each page's values are the surface of the page alone, with corners at both ends of every edge that is torn."""
    pages, spine, scheme = 3, 4, "loop" if triangles else "catmull_clark"
    cage = book(pages, triangles=triangles)
    corners, page = np.array(polygons(cage.topology)), np.repeat(np.arange(pages), cage.face_count // pages)
    held_once = set()
    for apart in ((0,), (1,), (2, 3), ()):
        # At these vertices of the spine the first page has rows of its own.
        indices = corners + np.where(np.isin(corners, apart) & (page == 0)[:, None], cage.vertex_count, 0)
        values = np_rng.random((2 * cage.vertex_count, 3))
        data = msub.Attribute(values, "face_varying", indices.ravel())
        surface = msub.LimitSurface(changed(cage, attributes={"a": data}, face_varying=mode))
        held = {0, spine - 1, *(vertex for a in apart for vertex in (a - 1, a, a + 1) if 0 <= vertex < spine)}
        held_once |= held
        for faces in (np.flatnonzero(page == k) for k in range(pages)):
            rows, corner_rows = np.unique(indices[faces], return_inverse=True)
            vertex = dict(zip(corner_rows.ravel().tolist(), corners[faces].ravel().tolist(), strict=True))
            alone = ControlCage(values[rows], corner_rows.reshape(len(faces), -1))
            is_linear = alone.topology.is_border_vertex if mode == "boundaries" else np.zeros(len(rows), dtype=bool)
            fixed = [(row, 10) for row, v in vertex.items() if v in held or (is_linear[row] and v >= spine)]
            alone = msub.LimitSurface(tagged(alone, corners=fixed), scheme)
            element, uv = np_rng.integers(0, len(faces), 40), np_rng.random((40, 2)) / 2
            evaluated = surface.evaluate_attribute("a", faces[element], uv)
            np.testing.assert_allclose(evaluated, alone.evaluate(element, uv).p, rtol=0, atol=1e-14)
    assert held_once == set(range(spine))


def random_faces(rng):
    """A manifold, two, pages that share a spine, or any faces; often with a face turned over, doubled or changed."""
    kind = rng.integers(4)
    if kind < 2:
        faces, _ = topologies.random_topology(rng)
        if kind:
            # A ball or a disc that touches it in a vertex, or is apart.
            faces += [tuple(100 + vertex for vertex in face) for face in topologies.SEEDS[rng.integers(4, 7)]]
            faces = topologies.identified(faces, 0, 100) if rng.random() < 0.8 else faces
    elif kind == 2:
        faces = polygons(book(int(rng.integers(2, 5))).topology)
    else:
        faces = [tuple(rng.integers(0, 7, rng.integers(3, 6)).tolist()) for _ in range(rng.integers(2, 9))]
    at = int(rng.integers(len(faces)))
    face, vertices = faces[at], sorted({vertex for face in faces for vertex in face})
    one, other = rng.choice(vertices, 2).tolist()
    changes = (
        faces,
        [*faces[:at], face[::-1], *faces[at + 1 :]],
        [*faces, face],
        [*faces, (*face[:2], max(vertices) + 1)],
        topologies.identified(faces, one, other),
        [*faces[:at], (*face, one), *faces[at + 1 :]],
    )
    return topologies.numbered(changes[rng.integers(len(changes))])


# In which every vertex and edge is what it is many times over.
RANDOM_MESHES = 300


def test_non_manifold_parts_follow_the_definition(np_rng):
    creases = closed_fans = manifolds = 0
    for _ in range(RANDOM_MESHES):
        faces = random_faces(np_rng)
        # With a vertex that no face uses.
        mesh, expected = mesh_of(2 + max(map(max, faces)), faces), NonManifoldParts(faces)
        is_manifold = not expected.vertices and all(len({*face}) == len(face) for face in faces)
        assert manifold.is_manifold(mesh) == is_manifold, faces
        manifolds += is_manifold
        separate, non_manifold = manifold.separated(mesh)
        assert (non_manifold is not None) == bool(expected.vertices), faces
        twins = np.full(mesh.half_edge_count, -1)
        twins[list(expected.twin)] = list(expected.twin.values())
        np.testing.assert_array_equal(separate.twin, twins)
        if non_manifold is None:
            continue
        assert set(np.flatnonzero(non_manifold.is_edge)) == expected.edges, faces
        assert set(np.flatnonzero(non_manifold.has_one_face)) == expected.own_edges, faces
        assert set(np.flatnonzero(non_manifold.is_vertex)) == expected.vertices, faces
        assert set(np.flatnonzero(non_manifold.is_crease)) == expected.creases, faces
        assert set(non_manifold.closed_fans) == expected.closed_fans, faces
        np.testing.assert_array_equal(non_manifold.is_corner, non_manifold.is_vertex & ~non_manifold.is_crease)
        assert len(np.unique(non_manifold.edge)) == mesh.edge_count
        creases += len(expected.creases)
        closed_fans += len(expected.closed_fans)
    assert min(creases, closed_fans, manifolds) > 10
