import _thread
import re
import time
import warnings

import numpy as np
import pytest
from mitsuba_subdivision import LimitSurface
from mitsuba_subdivision.cage import CageError, CageWarning, ControlCage
from mitsuba_subdivision.cage.errors import CageSource, in_digits, warn
from mitsuba_subdivision.cage.named_cages import cube
from mitsuba_subdivision.files.formats import warn_of_losses
from patches.closed_cages import tetrahedron, torus
from reference.refined_cages import sheet, tagged

POINTS = np.random.default_rng(1).random((9, 3))
NAN, INF = float("nan"), float("inf")


def raises(*parts):
    """Expect a CageError whose message has these parts in this order."""
    return pytest.raises(CageError, match=".*".join(re.escape(part) for part in parts))


@pytest.mark.parametrize(
    ("positions", "message"),
    [
        (np.zeros((4, 2)), ["positions have shape (4, 2)", "expected an (n, 3) array"]),
        (np.zeros(12), ["shape (12,)", "expected an (n, 3) array"]),
        ([], ["shape (0,)", "n > 0"]),
        (np.zeros((0, 3)), ["shape (0, 3)", "n > 0"]),
        ([["a", "b", "c"]], ["positions have type", "numbers"]),
        (np.zeros((4, 3), complex), ["positions have type complex128", "numbers"]),
        ([[0, 0, 0], [0, 0]], ["positions are not an array", "expected an (n, 3) array"]),
        ([[0, 0, 0], [0, NAN, 0], [INF, 0, 0]], ["vertex 1 has", "nan", "expected finite", "(2 such vertices"]),
        ([[0, 0, 0], [0, 0, 0], [0, 0, -INF]], ["vertex 2 has", "-inf", "expected finite", "(1 such vertex;"]),
    ],
)
def test_malformed_positions(positions, message):
    with raises("control cage: ", *message):
        ControlCage(positions, [[0, 1, 2]])


AT_MOST_TWO = ["expected a manifold", "at most 2", "(1 such edge;"]
TURNED = ["counter-clockwise from outside", "(1 such edge;"]
FOUR_FANS = [[0, 1, 2], [0, 3, 4], [0, 5, 6], [0, 7, 8]]
TETRAHEDRON = tetrahedron().face_vertices.reshape(-1, 3)
TETRAHEDRA = [*TETRAHEDRON, *np.where(TETRAHEDRON == 3, 3, TETRAHEDRON + 4)]


@pytest.mark.parametrize(
    ("faces", "message"),
    [
        *((none, ["no faces", "expected at least one"]) for none in ([], np.zeros((0, 4), int))),
        (np.arange(6), ["faces have shape (6,)", "expected an (f, k) array", "from_arrays"]),
        *((wrong, ["not sequences of vertex indices", "expected one sequence per face"]) for wrong in ([0, 1, 2], 3)),
        (["abc"], ["type <U1", "expected integers"]),
        ([[0, 1, None]], ["type object", "expected integers"]),
        ([[[0, 1], [1, 2], [2, 0]]], ["shape (3, 2)", "expected a flat array"]),
        ([[0, 1, 2], [2, 1, 3.5]], ["face 1 has the vertex index 3.5", "expected an integer", "(1 such index;"]),
        (np.array([[0.0, 1.0, 2.0]]), ["face 0 has the vertex index 0.0", "expected an integer", "(3 such indices;"]),
        ([[0, 1, NAN]], ["face 0 has the vertex index nan", "expected an integer"]),
        ([[0, 1, 2], [2, 1], []], ["face 1 has 2 vertices", "expected at least 3", "(2 such faces;"]),
        ([[0]], ["face 0 has 1 vertex;", "expected at least 3", "(1 such face;"]),
        ([[0, 1, 2], [2, 1, 9]], ["face 1 has the vertex index 9", "expected 0 to 8", "(1 such index", "count from 0"]),
        ([[0, -1, 2], [2, 1, 9]], ["face 0 has the vertex index -1", "expected 0 to 8", "(2 such"]),
        (np.array([[0, 1, 2**64 - 1]], np.uint64), [f"face 0 has the vertex index {2**64 - 1}", "expected 0 to 8"]),
        (np.array([[0, 1, 2], [3, 4, 3]], np.uint64), ["face 1 has vertex 3 more than once", "expected distinct"]),
        ([[0, 1, 2], [2, 1, 3, 1]], ["face 1 has vertex 1 more than once", "expected distinct", "(1 such face;"]),
        ([[0, 1, 2], [1, 0, 3], [0, 1, 4]], ["face 0 is one of 3 at edge (0, 1): faces 0, 1, 2", *AT_MOST_TWO]),
        ([[4, 5, 6], [0, 1, 2], [3, 0, 1]], ["face 1 and face 2 both run along edge (0, 1)", *TURNED]),
        ([[0, 1, 2], [0, 1, 2]], ["face 0 and face 1 both run along edge (0, 1)", "(3 such edges;"]),
        (FOUR_FANS[:2], ["vertex 0 joins 2 separate fans: face 0 | face 1; expected one fan", "(1 such vertex;"]),
        (FOUR_FANS[:3], ["vertex 0 joins 3 separate fans: face 0 | face 1 | face 2; expected one", "(1 such vertex;"]),
        (FOUR_FANS, ["vertex 0 joins 4 separate fans: face 0 | face 1 | face 2 | ...; expected one fan"]),
        (TETRAHEDRA, ["vertex 3 joins 2 separate fans: faces 0, 2, 3 | faces 4, 6, 7;", "(1 such vertex"]),
        ([*TETRAHEDRON, [3, 4, 5], [3, 5, 6]], ["vertex 3 joins 2 separate fans: faces 0, 2, 3 | faces 4, 5;"]),
    ],
)
@pytest.mark.filterwarnings("ignore::mitsuba_subdivision.cage.CageWarning")
def test_malformed_faces(faces, message):
    with raises("control cage: ", *message):
        ControlCage(POINTS, faces, strict=True)


