import gzip
import subprocess
import sys
from types import SimpleNamespace

import mitsuba as mi
import numpy as np
import pytest
from mitsuba_subdivision import CageError, CageWarning, ControlCage, LimitSurface
from mitsuba_subdivision.__main__ import main
from mitsuba_subdivision.cage import Attribute
from mitsuba_subdivision.cage.contents import RULES, CageContents, same
from mitsuba_subdivision.cage.named_cages import cube, extraordinary
from mitsuba_subdivision.files.formats import FORMATS, Format, Triangles, write_triangles
from patches.closed_cages import tetrahedron
from reference.refined_cages import tagged
from usd import stages

USD = (".usd", ".usda", ".usdc")


def test_a_new_format_is_a_module_and_a_line(monkeypatch, tmp_path):
    names = ("positions", "face_sizes", "face_vertices")
    module = SimpleNamespace(
        read=lambda path: CageContents(*np.load(path).values()),
        write=lambda contents, path: np.savez(path, **{name: getattr(contents, name) for name in names}),
    )
    monkeypatch.setitem(sys.modules, "mitsuba_subdivision.files.npz", module)
    monkeypatch.setitem(FORMATS, ".npz", Format("npz:read", "npz:write"))
    cube().save(tmp_path / "cube.npz")
    np.testing.assert_array_equal(ControlCage.from_file(tmp_path / "cube.npz").positions, cube().positions)
    with pytest.raises(ValueError, match=r'unknown format ".npz" of triangles; expected one of .obj, .ply, .usd, '):
        LimitSurface(cube()).tessellate(2).save(tmp_path / "triangles.npz")


def test_cages_files_and_libraries_are_imported_on_use_only(tmp_path):
    """After each of several lines in a new process: modules of cages, of files and of their formats."""
    cube().save(tmp_path / "cube.obj")
    packages = ("mitsuba_subdivision.cage", "mitsuba_subdivision.files", "pxr", "plyfile")
    names = f"print(*(name for name in sys.modules if name.startswith({packages})))"
    lines = ["import mitsuba_subdivision", "from mitsuba_subdivision import ControlCage"]
    lines += [f"ControlCage.from_file({str(tmp_path / 'cube.obj')!r})", "import mitsuba_subdivision.surface"]
    code = "\n".join(["import sys", *(f"{line}\n{names}" for line in lines)])
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    package, cage, reader, surface = (set(line.split()) for line in done.stdout.split("\n")[: len(lines)])
    assert package == {name for name in cage if ".files" in name} == set()
    assert "mitsuba_subdivision.files.obj" in reader
    assert not {"pxr", "plyfile"} & (reader | surface)


def skip_without_package(suffix):
    if suffix.lower() != ".obj":
        pytest.importorskip("plyfile" if suffix == ".ply" else "pxr")


@pytest.mark.parametrize("suffix", FORMATS)
def test_missing_files_folders_and_link_cycles_are_named(suffix, tmp_path):
    skip_without_package(suffix)
    with pytest.raises(FileNotFoundError, match=rf"missing\{suffix}"):
        ControlCage.from_file(tmp_path / f"missing{suffix}")
    if FORMATS[suffix].write:
        with pytest.raises(FileNotFoundError, match=rf'cage\{suffix}": there is no folder ".*missing"'):
            cube().save(tmp_path / "missing" / f"cage{suffix}")
    assert list(tmp_path.iterdir()) == []
    folder, link = tmp_path / f"folder{suffix}", tmp_path / f"link{suffix}"
    folder.mkdir()
    with pytest.raises(CageError, match=r'folder\..*" is a folder; expected a file'):
        ControlCage.from_file(folder)
    if sys.platform != "win32":
        link.symlink_to(link)
        with pytest.raises(CageError, match="is a link that leads back to itself"):
            ControlCage.from_file(link)


