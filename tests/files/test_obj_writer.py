import numpy as np
import pytest
from mitsuba_subdivision.cage import Attribute, CageWarning, ControlCage
from mitsuba_subdivision.cage.named_cages import cube, tetrahedron
from mitsuba_subdivision.files.obj_writer import write_obj


def test_file_is_plain_obj(tmp_path):
    cage = ControlCage([[0, 0.1, -0.0], [1, 0, 1e-300], [0, 1, 0], [1, 1, 0]], [[0, 1, 3, 2], [1, 0, 2]])
    write_obj(cage.contents, tmp_path / "cage.obj")
    assert (tmp_path / "cage.obj").read_text() == (
        "# 4 vertices, 2 faces\nv 0.0 0.1 -0.0\nv 1.0 0.0 1e-300\nv 0.0 1.0 0.0\nv 1.0 1.0 0.0\nf 1 2 4 3\nf 2 1 3\n"
    )


def test_a_warning_names_what_has_no_place(tmp_path):
    vertex = Attribute(np.zeros((4, 2)))
    cage = ControlCage(
        tetrahedron().positions,
        tetrahedron().face_vertices.reshape(-1, 3),
        texcoords=vertex,
        attributes={"colour": vertex, "weight": vertex},
        scheme="loop",
    )
    message = 'cage.obj": .obj files have no place for texcoords, attribute "colour", attribute "weight", scheme of the'
    with pytest.warns(CageWarning, match=message):
        cage.save(tmp_path / "cage.obj")
    assert ControlCage.from_file(tmp_path / "cage.obj").texcoords is None


def test_existing_file_is_replaced_and_nothing_else_is_left(tmp_path):
    path = tmp_path / "cage.obj"
    write_obj(cube().contents, path)
    write_obj(tetrahedron().contents, str(path))
    np.testing.assert_array_equal(ControlCage.from_file(path).positions, tetrahedron().positions)
    assert list(tmp_path.iterdir()) == [path]


def test_failure_leaves_the_existing_file(tmp_path, monkeypatch):
    path = tmp_path / "cage.obj"
    write_obj(cube().contents, path)
    before = path.read_bytes()

    def fail(*_):
        raise OSError("disk full")

    monkeypatch.setattr("pathlib.Path.replace", fail)
    with pytest.raises(OSError, match="disk full"):
        write_obj(tetrahedron().contents, path)
    assert path.read_bytes() == before
    assert list(tmp_path.iterdir()) == [path]


def test_missing_folder_is_an_os_error(tmp_path):
    with pytest.raises(FileNotFoundError, match=r'cage.obj": there is no folder ".*missing"'):
        write_obj(cube().contents, tmp_path / "missing" / "cage.obj")