@pytest.mark.parametrize("valence", [3, 4, 5, 8, 9, 100])
def test_vertex_of_any_valence_is_one_fan(valence):
    rim = np.arange(valence)
    cone = np.stack([rim, (rim + 1) % valence, np.full(valence, valence)], axis=1)
    positions = np.zeros((valence + 1, 3))
    for faces in (cone, cone[:-1], [*cone.tolist(), rim[::-1].tolist()]):
        ControlCage(positions, faces)
    if valence >= 4:
        with raises(f"vertex {valence} joins 2 separate fans"):
            ControlCage(positions, np.delete(cone, [0, 2], axis=0), strict=True)


def test_errors_of_a_file_name_lines_and_its_own_numbers():
    source = CageSource('"cube.obj"', 1, np.arange(1, 9), np.arange(11, 20))
    with raises('"cube.obj", line 12: face 2 has vertex 4 more than once', "numbers count from 1"):
        ControlCage(POINTS[:4], [[0, 1, 2], [3, 1, 3]], source=source, strict=True)
    with raises('"cube.obj", line 11: face 1 and face 2 (line 12) both run along edge (1, 2)'):
        ControlCage(POINTS[:4], [[0, 1, 2], [0, 1, 3]], source=source, strict=True)
    with raises('"cube.obj", line 2: vertex 2 has the coordinates'):
        ControlCage([[0, 0, 0], [NAN, 0, 0], [0, 0, 1]], [[0, 1, 2]], source=source, strict=True)
    with raises('"cube.obj", line 1: vertex 1 joins 2 separate fans: face 1 (line 11) | face 2 (line 12)'):
        ControlCage(POINTS[:5], [[0, 1, 2], [0, 3, 4]], source=source, strict=True)


def test_flat_arrays_must_agree():
    with raises("face_sizes add up to 7", "face_vertices has 6 entries"):
        ControlCage.from_arrays(POINTS, [3, 4], np.arange(6))
    with raises("face_sizes has type float64", "expected integers"):
        ControlCage.from_arrays(POINTS, [3.0], [0, 1, 2])
    with raises("face_vertices has shape (1, 3)", "expected a flat array"):
        ControlCage.from_arrays(POINTS, [3], [[0, 1, 2]])


def test_more_corners_or_vertices_than_can_be_numbered_are_an_error(monkeypatch):
    monkeypatch.setattr("mitsuba_subdivision.cage.validation.MOST_VERTICES", 3)
    with raises("tetrahedron: there are 4 vertices; expected at most 3"):
        tetrahedron()
    monkeypatch.setattr("mitsuba_subdivision.cage.validation.MOST_FACE_CORNERS", 11)
    with raises("tetrahedron: faces have 12 corners; expected at most 11"):
        tetrahedron()


