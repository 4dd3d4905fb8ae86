"""OpenSubdiv's tags in OBJ files."""

from __future__ import annotations

import time

import numpy as np
import pytest
from mitsuba_subdivision import CageError, CageWarning, ControlCage
from mitsuba_subdivision.cage import rules
from mitsuba_subdivision.cage.named_cages import cube, extraordinary
from reference.exact_samples import faces_of

SHEET = "v 0 0 0\nv 1 0 0\nv 2 0 0\nv 0 1 0\nv 1 1 0\nv 2 1 0\nf 1 2 5 4\nf 2 3 6 5\n"


@pytest.fixture
def read(tmp_path):
    def read(text):
        path = tmp_path / "cage.obj"
        path.write_text(SHEET + text)
        return ControlCage.from_file(path)

    return read


def sharp_edges(cage):
    t = cage.topology
    sharp = t.edge_half_edge[cage.tags.is_infinite[t.edge_half_edge]]
    return sorted(
        tuple(sorted(edge)) for edge in np.stack([t.face_vertices[sharp], t.face_vertices[t.next[sharp]]], 1).tolist()
    )


def test_vertices_of_tags_count_from_0(read):
    cage = read("t crease 2/1/0 4 1 10\nt corner 1/1/0 2 10.0\n")
    assert sharp_edges(cage) == [(1, 4)]
    assert np.flatnonzero(cage.tags.is_corner).tolist() == [2]


def test_sharpness_0_is_smooth(read):
    cage = read("t crease 2/1/0 1 4 0\nt corner 1/1/0 1 0\n")
    assert not cage.tags.is_infinite.any()
    assert not cage.tags.is_corner.any()


# As OpenSubdiv's regression/common/far_utils.h reads them.
RULES = {
    "interpolateboundary 1/0/0 0": ("boundary", "none"),
    "interpolateboundary 1/0/0 1": ("boundary", "edge_and_corner"),
    "interpolateboundary 1/0/0 2": ("boundary", "edge_only"),
    "facevaryinginterpolateboundary 1/0/0 0": ("face_varying", "none"),
    "facevaryinginterpolateboundary 1/0/0 1": ("face_varying", "corners_only"),
    "facevaryinginterpolateboundary 1/0/0 2": ("face_varying", "corners_plus1"),
    "facevaryinginterpolateboundary 1/0/0 3": ("face_varying", "corners_plus2"),
    "facevaryinginterpolateboundary 1/0/0 4": ("face_varying", "boundaries"),
    "facevaryinginterpolateboundary 1/0/0 5": ("face_varying", "all"),
    "facevaryingpropagatecorners 1/0/0 1": ("face_varying", "corners_plus2"),
    "facevaryingpropagatecorners 1/0/0 0": ("face_varying", "corners_plus1"),
    "creasemethod 0/0/1 normal": ("crease_method", "uniform"),
    "creasemethod 0/0/1 chaikin": ("crease_method", "chaikin"),
    "smoothtriangles 0/0/1 catmark": ("triangle_rule", "catmull_clark"),
    "smoothtriangles 0/0/1 smooth": ("triangle_rule", "smooth"),
}


@pytest.mark.parametrize("tag", RULES)
def test_rules(read, tag):
    rule, value = RULES[tag]
    assert getattr(read(f"t {tag}\n"), rule) == value


def test_corners_propagate_with_their_rule_only(read):
    text = "t facevaryingpropagatecorners 1/0/0 1\nt facevaryinginterpolateboundary 1/0/0 {}\n"
    assert read(text.format(2)).face_varying == "corners_plus2"
    with pytest.warns(CageWarning, match='line 9: tag "facevaryingpropagatecorners" has no effect .* rule "all"'):
        assert read(text.format(5)).face_varying == "all"


def test_the_last_rule_counts(read):
    assert read("t interpolateboundary 1/0/0 0\nt interpolateboundary 1/0/0 2\n").boundary == "edge_only"


