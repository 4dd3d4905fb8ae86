import re
import time

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from mitsuba_subdivision.cage import CageError, CageWarning, ControlCage, contents, without_warnings
from mitsuba_subdivision.cage.contents import same
from mitsuba_subdivision.cage.named_cages import extraordinary
from mitsuba_subdivision.files.obj import read_obj

TRIANGLE = "v 0 0 0\nv 1 0 0\nv 0 1 0\n"


def slow_read(content):
    """Independent reader, line by line, for well-formed files whose keywords stand on the line they begin on."""
    positions, sizes, corners, vertex_lines, face_lines, values, indices = [], [], [], [], [], [], []
    pending, first_line = b"", None
    for number, whole_line in enumerate(content.split(b"\n"), 1):
        line = whole_line.removesuffix(b"\r").split(b"#")[0]
        first_line = first_line or number
        if line.endswith(b"\\"):
            pending += line[:-1] + b" "
            continue
        keyword, *tokens = (pending + line).split() or [b""]
        if keyword == b"v":
            positions.append([float(token) for token in tokens[:3]])
            vertex_lines.append(first_line)
        elif keyword == b"vt":
            values.append([float(token) for token in [*tokens, b"0"][:2]])
        elif keyword == b"f":
            parts = [[*token.split(b"/"), b""][:2] for token in tokens]
            sizes.append(len(parts))
            corners += [absolute(int(part[0]), len(positions)) for part in parts]
            indices += [absolute(int(part[1]), len(values)) if part[1] else None for part in parts]
            face_lines.append(first_line)
        pending, first_line = b"", None
    return positions, sizes, corners, vertex_lines, face_lines, values, indices


def absolute(index, above):
    return index - 1 if index > 0 else above + index


def read_quietly(path):
    with without_warnings():
        return read_obj(path)


def assert_reads_as(content, path):
    contents = read_quietly(path)
    positions, sizes, vertices, vertex_lines, face_lines, values, indices = slow_read(content)
    np.testing.assert_array_equal(contents.positions, positions)
    np.testing.assert_array_equal(contents.face_sizes, sizes)
    np.testing.assert_array_equal(contents.face_vertices, vertices)
    assert [*contents.source.vertex_lines] == vertex_lines
    assert [*contents.source.face_lines] == face_lines
    if not values or None in indices:
        assert contents.texcoords is None
    else:
        np.testing.assert_array_equal(contents.texcoords.values, values)
        np.testing.assert_array_equal(contents.texcoords.indices, indices)


SPACES = st.sampled_from([b" ", b"  ", b"\t", b" \\\n ", b"\\\r\n"])
REPRESENTED = st.floats(allow_nan=False, allow_infinity=False).map(lambda number: repr(number).encode())
NUMBERS = st.one_of(REPRESENTED, st.sampled_from([b"-1.", b"+1", b".125", b"-1.0e0", b"007", b"1E2"]))
NOISE = [b"", b"  ", b"\t ", b"# v 1 2", b"#v 1 2 3 \xff", b"vn 0 0 1", b"g a#b", b"usemtl \xff", b"s off", b"vp 1 2"]
NOISE += [b"fo 1", b"#\\", b"\x0c", b"o a", b"mtllib my\xe9.mtl", b"l 1 2 3", b"p 1", b"curv 0 1 1 2", b"unknown 1 x"]
# A mark of UTF-8 before a comment, whose text is not.
BEGINNINGS = [[], [b"\xef\xbb\xbf# A tetrahedron.  \xff not UTF-8, C:\\path\\ "]]
# What follows the vertex of a corner in a file without texture coordinates, with them at some corners and at all.
TAILS = [[b"", b"//1"], [b"", b"//1", b"/1", b"/-2", b"/3/7"], [b"/1", b"/3", b"/-1", b"/-3/7"]]


def statements(keyword, tokens, least, most, ends=(b"",)):
    """Lines of a keyword with tokens, and spaces of all kinds around them."""
    words = st.lists(st.tuples(SPACES, tokens).map(b"".join), min_size=least, max_size=most).map(b"".join)
    return st.tuples(st.sampled_from([b"", b" ", b"\t"]), st.just(keyword), words, st.sampled_from(ends)).map(b"".join)


