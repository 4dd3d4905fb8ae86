"""The table of file formats."""

import gzip
import subprocess
import sys
from types import SimpleNamespace

import numpy as np
import pytest
from mitsuba_subdivision import CageError, CageWarning, ControlCage, LimitSurface
from mitsuba_subdivision.cage import Attribute
from mitsuba_subdivision.cage.contents import CageContents
from mitsuba_subdivision.cage.named_cages import cube
from mitsuba_subdivision.files.formats import FORMATS, Format
from patches.closed_cages import tetrahedron


def test_a_new_format_is_a_module_and_a_line(monkeypatch, tmp_path):
    def read(path):
        arrays = np.load(path)
        return CageContents(arrays["positions"], arrays["face_sizes"], arrays["face_vertices"])

    def write(contents, path):
        names = ("positions", "face_sizes", "face_vertices")
        np.savez(path, **{name: getattr(contents, name) for name in names})

    module = SimpleNamespace(read=read, write=write)
    monkeypatch.setitem(sys.modules, "mitsuba_subdivision.files.npz", module)
    monkeypatch.setitem(FORMATS, ".npz", Format("npz:read", "npz:write"))
    cube().save(tmp_path / "cube.npz")
    np.testing.assert_array_equal(ControlCage.from_file(tmp_path / "cube.npz").positions, cube().positions)
    with pytest.raises(ValueError, match=r'unknown format ".npz" of triangles; expected one of .obj, .ply, .usd, '):
        LimitSurface(cube()).tessellate(2).save(tmp_path / "triangles.npz")


def test_neither_cages_nor_files_are_imported_with_the_package_and_readers_only_where_they_are_used(tmp_path):
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
    assert "mitsuba_subdivision.files.obj_reader" in reader
    assert not {"mitsuba_subdivision.files.usd_reader", "pxr", "plyfile"} & (reader | surface)


@pytest.mark.parametrize("suffix", FORMATS)
def test_folders_and_circles_of_links_are_named(suffix, tmp_path):
    folder, link = tmp_path / f"folder{suffix}", tmp_path / f"link{suffix}"
    folder.mkdir()
    with pytest.raises(CageError, match=r'folder\..*" is a folder; expected a file'):
        ControlCage.from_file(folder)
    if sys.platform != "win32":
        link.symlink_to(link)
        with pytest.raises(CageError, match="is a link that leads back to itself"):
            ControlCage.from_file(link)


def skip_without_package(suffix):
    if suffix != ".obj":
        pytest.importorskip("plyfile" if suffix == ".ply" else "pxr")


@pytest.mark.parametrize("suffix", FORMATS)
def test_missing_files_and_folders_are_os_errors(suffix, tmp_path):
    skip_without_package(suffix)
    with pytest.raises(FileNotFoundError, match=rf"missing\{suffix}"):
        ControlCage.from_file(tmp_path / f"missing{suffix}")
    if FORMATS[suffix].write:
        with pytest.raises(FileNotFoundError, match=rf'cage\{suffix}": there is no folder ".*missing"'):
            cube().save(tmp_path / "missing" / f"cage{suffix}")
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(("suffix", "module", "name"), [(".ply", "plyfile", "plyfile"), (".usda", "pxr", "usd-core")])
def test_a_missing_package_is_named(suffix, module, name, tmp_path, monkeypatch):
    skip_without_package(suffix)
    path = tmp_path / f"cube{suffix}"
    cube().save(path)
    monkeypatch.setitem(sys.modules, module, None)
    message = rf'the package {name}, .* pip install "mitsuba-subdivision\[files\]"'
    for act in (ControlCage.from_file, *([cube().save] if module == "pxr" else [])):
        with pytest.raises(CageError, match=message):
            act(path)


ONE, TWO = (Attribute(np.zeros((4, size))) for size in (1, 2))
TAGS = {"creases": [(0, 1, 2)], "corners": [(0, 2)], "holes": [1]}
RULES = {"boundary": "edge_only", "triangle_rule": "smooth", "scheme": "loop"}
OF_CORNERS = {"texcoords": Attribute(np.zeros((12, 2)), "face_varying")}
VARYING = {"a b": ONE, "kept": ONE, "v": Attribute(np.zeros((4, 1)), "varying")}
# What a cage has, what of it has no place in a file, and which attributes are read back.
NO_PLACE = {
    ".obj": (
        {"texcoords": TWO, "attributes": {"colour": TWO, "weight": TWO}, "scheme": "loop"},
        'texcoords, attribute "colour", attribute "weight", scheme',
        [],
    ),
    ".ply": (
        {**TAGS, **RULES, **OF_CORNERS, "attributes": VARYING},
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
def test_a_warning_names_what_has_no_place(suffix, tmp_path):
    skip_without_package(suffix)
    given, lost, kept = NO_PLACE[suffix]
    cage = ControlCage(tetrahedron().positions, tetrahedron().face_vertices.reshape(-1, 3), **given)
    message = rf'cage\{suffix}": {suffix} files have no place for {lost} of the cage; written without'
    with pytest.warns(CageWarning, match=message):
        cage.save(tmp_path / f"cage{suffix}")
    again = ControlCage.from_file(tmp_path / f"cage{suffix}")
    assert (again.texcoords, list(again.attributes)) == (None, kept)


OTHER_FILES = {
    "UTF-16": ("v 0 0 0\n".encode("utf-16"), "text in UTF-16"),
    "UTF-16, no mark": ("v 0 0 0\n".encode("utf-16-le"), "text in UTF-16"),
    "UTF-16, other order": ("v 0 0 0\n".encode("utf-16-be"), "text in UTF-16"),
    "gzip": (gzip.compress(b"v 0 0 0\n"), "compressed with gzip"),
    "zip": (b"PK\x03\x04rest", "a zip archive"),
}


@pytest.mark.parametrize(("content", "what"), OTHER_FILES.values(), ids=OTHER_FILES)
def test_an_obj_file_that_is_something_else_is_called_that(content, what, tmp_path):
    path = tmp_path / "cage.obj"
    path.write_bytes(content)
    with pytest.raises(CageError, match=what):
        ControlCage.from_file(path)
