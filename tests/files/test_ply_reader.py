import os
import re
import tempfile
import threading

import numpy as np
import pytest
from mitsuba_subdivision.cage import CageError, CageWarning, ControlCage
from mitsuba_subdivision.cage.contents import same
from mitsuba_subdivision.cage.named_cages import cube
from mitsuba_subdivision.files.ply import read_ply

plyfile = pytest.importorskip("plyfile")

SHEET = """ply
format ascii 1.0
element vertex 5
comment a sheet of two faces
property float x
property double y
property float z
element face 2
property list uchar int vertex_indices
end_header
0 0 0
1 0 0
1 1 0
0 1 0
2 0.1 0
4 0 1 2 3
3 1 4 2
"""


@pytest.fixture
def read(tmp_path):
    def read(text):
        path = tmp_path / "cage.ply"
        path.write_bytes(text if isinstance(text, bytes) else text.encode())
        return ControlCage.from_file(path)

    return read


def element(name, count, *properties):
    return f"element {name} {count}\n" + "".join(f"property {prop}\n" for prop in properties)


def with_data(properties, rows):
    lines = SHEET.splitlines()
    start = lines.index("end_header") + 1
    changed = [*lines[:7], *(f"property {name}" for name in properties), *lines[7:start]]
    changed += [f"{line} {row}" for line, row in zip(lines[start : start + 5], rows, strict=True)]
    return "\n".join([*changed, *lines[start + 5 :], ""])


def test_polygons(read):
    cage = read(SHEET)
    np.testing.assert_array_equal(cage.positions, [[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0], [2, 0.1, 0]])
    assert (cage.face_sizes.tolist(), cage.face_vertices.tolist()) == ([4, 3], [0, 1, 2, 3, 1, 4, 2])
    assert (cage.texcoords, cage.attributes, cage.scheme) == (None, {}, None)
    assert read(SHEET.replace("double y", "uchar y").replace("0.1", "1")).face_count == 2
    edges = element("edge", 1, "int vertex1", "int vertex2")
    text = SHEET.replace("element face", edges + "element face").replace("4 0 1 2 3", "0 1\n4 0 1 2 3")
    assert read(text).face_count == 2
    with pytest.raises(CageError, match="line 21: face 1 has the vertex index 9"):
        read(text.replace("3 1 4 2", "3 1 9 2"))


@pytest.mark.parametrize("byte_order", ["<", ">"])
@pytest.mark.parametrize(
    ("name", "size", "index"),
    [("vertex_indices", "u1", "i4"), ("vertex_index", "i4", "u4"), ("vertex_index", "u2", "u2")],
)
def test_binary_files_of_all_types(tmp_path, monkeypatch, byte_order, name, size, index):
    """Also where no temporary file can be made."""
    vertices = np.array([tuple(row) for row in cube().positions], dtype=[("x", "f8"), ("y", "f4"), ("z", "f8")])
    faces, empty = np.empty(6, dtype=[(name, object)]), np.empty(0, dtype=[("a", object), ("b", "f4")])
    faces[name] = list(cube().face_vertices.reshape(-1, 4).astype(index))
    of_faces = plyfile.PlyElement.describe(faces, "face", len_types={name: size}, val_types={name: index})
    no_rows = plyfile.PlyElement.describe(empty, "edge", len_types={"a": "i1"}, val_types={"a": "i4"})
    elements = [plyfile.PlyElement.describe(vertices, "vertex"), of_faces, no_rows]
    plyfile.PlyData(elements, byte_order=byte_order).write(tmp_path / "cube.ply")
    assert same(ControlCage.from_file(tmp_path / "cube.ply").contents, cube().contents)

    def fail():
        raise OSError("no space left")

    monkeypatch.setattr(tempfile, "TemporaryFile", fail)
    assert same(ControlCage.from_file(tmp_path / "cube.ply").contents, cube().contents)