def test_a_path_of_a_wrong_type_or_an_unknown_format_is_an_error():
    for call in (ControlCage.from_file, cube().save):
        with pytest.raises(CageError, match="path 3; expected a str or Path"):
            call(3)
        for path, suffix in (("cube.fbx", ".fbx"), ("cube", ""), ("obj", "")):
            with pytest.raises(CageError, match=f'{path}": unknown cage format "{suffix}"; expected one of .obj'):
                call(path)


@pytest.mark.parametrize(("suffix", "module", "name"), [(".ply", "plyfile", "plyfile"), (".usda", "pxr", "usd-core")])
def test_a_missing_package_is_named(suffix, module, name, tmp_path, monkeypatch):
    skip_without_package(suffix)
    path = tmp_path / f"cube{suffix}"
    cube().save(path)
    monkeypatch.setitem(sys.modules, module, None)
    for act in (ControlCage.from_file, *([cube().save] if module == "pxr" else [])):
        with pytest.raises(CageError, match=rf'the package {name}, .* pip install "mitsuba-subdivision\[files\]"'):
            act(path)


@pytest.mark.parametrize(("option", "suffix"), [({"prim": "/a"}, ".obj"), ({"time": 0}, ".ply")])
def test_options_of_usd_files_are_errors_elsewhere(tmp_path, option, suffix):
    cube().save(tmp_path / f"cube{suffix}")
    (given,) = option.items()
    with pytest.raises(CageError, match="{} {!r} was given; expected it for USD files only".format(*given)):
        ControlCage.from_file(tmp_path / f"cube{suffix}", **option)


# Names that look like those of other columns.
NAMES_IN_PLY = ("alpha", "weight", "weight_0", "r", "u", "b_x", "x")


def with_all_data(cage, suffix, number, rng):
    """A cage of random numbers with all that files of a format hold, in their precision."""
    count, corners, faces = cage.vertex_count, len(cage.face_vertices), cage.face_count

    def numbers(*shape, exponent=0):
        values = rng.normal(size=shape) * 10.0 ** rng.integers(-exponent, exponent + 1, shape)
        return values.astype(np.float32) if suffix in USD else values

    sharp = [(*cage.face_vertices[:2].tolist(), 2.5), (*cage.face_vertices[1:3].tolist(), 12)]
    data = {"creases": sharp, "corners": [(2, 10), (0, 1.25)], "holes": [0] * (faces > 1)}
    data["texcoords"] = Attribute(numbers(5, 2), "face_varying", rng.integers(5, size=corners))
    if suffix in USD:
        attributes = {"displayColor": Attribute(numbers(count, 3)), "weight": Attribute(numbers(count, 1), "varying")}
        attributes |= {"mask": Attribute(numbers(corners, 4), "face_varying"), "a:deep": Attribute(numbers(count, 7))}
        data |= {"scheme": "loop", "attributes": attributes}
    elif suffix == ".ply":
        sizes = {**dict.fromkeys(NAMES_IN_PLY, 1), "color": (1, 3, 4)[number % 3], "flow": 12}
        attributes = {name: Attribute(numbers(count, size)) for name, size in sizes.items()}
        owner = rng.integers(-1, 3, faces)
        numbers_of = {"": -1, "material_0": 0, "material_12": 1, "material_2": 2}
        materials = {name: np.flatnonzero(owner == number) for name, number in numbers_of.items() if number in owner}
        data = {"texcoords": Attribute(numbers(count, 2)), "attributes": attributes, "materials": materials}
    return numbers(count, 3, exponent=30), cage.face_sizes, cage.face_vertices, data


