import numpy as np
import pytest
from mitsuba_subdivision.mesh import ragged
from mitsuba_subdivision.mesh.one_ring import RingTable, one_ring
from mitsuba_subdivision.mesh.signature import Fan, Signature, signatures_at
from patches.closed_cages import CLOSED_CAGES, cube_with_valence_2, polygons, torus
from reference.exact_samples import mesh_of
from reference.refined_cages import sheet, tagged

pytestmark = pytest.mark.core

# Two polygons back to back: every vertex has valence 2, and the faces share all their edges.
PILLOWS = {f"pillow {n}": mesh_of(n, [range(n), range(n - 1, -1, -1)]) for n in (3, 4, 5)}
TOPOLOGIES = {name: make().topology for name, make in CLOSED_CAGES.items()} | PILLOWS


def signature_at(topology, half_edge, kind):
    return signatures_at(topology, np.array([half_edge]), kind)[0]


def half_edges_of(topology, most=40):
    count = topology.half_edge_count
    return np.unique(np.linspace(0, count - 1, min(count, most)).astype(int)).tolist()


def by_name(topologies):
    return pytest.mark.parametrize("topology", topologies.values(), ids=topologies)


WITH_SHEETS = TOPOLOGIES | {"sheet": sheet(3, 2).topology, "triangle sheet": sheet(3, 2, triangles=True).topology}
EVERY_KIND = pytest.mark.parametrize("kind", ["face", "vertex"])


def gathered(ring, topology, half_edges):
    table = RingTable(topology, [ring], np.array(half_edges), np.array([len(half_edges)]))
    index = np.arange(len(half_edges))
    (some,) = table.vertices_of(0 * index, index)
    np.testing.assert_array_equal(table.vertices.reshape(-1, len(half_edges)).T, some)
    return some


def element_vertices(topology, half_edge, kind):
    face = polygons(topology)[topology.face[half_edge]]
    turn = half_edge - topology.face_offsets[topology.face[half_edge]]
    turned = face[turn:] + face[:turn]
    return turned if kind == "face" else turned[:1]


@by_name(TOPOLOGIES)
@EVERY_KIND
def test_signature_lists_the_faces_around_each_corner_and_the_local_mesh_has_it(topology, kind):
    faces = polygons(topology)
    for half_edge in half_edges_of(topology):
        signature = signature_at(topology, half_edge, kind)
        assert signature.kind == kind
        assert signature_at(one_ring(signature).topology, 0, kind) == signature
        corners = element_vertices(topology, half_edge, kind)
        assert len(signature.fans) == len(corners)
        assert [fan.face_count for fan in signature.fans] == [sum(v in f for f in faces) for v in corners]
        for fan, vertex in zip(signature.fans, corners, strict=True):
            assert fan.ahead[0] == len(faces[topology.face[half_edge]])
            assert sorted(fan.ahead) == sorted(len(f) for f in faces if vertex in f)


@by_name(TOPOLOGIES)
@EVERY_KIND
def test_gathered_ring_is_a_map_of_meshes(topology, kind):
    """The element comes first; local faces land on faces, and local edges on edges between the same faces."""
    starts = zip(topology.face.tolist(), topology.face_vertices.tolist(), strict=True)
    half_edge_of = {start: half_edge for half_edge, start in enumerate(starts)}
    faces = {}
    for index, face in enumerate(polygons(topology)):
        faces |= {face[i:] + face[:i]: index for i in range(len(face))}
    for half_edge in half_edges_of(topology):
        ring = one_ring(signature_at(topology, half_edge, kind))
        controls, local = gathered(ring, topology, [half_edge])[0], ring.topology
        element = element_vertices(topology, half_edge, kind)
        assert tuple(controls[: len(element)]) == element
        assert tuple(local.face_vertices[: len(element)]) == tuple(range(len(element)))
        landed = [faces[tuple(int(v) for v in controls[list(face)])] for face in polygons(ring.topology)]
        places = zip(local.face, local.face_vertices, strict=True)
        image = np.array([half_edge_of[landed[f], controls[v]] for f, v in places])
        assert image[0] == half_edge
        inner = np.flatnonzero(local.twin >= 0)
        np.testing.assert_array_equal(topology.twin[image[inner]], image[local.twin[inner]])


@by_name(WITH_SHEETS)
@EVERY_KIND
def test_many_elements_gather_the_rings_of_single_ones(topology, kind, monkeypatch):
    monkeypatch.setattr(ragged, "CHUNK_LENGTH", 3)
    classes = {}
    for half_edge, signature in enumerate(signatures_at(topology, np.arange(topology.half_edge_count), kind)):
        classes.setdefault(signature, []).append(half_edge)
    for signature, members in classes.items():
        ring = one_ring(signature)
        alone = [gathered(ring, topology, [member])[0] for member in members]
        assert alone[0].shape == (ring.vertex_count,)
        np.testing.assert_array_equal(gathered(ring, topology, members), alone)


@pytest.mark.parametrize("sharpness", [9.99, 10.0, 20.0])
def test_corners_of_sharpness_ten_are_not_semi_sharp(sharpness):
    """Beside a crease that is, in a face that does not see it."""
    cage = tagged(torus(5, 6), corners=[(0, sharpness)], creases=[(13, 14, 1.0)])
    at_corner, at_crease = (signature_at(cage.cut_mesh.topology, 4 * face, "face") for face in (0, 13))
    assert at_crease.is_semi_sharp
    assert at_corner.is_semi_sharp == (sharpness < 10)


def test_a_face_is_the_same_from_both_ends_of_its_edge():
    # The triangle has two edges in common with the element; its third leads to the same face from either end.
    topology = cube_with_valence_2(beside_triangle=True).topology
    (a, _, c, d), triangle, beyond = polygons(topology)[:3]
    assert (triangle, beyond[:2]) == ((a, d, c), (a, c))
    # All but the bottom of the cube, each once.
    assert one_ring(signature_at(topology, 0, "face")).topology.face_count == 7


def test_a_face_is_named_by_the_first_walk_that_arrives_there():
    """Around a quadrilateral amid others, as the drawing at `_glued_rings` has them."""
    ring = one_ring(Signature("face", (Fan((4,) * 4),) * 4))
    arrivals = ((0, 0), (0, 1), (0, 2), (0, 3), (1, 2), (1, 3), (2, 2), (2, 3), (3, 2))
    assert [4 * face for face in range(9)] == [ring.around[corner][turns] for corner, turns in arrivals]
    below, right = (list(ring.topology.face_vertices.reshape(-1, 4)[face]) for face in (3, 5))
    assert {0, 1} <= {*below}
    assert {1, 2} <= {*right}