def test_tags_of_several_items(read):
    cage = read("t crease 4/1/0 1 4 0 1 2.5\nt crease 4/2/0 1 2 0 3 3 4\nt corner 2/1/0 0 2 1.5\n")
    found = {tuple(sorted(edge)): sharpness for *edge, sharpness in cage.contents.creases.tolist()}
    assert found == {(1, 4): 2.5, (0, 1): 2.5, (1, 2): 3, (0, 3): 4}
    assert cage.contents.corners.tolist() == [[0, 1.5], [2, 1.5]]


def test_holes_count_faces_from_0(read):
    assert read("t hole 1/0/0 1\n").holes.tolist() == [1]
    with pytest.raises(CageError, match="all 2 faces are holes"):
        read("t hole 2/0/0 1 0\n")
    with pytest.raises(CageError, match="hole 3 is no face; expected one of 2"):
        read("t hole 1/0/0 2\n")


def test_an_argument_overrides_the_boundary_rule(tmp_path):
    path = tmp_path / "cage.obj"
    path.write_text(SHEET + "t interpolateboundary 1/0/0 2\n")
    assert ControlCage.from_file(path, boundary="edge_and_corner").boundary == "edge_and_corner"


@pytest.mark.parametrize(
    "tag", ["odd 0/0/0", "faceedit 4/0/1 3 4 1 1 hole", "vertexedit 4/3/3 3 4 1 0 0 0 1 add P value"]
)
def test_a_warning_names_what_has_no_effect(read, tag):
    with pytest.warns(CageWarning, match=rf'cage.obj", line 9: tag "{tag}" is not supported and has no effect'):
        read(f"t {tag}\n")


def test_long_tags_are_cut_in_messages(read):
    with pytest.warns(CageWarning, match=r'line 9: tag "vertexedit 100/0/0 0 0 [ 0]*\.\.\." is not supported'):
        read(f"t vertexedit 100/0/0{' 0' * 100}\n")


@pytest.mark.parametrize(
    ("tag", "expected"),
    [
        ("interpolateboundary 1/0/0 3", "0, 1, 2"),
        ("facevaryinginterpolateboundary 1/0/0 6", "0, 1, 2, 3, 4, 5"),
        ("creasemethod 0/0/1 odd", "normal, chaikin"),
        ("smoothtriangles 0/0/1 normal", "catmark, smooth"),
    ],
)
def test_a_warning_names_unknown_values(read, tag, expected):
    with pytest.warns(CageWarning, match=rf'line 9: tag "{tag}" has an unknown value .* expected one of {expected}$'):
        read(f"t {tag}\n")


@pytest.mark.parametrize(
    ("tag", "message"),
    [
        ("crease 2/1/0 1 4", r'line 9: malformed tag "crease 2/1/0 1 4" \(2 values\); expected a name, counts'),
        (
            "crease 1/1/0 1 10",
            "line 9: tag crease has 1 integers and 1 floats; expected two integers per edge and a float",
        ),
        (
            "crease 4/3/0 1 4 0 1 1 2 3",
            "line 9: tag crease has 4 integers and 3 floats; expected two integers per edge",
        ),
        (
            "corner 1/0/0 1",
            "line 9: tag corner has 1 integers and 0 floats; expected one integer per vertex and a float",
        ),
        ("hole 0/0/0", "line 9: tag hole has 0 integers and 0 floats; expected one or more integers and no floats"),
        ("hole 1/1/0 1 2.0", "line 9: tag hole has 1 integers and 1 floats; expected one or more integers"),
        ("creasemethod 1/0/0 1", 'line 9: tag "creasemethod 1/0/0 1" has the wrong values; expected one string'),
        (
            "interpolateboundary 2/0/0 1 1",
            'line 9: tag "interpolateboundary .* has the wrong values; expected one integer',
        ),
        ("crease -1/1/0 10", "malformed tag"),
        ("crease 2/1/0 1 x 10", "malformed tag"),
        ("crease", r'line 9: malformed tag "crease"; expected a name, counts'),
        ("", r'line 9: malformed tag ""; expected a name, counts'),
        ("hole 2/0/0 1 7", "line 9: hole 8 is no face; expected one of 2 faces"),
        (
            "crease 2/1/0 1 4 -2.5",
            r'cage.obj", line 9: crease along edge \(2, 5\) has sharpness -2.5; expected 0 for smooth',
        ),
    ],
)
def test_wrong_tags_are_errors_that_say_where(read, tag, message):
    with pytest.raises(CageError, match=message):
        read(f"t {tag}\n")