def test_unused_vertices_are_one_warning():
    with pytest.warns(CageWarning, match=r"control cage: 1 of 4 vertices .* \(3; numbers count from 0\)") as record:
        ControlCage(POINTS[:4], [[0, 1, 2]])
    assert len(record) == 1
    assert record[0].filename == __file__
    with pytest.warns(CageWarning, match=r"7 of 10 vertices .* \(1, 3, 5, 6, 7, \.\.\.;") as record:
        cage = ControlCage(np.zeros((10, 3)), [[0, 2, 4]])
    assert len(record) == 1
    cage.with_positions(np.ones((10, 3)))


def test_tags_set_both_half_edges_only_and_the_last_one_counts():
    cage = tagged(cube(), creases=[(0, 1, 3), (6, 2, 20)], corners=[(7, 2.5)])
    t = cage.topology
    ends = np.sort(np.stack([t.face_vertices, t.face_vertices[t.next]]), axis=0).T
    expected = np.select([(ends == (0, 1)).all(axis=1), (ends == (2, 6)).all(axis=1)], [3.0, 10.0])
    assert np.count_nonzero(expected) == 4
    np.testing.assert_array_equal(cage.tags.edges, expected)
    np.testing.assert_array_equal(cage.tags.vertices, 2.5 * (np.arange(8) == 7))
    # An edge on a border has one half-edge only.
    for plain, count in ((cube(), 2), (sheet(2, 2), 1)):
        cage = tagged(plain, creases=[(0, 1, 3), (1, 0, 4), (0, 1, 5), (1, 0, 2)])
        assert cage.tags.edges[cage.tags.edges > 0].tolist() == [2] * count


def test_creases_of_large_cages_are_found():
    """From 46,341 vertices on, pairs of vertices need more than 32 bits."""
    plain = torus(256, 200)
    wanted = plain.face_vertices.reshape(-1, 4)[-3:, [0, 3]]
    cage = tagged(plain, creases=[(*edge, 10) for edge in wanted.tolist()])
    creased = np.sort(cage.tags.creases(cage.topology)[:, :2], axis=1)
    np.testing.assert_array_equal(np.unique(creased, axis=0), np.unique(np.sort(wanted, axis=1), axis=0))


def test_tags_are_read_only_and_constant_tags_take_no_memory():
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
def test_tags_without_a_face_are_ignored_with_a_warning(tags, message):
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


def test_warnings_name_the_file_of_the_caller():
    with pytest.warns(CageWarning, match="all of it") as record:
        warn_of_losses("cage.obj", {"all of it": True})
    assert record[0].filename == __file__


def test_a_thread_without_a_caller_can_warn(monkeypatch):
    # Mitsuba loads the shapes of a scene in such threads.
    shown = []
    with warnings.catch_warnings():
        warnings.simplefilter("always")
        monkeypatch.setattr(warnings, "showwarning", lambda message, *_place: shown.append(str(message)))
        _thread.start_new_thread(warn, ("odd",))
        end = time.monotonic() + 10
        while not shown and time.monotonic() < end:
            time.sleep(0.01)
    assert shown == ["odd"]


def test_numbers_have_all_their_digits():
    """Those just outside a range do not look as if they were within."""
    numbers = [5.0, 3, 1.000000001, np.float32(0.1), np.nan, 1e300, [1.000000001, 0.5], np.array([1, 2])]
    expected = ["5", "3", "1.000000001", "0.1", "nan", "1e+300", "(1.000000001, 0.5)", "(1, 2)"]
    assert [in_digits(number) for number in numbers] == expected
    with pytest.raises(ValueError, match=re.escape("uv of sample 0 is (1.000000001, 0.5); expected parameters in")):
        LimitSurface(cube()).evaluate([0], [[1.000000001, 0.5]])
    with pytest.raises(CageError, match="has sharpness -1e-09; expected 0"):
        tagged(cube(), creases=[(0, 1, -1e-9)])


def test_several_faces_are_numbered_from_zero_in_arrays_and_by_lines_in_files():
    array, file = CageSource(), CageSource('"cube.obj"', 1, np.array([2, 3]), np.array([5, 17]))
    assert (array.faces(np.array([2])), array.faces(np.arange(10))) == ("face 2", "faces 0, 1, 2, 3, 4, 5 and 4 more")
    assert file.faces(np.array([0, 1])) == "faces 1 (line 5), 2 (line 17)"
