import re
import warnings

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from mitsuba_subdivision.cage import CageError, CageWarning, ControlCage
from mitsuba_subdivision.files.obj_reader import read_obj

TRIANGLE = "v 0 0 0\nv 1 0 0\nv 0 1 0\n"

EVERY_FEATURE = b"""\xef\xbb\xbf# A tetrahedron.  \xff not UTF-8, C:\\path\\
mtllib my\xe9materials.mtl
o tetra
v 1 1 1 # first
v\t-1. -1.0e0\t +1 1.0
  v -1 1 -1 0.5 0.25 .125
vt 0 0.5
vt 1
vt .25 0 0
vn 0 0 1
vp 1 2
g side#1
usemtl blue
s off
"""


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
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", CageWarning)
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


def test_file_with_every_feature(obj_file):
    content = EVERY_FEATURE + (
        b"f 1/1/1 -2/2 3/-1\n"
        b"v 1 \\\n  -1 \\\r\n-1\r\n"
        b"l 1 2 3\np 1\ncurv 0 1 1 2\nunknown 1 2 x\n\n   \n\t\n"
        b"f 1/1 3/2 4/3 # f 1 2 3\r\n"
        b"vt 7 8\n"
        b"f -4/-1 \\\n -1/1 \\\n 2/-4/1\n"
        b"#f 1 2 3\n"
        b"f\t3/4/1 2/2/1 4/1"
    )
    path = obj_file(content)
    assert_reads_as(content, path)
    cage = read_quietly(path)
    np.testing.assert_array_equal(cage.positions, [[1, 1, 1], [-1, -1, 1], [-1, 1, -1], [1, -1, -1]])
    np.testing.assert_array_equal(cage.face_vertices.reshape(-1, 3), [[0, 1, 2], [0, 2, 3], [0, 3, 1], [2, 1, 3]])
    np.testing.assert_array_equal(cage.texcoords.indices, [0, 1, 2, 0, 1, 2, 3, 0, 0, 3, 1, 0])


SPACES = st.sampled_from([b" ", b"  ", b"\t", b" \\\n ", b"\\\r\n"])
NUMBERS = st.floats(allow_nan=False, allow_infinity=False).map(lambda number: repr(number).encode())
NOISE = [b"", b"  ", b"# v 1 2", b"vn 0 0 1", b"g a b", b"usemtl \xff", b"s 1", b"vp 1", b"fo 1", b"#\\", b"\x0c"]
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
    texts = st.tuples(lines, st.sampled_from([b"\n", b"\r\n"]), st.booleans())
    return texts.map(lambda text: text[1].join([*text[0][0], text[0][1], *text[0][2], *([b""] if text[2] else [])]))


@given(content=st.sampled_from(TAILS).flatmap(obj_files))
@settings(max_examples=40, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
def test_agrees_with_a_reader_of_lines(content, obj_file):
    assert_reads_as(content, obj_file(content))


@pytest.mark.parametrize(
    "statement", ["v 0 0 {}", "vt {} 0", "f 1 2 {}", "f 1/{} 2 3", "t hole {}/0/0 1", "t hole 1/0/0 {}"]
)
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
FORMS = "expected integers as v, v/vt, v//vn or v/vt/vn"
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
    ("v 0 0 0\nv 0 1,5 0\nf 1 2 3\n", ['line 2: malformed number "1,5"', DECIMAL]),
    ("v 0 0 0\nv 0 1-5 0\nf 1 2 3\n", ['line 2: malformed number "1-5"', DECIMAL]),
    ("v 0 0 0 \\\n 1 0x1\nf 1 2 3\n", ['line 2: malformed number "0x1"', DECIMAL]),
    ("v 0 0 0 white\nf 1 2 3\n", ['line 1: malformed number "white"', DECIMAL]),
    ("v 0 0 1_0\nf 1 2 3\n", ['line 1: malformed number "1_0"', DECIMAL]),
    (f"v 0 0 {'x' * 999}\nf 1 2 3\n", [f'line 1: malformed number "{"x" * 80}..."', DECIMAL]),
    (b"v 0 0 1\xe2\x80\xa8\nf 1 2 3\n", [r'line 1: malformed number "1\xe2\x80\xa8"', DECIMAL]),
    (b"v 0 0 \xff\nf 1 2 3\n", [r'line 1: malformed number "\xff"', DECIMAL]),
    *((f"{TRIANGLE}f 1 2 3\nf 1 {bad} 3\n", [f'line 5: malformed number "{bad}"', FORMS]) for bad in NO_CORNERS),
    (TRIANGLE + "f 1 0 3\n", ["line 4: vertex index 0 is out of range", "expected 1 to 3", "has 3 vertices"]),
    (TRIANGLE + "f 1 2 \\\n 4\n", ["line 5: vertex index 4 is out of range", "expected 1 to 3", "has 3 vertices"]),
    (TRIANGLE + "f 1 2 99999999999999999999\n", ["line 4: vertex index", "expected 1 to 3"]),
    (
        f"{TRIANGLE}f -1 -2 -4\nv 0 0 1\n",
        ["line 4: vertex index -4 is out of range", "expected -3 to -1", "3 vertices are above"],
    ),
    (TRIANGLE + "vt\nf 1 2 3\n", ["line 4: 0 texture coordinates", "expected at least 1"]),
    (TRIANGLE + "vt 0 o\nf 1 2 3\n", ['line 4: malformed number "o"', DECIMAL]),
    (
        TRIANGLE + "vt 0 1\nf 1 2/2 3\n",
        ["line 5: texture coordinate index 2 is out of range", "expected 1 to 1", "has 1 texture coordinates"],
    ),
    (
        TRIANGLE + "vt 0 1\nf 1/1 2/-2 3//1\nvt 0 1\n",
        ["line 5: texture coordinate index -2 is out of range", "expected -1 to -1", "are above this line"],
    ),
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
def test_malformed_files_and_those_that_end_too_early(text, message, obj_file):
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
def test_colours_and_texture_coordinates_of_some_corners_are_left_out_with_a_warning(obj_file, text, message):
    with pytest.warns(CageWarning, match=message):
        cage = ControlCage.from_file(obj_file(text))
    assert cage.texcoords is None
    np.testing.assert_array_equal(cage.positions[:3], [[0, 0, 0], [1, 0, 0], [0, 1, 0]])


def test_names_of_materials_may_have_a_number_sign(tmp_path):
    # Quadrilaterals side by side.
    quads = "".join(f"v {i} 0 0 # {i}\nv {i} 1 0\n" for i in range(6))
    uses = ["usemtl a#1", "\tusemtl\tMaterial #25 # a comment", "# usemtl none", "usemtl plain # comment"]
    uses += ["usemtl # none"]
    faces = (f"{use}\nf {2 * i + 1} {2 * i + 3} {2 * i + 4} {2 * i + 2}\n" for i, use in enumerate(uses))
    (tmp_path / "a.obj").write_text(quads + "".join(faces))
    materials = ControlCage.from_file(tmp_path / "a.obj").materials
    expected = {"a#1": [0], "Material #25": [1, 2], "plain": [3], "": [4]}
    assert {name: faces.tolist() for name, faces in materials.items()} == expected