@pytest.mark.parametrize("byte_order", ["<", ">"])
@pytest.mark.parametrize("corner_counts", [[4, 4, 4], [3, 3, 3], [4, 3, 4], [3, 4, 3], [4, 4, 3]])
def test_tables_and_lists_of_any_length_are_read(tmp_path, np_rng, byte_order, corner_counts):
    # Lists of vertices, numbers of faces, and elements between and after that are neither. Written by hand, as plyfile
    # writes numbers beside lists in the machine's own byte order.
    order = "little" if byte_order == "<" else "big"
    numbers = "double y", "float z", "short weight"
    header = f"ply\nformat binary_{order}_endian 1.0\n"
    header += element("vertex", 5, "float x", "list uchar short pair", *numbers, "list ushort float one")
    header += element("between", 2, "ushort id")
    header += element("face", 3, "uchar id", "list uchar int vertex_indices", "list uint float none")
    header += element("after", 1, "ushort id") + "end_header\n"

    def packed(types, *values):
        return b"".join(np.array(v, byte_order + t).tobytes() for t, v in zip(types.split(), values, strict=True))

    points, weights = np_rng.normal(size=(5, 3)), np_rng.integers(-99, 99, 5)
    faces = [np_rng.permutation(5)[:count] for count in corner_counts]
    content = header.encode()
    for (x, y, z), weight in zip(points, weights, strict=True):
        content += packed("f4 u1 i2 f8 f4 i2 u2 f4", x, 2, [1, 2], y, z, weight, 1, 0.5)
    content += packed("u2", [1, 2])
    for face in faces:
        content += packed("u1 u1 i4 u4", 7, len(face), face, 0)
    content += packed("u2", [3])
    path = tmp_path / "cage.ply"
    path.write_bytes(content)
    with pytest.warns(CageWarning, match='"id" of faces, "none" of faces, the list "pair" of vertices, the list "one"'):
        contents = read_ply(path)
    np.testing.assert_array_equal(contents.face_sizes, corner_counts)
    np.testing.assert_array_equal(contents.face_vertices, np.concatenate(faces))
    np.testing.assert_array_equal(contents.positions[:, 1], points[:, 1])
    np.testing.assert_array_equal(contents.attributes["weight"].values[:, 0], weights)


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="no named pipes")
def test_a_pipe_is_read_once(tmp_path):
    cube().save(tmp_path / "cube.ply")
    os.mkfifo(tmp_path / "pipe.ply")
    content, results = (tmp_path / "cube.ply").read_bytes(), []
    writer = threading.Thread(target=lambda: (tmp_path / "pipe.ply").write_bytes(content), daemon=True)
    reader = threading.Thread(target=lambda: results.append(read_ply(tmp_path / "pipe.ply")), daemon=True)
    writer.start()
    reader.start()
    reader.join(timeout=60)
    assert results
    assert same(results[0], read_ply(tmp_path / "cube.ply"))


# Type and names of properties, and what they become.
COLUMNS = [
    *(("float", names, {"texcoords": names}) for names in ("s t", "u v", "texture_u texture_v")),
    ("float", "nx ny nz quality", {"quality": "quality"}),
    # Bytes as Blender and MeshLab write colours are scaled.
    ("uchar", "red green blue alpha", {"color": "red green blue", "alpha": "alpha"}),
    ("float", "red green blue alpha", {"color": "red green blue", "alpha": "alpha"}),
    ("short", "flow_1 flow_0 group_1", {"flow": "flow_0 flow_1", "group": "group_1"}),
    ("float", "r g b a", {"color": "r g b", "alpha": "a"}),
    ("float", "alpha red", {"alpha": "alpha", "red": "red"}),
    ("float", "red green blue r g b", {"color": "red green blue", "r": "r", "g": "g", "b": "b"}),
    ("float", "color red green blue", {"color": "color", "red": "red", "green": "green", "blue": "blue"}),
    ("float", "n_x n_y n_z n_w", {"n": "n_x n_y n_z", "n_w": "n_w"}),
    ("float", "n_x n_y", {"n_x": "n_x", "n_y": "n_y"}),
    ("uchar", "k_r k_g k_b", {"k_color": "k_r k_g k_b"}),
    ("float", "n_2 n_3 n_1 m_0 m_2", {"n": "n_1 n_2 n_3", "m_0": "m_0", "m_2": "m_2"}),
    ("uchar", "heat_0 heat", {"heat_0": "heat_0", "heat": "heat"}),
    ("float", "heat_0", {"heat": "heat_0"}),
]


@pytest.mark.parametrize(("kind", "properties", "expected"), COLUMNS)
def test_columns_are_attributes_by_their_names(read, np_rng, kind, properties, expected):
    names, rows = properties.split(), np_rng.integers(256, size=(5, len(properties.split())))
    cage = read(with_data([f"{kind} {name}" for name in names], [" ".join(map(str, row)) for row in rows]))
    data = {**cage.attributes, **({"texcoords": cage.texcoords} if cage.texcoords else {})}
    assert list(data) == list(expected)
    for name, columns in expected.items():
        is_color = kind == "uchar" and name in ("color", "alpha", "k_color")
        values = rows[:, [names.index(column) for column in columns.split()]] / (255 if is_color else 1)
        assert data[name].interpolation == "vertex"
        np.testing.assert_array_equal(data[name].values, values)


def test_a_warning_names_ignored_properties(read):
    more = "vertex_indices\nproperty uchar flags\nproperty list uchar float texcoord\n"
    text = SHEET.replace("vertex_indices\n", more).replace("4 0 1 2 3", "4 0 1 2 3 1 0")
    message = 'cage.ply": "flags" of faces, "texcoord" of faces left out; expected numbers at'
    with pytest.warns(CageWarning, match=message):
        read(text.replace("3 1 4 2", "3 1 4 2 1 2 0 1"))