@pytest.mark.parametrize(
    ("tag", "message"),
    [
        (
            "crease 4/1/0 0 4 1 4 10",
            r'cage.obj", line 9: crease along edge \(1, 5\), which is no edge of a face, is ign',
        ),
        ("corner 2/1/0 6 1 10", 'cage.obj", line 9: corner at vertex 7, which is none of 6 vertices, is ignored'),
    ],
)
def test_tags_of_what_no_face_has_are_ignored_and_told(read, tag, message):
    """As OpenSubdiv's Far::TopologyRefinerFactory does; the others of the statement count."""
    with pytest.warns(CageWarning, match=message):
        cage = read(f"t {tag}\n")
    assert sharp_edges(cage) == ([(1, 4)] if "crease" in tag else [])
    assert np.flatnonzero(cage.tags.is_corner).tolist() == ([] if "crease" in tag else [1])


@pytest.mark.core
@pytest.mark.parametrize(
    "rules",
    [
        {},
        {"boundary": "edge_only", "face_varying": "none", "crease_method": "chaikin", "triangle_rule": "smooth"},
        {"boundary": "none", "face_varying": "corners_plus2"},
        *({"face_varying": rule} for rule in ("corners_only", "boundaries", "all")),
    ],
)
def test_tags_survive_saving(tmp_path, rules):
    cage = extraordinary(5, closed=False)
    cage = ControlCage(
        cage.positions, faces_of(cage), creases=[(0, 1, 0.3), (0, 2, 12)], corners=[(3, 1 / 3)], holes=[4, 2], **rules
    )
    cage.save(tmp_path / "cage.obj")
    again = ControlCage.from_file(tmp_path / "cage.obj")
    assert np.array_equal(again.tags.edges, cage.tags.edges)
    assert np.array_equal(again.tags.vertices, cage.tags.vertices)
    assert np.array_equal(again.holes, cage.holes)
    for rule in ("boundary", "face_varying", "crease_method", "triangle_rule"):
        assert getattr(again, rule) == getattr(cage, rule)


def test_tags_reach_mitsuba(variant_scalar_rgb):  # noqa: ARG001
    import mitsuba as mi

    creases = [(0, 1, 10), (1, 3, 10), (3, 2, 10), (2, 0, 10)]
    cage = ControlCage(cube().positions, faces_of(cube()), creases=creases, corners=[(7, 10)])
    shape = mi.load_dict({"type": "subdivision", "tessellation_rate": 2, **cage.as_properties(mi)})
    box = shape.bbox()
    # The corner stays; the creases are a circle at z = -1; the smooth corners above have moved.
    assert np.allclose(np.array(box.max), 1)
    assert np.isclose(box.min.z, -1)
    smooth = mi.load_dict({"type": "subdivision", "tessellation_rate": 2, **cube().as_properties(mi)})
    assert smooth.bbox().min.z > -0.9


@pytest.mark.parametrize(
    ("tag", "message"),
    [
        ("crease 2/1/0 0 1" + "0" * 400 + " 1", r"\.\.\. is out of range|\(10+\.\.\."),
        ("hole 1/0/0 9223372036854775808", r"\(9223372036854775808 is out of range\)"),
        ("hole " + "9" * 5000 + "/0/0 1", "malformed tag"),
        ("hole 1/0/0 " + "9" * 5000, "malformed tag"),
        ("corner 1/1/0 4503599627370497000 1", "corners have the row .*; expected .vertex, sharpness"),
        ("crease 2/1/0 0 4611686018427387904 1", "creases have the row .*; expected .vertex, vertex, sharpness"),
        ("corner 1/1/0 0 1e400", None),
        ("crease 2/1/0 0 1 nan", "crease along edge .* has sharpness nan"),
    ],
)
def test_numbers_of_any_size_name_their_line_in_few_words(read, tag, message):
    if message is None:
        assert read(f"t {tag}\n").tags.is_corner[0]
        return
    with pytest.raises(CageError, match=f'cage.obj", line 9: .*({message})') as caught:
        read(f"t {tag}\n")
    assert len(str(caught.value)) < 600


