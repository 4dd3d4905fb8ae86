"""Tessellations as files."""

import mitsuba as mi
import numpy as np
import pytest
from mitsuba_subdivision import CageWarning, ControlCage, LimitSurface
from mitsuba_subdivision.__main__ import main
from mitsuba_subdivision.cage.named_cages import cube, extraordinary, tetrahedron
from mitsuba_subdivision.files.triangle_writer import write_triangles


@pytest.fixture(scope="module")
def triangles():
    return LimitSurface(extraordinary(5)).tessellate(3)


def data_of(triangles, np_rng):
    count = len(triangles.positions)
    return np_rng.random((count, 2)), {"color": np_rng.random((count, 3)), "weight": np_rng.random((count, 1))}


def save(path, triangles, *data):
    write_triangles(path, triangles.positions, triangles.normals, triangles.triangles, *data)
    assert list(path.parent.iterdir()) == [path]


def test_mitsuba_reads_ply_files(tmp_path, triangles, variant_scalar_rgb, np_rng):  # noqa: ARG001
    texcoords, attributes = data_of(triangles, np_rng)
    path = tmp_path / "surface.ply"
    save(path, triangles, texcoords, attributes)
    found = mi.traverse(mi.load_dict({"type": "ply", "filename": str(path)}))
    vertices = {"positions": triangles.positions, "normals": triangles.normals, "texcoords": texcoords}
    for name, values in vertices.items():
        np.testing.assert_allclose(np.array(found[f"vertex_{name}"]), values.ravel(), atol=1e-6)
    np.testing.assert_array_equal(np.array(found["faces"]), triangles.triangles.ravel())


def test_mitsuba_reads_obj_files(tmp_path, triangles, variant_scalar_rgb, np_rng):  # noqa: ARG001
    texcoords, _ = data_of(triangles, np_rng)
    path = tmp_path / "surface.obj"
    save(path, triangles, texcoords)
    found = mi.traverse(mi.load_dict({"type": "obj", "filename": str(path), "flip_tex_coords": False}))
    faces = np.array(found["faces"])
    for name, values in (("positions", triangles.positions), ("normals", triangles.normals), ("texcoords", texcoords)):
        # Mitsuba numbers vertices anew.
        read = np.array(found[f"vertex_{name}"]).reshape(-1, values.shape[1])[faces]
        # Its parser of numbers is right to a few units in the last place.
        np.testing.assert_allclose(read, values[triangles.triangles.ravel()], rtol=1e-6, atol=1e-7)


@pytest.mark.core
@pytest.mark.parametrize("dtype", [np.float32, np.float64])
@pytest.mark.parametrize("with_texcoords", [False, True])
def test_obj_files_keep_every_bit(tmp_path, triangles, np_rng, dtype, with_texcoords):
    count = len(triangles.positions)
    positions = (np_rng.normal(size=(count, 3)) * 10.0 ** np_rng.integers(-30, 30, (count, 3))).astype(dtype)
    texcoords = np_rng.random((count, 2)).astype(dtype) if with_texcoords else None
    path = tmp_path / "surface.obj"
    write_triangles(path, positions, triangles.normals, triangles.triangles, texcoords)
    found = ControlCage.from_file(path)
    np.testing.assert_array_equal(found.positions.astype(dtype), positions)
    np.testing.assert_array_equal(found.face_vertices, triangles.triangles.ravel())
    if with_texcoords:
        corners = found.texcoords.values[found.texcoords.indices]
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
    assert mesh.GetSubdivisionSchemeAttr().Get() == "none"
    assert mesh.GetNormalsInterpolation() == "vertex"
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


@pytest.mark.parametrize("name", ["a.stl", "a.usdz", "a"])
def test_unknown_formats_name_the_known_ones(tmp_path, triangles, name):
    with pytest.raises(ValueError, match=r"of triangles; expected one of .obj, .ply, .usd, .usda, .usdc$"):
        triangles.save(tmp_path / name)


def test_command(tmp_path, capsys):
    cube().save(tmp_path / "cube.obj")
    words = ["tessellate", str(tmp_path / "cube.obj"), "--rate", "2", "-o"]
    assert main([*words, str(tmp_path / "out.ply")]) == 0
    assert capsys.readouterr().out == f"{tmp_path / 'out.ply'}: 48 triangles, 26 vertices\n"
    found = ControlCage.from_file(tmp_path / "out.ply")
    expected = LimitSurface(cube()).tessellate(2)
    np.testing.assert_array_equal(found.positions, expected.positions.astype(np.float32))
    np.testing.assert_array_equal(found.face_vertices, expected.triangles.ravel())
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
