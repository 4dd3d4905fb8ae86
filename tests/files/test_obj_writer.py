import numpy as np
import pytest
from mitsuba_subdivision.cage import CageWarning, ControlCage
from mitsuba_subdivision.cage.named_cages import cube, tetrahedron
from mitsuba_subdivision.files.obj_writer import write_obj


def test_file_is_plain_obj(tmp_path):
    cage = ControlCage([[0, 0.1, -0.0], [1, 0, 1e-300], [0, 1, 0], [1, 1, 0]], [[0, 1, 3, 2], [1, 0, 2]])
    write_obj(cage.contents, tmp_path / "cage.obj")
    vertices = "v 0.0 0.1 -0.0\nv 1.0 0.0 1e-300\nv 0.0 1.0 0.0\nv 1.0 1.0 0.0\n"
    expected = f"# 4 vertices, 2 faces\n{vertices}f 1 2 4 3\nf 2 1 3\n"
    assert (tmp_path / "cage.obj").read_text() == expected


def test_materials_are_read_back(tmp_path):
    materials = {"": [0], "red 100%": [1, 4], "großes Glas": [2, 3, 5]}
    square = cube().face_vertices.reshape(-1, 4)
    ControlCage(cube().positions, square, materials=materials).save(tmp_path / "cage.obj")
    found = ControlCage.from_file(tmp_path / "cage.obj")
    np.testing.assert_array_equal(found.face_vertices, square.ravel())
    assert [faces.tolist() for faces in found.materials.values()] == list(materials.values())
    found.save(tmp_path / "again.obj")
    assert ControlCage.from_file(tmp_path / "again.obj").materials.keys() == found.materials.keys()
    with pytest.warns(CageWarning, match='no place for material "a # b", further materials of a face of the cage'):
        ControlCage(cube().positions, square, materials={"a": [0, 1], "a # b": [1]}).save(tmp_path / "cage.obj")
    found = ControlCage.from_file(tmp_path / "cage.obj").materials
    assert {name: faces.tolist() for name, faces in found.items()} == {"": [1, 2, 3, 4, 5], "a": [0]}


def test_existing_file_is_replaced_and_nothing_else_is_left_but_stays_where_that_fails(tmp_path, monkeypatch):
    path = tmp_path / "cage.obj"
    write_obj(cube().contents, path)
    write_obj(tetrahedron().contents, str(path))
    np.testing.assert_array_equal(ControlCage.from_file(path).positions, tetrahedron().positions)
    assert list(tmp_path.iterdir()) == [path]
    before = path.read_bytes()

    def fail(*_):
        raise OSError("disk full")

    monkeypatch.setattr("pathlib.Path.replace", fail)
    with pytest.raises(OSError, match="disk full"):
        write_obj(cube().contents, path)
    assert path.read_bytes() == before
    assert list(tmp_path.iterdir()) == [path]
