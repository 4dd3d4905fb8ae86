"""Tessellations, and cages in OBJ, as files."""

import mitsuba as mi
import numpy as np
import pytest
from mitsuba_subdivision import CageWarning, ControlCage, LimitSurface
from mitsuba_subdivision.__main__ import main
from mitsuba_subdivision.cage.named_cages import cube, extraordinary
from mitsuba_subdivision.files.formats import write_triangles
from mitsuba_subdivision.files.obj_writer import write_obj
from patches.closed_cages import tetrahedron


@pytest.fixture(scope="module")
def triangles():
    return LimitSurface(extraordinary(5)).tessellate(3)


def data_of(triangles, np_rng):
    count = len(triangles.positions)
    return np_rng.random((count, 2)), {"color": np_rng.random((count, 3)), "weight": np_rng.random((count, 1))}


def save(path, triangles, *data):
    write_triangles(path, triangles.positions, triangles.normals, triangles.triangles, *data)
    assert list(path.parent.iterdir()) == [path]


# Of OBJ files, Mitsuba numbers vertices anew, and its parser of numbers is right to a few units in the last place.
@pytest.mark.parametrize(
    ("kind", "options", "rtol", "atol"), [("ply", {}, 1e-7, 1e-6), ("obj", {"flip_tex_coords": False}, 1e-6, 1e-7)]
)
def test_mitsuba_reads_files(tmp_path, triangles, variant_scalar_rgb, np_rng, kind, options, rtol, atol):  # noqa: ARG001
    texcoords, attributes = data_of(triangles, np_rng)
    path = tmp_path / f"surface.{kind}"
    save(path, triangles, texcoords, attributes if kind == "ply" else None)
    shape = mi.traverse(mi.load_dict({"type": kind, "filename": str(path), **options}))
    faces, corners = np.array(shape["faces"]), triangles.triangles.ravel()
    assert kind == "obj" or np.array_equal(faces, corners)
    for name, values in (("positions", triangles.positions), ("normals", triangles.normals), ("texcoords", texcoords)):
        read = np.array(shape[f"vertex_{name}"]).reshape(-1, values.shape[1])[faces]
        np.testing.assert_allclose(read, values[corners], rtol=rtol, atol=atol)


@pytest.mark.core
@pytest.mark.parametrize("dtype", [np.float32, np.float64])
@pytest.mark.parametrize("with_texcoords", [False, True])
def test_obj_files_keep_every_bit(tmp_path, triangles, np_rng, dtype, with_texcoords):
    count = len(triangles.positions)
    positions = (np_rng.normal(size=(count, 3)) * 10.0 ** np_rng.integers(-30, 30, (count, 3))).astype(dtype)
    texcoords = np_rng.random((count, 2)).astype(dtype) if with_texcoords else None
    path = tmp_path / "surface.obj"
    write_triangles(path, positions, triangles.normals, triangles.triangles, texcoords)
    cage = ControlCage.from_file(path)
    np.testing.assert_array_equal(cage.positions.astype(dtype), positions)
    np.testing.assert_array_equal(cage.face_vertices, triangles.triangles.ravel())
    if with_texcoords:
        corners = cage.texcoords.values[cage.texcoords.indices]
        np.testing.assert_array_equal(corners.astype(dtype), texcoords[triangles.triangles.ravel()])
    normals = np.loadtxt(line[3:] for line in path.read_text().splitlines() if line.startswith("vn "))
    np.testing.assert_array_equal(normals, triangles.normals)


@pytest.mark.parametrize("suffix", [".usd", ".usda", ".usdc"])
def test_usd_reads_usd_files(tmp_path, triangles, np_rng, suffix):
    pytest.importorskip("pxr")
    from pxr import Usd, UsdGeom

    texcoords, attributes = data_of(triangles, np_rng)
    path = tmp_path / f"surface{suffix}"
    save(path, triangles, texcoords, attributes)
    stage = Usd.Stage.Open(str(path))
    mesh = UsdGeom.Mesh(stage.GetDefaultPrim())
    assert (mesh.GetSubdivisionSchemeAttr().Get(), mesh.GetNormalsInterpolation()) == ("none", "vertex")
    np.testing.assert_array_equal(mesh.GetPointsAttr().Get(), triangles.positions.astype(np.float32))
    np.testing.assert_array_equal(mesh.GetNormalsAttr().Get(), triangles.normals.astype(np.float32))
    np.testing.assert_array_equal(mesh.GetFaceVertexCountsAttr().Get(), np.full(len(triangles.triangles), 3))
    np.testing.assert_array_equal(mesh.GetFaceVertexIndicesAttr().Get(), triangles.triangles.ravel())
    primvars = UsdGeom.PrimvarsAPI(mesh)
    for name, values in {"st": texcoords, **attributes, "weight": attributes["weight"][:, 0]}.items():
        np.testing.assert_array_equal(primvars.GetPrimvar(name).Get(), values.astype(np.float32))
    assert primvars.GetPrimvar("st").GetInterpolation() == "vertex"
    extent = [triangles.positions.min(axis=0), triangles.positions.max(axis=0)]
    np.testing.assert_allclose(mesh.GetExtentAttr().Get(), extent, rtol=1e-6)


