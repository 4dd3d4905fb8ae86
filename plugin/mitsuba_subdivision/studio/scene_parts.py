"""Writes a scene's in-memory data to files beside its XML file: cages, polygon meshes and images."""

from __future__ import annotations

import hashlib
import importlib.util
import os
import warnings
from collections.abc import Callable, Iterable, Mapping
from dataclasses import replace
from functools import partial
from pathlib import Path

import mitsuba as mi
import numpy as np

from ..cage import CageError, CageWarning, ControlCage
from ..cage.contents import RULES, CageContents
from ..files import ply, usd_stage
from ..files.formats import write_file
from ..shapes.parameters import is_attribute_parameter, read_attributes
from ..variants import SceneNode
from ..whole_file import require_writable, whole_file

# Properties of the shape that `ControlCage.from_arrays` takes, too.
_ARRAYS = ("positions", "face_sizes", "face_vertices", "creases", "corners", "holes")


class SceneParts:
    """Collects the parts of a scene that are in memory, and writes them to files."""

    def __init__(
        self,
        path: Path,  # Of the scene's XML file. A part of the entry NAME becomes `SCENE_NAME` with a suffix.
        inputs: Iterable[Path],  # Files that must not be written to
    ) -> None:
        self._path, self._inputs = path, list(inputs)
        self._writers: dict[Path, Callable[[Path], None]] = {}
        self._pictures: dict[str, Path] = {}

    def in_files(self, name: str, node: SceneNode) -> SceneNode:
        """A scene entry that refers to files instead of data in memory.

        Raises ValueError if something cannot be written. Raises OSError if a file cannot be written.
        """
        found = dict(node)
        if "positions" in node:
            found = self._with_cage(name, node)
        elif "mesh" in node:
            found = _with_name(self._file(name, ".ply", found.pop("mesh").save), found)
        elif "bitmap" in node:
            found = _with_name(self._picture(name, found.pop("bitmap")), found)
        if "filename" in found:
            found["filename"] = _relative(Path(found["filename"]), self._path.parent)
        for key, value in found.items():
            if isinstance(value, Mapping):
                found[key] = self.in_files(f"{name}_{key}", dict(value))
            elif isinstance(value, mi.Object):
                kind = type(value).__name__
                raise ValueError(f'"{key}" of "{name}" is an object of Mitsuba, {kind}; expected a dictionary to save')
        return found

    def write(self) -> list[Path]:
        """Write the files that have been found."""
        for path, write in self._writers.items():
            write(path)
        return list(self._writers)

    def _file(self, name: str, suffix: str, write: Callable[[Path], None]) -> Path:
        stem = f"{self._path.stem}_{name}"
        path, number = self._path.with_name(f"{stem}{suffix}"), 1
        while path in self._writers:
            number += 1
            path = self._path.with_name(f"{stem}_{number}{suffix}")
        require_writable(path, self._inputs)
        self._writers[path] = write
        return path

    def _with_cage(self, name: str, entry: SceneNode) -> SceneNode:
        contents = _contents(entry)
        suffix = _suffix_for(name, contents)
        chosen = {}
        if suffix != ".obj":
            # Rules are tags in OBJ files. Other formats cannot hold some of them; the scene can hold all.
            chosen = {rule: value for rule, value in contents.rules.items() if value != RULES[rule][0]}
            contents = replace(contents, rules={})
        beside = self._file(name, suffix, partial(write_file, contents))
        others = (*_ARRAYS, "cage_name", *RULES)
        kept = {key: value for key, value in entry.items() if key not in others and not is_attribute_parameter(key)}
        return _with_name(beside, {**kept, **chosen})

    def _picture(self, name: str, bitmap: mi.Bitmap) -> Path:
        pixels = np.array(bitmap)
        content = f"{pixels.shape} {pixels.dtype} {bitmap.srgb_gamma()}".encode() + pixels.tobytes()
        digest = hashlib.sha256(content).hexdigest()
        if digest not in self._pictures:
            # A PNG file of eight bits is decoded from sRGB.
            in_8_bits = pixels.dtype == np.uint8 and bitmap.srgb_gamma()
            if not in_8_bits:
                bitmap = bitmap.convert(component_format=mi.Struct.Type.Float32, srgb_gamma=False)

            def write(path: Path) -> None:
                with whole_file(path) as beside:
                    bitmap.write(str(beside))

            self._pictures[digest] = self._file(name, ".png" if in_8_bits else ".exr", write)
        return self._pictures[digest]


def _contents(entry: SceneNode) -> CageContents:
    """The cage described by properties of the shape ``subdivision``, without its scheme, which the scene keeps."""
    arrays = {key: np.array(entry[key]) for key in _ARRAYS if key in entry}
    rules = {key: entry[key] for key in RULES if key in entry}
    data = read_attributes(entry, lambda properties, key, _shape: np.array(properties[key]))
    with warnings.catch_warnings():
        # These warnings were issued when the scene was made.
        warnings.simplefilter("ignore", CageWarning)
        return ControlCage.from_arrays(**arrays, **rules, **data).contents


def _suffix_for(name: str, contents: CageContents) -> str:
    """The simplest file format that preserves a cage."""
    data = {**contents.attributes, **({} if contents.texcoords is None else {"texcoords": contents.texcoords})}
    if not contents.attributes and all(each.interpolation == "face_varying" for each in data.values()):
        return ".obj"
    has_tags = any(len(tags) for tags in (contents.creases, contents.corners, contents.holes))
    is_plain = not has_tags and all(each.interpolation == "vertex" for each in data.values())
    if is_plain and all(map(ply.is_possible, contents.attributes)) and importlib.util.find_spec("plyfile"):
        return ".ply"
    first = next(iter(data))
    if not importlib.util.find_spec("pxr"):
        raise CageError(
            f'"{first}" of "{name}" cannot be written to an OBJ file; expected the package usd-core, to save '
            'it as USD: pip install "mitsuba-subdivision[files]"'
        )
    for key in contents.attributes:
        if not usd_stage.is_possible(key) or key in usd_stage.TEXCOORDS:
            raise CageError(
                f'attribute "{key}" of "{name}" cannot be written to a file; expected a name of letters, digits and '
                f'"_" other than {", ".join(usd_stage.TEXCOORDS)}'
            )
    return ".usda"


def _with_name(path: Path, kept: SceneNode) -> SceneNode:
    # The type comes first, as `mi.load_dict` expects.
    return {"type": kept.pop("type"), "filename": str(path), **kept}


def _relative(path: Path, folder: Path) -> str:
    try:
        return Path(os.path.relpath(path.resolve(), folder.resolve())).as_posix()
    except ValueError:  # On Windows, there is no relative path from one drive to another.
        return path.resolve().as_posix()