def test_many_tags_are_read_as_one_by_one(tmp_path):
    """Lines of the most common form take array passes; here each has a twin in another form, which does not."""
    rng = np.random.default_rng(3)
    cage = extraordinary(7)
    creases = cage.edges[rng.integers(0, len(cage.edges), 40)]
    plain, other = [], []
    for a, b in creases.tolist():
        sharpness = rng.uniform(0, 12)
        plain.append(f"t crease 2/1/0 {a} {b} {sharpness!r}\n")
        other.append(f"t  crease\t2/1/0 {a} {b} {sharpness!r}\n")
    for vertex in rng.integers(0, cage.vertex_count, 20).tolist():
        plain.append(f"t corner 1/1/0 {vertex} {vertex}e-1\n")
        other.append(f"t corner  1/1/0 {vertex} {vertex}e-1 # a comment\n")
    for face in range(3):
        plain.append(f"t hole 1/0/0 {face}\n")
        other.append(f"t hole 1/0/0  +{face}\n")
    order = rng.permutation(len(plain))
    # Mixed, too, as the last of several tags of an edge counts.
    mixed = np.where(rng.random(len(plain)) < 0.5, plain, other)
    cages = []
    for lines in (plain, other, mixed):
        cage.with_positions(cage.positions).save(tmp_path / "cage.obj")
        with open(tmp_path / "cage.obj", "a") as file:
            file.writelines(lines[i] for i in order)
        cages.append(ControlCage.from_file(tmp_path / "cage.obj"))
    for found in cages[1:]:
        np.testing.assert_array_equal(found.tags.edges, cages[0].tags.edges)
        np.testing.assert_array_equal(found.tags.vertices, cages[0].tags.vertices)
        np.testing.assert_array_equal(found.holes, cages[0].holes)
        for kind, lines in cages[0].source.tag_lines.items():
            np.testing.assert_array_equal(found.source.tag_lines[kind], lines)


def test_a_malformed_line_among_many_tags_is_named(read):
    with pytest.raises(CageError, match="line 10: malformed tag"):
        read("t crease 2/1/0 4 1 10\nt crease 2/1/0 4 1.0 10\nt crease 2/1/0 1 4 2\n")
    with pytest.warns(CageWarning, match="line 10: crease along edge"):
        read("t crease 2/1/0 4 1 10\nt crease 2/1/0 4 99 10\n")


def test_time_of_tags_grows_with_their_number(tmp_path):
    """Each is some bytes of an array: a hundred thousand take less than a second."""
    path = tmp_path / "cage.obj"
    path.write_text(SHEET + "t crease 2/1/0 1 4 2.5\n" * 100_000)
    start = time.process_time()
    cage = ControlCage.from_file(path)
    assert time.process_time() - start < 1
    assert cage.tags.edges.max() == 2.5


def test_a_rule_that_no_tag_stands_for_is_lost_with_a_warning(tmp_path, monkeypatch):
    """As a new boundary rule would be, which OpenSubdiv's tags do not know."""
    monkeypatch.setitem(rules.RULES, "boundary", (*rules.RULES["boundary"], "new"))
    cage = ControlCage([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]], [[0, 1, 2, 3]], boundary="new")
    with pytest.warns(CageWarning, match="no place for boundary new"):
        cage.save(tmp_path / "cage.obj")
    assert ControlCage.from_file(tmp_path / "cage.obj").boundary == rules.RULES["boundary"][0]