@pytest.mark.parametrize("suffix", [".obj", ".ply", ".usda"])
def test_a_warning_names_attributes_without_a_place(tmp_path, triangles, suffix):
    if suffix == ".usda":
        pytest.importorskip("pxr")
    values = {"a b": np.zeros((len(triangles.positions), 1))}
    with pytest.warns(CageWarning, match=f'{suffix} files have no place for attribute "a b"'):
        save(tmp_path / f"a{suffix}", triangles, None, values)


def test_command(tmp_path, capsys):
    cube().save(tmp_path / "cube.obj")
    words = ["tessellate", str(tmp_path / "cube.obj"), "--rate", "2", "-o"]
    assert main([*words, str(tmp_path / "out.ply")]) == 0
    assert capsys.readouterr().out == f"{tmp_path / 'out.ply'}: 48 triangles, 26 vertices\n"
    cage = ControlCage.from_file(tmp_path / "out.ply")
    expected = LimitSurface(cube()).tessellate(2)
    np.testing.assert_array_equal(cage.positions, expected.positions.astype(np.float32))
    np.testing.assert_array_equal(cage.face_vertices, expected.triangles.ravel())
    # With every digit.
    assert main([*words, str(tmp_path / "out.obj")]) == 0
    np.testing.assert_array_equal(ControlCage.from_file(tmp_path / "out.obj").positions, expected.positions)
    expected.save(tmp_path / "saved.obj")
    assert (tmp_path / "saved.obj").read_bytes() == (tmp_path / "out.obj").read_bytes()


def test_command_chooses_scheme_mesh_and_time(tmp_path, capsys):
    pytest.importorskip("pxr")
    from pxr import Usd, UsdGeom

    path = tmp_path / "cages.usda"
    stage = Usd.Stage.CreateNew(str(path))
    for name, cage in (("cube", cube()), ("tetrahedron", tetrahedron())):
        mesh = UsdGeom.Mesh.Define(stage, f"/{name}")
        for time in (1, 2):
            mesh.CreatePointsAttr().Set((time * cage.positions).astype(np.float32), time)
        mesh.CreateFaceVertexCountsAttr(cage.face_sizes.astype(np.int32))
        mesh.CreateFaceVertexIndicesAttr(cage.face_vertices.astype(np.int32))
    mesh.CreateSubdivisionSchemeAttr("loop")
    stage.Save()
    words = ["tessellate", str(path), "-o", str(tmp_path / "out.ply"), "--rate", "2"]
    assert main(words) == 1
    assert "there are 2 meshes; expected prim to name one of /cube, /tetrahedron" in capsys.readouterr().err
    assert main([*words, "--prim", "/tetrahedron", "--time", "2"]) == 0
    loop = LimitSurface(tetrahedron(), "loop").tessellate(2)
    np.testing.assert_allclose(ControlCage.from_file(tmp_path / "out.ply").positions, 2 * loop.positions, atol=1e-6)
    assert main([*words, "--prim", "/tetrahedron", "--scheme", "catmull_clark"]) == 0
    message = f'mitsuba-subdivision: warning: "{path}", prim /tetrahedron: subdivisionScheme is "loop"; '
    assert capsys.readouterr().err.startswith(message)
    assert main(["tessellate", str(path), "-o", str(tmp_path / "out.txt")]) == 1
    assert 'unknown format ".txt" of triangles; expected one of .obj, .ply, .usd' in capsys.readouterr().err


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
    again = ControlCage.from_file(tmp_path / "cage.obj")
    np.testing.assert_array_equal(again.face_vertices, square.ravel())
    assert [faces.tolist() for faces in again.materials.values()] == list(materials.values())
    again.save(tmp_path / "again.obj")
    assert ControlCage.from_file(tmp_path / "again.obj").materials.keys() == again.materials.keys()
    with pytest.warns(CageWarning, match='no place for material "a # b", further materials of a face of the cage'):
        ControlCage(cube().positions, square, materials={"a": [0, 1], "a # b": [1]}).save(tmp_path / "cage.obj")
    again = ControlCage.from_file(tmp_path / "cage.obj").materials
    assert {name: faces.tolist() for name, faces in again.items()} == {"": [1, 2, 3, 4, 5], "a": [0]}


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
