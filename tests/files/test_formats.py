"""The table of file formats."""

import gzip
import subprocess
import sys
from types import SimpleNamespace

import numpy as np
import pytest
from mitsuba_subdivision import CageError, ControlCage, LimitSurface
from mitsuba_subdivision.cage.contents import CageContents
from mitsuba_subdivision.cage.named_cages import cube
from mitsuba_subdivision.files import triangle_writer
from mitsuba_subdivision.files.formats import FORMATS, Format, function_named


@pytest.mark.parametrize("suffix", FORMATS)
def test_every_function_of_the_table_exists(suffix):
    found = FORMATS[suffix]
    names = [name for name in (found.read, found.write, found.write_triangles) if name is not None]
    assert len(names) == (1 if suffix == ".usdz" else 3)
    assert all(callable(function_named(name)) for name in names)


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
    with pytest.raises(ValueError, match=r'unknown format ".npz" of triangles'):
        LimitSurface(cube()).tessellate(2).save(tmp_path / "triangles.npz")
    assert list(triangle_writer.writers()) == [".obj", ".ply", ".usd", ".usda", ".usdc"]


def modules_after(code):
    """Modules of cages and of files that are imported after some code has run in a new process."""
    packages = ("mitsuba_subdivision.cage", "mitsuba_subdivision.files")
    code = f"import sys; {code}; print(*(name for name in sys.modules if name.startswith({packages})))"
    return subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout.split()


def test_neither_cages_nor_files_are_imported_with_the_package():
    assert modules_after("import mitsuba_subdivision") == []


def test_readers_are_imported_when_a_file_is_read(tmp_path):
    cube().save(tmp_path / "cube.obj")
    code = "from mitsuba_subdivision import ControlCage"
    assert [name for name in modules_after(code) if ".files" in name] == []
    found = modules_after(f"{code}; ControlCage.from_file({str(tmp_path / 'cube.obj')!r})")
    assert "mitsuba_subdivision.files.obj_reader" in found
    assert "mitsuba_subdivision.files.usd_reader" not in found


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