def obj_files(tails):
    """Well-formed OBJ text, with vertices, texture coordinates, faces and noise in any order after the first ones."""
    vertices, texcoords = statements(b"v", NUMBERS, 3, 7), statements(b"vt", NUMBERS, 1, 3)
    corners = st.tuples(st.sampled_from([b"1", b"2", b"4", b"-1", b"-3", b"-4"]), st.sampled_from(tails)).map(b"".join)
    faces = statements(b"f", corners, 3, 6, (b"", b" ", b" # 7", b"#7"))
    first = [vertices, vertices, vertices, vertices, *[texcoords] * (3 if len(tails) > 2 else 0)]
    more = [vertices, faces, faces, st.sampled_from(NOISE), *([texcoords] if len(tails) > 2 else [])]
    lines = st.tuples(st.tuples(*first), faces, st.lists(st.one_of(more), max_size=12))
    texts = st.tuples(lines, st.sampled_from([b"\n", b"\r\n"]), st.sampled_from(BEGINNINGS), st.booleans())

    def joined(text):
        (first, face, more), end, beginning, has_end = text
        return end.join([*beginning, *first, face, *more, *([b""] if has_end else [])])

    return texts.map(joined)


@pytest.mark.long
@given(content=st.sampled_from(TAILS).flatmap(obj_files))
@settings(max_examples=80, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
def test_agrees_with_a_reader_of_lines(content, obj_file):
    assert_reads_as(content, obj_file(content))


@pytest.mark.parametrize("statement", ["v 0 0 {}", "vt {} 0", "f 1 2 {}", "f 1/{} 2 3", "t a {}/0/0 1", "t a 1/0/0 {}"])
@pytest.mark.parametrize("end", ["x", "-"])
def test_many_digits_are_read_as_fast_as_any_text(obj_file, statement, end):
    """It would take hours with a search that goes back for each digit."""
    with pytest.raises(CageError, match="line 5: ") as caught:
        ControlCage.from_file(obj_file(TRIANGLE + "f 1 2 3\n" + statement.format("9" * 300_000 + end) + "\n"))
    assert len(str(caught.value)) < 600


def test_old_mac_line_ends_and_faces_before_their_vertices(obj_file):
    contents = read_quietly(obj_file(b"# old\rf 1 2 3\rv 0 0 0\rv 1 0 0\rv 0 1 0\rf 3 2 1\r"))
    np.testing.assert_array_equal(contents.positions, [[0, 0, 0], [1, 0, 0], [0, 1, 0]])
    np.testing.assert_array_equal(contents.face_vertices, [0, 1, 2, 2, 1, 0])
    np.testing.assert_array_equal(contents.source.face_lines, [2, 6])


AT_LEAST_3, DECIMAL = "expected at least 3", "expected a decimal number"
OUT, TEXCOORD = "is out of range", "texture coordinate"
FORMS = "expected integers as v, v/vt, v//vn or v/vt/vn"
NO_NUMBERS = ("1,5", "1-5", "1_0")
NO_CORNERS = ("x", "2.0", "2/", "2//", "/2", "//2", "2/1/", "2/1/1/1", "2///1", "1-2", "2/x", "--2", "2/1-1")
MALFORMED = [
    ("v 0 0 0\nv 1 nan 0\nv 0 1 0\nf 1 2 3\n", ["line 2: vertex 2 has the coordinates (1.0, nan, 0.0)"]),
    ("", [': there are no vertices ("v" statements)', "expected at least one"]),
    ("# nothing\n", ["there are no vertices", "expected at least one"]),
    ("f 1 2 3\n", ["there are no vertices", "expected at least one"]),
    (TRIANGLE, [': there are no faces ("f" statements)', "expected at least one"]),
    (TRIANGLE + "f\n", ["line 4: 0 face corners", AT_LEAST_3]),
    (TRIANGLE + "\nf 1 2\nf 1 2 3\n", ["line 5: 2 face corners", AT_LEAST_3]),
    ("v 0 0\nf 1 2 3\n", ["line 1: 2 coordinates", AT_LEAST_3]),
    ("v\n" + TRIANGLE + "f 1 2 3\n", ["line 1: 0 coordinates", AT_LEAST_3]),
    *((f"v 0 0 0\nv 0 {bad} 0\nf 1 2 3\n", [f'line 2: malformed number "{bad}"', DECIMAL]) for bad in NO_NUMBERS),
    ("v 0 0 0 \\\n 1 0x1\nf 1 2 3\n", ['line 2: malformed number "0x1"', DECIMAL]),
    ("v 0 0 0 white\nf 1 2 3\n", ['line 1: malformed number "white"', DECIMAL]),
    (f"v 0 0 {'x' * 999}\nf 1 2 3\n", [f'line 1: malformed number "{"x" * 80}..."', DECIMAL]),
    (b"v 0 0 1\xe2\x80\xa8\nf 1 2 3\n", [r'line 1: malformed number "1\xe2\x80\xa8"', DECIMAL]),
    (b"v 0 0 \xff\nf 1 2 3\n", [r'line 1: malformed number "\xff"', DECIMAL]),
    *((f"{TRIANGLE}f 1 2 3\nf 1 {bad} 3\n", [f'line 5: malformed number "{bad}"', FORMS]) for bad in NO_CORNERS),
    (TRIANGLE + "f 1 0 3\n", ["line 4: vertex index 0 is out of range", "expected 1 to 3", "has 3 vertices"]),
    (TRIANGLE + "f 1 2 \\\n 4\n", ["line 5: vertex index 4 is out of range", "expected 1 to 3", "has 3 vertices"]),
    (TRIANGLE + "f 1 2 99999999999999999999\n", ["line 4: vertex index", "expected 1 to 3"]),
    (f"{TRIANGLE}f -1 -2 -4\nv 0 0 1\n", [f"line 4: vertex index -4 {OUT}", "expected -3 to -1", "3 vertices are"]),
    (TRIANGLE + "vt\nf 1 2 3\n", ["line 4: 0 texture coordinates", "expected at least 1"]),
    (TRIANGLE + "vt 0 o\nf 1 2 3\n", ['line 4: malformed number "o"', DECIMAL]),
    (TRIANGLE + "vt 0 1\nf 1 2/2 3\n", [f"line 5: {TEXCOORD} index 2 {OUT}", "expected 1 to 1", f"has 1 {TEXCOORD}s"]),
    (f"{TRIANGLE}vt 0 1\nf 1/1 2/-2 3//1\nvt 0 1\n", [f"line 5: {TEXCOORD} index -2 {OUT}", "expected -1 to -1"]),
    (TRIANGLE + "vt 0 1\nf 1/0 2/1 3/1\n", ["line 5: texture coordinate index 0 is out of range"]),
    (TRIANGLE + "f 1 2", ["line 4: 2 face corners", AT_LEAST_3, "the file ends here"]),
    (TRIANGLE + "f 1 2\nf 1 2 3", ["line 4: 2 face corners", AT_LEAST_3]),
    (TRIANGLE + "f 1 2 3/", ['line 4: malformed number "3/"', "the file ends here"]),
    ("f 1 2 3\nv 0 0", ["line 2: 2 coordinates", "the file ends here"]),
    ("f 1 2 3\nv 0 0 1e", ['line 2: malformed number "1e"', "the file ends here"]),
    (TRIANGLE + "f 1 2 3 \\\n", ["line 4: the file ends in a line continuation", "expected another line"]),
    (TRIANGLE + "f 1 2 3\\", ["line 4: the file ends in a line continuation", "expected another line"]),
]


@pytest.mark.parametrize(("text", "message"), MALFORMED)
def test_malformed_and_truncated_files_are_errors(text, message, obj_file):
    path = obj_file(text)
    with pytest.raises(CageError, match=".*".join(re.escape(part) for part in [f'"{path}"', *message])) as caught:
        ControlCage.from_file(path)
    assert ("ends here" in str(caught.value)) == ("the file ends here" in message)


COLOURED = "v 0 0 0 1 0 0\nv 1 0 0 1 0 0\nv 0 1 0 1 0 0\nf 1 2 3\n"
LEFT_OUT = [
    (
        TRIANGLE + "v 1 1 0\nvt 0 0\nf 1/1 2/1 3/1\nf 3/1 2 4//1\n",
        r'cube\.obj": 1 of 2 faces have corners without texture coordinates, the first in line 7; .* at all corners',
    ),
    (TRIANGLE + "f 1/1/1 2/2/2 3/3/3\n", r'no texture coordinates \("vt" statements\); the cage is read without them'),
    (COLOURED, "colours of vertices are ignored; expected them as an attribute"),
]


@pytest.mark.parametrize(("text", "message"), LEFT_OUT)
def test_colours_and_texture_coordinates_of_some_corners_only_are_omitted_with_a_warning(obj_file, text, message):
    with pytest.warns(CageWarning, match=message):
        cage = ControlCage.from_file(obj_file(text))
    assert cage.texcoords is None
    np.testing.assert_array_equal(cage.positions[:3], [[0, 0, 0], [1, 0, 0], [0, 1, 0]])


def test_names_of_materials_may_have_a_number_sign(obj_file):
    # Quadrilaterals side by side.
    text = "".join(f"v {i} 0 0 # {i}\nv {i} 1 0\n" for i in range(6))
    uses = [
        "usemtl a#1",
        "\tusemtl\tMaterial #25 # a comment",
        "# usemtl none",
        "usemtl plain # comment",
        "usemtl # none",
    ]
    text += "".join(f"{use}\nf {2 * i + 1} {2 * i + 3} {2 * i + 4} {2 * i + 2}\n" for i, use in enumerate(uses))
    materials = ControlCage.from_file(obj_file(text)).materials
    expected = {"a#1": [0], "Material #25": [1, 2], "plain": [3], "": [4]}
    assert {name: faces.tolist() for name, faces in materials.items()} == expected


SHEET = "v 0 0 0\nv 1 0 0\nv 2 0 0\nv 0 1 0\nv 1 1 0\nv 2 1 0\nf 1 2 5 4\nf 2 3 6 5\n"


@pytest.fixture
def read(obj_file):
    return lambda text, **options: ControlCage.from_file(obj_file(SHEET + text), **options)


def sharp_edges(cage):
    t = cage.topology
    sharp = t.edge_half_edge[cage.tags.is_infinite[t.edge_half_edge]]
    ends = np.stack([t.face_vertices[sharp], t.face_vertices[t.next[sharp]]], 1)
    return sorted(tuple(sorted(edge)) for edge in ends.tolist())


def test_items_of_tags_count_from_0(read):
    """A sharpness of 0 is smooth, and one of 10 and more is infinite."""
    cage = read("t crease 2/1/0 4 1 10\nt corner 1/1/0 2 10.0\n")
    assert (sharp_edges(cage), np.flatnonzero(cage.tags.is_corner).tolist()) == ([(1, 4)], [2])
    cage = read("t crease 2/1/0 1 4 0\nt corner 1/1/0 1 0\n")
    assert not cage.tags.any
    assert read("t corner 1/1/0 0 1e400\n").tags.is_corner[0]
    cage = read("t crease 4/1/0 1 4 0 1 2.5\nt crease 4/2/0 1 2 0 3 3 4\nt corner 2/1/0 0 2 1.5\nt hole 1/0/0 1\n")
    sharpness_of = {tuple(sorted(edge)): sharpness for *edge, sharpness in cage.contents.creases.tolist()}
    assert sharpness_of == {(1, 4): 2.5, (0, 1): 2.5, (1, 2): 3, (0, 3): 4}
    assert (cage.contents.corners.tolist(), cage.holes.tolist()) == ([[0, 1.5], [2, 1.5]], [1])


# As OpenSubdiv's regression/common/far_utils.h reads them.
FACE_VARYING = ("none", "corners_only", "corners_plus1", "corners_plus2", "boundaries", "all")
RULES = {
    ("boundary", "interpolateboundary 1/0/0 {}"): dict(enumerate(("none", "edge_and_corner", "edge_only"))),
    # The last one counts.
    ("boundary", "interpolateboundary 1/0/0 0\nt interpolateboundary 1/0/0 {}"): {2: "edge_only"},
    ("face_varying", "facevaryinginterpolateboundary 1/0/0 {}"): dict(enumerate(FACE_VARYING)),
    ("face_varying", "facevaryingpropagatecorners 1/0/0 {}"): {0: "corners_plus1", 1: "corners_plus2"},
    ("crease_method", "creasemethod 0/0/1 {}"): {"normal": "uniform", "chaikin": "chaikin"},
    ("triangle_rule", "smoothtriangles 0/0/1 {}"): {"catmark": "catmull_clark", "smooth": "smooth"},
}


@pytest.mark.parametrize(("rule", "tag"), RULES)
def test_arguments_override_the_rules_of_tags(read, rule, tag):
    override = contents.RULES[rule][-1]
    for value, expected in RULES[rule, tag].items():
        assert getattr(read(f"t {tag.format(value)}\n"), rule) == expected
        assert getattr(read(f"t {tag.format(value)}\n", **{rule: override}), rule) == override


def test_corners_propagate_with_their_rule_only(read):
    text = "t facevaryingpropagatecorners 1/0/0 1\nt facevaryinginterpolateboundary 1/0/0 {}\n"
    assert read(text.format(2)).face_varying == "corners_plus2"
    with pytest.warns(CageWarning, match='line 9: tag "facevaryingpropagatecorners" has no effect .* rule "all"'):
        assert read(text.format(5)).face_varying == "all"


UNSUPPORTED, UNKNOWN = "is not supported and has no effect", "has an unknown value .* expected one of {}$"
WITHOUT_EFFECT = {
    **dict.fromkeys(("odd 0/0/0", "faceedit 4/0/1 3 4 1 1 a", "vertexedit 4/3/3 3 4 1 0 0 0 1 add P v"), UNSUPPORTED),
    "interpolateboundary 1/0/0 3": UNKNOWN.format("0, 1, 2"),
    "facevaryinginterpolateboundary 1/0/0 6": UNKNOWN.format("0, 1, 2, 3, 4, 5"),
    "creasemethod 0/0/1 odd": UNKNOWN.format("normal, chaikin"),
    "smoothtriangles 0/0/1 normal": UNKNOWN.format("catmark, smooth"),
    "vertexedit 100/0/0" + " 0" * 100: UNSUPPORTED,
}


@pytest.mark.parametrize(("tag", "message"), WITHOUT_EFFECT.items())
def test_a_short_warning_names_tags_without_effect(read, tag, message):
    shown = tag if len(tag) < 100 else r"vertexedit 100/0/0 0 0 [ 0]*\.\.\."
    with pytest.warns(CageWarning, match=rf'cube.obj", line 9: tag "{shown}" {message}'):
        read(f"t {tag}\n")


WRONG_TAGS = [
    ("crease 2/1/0 1 4", r'malformed tag "crease 2/1/0 1 4" \(2 values\); expected a name, counts'),
    ("crease 1/1/0 1 10", "tag crease has 1 integers and 1 floats; expected two integers per edge and a float"),
    ("crease 4/3/0 1 4 0 1 1 2 3", "tag crease has 4 integers and 3 floats; expected two integers per edge"),
    ("corner 1/0/0 1", "tag corner has 1 integers and 0 floats; expected one integer per vertex and a float"),
    ("hole 0/0/0", "tag hole has 0 integers and 0 floats; expected one or more integers and no floats"),
    ("hole 1/1/0 1 2.0", "tag hole has 1 integers and 1 floats; expected one or more integers"),
    ("creasemethod 1/0/0 1", 'tag "creasemethod 1/0/0 1" has the wrong values; expected one string'),
    ("interpolateboundary 2/0/0 1 1", 'tag "interpolateboundary .* has the wrong values; expected one integer'),
    ("crease -1/1/0 10", "malformed tag"),
    ("crease 2/1/0 1 x 10", "malformed tag"),
    ("crease", r'malformed tag "crease"; expected a name, counts'),
    ("", r'malformed tag ""; expected a name, counts'),
    *((f"hole 2/0/0 1 {face}", f"hole {face + 1} is no face; expected one of 2 faces") for face in (2, 7)),
    ("crease 2/1/0 1 4 -2.5", r"crease along edge \(2, 5\) has sharpness -2.5; expected 0 for smooth"),
    # Numbers of any size.
    (f"crease 2/1/0 0 1{'0' * 400} 1", r".*(\.\.\. is out of range|\(10+\.\.\.)"),
    ("hole 1/0/0 9223372036854775808", r".*\(9223372036854775808 is out of range\)"),
    (f"hole {'9' * 5000}/0/0 1", "malformed tag"),
    (f"hole 1/0/0 {'9' * 5000}", "malformed tag"),
    ("corner 1/1/0 4503599627370497000 1", "corners have the row .*; expected .vertex, sharpness"),
    ("crease 2/1/0 0 4611686018427387904 1", "creases have the row .*; expected .vertex, vertex, sharpness"),
    ("crease 2/1/0 0 1 nan", "crease along edge .* has sharpness nan"),
]


@pytest.mark.parametrize(("tag", "message"), WRONG_TAGS)
def test_errors_of_wrong_tags_are_short_and_name_their_line(read, tag, message):
    with pytest.raises(CageError, match=f'cube.obj", line 9: {message}') as caught:
        read(f"t {tag}\n")
    assert len(str(caught.value)) < 600


def test_many_tags_are_read_as_one_by_one(tmp_path):
    """Lines of the most common form take array passes; here each has a twin in another form, which does not."""
    rng, cage = np.random.default_rng(3), extraordinary(7)
    tags = [(f"t hole 1/0/0 {face}\n", f"t hole 1/0/0  +{face}\n") for face in range(3)]
    for a, b in cage.edges[rng.integers(0, len(cage.edges), 40)].tolist():
        crease = f"{a} {b} {rng.uniform(0, 12)!r}\n"
        tags.append((f"t crease 2/1/0 {crease}", f"t  crease\t2/1/0 {crease}"))
    for vertex in rng.integers(0, cage.vertex_count, 20).tolist():
        corner = f"{vertex} {vertex}e-1"
        tags.append((f"t corner 1/1/0 {corner}\n", f"t corner  1/1/0 {corner} # a comment\n"))
    plain, other = np.array(tags)[rng.permutation(len(tags))].T
    cages = []
    # Mixed, too, as the last of several tags of an edge counts.
    for lines in (plain, other, np.where(rng.random(len(tags)) < 0.5, plain, other)):
        cage.with_positions(cage.positions).save(tmp_path / "cage.obj")
        with open(tmp_path / "cage.obj", "a") as file:
            file.writelines(lines)
        cages.append(ControlCage.from_file(tmp_path / "cage.obj"))
    for again in cages[1:]:
        assert same((again.contents, again.source.tag_lines), (cages[0].contents, cages[0].source.tag_lines))


def test_a_malformed_line_among_many_tags_is_named(read):
    with pytest.raises(CageError, match="line 10: malformed tag"):
        read("t crease 2/1/0 4 1 10\nt crease 2/1/0 4 1.0 10\nt crease 2/1/0 1 4 2\n")
    ignored = {"crease 2/1/0 4 99 10": r"crease along edge \(5, 100\)", "corner 1/1/0 6 10": "corner at vertex 7"}
    for tag, message in ignored.items():
        with pytest.warns(CageWarning, match=f'cube.obj", line 10: {message}, which'):
            read(f"t crease 2/1/0 4 1 10\nt {tag}\n")


def test_time_of_tags_grows_with_their_number(tmp_path):
    """Each is some bytes of an array: a hundred times as many take about as much longer, not its square."""
    path, times = tmp_path / "cage.obj", []
    for count in (1_000, 100_000):
        path.write_text(SHEET + "t crease 2/1/0 1 4 2.5\n" * count)
        start = time.process_time()
        cage = ControlCage.from_file(path)
        times.append(time.process_time() - start)
        assert cage.tags.edges.max() == 2.5
    assert times[1] < 500 * times[0]


def test_rules_without_a_tag_are_lost_with_a_warning(tmp_path, monkeypatch):
    """As a new boundary rule would be, which OpenSubdiv's tags do not know."""
    monkeypatch.setitem(contents.RULES, "boundary", (*contents.RULES["boundary"], "new"))
    cage = ControlCage([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]], [[0, 1, 2, 3]], boundary="new")
    with pytest.warns(CageWarning, match="no place for boundary new"):
        cage.save(tmp_path / "cage.obj")
    assert ControlCage.from_file(tmp_path / "cage.obj").boundary == contents.RULES["boundary"][0]
