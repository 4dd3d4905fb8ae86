"""The table of file formats; readers and writers of control cages and triangles by the suffix of the file.

A new format is a module and a line in `FORMATS`.
"""

from __future__ import annotations

import errno
import os
import pkgutil
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import KW_ONLY, dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..cage import CageContents, CageError, warn
from ..mesh.connectivity import IntArray


@dataclass(frozen=True)
class Format:
    """Readers and writers of a file format, and its properties.

    Functions are named "module:function"; the module of this package is imported on first use.
    """

    read: str  # Reads `CageContents` from a path; if the format has prims, with arguments of `ControlCage.from_file`
    write: str = ""  # Takes `CageContents` and a path; empty if there is none
    write_triangles: str = ""  # Takes a path and `Triangles`; empty if there is none
    _: KW_ONLY
    has_prims: bool = False  # Whether a file may contain several meshes, and values at several times
    refers_to_files: bool = False  # Whether other files may change the contents of a file
    up: str | None = "y"  # Usual up axis of modelling programs' files, "y" or "z"; None if files store it


_USDZ = Format("usd_reader:read_usd", has_prims=True, refers_to_files=True, up=None)
_USD = replace(_USDZ, write="usd_writer:write_usd", write_triangles="usd_writer:write_usd_triangles")
# Formats by suffix. Blender, Maya and Houdini write OBJ files with y up, Blender PLY files with z up.
FORMATS = {
    ".obj": Format("obj:read_obj", "obj:write_obj", "obj:write_obj_triangles"),
    ".ply": Format("ply:read_ply", "ply:write_ply", "ply:write_ply_triangles", up="z"),
    **dict.fromkeys((".usd", ".usda", ".usdc"), _USD),
    ".usdz": _USDZ,
}


class Triangles(NamedTuple):
    """Triangles on a limit surface, and data at their vertices."""

    positions: NDArray  # (n, 3) float32 or float64
    normals: NDArray  # The same
    triangles: NDArray  # (m, 3) int: 0-based rows of the other arrays
    texcoords: NDArray | None  # (n, 2)
    attributes: Mapping[str, NDArray]  # (n, k) each


def read_file(path: str | Path, prim: str | None, time: float | None, rules: Mapping[str, str]) -> CageContents:
    """Read a file of any known format; the parameters are those of `ControlCage.from_file`."""
    known = FORMATS[_known_suffix(path, FORMATS)]
    # For other problems, the reader raises OSError.
    if os.path.isdir(path):
        raise CageError(f'"{path}" is a folder; expected a file')
    try:
        os.stat(path)
    except OSError as error:
        if error.errno == errno.ELOOP:
            raise CageError(f'"{path}" is a link that leads back to itself; expected a file') from None
    read = function_named(known.read)
    if known.has_prims:
        return read(path, prim, time, rules)
    for name, value in (("prim", prim), ("time", time)):
        if value is not None:
            suffixes = ", ".join(suffix for suffix, other in FORMATS.items() if other.has_prims)
            raise CageError(f'"{path}": {name} {value!r} was given; expected it for USD files only ({suffixes})')
    return read(path)


def write_file(contents: CageContents, path: str | Path) -> None:
    """Write a file of any known format; see `ControlCage.save`."""
    suffix = _known_suffix(path, [suffix for suffix, known in FORMATS.items() if known.write])
    function_named(FORMATS[suffix].write)(contents, path)


def is_usd(path: Path) -> bool:
    """Whether a file may contain several meshes, and values at several times."""
    return path.suffix.lower() in FORMATS and FORMATS[path.suffix.lower()].has_prims


def require_triangle_format(path: str | Path) -> str:
    """The suffix of a file of triangles. Raises ValueError if the format is unknown."""
    writable = [suffix for suffix, known in FORMATS.items() if known.write_triangles]
    return _known_suffix(path, writable, 'format "{}" of triangles', ValueError)


def write_triangles(path: str | Path, surface: Triangles) -> None:
    """Write triangles; see `Tessellation.save`."""
    function_named(FORMATS[require_triangle_format(path)].write_triangles)(path, surface)


def faces_by_name(names: Sequence[str], number: IntArray) -> dict[str, IntArray]:
    """Faces by name, from the index ``(n_f,)`` of each face's name; names may be repeated."""
    index = {name: i for i, name in enumerate(dict.fromkeys(names))}
    number = np.array([index[name] for name in names])[number]
    ends = np.cumsum(np.bincount(number, minlength=len(index)))
    faces = np.split(np.argsort(number, kind="stable"), ends[:-1])
    return {name: its_faces for name, its_faces in zip(index, faces, strict=True) if len(its_faces)}


def material_of_face(contents: CageContents) -> IntArray:
    """``(n_f,)`` index of each face's material in ``contents.materials``, the last one of several; -1 for none."""
    material = np.full(len(contents.face_sizes), -1)
    for index, faces in enumerate(contents.materials.values()):
        material[faces] = index
    return material


def warn_of_losses(path: str | Path, parts: Mapping[str, bool]) -> None:
    """Warn of parts of a cage, by name, that files of this format cannot store."""
    if lost := [name for name, is_lost in parts.items() if is_lost]:
        suffix = os.path.splitext(path)[1]
        warn(f'"{path}": {suffix} files have no place for {", ".join(lost)} of the cage; written without them')


def function_named(name: str) -> Callable[..., Any]:
    """The function of this package that a `Format` names."""
    return pkgutil.resolve_name(f"{__package__}.{name}")


def _known_suffix(
    path: str | Path, known: Iterable[str], what: str = 'cage format "{}"', error: type[ValueError] = CageError
) -> str:
    if not isinstance(path, (str, os.PathLike)):
        raise error(f"path {path!r}; expected a str or Path")
    suffix = os.path.splitext(path)[1].lower()
    if suffix not in known:
        raise error(f'"{path}": unknown {what.format(suffix)}; expected one of {", ".join(known)}')
    return suffix