@pytest.mark.core
@pytest.mark.parametrize("suffix", [".OBJ", ".ply", *USD])
def test_saved_cages_are_read_back(any_cage, suffix, request, tmp_path, np_rng):
    """Bit by bit, with every rule that tags of OBJ and tokens of USD stand for; what was there is replaced."""
    skip_without_package(suffix)
    number = request.node.callspec.indices["any_cage"]
    *arrays, data = with_all_data(any_cage, suffix, number, np_rng)
    rules = {rule: values[number % len(values)] for rule, values in RULES.items() if suffix != ".ply"}
    if suffix in USD:
        rules["crease_method"] = "uniform"
    path, cage = tmp_path / f"cage{suffix}", ControlCage.from_arrays(*arrays, **data, **rules)
    any_cage.save(path)
    cage.save(path)
    again = ControlCage.from_file(str(path) if number % 2 else path)
    assert same(again.contents, cage.contents)
    assert suffix in USD or list(again.attributes) == list(cage.attributes)
    assert again.source.name.startswith(f'"{path}"')
    assert list(tmp_path.iterdir()) == [path]


ONE, TWO = (Attribute(np.zeros((4, size))) for size in (1, 2))
TAGS = {"creases": [(0, 1, 2)], "corners": [(0, 2)], "holes": [1]}
OF_CORNERS = {"texcoords": Attribute(np.zeros((12, 2)), "face_varying")}
CHOSEN = {"boundary": "edge_only", "triangle_rule": "smooth", "scheme": "loop"}
VARYING = {"a b": ONE, "kept": ONE, "v": Attribute(np.zeros((4, 1)), "varying")}
# What a cage has, what of it has no place in a file, and which attributes are read back.
NO_PLACE = {
    ".obj": (
        {"texcoords": TWO, "attributes": {"colour": TWO, "weight": TWO}, "scheme": "loop"},
        'texcoords, attribute "colour", attribute "weight", scheme',
        [],
    ),
    ".ply": (
        {**TAGS, **OF_CORNERS, **CHOSEN, "attributes": VARYING},
        'creases, corners, holes, boundary, triangle_rule, scheme, texcoords, attribute "a b", attribute "v"',
        ["kept"],
    ),
    ".usda": (
        {"crease_method": "chaikin", "scheme": "doo_sabin", "attributes": {"a b": ONE}},
        'crease_method "chaikin", scheme "doo_sabin", attribute "a b"',
        [],
    ),
}


@pytest.mark.parametrize("suffix", NO_PLACE)
def test_a_warning_names_data_without_a_place_in_the_format(suffix, tmp_path):
    skip_without_package(suffix)
    given, lost, kept = NO_PLACE[suffix]
    cage = ControlCage(tetrahedron().positions, tetrahedron().face_vertices.reshape(-1, 3), **given)
    message = rf'cage\{suffix}": {suffix} files have no place for {lost} of the cage; written without'
    with pytest.warns(CageWarning, match=message):
        cage.save(tmp_path / f"cage{suffix}")
    again = ControlCage.from_file(tmp_path / f"cage{suffix}")
    assert (again.texcoords, list(again.attributes)) == (None, kept)
    triangles = LimitSurface(cube()).tessellate(1)
    with pytest.warns(CageWarning, match=f'{suffix} files have no place for attribute "a b"'):
        save(tmp_path / f"a{suffix}", triangles, None, {"a b": np.zeros((len(triangles.positions), 1))})


OTHER_FILES = {
    "UTF-16": ("v 0 0 0\n".encode("utf-16"), "text in UTF-16"),
    "UTF-16, no mark": ("v 0 0 0\n".encode("utf-16-le"), "text in UTF-16"),
    "UTF-16, other order": ("v 0 0 0\n".encode("utf-16-be"), "text in UTF-16"),
    "gzip": (gzip.compress(b"v 0 0 0\n"), "compressed with gzip"),
    "zip": (b"PK\x03\x04rest", "a zip archive"),
}


@pytest.mark.parametrize(("content", "what"), OTHER_FILES.values(), ids=OTHER_FILES)
def test_errors_of_obj_files_name_the_true_format(content, what, tmp_path):
    path = tmp_path / "cage.obj"
    path.write_bytes(content)
    with pytest.raises(CageError, match=what):
        ControlCage.from_file(path)


def named(cage):
    return {name: faces.tolist() for name, faces in cage.materials.items()}