@pytest.mark.parametrize("name", ["material_index", "material_id", "texnumber"])
@pytest.mark.parametrize("before", [False, True])
def test_integers_of_faces_are_materials(read, name, before):
    prop = f"property short {name}\n"
    text = SHEET.replace("property list", f"{prop}property list") if before else SHEET.replace("end_", f"{prop}end_")
    for row, number in (("4 0 1 2 3", "7"), ("3 1 4 2", "-1")):
        text = text.replace(row, f"{number} {row}" if before else f"{row} {number}")
    materials = read(text).materials
    assert {name: faces.tolist() for name, faces in materials.items()} == {"": [1], "material_7": [0]}


ERRORS = [
    ("ply\nformat", "plx\nformat", "line 1: .*expected a PLY file"),
    ("comment a", "comment \xe9", ".*expected a"),
    ("ascii 1.0", "text 1.0", "line 2: .*expected a PLY file"),
    ("double y", "double x", ": two properties with same name"),
    ("double y", "double why", 'the element "vertex" has no property "y"; expected x, y, z among x, why, z'),
    ("vertex_indices", "corners", '"face" has no property "vertex_indices" or "vertex_index"; .* among corners'),
    ("element face 2", "element strip 2", 'there is no element "face" with rows; the file has vertex (5), strip (2)'),
    ("element vertex", "element point", 'there is no element "vertex" with rows; the file has point (5), face (2)'),
    ("list uchar int", "list uchar float", "the vertex indices of faces have type float32; expected integers"),
    ("1 1 0\n", "1 x 0\n", "line 13: element 'vertex': row 2: property 'y': malformed input"),
    ("3 1 4 2\n", "", "line 17: element 'face': row 1: .* (is the file cut short?)"),
    ("3 1 4 2\n", "3 1 4\n", "line 17: element 'face': row 1: .* (is the file cut short?)"),
    ("3 1 4 2", "3 1 5 2", "line 17: face 1 has the vertex index 5; expected 0 to 4"),
    ("3 1 4 2", "3 1 -1 2", "line 17: face 1 has the vertex index -1; expected 0 to 4"),
    ("3 1 4 2", "2 1 4", "line 17: face 1 has 2 vertices; expected at least 3"),
    ("3 1 4 2", "3 1 4 9999999999", "line 17: element 'face': row 1: property 'vertex_indices': malformed input"),
    ("3 1 4 2", "3 1 4 2.0", "line 17: element 'face': row 1: property 'vertex_indices': malformed input"),
    ("double y", "real y", "real"),
    ("end_header", "end", "expected a PLY file"),
    ("element face 2", "element vertex 2", "expected a PLY file"),
    ("2 0.1 0", "2 nan 0", "line 15: vertex 4 has the coordinates"),
    ("2 0.1 0", "1e39 0.1 0", "line 15: vertex 4 has the coordinates (inf, "),
    ("double y", f"double {'y' * 9999}", "yyy"),
    ("uchar int", f"uchar {'i' * 9999}", "iii"),
]


@pytest.mark.parametrize(("old", "new", "message"), ERRORS)
def test_errors_are_short_and_name_the_value_and_place(read, old, new, message):
    assert old in SHEET
    pattern = 'cage.ply".*' + ".*".join(re.escape(part) for part in message.split(".*"))
    with pytest.raises(CageError, match=pattern) as caught:
        read(SHEET.replace(old, new, 1).encode("latin-1"))
    assert len(str(caught.value)) < 600


@pytest.mark.parametrize("form", ["ascii", "binary_little_endian"])
@pytest.mark.parametrize("properties", ["", "property list uchar int a\n", "property float a\nproperty double b\n"])
def test_impossible_counts_are_errors_before_reading(read, form, properties):
    text = f"ply\nformat {form} 1.0\nelement junk 3000000000\n{properties}end_header\n0 0\n"
    with pytest.raises(CageError, match=r'cage.ply": 3000000000 rows of junk do not fit into the file'):
        read(text)


def test_non_finite_numbers_are_errors_without_warnings(read):
    content = SHEET.replace("ascii", "binary_little_endian").replace("double", "float").encode()
    content = content[: content.index(b"0 0 0\n")] + np.zeros(12, "<f4").tobytes()
    faces = b"\x04" + np.arange(4, dtype="<i4").tobytes() + b"\x03" + np.array([1, 4, 2], "<i4").tobytes()
    signalling = b"\x01\x00\xa0\x7f"
    with pytest.raises(CageError, match=r'cage.ply": vertex 4 has the coordinates \(0.0, nan, 0.0\)'):
        read(content + bytes(4) + signalling + bytes(4) + faces)


def test_many_properties_long_names_and_faces_of_more_than_255_vertices_are_read(read, tmp_path):
    names = [f"a{i}_0" for i in range(1500)] + ["b_" + "9" * 5000, "c_0", "c_1", "d_00", "d_01"]
    attributes = read(with_data([f"uchar {name}" for name in names], [" ".join("1" * len(names))] * 5)).attributes
    assert len(attributes) == len(names) - 1
    assert attributes["c"].values.shape == (5, 2)
    ControlCage(np.random.default_rng(0).random((300, 3)), [range(300)]).save(tmp_path / "disk.ply")
    assert ControlCage.from_file(tmp_path / "disk.ply").face_vertices.tolist() == list(range(300))