def test_materials_of_obj_files_have_names(tmp_path):
    materials = {"": [0], "red 100%": [1, 4], "großes Glas": [2, 3, 5]}
    tagged(cube(), materials=materials).save(tmp_path / "cage.obj")
    again = ControlCage.from_file(tmp_path / "cage.obj")
    assert [*named(again).values()] == [*materials.values()]
    again.save(tmp_path / "again.obj")
    assert named(ControlCage.from_file(tmp_path / "again.obj")) == named(again)
    with pytest.warns(CageWarning, match='no place for material "a # b", further materials of a face of the cage'):
        tagged(cube(), materials={"a": [0, 1], "a # b": [1]}).save(tmp_path / "cage.obj")
    assert named(ControlCage.from_file(tmp_path / "cage.obj")) == {"": [1, 2, 3, 4, 5], "a": [0]}


def test_materials_of_ply_files_have_numbers(tmp_path):
    skip_without_package(".ply")
    with pytest.warns(CageWarning, match='no place for the name of material "red" of the cage; written'):
        tagged(cube(), materials={"red": [1], "material_0": [2]}).save(tmp_path / "cage.ply")
    expected = {"": [0, 3, 4, 5], "material_0": [2], "material_1": [1]}
    assert named(ControlCage.from_file(tmp_path / "cage.ply")) == expected


@pytest.fixture(scope="module")
def triangles():
    return LimitSurface(extraordinary(5)).tessellate(3)


def data_of(triangles, np_rng):
    count = len(triangles.positions)
    return np_rng.random((count, 2)), {"color": np_rng.random((count, 3)), "weight": np_rng.random((count, 1))}


def save(path, triangles, *data):
    write_triangles(path, Triangles(triangles.positions, triangles.normals, triangles.triangles, *data))


# Mitsuba numbers vertices of OBJ files anew, and its parser of numbers is right to a few units in the last place.
@pytest.mark.parametrize(
    ("kind", "options", "rtol", "atol"), [("ply", {}, 1e-7, 1e-6), ("obj", {"flip_tex_coords": False}, 1e-6, 1e-7)]
)
def test_mitsuba_reads_files(tmp_path, triangles, variant_scalar_rgb, np_rng, kind, options, rtol, atol):  # noqa: ARG001
    texcoords, attributes = data_of(triangles, np_rng)
    path = tmp_path / f"surface.{kind}"
    save(path, triangles, texcoords, attributes if kind == "ply" else {})
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
    write_triangles(path, Triangles(positions, triangles.normals, triangles.triangles, texcoords, {}))
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


def test_command(tmp_path, capsys):
    cube().save(tmp_path / "cube.obj")
    words = ["tessellate", str(tmp_path / "cube.obj"), "--rate", "2", "-o"]
    assert main([*words, str(tmp_path / "out.ply")]) == 0
    assert capsys.readouterr().out == f"{tmp_path / 'out.ply'}: 48 triangles, 26 vertices\n"
    cage = ControlCage.from_file(tmp_path / "out.ply")
    expected = LimitSurface(cube()).tessellate(2)
    np.testing.assert_array_equal(cage.positions, expected.positions.astype(np.float32))
    np.testing.assert_array_equal(cage.face_vertices, expected.triangles.ravel())
    assert main([*words, str(tmp_path / "out.obj")]) == 0
    np.testing.assert_array_equal(ControlCage.from_file(tmp_path / "out.obj").positions, expected.positions)
    expected.save(tmp_path / "saved.obj")
    assert (tmp_path / "saved.obj").read_bytes() == (tmp_path / "out.obj").read_bytes()


def test_command_chooses_scheme_mesh_and_time(tmp_path, capsys):
    pytest.importorskip("pxr")
    text = ""
    for name, cage, scheme in (("cube", cube(), "catmullClark"), ("tetrahedron", tetrahedron(), "loop")):
        text += stages.mesh_of(cage, name, {time: time * cage.positions for time in (1, 2)}, scheme)
    path = stages.write(tmp_path, text, "cages.usda")
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
